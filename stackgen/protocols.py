"""The contracts between the parts: what samples stacks, what predicts block lists, what says whether a stack stands.

Networks and heuristics answer alike, so metrics, reports and the robot never know what is behind them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stackgen.stack import Stack
from stackgen.world import Mask, World


@dataclass(frozen=True)
class Verdict:
    """What became of a stack.

    Args:
        stable: Whether no block fell: no centre sank by more than `Physics.fall_height`.
        fell: (k,) which blocks fell.
        drop: (k,) how far each block's centre sank [cell]; negative if it rose.
        settled: The blocks where they ended.
        at_rest: Whether everything stood still at the end of the watch.
        margin: Largest tilt of the ground that the stack survives [rad], where statics gave one.
    """

    stable: bool
    fell: NDArray[np.bool_]
    drop: NDArray[np.float64]
    settled: Stack
    at_rest: bool = True
    margin: float | None = None


class PhysicsNumbers(Protocol):
    """The numbers that verdicts depend on; see stackgen.sim.physics.Physics."""

    @property
    def cell_size(self) -> float: ...

    def to_json(self) -> dict[str, Any]:
        """Plain form, for files."""
        ...


class StackSampler(Protocol):
    """A method that turns silhouettes and block lists into stacks: a network or a heuristic.

    `world` is what it knows, `settings` how it samples (for the record, as JSON allows), `card` what is known
    about it: `kind`, `name`, `sha256`, and for trained weights the `dataset`; empty where nothing is known.
    """

    @property
    def world(self) -> World: ...

    @property
    def settings(self) -> Mapping[str, Any]: ...

    @property
    def card(self) -> Mapping[str, Any]: ...

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """Sample `num_samples` stacks for each of B scenes.

        Args:
            silhouettes: (B, H, W) front silhouettes.
            counts: (B, S) block lists.
            num_samples: Stacks per scene.
            seed: The same seed gives the same stacks.
        """
        ...


class BlockListPredictor(Protocol):
    """A method that turns silhouettes into block lists, the most likely first."""

    @property
    def world(self) -> World: ...

    @property
    def card(self) -> Mapping[str, Any]: ...

    def predict(self, silhouettes: Mask, top: int = 1, limit: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """Predict the most likely block lists of each silhouette.

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
    """A method that says whether stacks stand.

    `physics` holds the numbers its verdicts depend on.
    """

    @property
    def physics(self) -> PhysicsNumbers: ...

    def check(self, stack: Stack) -> Verdict:
        """Give the verdict on one stack."""
        ...

    def check_all(self, stacks: Iterable[Stack]) -> list[Verdict]:
        """Give the verdicts on many stacks, in order; one after the other where a checker knows no better."""
        return [self.check(stack) for stack in stacks]
