"""Writing files so that nobody ever sees half of one."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from stackgen.errors import StackgenError


def write_atomically(path: str | Path, data: bytes | memoryview) -> None:
    """Write a file whole or not at all: under a temporary name in its folder, made if missing, then in its place.

    What is no file, such as /dev/null, is written to and not replaced.

    Raises:
        StackgenError: If the folder cannot be made, is not writable or full; `path` is then as it was before.
    """
    path = Path(path)
    if path.is_absolute() and path.parts[1] in ("dev", "proc"):
        return _write_to_device(path, data)
    temporary = path.with_name(f".{path.name[:200]}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
            _flush_folder(path.parent)
        except BaseException:  # Ctrl-C too
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
    except OSError as error:
        raise StackgenError(f"{path}: cannot be written: {error.strerror or error}") from error


def _write_to_device(path: Path, data: bytes | memoryview) -> None:
    try:
        with path.open("wb") as device:
            device.write(data)
    except OSError as error:
        raise StackgenError(f"{path}: cannot be written: {error.strerror or error}") from error


_LEFT_OVER = re.compile(r"\..+\.[0-9a-f]{8}\.tmp")


def is_left_over(name: str) -> bool:
    """Tell whether a file's name is one that a killed :func:`write_atomically` leaves behind.

    >>> is_left_over(".train-000000.tar.0123abcd.tmp"), is_left_over("notes.tmp")
    (True, False)
    """
    return _LEFT_OVER.fullmatch(name) is not None


@contextlib.contextmanager
def held(folder: Path, shared: bool = False) -> Iterator[None]:
    """Keep a folder from other commands as long as the block runs; nothing is left behind, even by a kill.

    Args:
        folder: The folder.
        shared: Whether others may hold it, too, if they share it.

    Raises:
        StackgenError: If another command holds it.
    """
    number = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(number, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StackgenError(f"another command is at work in {folder}: wait until it has ended") from None
        except OSError:
            pass  # some file systems of networks have no locks of folders
        yield
    finally:
        os.close(number)


def _flush_folder(folder: Path) -> None:
    """Have the new name survive a power cut, where the file system knows how."""
    with contextlib.suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def write_json(path: str | Path, content: Any, indent: int | None = 1) -> None:
    """Write a JSON file, whole or not at all.

    Raises:
        StackgenError: If it cannot be written; `path` is then as it was before.
    """
    write_atomically(path, (json.dumps(content, indent=indent, allow_nan=False) + "\n").encode())


@contextlib.contextmanager
def staged(folder: Path, replaces: str) -> Iterator[Path]:
    """Give a temporary folder whose files move to `folder` when the block ends, and vanish when it fails.

    Args:
        folder: Folder of the files, made if missing.
        replaces: Pattern of the files of an earlier result that are removed unless they are written again.
    """
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    stage = Path(tempfile.mkdtemp(prefix=".stackgen-", dir=folder))
    try:
        yield stage
        names = {file.name for file in stage.iterdir()}
        for old in folder.glob(replaces):
            if old.name not in names:
                old.unlink()
        for name in names:
            os.replace(stage / name, folder / name)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        if new and not any(folder.iterdir()):
            folder.rmdir()


_ENDLESS = ("/dev/zero", "/dev/full", "/dev/random", "/dev/urandom")
_OWN_PIPES = ("/dev/fd/", "/dev/stdin", "/proc/self/fd/")
"""Where a shell puts what a command is given by `<(...)`."""


def open_bytes(path: str | Path) -> BinaryIO:
    """Open a file to read; what is no file, such as a pipe that nobody writes to, is not waited for.

    Raises:
        OSError: If it cannot be read.
    """
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(number).st_mode) and not str(path).startswith(_OWN_PIPES):
        os.close(number)
        kind = errno.EISDIR if Path(path).is_dir() else errno.EINVAL
        raise OSError(kind, os.strerror(kind) if kind == errno.EISDIR else "it is no regular file", str(path))
    os.set_blocking(number, True)
    return os.fdopen(number, "rb")


def read_bytes(path: str | Path) -> bytes:
    """Read a whole file, as :func:`open_bytes` opens it.

    Raises:
        OSError: If it cannot be read.
    """
    with open_bytes(path) as file:
        return file.read()


def is_endless(path: str) -> bool:
    """Tell whether a path is a pipe, a socket or a device that may never end; a shell's own do not count."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # ValueError: a NUL in the name
        return False
    endless = stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode) or os.path.realpath(path) in _ENDLESS
    return endless and not path.startswith(_OWN_PIPES)


def require_folder(folder: Path, asked: str) -> None:
    """See that a folder is there or can be made, and can be written to.

    Args:
        folder: The folder.
        asked: What the user asked for; the message begins with it.

    Raises:
        StackgenError: If it cannot.

    >>> require_folder(Path("no-such-folder"), "--out no-such-folder")
    """
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise StackgenError(f"{asked}: {there} is {'not writable' if there.is_dir() else 'not a folder'}")
