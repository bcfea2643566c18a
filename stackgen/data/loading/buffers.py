"""Memory that is used again."""

from __future__ import annotations

import sys
from collections import deque

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class Buffers:
    """Memory for float pictures on the CPU, used again once nobody holds what was made of it.

    64 MB a batch of 4096: to ask the system for them anew costs more than to fill them.

    Args:
        most: Buffers kept; whoever holds more batches than this gets fresh memory.
    """

    def __init__(self, most: int = 4) -> None:
        self._most = most
        self._kept: deque[NDArray[np.float32]] = deque()

    def take(self, size: int) -> Tensor:
        """(size,) float32 of any content."""
        for _ in range(len(self._kept)):
            buffer = self._kept.popleft()
            free = sys.getrefcount(buffer) == 2  # by this name and as the argument; a tensor's storage is a third
            if free and len(buffer) < size:
                continue  # too small by now: let it go
            self._kept.append(buffer)
            if free:
                return torch.from_numpy(buffer[:size])
        # numpy asks for huge pages: half the time of torch's fresh memory
        buffer = np.empty(size, np.float32)
        if len(self._kept) < self._most:
            self._kept.append(buffer)
        return torch.from_numpy(buffer[:size])
