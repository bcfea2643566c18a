"""The real jaws: Robotiq's socket protocol, or a plain digital output.

Robotiq's URCap listens on port 63352 of the controller: lines `SET POS 255` answered by `ack`, `GET POS` answered by
`POS 255`. POS runs from 0, open, to 255, closed. PRE repeats the position asked for once the gripper knows of it; OBJ
is then 0 while the jaws move, 1 or 2 when something stopped them as they opened or closed, 3 when they got there.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from stackgen.errors import StackgenError
from stackgen.robot.real.lines import LineLink
from stackgen.robot.real.program import check_host

PORT = 63352
POSITIONS = 255
ACTIVE, MOVING, STOPPED_OPENING, HOLDS = 3, 0, 1, 2  # of STA the first, of OBJ the others

_LOOK = 0.02  # between looks at jaws that move [s]
_PATIENCE = 3.0  # with an answer [s]
_STOPPING = 5.0  # time that jaws take to stop, at most [s]
_ACTIVATION = 15.0  # an activation opens and closes them once [s]


@dataclass(frozen=True)
class Gripper:
    """How the real jaws are driven; their sizes are the workcell's.

    Args:
        kind: Robotiq's socket protocol, or a digital output of the controller.
        host: Address of Robotiq's server; the controller by default.
        port: Port of Robotiq's server.
        stroke: Opening at position 0 [m].
        weakest: Force at FOR 0 [N].
        strongest: Force at FOR 255 [N].
        speed: Speed of the jaws, as a share of the largest.
        output: Number of the standard digital output.
        closed: Level of that output while the jaws are closed.
        seconds: Time that jaws on a digital output take to open or close: they do not tell [s].
    """

    kind: Literal["robotiq", "digital"] = "robotiq"
    host: str = ""
    port: int = PORT
    stroke: float = 0.085
    weakest: float = 20.0
    strongest: float = 235.0
    speed: float = 0.5
    output: int = 0
    closed: bool = True
    seconds: float = 1.0

    def __post_init__(self) -> None:
        check_host("gripper", self.host)
        for name in ("stroke", "strongest", "seconds"):
            if not 0 < getattr(self, name) < np.inf:
                raise StackgenError(f"gripper: {name} must be positive, got {getattr(self, name):g}")
        if not 0 < self.speed <= 1:
            raise StackgenError(f"gripper: speed must lie in 0..1, got {self.speed:g}")
        if not 0 <= self.weakest < self.strongest:
            raise StackgenError("gripper: weakest must lie below strongest")
        if not 0 <= self.output <= 7:
            raise StackgenError(f"gripper: output must be one of 0 to 7, got {self.output}")
        if not 0 < self.port < 65536:
            raise StackgenError(f"gripper: port must lie in 1..65535, got {self.port}")

    def position(self, width: float) -> int:
        """Position (POS) for an opening [m].

        >>> Gripper().position(0.085), Gripper().position(0.0)
        (0, 255)
        """
        return int(np.clip(round(POSITIONS * (1 - width / self.stroke)), 0, POSITIONS))

    def opening(self, position: int) -> float:
        """Opening [m] at a POS; inverse of :meth:`position` up to its steps."""
        return self.stroke * (1 - position / POSITIONS)

    def force(self, newtons: float) -> int:
        """Number (FOR) for a force [N].

        >>> Gripper().force(20), Gripper().force(400)
        (0, 255)
        """
        share = (newtons - self.weakest) / (self.strongest - self.weakest)
        return int(np.clip(round(POSITIONS * share), 0, POSITIONS))

    @property
    def rate(self) -> int:
        """Number (SPE) for the speed."""
        return round(POSITIONS * self.speed)


class RealJaws(Protocol):
    """Real jaws. Every call returns when they are at rest."""

    def open(self, width: float) -> None:
        """Open to a width [m]."""
        ...

    def close(self, force: float) -> None:
        """Close until they meet something, or each other [N]."""
        ...

    def opening(self) -> float | None:
        """Between the pads [m]; None if they cannot tell."""
        ...

    def holds(self) -> bool | None:
        """Whether something stopped them as they closed; None if they cannot tell."""
        ...

    def disconnect(self) -> None:
        """Let go of the connection, not of the block."""
        ...


class RobotiqJaws:
    """A Robotiq two-finger gripper.

    Args:
        gripper: Settings of the gripper.
        host: Address of the controller.
        tick: Called while waiting, so that what else is alive stays so.

    Raises:
        StackgenError: If no gripper answers there.
    """

    def __init__(self, gripper: Gripper, host: str, tick: Callable[[], None] = lambda: None) -> None:
        self.gripper, self.tick = gripper, tick
        self.where = f"{gripper.host or host}:{gripper.port}"
        try:
            self._link = LineLink(gripper.host or host, gripper.port, _PATIENCE)
        except OSError as error:
            raise StackgenError(
                f"no Robotiq gripper answers at {self.where} ({error.strerror or error}): is its URCap installed?"
            ) from error

    def activate(self) -> None:
        """Activate jaws that are not: they open and close once.

        Raises:
            StackgenError: If they report a fault, or do not get ready.
        """
        if self.get("STA") == ACTIVE:
            return
        self.set(ACT=0)
        self.set(ACT=1)
        self._wait("get ready", lambda: self.get("STA") == ACTIVE, _ACTIVATION)

    def open(self, width: float) -> None:
        """Open to a width [m]."""
        if self._go(self.gripper.position(width), 0.0) == STOPPED_OPENING:
            raise StackgenError("something stopped the jaws as they opened")

    def close(self, force: float) -> None:
        """Close [N]."""
        self._go(POSITIONS, force)

    def opening(self) -> float:
        """Between the pads [m]."""
        return self.gripper.opening(self.get("POS"))

    def holds(self) -> bool:
        """Whether something stopped them as they closed."""
        return self.get("OBJ") == HOLDS

    def disconnect(self) -> None:
        """Close the socket; the gripper keeps its grip."""
        with contextlib.suppress(OSError):
            self._link.close()

    def get(self, name: str) -> int:
        """Read a variable."""
        answer = self._ask(f"GET {name}").split()
        if len(answer) != 2 or answer[0] != name or not re.fullmatch(r"-?[0-9]{1,9}", answer[1]):
            raise StackgenError(f"the gripper at {self.where} answered {' '.join(answer)!r} when asked for {name}")
        return int(answer[1])

    def set(self, **values: int) -> None:
        """Set variables, in their order."""
        words = " ".join(f"{name} {value}" for name, value in values.items())
        answer = self._ask(f"SET {words}")
        if answer != "ack":
            raise StackgenError(f"the gripper at {self.where} answered {answer!r} to SET {words}")

    def _go(self, position: int, force: float) -> int:
        """Move to a position, wait, and return OBJ."""
        self.set(FOR=self.gripper.force(force), SPE=self.gripper.rate, POS=position, GTO=1)
        self._wait("take the order", lambda: self.get("PRE") == position, _STOPPING)
        self._wait("come to rest", lambda: self.get("OBJ") != MOVING, _STOPPING)
        return self.get("OBJ")

    def _wait(self, what: str, done: Callable[[], bool], patience: float) -> None:
        end = time.monotonic() + patience
        while not done():
            self.tick()
            fault = self.get("FLT")
            if fault >= 8:  # below are reasons to wait, not faults
                raise StackgenError(f"the gripper reports fault {fault}; see its manual, and switch it off and on")
            if time.monotonic() > end:
                raise StackgenError(f"the gripper did not {what} within {patience:.0f} s")
            time.sleep(_LOOK)

    def _ask(self, line: str) -> str:
        """Send a line and read the answer; the server ends its values with a newline, its `ack` with nothing."""
        try:
            return self._link.ask(line, (b"ack",))
        except OSError as error:
            raise StackgenError(f"lost the gripper at {self.where}: {error.strerror or error}") from error


class DigitalJaws:
    """Jaws that one digital output opens and closes.

    Args:
        gripper: Settings: number of the output, its level, and how long they take.
        set_output: Sets a standard digital output to a level.
        tick: Called while waiting.
    """

    def __init__(
        self, gripper: Gripper, set_output: Callable[[int, bool], None], tick: Callable[[], None] = lambda: None
    ) -> None:
        self.gripper, self.set_output, self.tick = gripper, set_output, tick

    def open(self, width: float) -> None:
        """Open, as far as they do [m]."""
        self._switch(not self.gripper.closed)

    def close(self, force: float) -> None:
        """Close, as firmly as they do [N]."""
        self._switch(self.gripper.closed)

    def opening(self) -> None:
        """They cannot tell."""
        return None

    def holds(self) -> None:
        """They cannot tell."""
        return None

    def disconnect(self) -> None:
        """The output stays as it is."""

    def _switch(self, level: bool) -> None:
        self.set_output(self.gripper.output, level)
        end = time.monotonic() + self.gripper.seconds
        while time.monotonic() < end:
            self.tick()
            time.sleep(_LOOK)
