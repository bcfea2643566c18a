"""What a UR controller says of itself before anything is asked of it: its dashboard server, a line for a line."""

from __future__ import annotations

import contextlib
import socket
from types import TracebackType

from stackgen.errors import StackgenError

PORT = 29999

_PATIENCE = 3.0  # with an answer [s]
_SAFE = ("NORMAL", "REDUCED")


class Dashboard:
    """A connection to the dashboard server.

    Args:
        host: Of the controller.
        port: Of the server.

    Raises:
        StackgenError: If nobody answers there.
    """

    def __init__(self, host: str, port: int = PORT) -> None:
        self.where = f"{host}:{port}"
        try:
            self._socket = socket.create_connection((host, port), timeout=_PATIENCE)
        except OSError as error:
            raise StackgenError(
                f"no UR controller answers at {self.where} ({error.strerror or error}): is the arm switched on, and"
                " the address right?"
            ) from error
        self._lines = self._socket.makefile("r", encoding="utf-8", errors="replace", newline="\n")
        self._read()  # its greeting

    def ask(self, line: str) -> str:
        """Its answer."""
        try:
            self._socket.sendall(line.encode() + b"\n")
        except OSError as error:
            raise StackgenError(f"lost the controller at {self.where}: {error.strerror or error}") from error
        return self._read()

    def _read(self) -> str:
        try:
            line = self._lines.readline()
        except OSError as error:
            raise StackgenError(f"the controller at {self.where} does not answer: {error.strerror or error}") from error
        if not line:
            raise StackgenError(f"the controller at {self.where} closed the connection")
        return line.strip()

    def __enter__(self) -> Dashboard:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with contextlib.suppress(OSError):
            self._lines.close()
            self._socket.close()


def require_ready(host: str) -> None:
    """See that an arm may be moved from here: switched on, safe, idle, and, where there is such a mode, remote.

    Raises:
        StackgenError: If not; it says what to do at the pendant.
    """
    with Dashboard(host) as dashboard:
        # Arms before PolyScope 5.6 have no such mode and say that they do not understand.
        if dashboard.ask("is in remote control").lower() == "false":
            raise StackgenError(
                f"the controller at {host} is in local mode: switch it to remote control at the pendant"
            )
        safety = _value(dashboard.ask("safetymode"))
        if safety not in _SAFE:
            raise StackgenError(f"the arm at {host} is in safety mode {safety}: clear that at the pendant")
        mode = _value(dashboard.ask("robotmode"))
        if mode != "RUNNING":
            raise StackgenError(
                f"the arm at {host} is in mode {mode}: switch it on and release its brakes at the pendant"
            )
        program = dashboard.ask("programState")
        if not program.upper().startswith("STOPPED"):
            raise StackgenError(f"the controller at {host} has a program going ({program}): stop it at the pendant")


def _value(answer: str) -> str:
    """
    >>> _value("Robotmode: RUNNING")
    'RUNNING'
    """
    return answer.rpartition(":")[2].strip().upper()
