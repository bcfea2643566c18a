"""What is delivered is clean: no block in another, none in the air."""

from __future__ import annotations

import numpy as np

from stackgen.sampling.clean import as_settled
from stackgen.sim.statics.fit import CLEAN, overlaps_and_gaps
from stackgen.stack import Stack


def tower(*heights: float) -> Stack:
    """Cubes above each other, their centres at these heights."""
    return Stack(np.zeros(len(heights), dtype=np.int64), np.array([[0, 0, z, 0, 0, 0] for z in heights]))


def test_what_stands_is_delivered_where_it_came_to_rest() -> None:
    from stackgen.sim.checkers import SimulatorChecker

    proposed = [tower(0.5, 1.45), tower(0.55, 1.6, 2.58), tower(0.5, 2.9)]
    assert all(overlaps_and_gaps(stack).largest_overlap + overlaps_and_gaps(stack).largest_gap > CLEAN
               for stack in proposed)  # fmt: skip
    *clean, (fallen, verdict) = as_settled(proposed, SimulatorChecker())
    for stack, said in clean:
        fit = overlaps_and_gaps(stack)
        assert said.stable and max(fit.largest_overlap, fit.largest_gap) <= CLEAN
        assert np.abs(said.settled.poses - stack.poses).max() < 0.01  # it does not move any more
    assert not verdict.stable and fallen is proposed[2]
