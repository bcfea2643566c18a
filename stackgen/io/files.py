"""Writing files so that nobody ever sees half of one."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
from pathlib import Path
from typing import Any

from stackgen.errors import StackgenError


def write_atomically(path: str | Path, data: bytes) -> None:
    """Write `data` under a temporary name in the same folder, made if missing, then put it in the place of `path`.

    Raises:
        StackgenError: If the folder cannot be made, is not writable or full; `path` is then as it was before.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name[:200]}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:  # Ctrl-C too
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
    except OSError as error:
        raise StackgenError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_json(path: str | Path, content: Any, indent: int | None = 1) -> None:
    """Write a JSON file, whole or not at all.

    Raises:
        StackgenError: If it cannot be written; `path` is then as it was before.
    """
    write_atomically(path, (json.dumps(content, indent=indent, allow_nan=False) + "\n").encode())


def require_folder(folder: Path, asked: str) -> None:
    """See that a folder is there, or can be made, and be written to.

    Args:
        folder: The folder.
        asked: What the user asked for, with which the message begins.

    Raises:
        StackgenError: If not.

    >>> require_folder(Path("no-such-folder"), "--out no-such-folder")
    """
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise StackgenError(f"{asked}: {there} is {'not writable' if there.is_dir() else 'not a folder'}")
