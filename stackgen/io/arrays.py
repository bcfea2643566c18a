"""Arrays of numpy's format out of files that anybody may have made: no header makes room for what is not there."""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LARGE = 2**30
_RATIO = 200
"""What is unpacked may be so many times as large as the file, or `_LARGE` [byte]; silhouettes pack twentyfold."""

_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, SyntaxError, EOFError),
    *(LookupError, TypeError, ValueError, RuntimeError, OverflowError, OSError),
)
"""What zipfile and numpy raise at bytes that are not as they were written."""

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_npy(content: bytes) -> NDArray[Any]:
    """Read a `.npy` file from its bytes.

    Raises:
        ValueError: If it is none, holds objects, or its header promises other than is there.
    """
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        shape, _, kind = _HEADERS[version](file)
    except _DAMAGED as error:
        raise ValueError(f"no array that is read here: {' '.join(str(error).split())}") from error
    if kind.hasobject or math.prod(shape) * kind.itemsize != len(content) - file.tell():
        raise ValueError(f"an array {kind} {shape} in {len(content) - file.tell()} bytes")
    file.seek(0)
    return np.load(file, allow_pickle=False)


def read_npz(content: bytes) -> dict[str, NDArray[Any]]:
    """Read a `.npz` file from its bytes.

    Raises:
        ValueError: If it is none, is packed beyond belief, or holds anything but plain arrays.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
    except _DAMAGED as error:
        raise ValueError(" ".join(str(error).split())) from error
    with archive:
        size = sum(member.file_size for member in archive.infolist())
        if size > max(_LARGE, _RATIO * len(content)):
            raise ValueError(f"{size} bytes are packed into {len(content)}")
        return {name.removesuffix(".npy"): read_npy(_unpacked(archive, name)) for name in archive.namelist()}


def _unpacked(archive: zipfile.ZipFile, name: str) -> bytes:
    try:
        return archive.read(name)
    except _DAMAGED as error:
        raise ValueError(f"{name} is damaged: {' '.join(str(error).split())}") from error
