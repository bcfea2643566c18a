"""What a build asks of an arm, simulated or real, and how an arm carries out a plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.robot.planning.motion import Action, Motion, Open
from stackgen.robot.planning.plan import BlockPlan, BuildPlan

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ArmState:
    """What an arm says of itself.

    Args:
        joints: (n,) joint angles [rad].
        opening: Distance between the pads [m].
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
        """Tell where it stands."""
        ...

    def stop(self) -> None:
        """Stop at once and stay."""
        ...


def execute(
    plan: BuildPlan,
    arm: ArmBackend,
    *,
    on_start: Callable[[BlockPlan], None] = lambda step: None,
    on_release: Callable[[BlockPlan], None] = lambda step: None,
    on_done: Callable[[BlockPlan], None] = lambda step: None,
) -> None:
    """Have an arm carry out a plan.

    Args:
        plan: Plan from :func:`stackgen.robot.planning.plan.plan_build`.
        arm: Arm at the place where the first motion starts.
        on_start, on_release, on_done: Called before each block, when the jaws have let it go, and after it.

    Raises:
        StackgenError: If the arm stops on its own.
    """
    for step in plan.blocks:
        on_start(step)
        last_open = max(i for i, action in enumerate(step.actions) if isinstance(action, Open))
        for number, action in enumerate(step.actions):
            _perform(action, arm)
            stopped = arm.state().stopped
            if stopped is not None:
                raise StackgenError(f"the arm stopped at block {step.block}: {stopped}")
            if number == last_open:
                on_release(step)
        on_done(step)
    if plan.homing is not None:
        arm.move(plan.homing)


def _perform(action: Action, arm: ArmBackend) -> None:
    if isinstance(action, Motion):
        arm.move(action)
    elif isinstance(action, Open):
        arm.open(action.width)
    else:
        arm.close(action.force)
