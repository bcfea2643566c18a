"""Two questions to one rollout: is the stack good enough to be data (accept), and did a block fall (fell)?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import tilt
from stackgen.protocols import Verdict
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Rollout, Simulator
from stackgen.stack import Stack


@dataclass(frozen=True)
class AcceptLimits:
    """How far a stack may settle and still be called the stack that was put down.

    Args:
        displacement: Largest displacement of a block's centre along an axis [cell].
        tilt: Largest change of the angle between a block and the vertical [rad].
    """

    displacement: float = 0.2
    tilt: float = 0.1


def accept(rollout: Rollout, limits: AcceptLimits) -> bool:
    """Tell whether the settled stack is good enough to be data: at rest, near where it began, upright."""
    moved = np.abs(rollout.end.poses[:, :3] - rollout.start.poses[:, :3]).max(initial=0)
    leaned = np.abs(tilt(rollout.end.poses) - tilt(rollout.start.poses)).max(initial=0)
    return bool(rollout.at_rest and moved <= limits.displacement and leaned <= limits.tilt)


def fell(rollout: Rollout, physics: Physics) -> NDArray[np.bool_]:
    """Tell which blocks (k,) fell to a layer below where they began (paper, "Evaluation in simulation")."""
    return rollout.drop > physics.fall_height


def judged(rollout: Rollout, physics: Physics) -> Verdict:
    """Give the verdict that follows from a rollout."""
    fallen = fell(rollout, physics)
    return Verdict(not fallen.any(), fallen, rollout.drop, rollout.end, rollout.at_rest)


class SimulatorChecker:
    """A StabilityChecker that asks an engine, Bullet or MuJoCo.

    Args:
        physics: Numbers of the physics, and the engine; the project's own by default.
        until_fall: End a rollout at the first fall: the same verdicts, sooner; but the settled
            poses of unstable stacks are then those of that moment.
    """

    def __init__(self, physics: Physics | None = None, until_fall: bool = False) -> None:
        self.simulator = Simulator(physics)
        self.until_fall = until_fall

    @property
    def physics(self) -> Physics:
        """The numbers that its verdicts hold for."""
        return self.simulator.physics

    def check(self, stack: Stack) -> Verdict:
        """Give the verdict on one stack."""
        return judged(self.simulator.rollout(stack, until_fall=self.until_fall), self.physics)

    def check_all(self, stacks: Iterable[Stack]) -> list[Verdict]:
        """Give the verdicts on many stacks, in order."""
        return [self.check(stack) for stack in stacks]
