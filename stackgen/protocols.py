"""The contracts that keep the parts apart: whoever samples, predicts a block list or judges.

Networks and heuristics answer alike, so metrics, reports and the robot never know what is behind them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from stackgen.stack import Stack
from stackgen.world import Mask


@dataclass(frozen=True)
class Verdict:
    """What became of a stack.

    Args:
        stable: No block fell (SPEC: no centre dropped by more than half a cell).
        fell: (k,) which blocks fell.
        drop: (k,) how far each block's centre sank [cell]; negative if it rose.
        settled: The blocks where they ended.
        at_rest: Whether everything stood still at the end of the watch.
        margin: Largest tilt of the ground that the stack survives [rad], where an equilibrium
            check gave one.
    """

    stable: bool
    fell: NDArray[np.bool_]
    drop: NDArray[np.float64]
    settled: Stack
    at_rest: bool = True
    margin: float | None = None


Judge = Literal["simulator", "statics"]
"""Who can be asked for verdicts by name."""


class StackSampler(Protocol):
    """Silhouette and block list in, stacks out: networks and heuristics alike."""

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """Sample `num_samples` stacks for each of B scenes.

        Args:
            silhouettes: (B, H, W) front silhouettes.
            counts: (B, S) block lists.
            num_samples: Stacks per scene.
            seed: Same seed, same stacks.
        """
        ...


class BlockListPredictor(Protocol):
    """Silhouette in, block lists out, the most likely first."""

    def predict(self, silhouettes: Mask, top: int = 1, limit: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """The most likely block lists of each silhouette.

        Args:
            silhouettes: (B, H, W).
            top: How many lists.
            limit: (S,) an inventory: at most so many of each shape; None for no limit.

        Returns:
            (B, top, S) block lists in order of their probability; fewer than `top` where the limit
            allows fewer.

        Raises:
            StackgenError: If the limit allows no block at all.
        """
        ...


class StabilityChecker(Protocol):
    """Stack in, verdict out."""

    def check(self, stack: Stack) -> Verdict:
        """Judge one stack."""
        ...


def check_all(checker: StabilityChecker, stacks: Sequence[Stack]) -> list[Verdict]:
    """Judge many stacks; at once where the checker can."""
    many = getattr(checker, "check_all", None)
    return many(stacks) if many else [checker.check(stack) for stack in stacks]
