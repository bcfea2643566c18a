"""The best stacks for a picture: the network is asked for what it can make only."""

from __future__ import annotations

from stackgen.api import Model, best
from tests.sampling.test_best import SLANT


def test_the_network_is_not_asked_for_more_blocks_than_it_knows(towers: Model) -> None:
    found = best(SLANT, 1, blocks="cube=12", cells="3")
    assert towers.world.max_blocks < 12 == len(found.entries[0].stack)
    assert "0 by the network" in found.comment
