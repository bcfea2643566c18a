"""What a UR controller says of itself before anything is asked of it, by its dashboard server.

The server is asked by a few lines of our own: ur-rtde's client waits for ever for an answer that has no end, and keeps
all of it.
"""

from __future__ import annotations

import contextlib
import re

from stackgen.errors import StackgenError
from stackgen.robot.real.lines import LineLink

PORT = 29999

_PATIENCE = 3.0  # with the connection, and with each answer [s]
_SAFE = ("NORMAL", "REDUCED")
_REMOTE_SINCE = (5, 6)
"""The version of PolyScope that brought remote control."""


def require_ready(host: str) -> None:
    """See that an arm may be moved from here: switched on, safe, idle, and, where there is such a mode, remote.

    Raises:
        StackgenError: If not; it says what to do at the pendant.
    """
    try:
        link = LineLink(host, PORT, _PATIENCE)
    except OSError as error:
        raise StackgenError(
            f"no UR controller answers at {host}:{PORT} ({in_a_line(error)}): is the arm switched on, and is the"
            " address right?"
        ) from error
    try:
        link.read()  # its greeting
        _require_ready(link, host)
    except (OSError, ValueError) as error:
        raise StackgenError(
            f"the controller at {host}:{PORT} does not answer as a UR's does: {in_a_line(error)}"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            link.close()


def _require_ready(link: LineLink, host: str) -> None:
    version = re.search(r"(\d{1,4})\.(\d{1,4})", answer := link.ask("PolyscopeVersion"))
    if version is None:
        raise ValueError(f"its version is {answer[:80]!r}")
    if (int(version[1]), int(version[2])) >= _REMOTE_SINCE and link.ask("is in remote control").lower() != "true":
        raise StackgenError(f"the controller at {host} is in local mode: switch it to remote control at the pendant")
    safety = _value(link.ask("safetymode"), "safetymode")
    if safety not in _SAFE:
        raise StackgenError(f"the arm at {host} is in safety mode {safety}: clear that at the pendant")
    mode = _value(link.ask("robotmode"), "robotmode")
    if mode != "RUNNING":
        raise StackgenError(f"the arm at {host} is in mode {mode}: switch it on and release its brakes at the pendant")
    program = link.ask("programState")
    if not program.upper().startswith("STOPPED"):
        raise StackgenError(f"the controller at {host} has a program going ({program}): stop it at the pendant")


def _value(answer: str, name: str) -> str:
    """Read the value out of an answer.

    Raises:
        ValueError: If it is the answer to something else.

    >>> _value("Robotmode: RUNNING", "robotmode")
    'RUNNING'
    """
    match = re.fullmatch(rf"{name}: *(\w{{1,40}})", answer, re.IGNORECASE | re.ASCII)
    if match is None:
        raise ValueError(f"it answers {answer[:80]!r} to {name}")
    return match[1].upper()


def in_a_line(error: BaseException) -> str:
    """Write what is said of an error in a line."""
    return " ".join(str(getattr(error, "strerror", None) or error).split())
