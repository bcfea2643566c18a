"""Tasks over which their process dies; they import little, as each death costs a new process."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stackgen.errors import StackgenError


@dataclass(frozen=True)
class Deadly:
    """Squares numbers; dies over some of them, so many times.

    Args:
        folder: Where deaths are counted.
        deadly: How often each number kills.
        how: What dying is.
    """

    folder: Path
    deadly: dict[int, int]
    how: Callable[[], None]

    def __call__(self, number: int) -> int:
        marks = list(self.folder.glob(f"{number}-*"))
        if len(marks) < self.deadly.get(number, 0):
            (self.folder / f"{number}-{len(marks)}").touch()
            self.how()
        return number**2


def killed() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def out_of_memory() -> None:
    raise MemoryError


def refused() -> None:
    raise StackgenError("no such thing")


def slow(number: int) -> int:
    time.sleep(0 if number == 0 else 60)
    return number
