"""Writing files so that nobody ever sees half of one."""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path

from stackgen.stack import StackgenError


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
