"""What a build asks of an arm, simulated or real, and the steps that it is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stackgen.robot.planning.motion import Motion

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ArmState:
    """What an arm says of itself.

    Args:
        joints: (6,) angles [rad].
        opening: Between the pads [m].
        stopped: Why it does not move on (a protective stop, a lost connection); None while all is well.
    """

    joints: Floats
    opening: float
    stopped: str | None = None


class ArmBackend(Protocol):
    """An arm with parallel jaws. Every call returns when it is done."""

    def move(self, motion: Motion) -> None:
        """Follow a motion from where it starts, which is where the arm stands, to its end."""
        ...

    def open(self, width: float) -> None:
        """Open the jaws to a width between the pads [m]."""
        ...

    def close(self, force: float) -> None:
        """Close the jaws until they meet a block, or each other, and keep pressing [N]."""
        ...

    def state(self) -> ArmState:
        """Where it stands."""
        ...

    def stop(self) -> None:
        """Stop at once and stay."""
        ...


@dataclass(frozen=True)
class Open:
    """Open the jaws.

    Args:
        width: Between the pads [m].
    """

    width: float


@dataclass(frozen=True)
class Close:
    """Close the jaws.

    Args:
        force: [N].
    """

    force: float


Action = Motion | Open | Close
"""One thing an arm does."""


def perform(action: Action, arm: ArmBackend) -> None:
    """Have an arm do it."""
    if isinstance(action, Motion):
        arm.move(action)
    elif isinstance(action, Open):
        arm.open(action.width)
    else:
        arm.close(action.force)
