"""What a UR controller says of itself before anything is asked of it, by ur-rtde's client of its dashboard server."""

from __future__ import annotations

from typing import Any

from stackgen.errors import StackgenError, require

PORT = 29999

_PATIENCE = 3000  # with the connection [ms]; the client itself waits 2.5 s for an answer
_SAFE = ("NORMAL", "REDUCED")
_REMOTE_SINCE = (5, 6)
"""The version of PolyScope that brought remote control."""


def require_ready(host: str) -> None:
    """See that an arm may be moved from here: switched on, safe, idle, and, where there is such a mode, remote.

    Raises:
        StackgenError: If not; it says what to do at the pendant.
    """
    dashboard = require("dashboard_client", "ur").DashboardClient(host, PORT)
    try:
        dashboard.connect(_PATIENCE)
    except (RuntimeError, ValueError) as error:
        raise StackgenError(
            f"no UR controller answers at {host}:{PORT} ({in_a_line(error)}): is the arm switched on, and is the"
            " address right?"
        ) from error
    try:
        _require_ready(dashboard, host)
    except (RuntimeError, ValueError) as error:  # silence, a closed connection, or what is no text
        raise StackgenError(
            f"the controller at {host}:{PORT} does not answer as a UR's does: {in_a_line(error)}"
        ) from error
    finally:
        dashboard.disconnect()


def _require_ready(dashboard: Any, host: str) -> None:
    version = tuple(int(number) for number in dashboard.polyscopeVersion().split(".")[:2])
    if version >= _REMOTE_SINCE and not dashboard.isInRemoteControl():
        raise StackgenError(f"the controller at {host} is in local mode: switch it to remote control at the pendant")
    safety = _value(dashboard.safetymode())
    if safety not in _SAFE:
        raise StackgenError(f"the arm at {host} is in safety mode {safety}: clear that at the pendant")
    mode = _value(dashboard.robotmode())
    if mode != "RUNNING":
        raise StackgenError(f"the arm at {host} is in mode {mode}: switch it on and release its brakes at the pendant")
    program = dashboard.programState()
    if not program.upper().startswith("STOPPED"):
        raise StackgenError(f"the controller at {host} has a program going ({program}): stop it at the pendant")


def _value(answer: str) -> str:
    """Read the value out of an answer.

    >>> _value("Robotmode: RUNNING")
    'RUNNING'
    """
    return answer.rpartition(":")[2].strip().upper()


def in_a_line(error: BaseException) -> str:
    """Write what the client says of an error in a line."""
    return " ".join(str(error).split())
