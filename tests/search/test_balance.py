"""The quick balance of rows against the statics of planes."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from stackgen.search.balance import Balance, steadied
from stackgen.search.rows import Levels, Placed
from stackgen.sim.statics.plane import PlaneStatics, StaticsMargins
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD

LEVELS = Levels(np.ones((64, 64), dtype=bool), PAPER_WORLD)


def stack_of(blocks: list[Placed]) -> Stack:
    poses = np.zeros((len(blocks), 6))
    for i, block in enumerate(blocks):
        poses[i, 0] = LEVELS.left_end(block.left) + LEVELS.pieces[block.shape].width / 28
        poses[i, 2] = block.level + 0.5
    return Stack(np.array([block.shape for block in blocks]), poses)


def random_blocks(rng: np.random.Generator) -> list[Placed]:
    blocks: list[Placed] = []
    for level in range(int(rng.integers(1, 5))):
        left = int(rng.integers(0, 20))
        for _ in range(int(rng.integers(1, 3))):
            shape = int(rng.integers(0, 4))
            if left + LEVELS.pieces[shape].width <= 64:
                blocks.append(Placed(shape, left, level))
            left += LEVELS.pieces[shape].width + int(rng.integers(0, 14))
    return blocks


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.025, -0.1, 0.3]), st.booleans())
@settings(max_examples=150, deadline=None)
def test_blocks_hold_if_and_only_if_there_are_forces(seed: int, slope: float, any_load: bool) -> None:
    blocks = random_blocks(np.random.default_rng(seed))
    balance = Balance(blocks, LEVELS)
    loaded = [i for i, block in enumerate(blocks) if LEVELS.pieces[block.shape].head] if any_load else []
    if balance.hangs:
        assert not balance.holds(slope, loaded)
        return
    missing = nnls(balance._effects(slope, loaded), balance._needed)[1]  # another way to look for the same forces
    if not 1e-8 < missing < 1e-3:  # else rounding decides
        assert balance.holds(slope, loaded) == (missing < 1e-6)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=80, deadline=None)
def test_what_balances_stands_and_what_nothing_could_hold_does_not(seed: int) -> None:
    blocks = random_blocks(np.random.default_rng(seed))
    outcome = PlaneStatics(stack_of(blocks), 0.5, StaticsMargins()).outcome(np.arange(len(blocks)))
    balance = Balance(blocks, LEVELS)
    assert not balance.stands or outcome == "stands"
    heads = [i for i, block in enumerate(blocks) if LEVELS.pieces[block.shape].head]
    assert not balance.stands or balance.holds(loaded=heads)


def test_an_overhang_by_a_pixel_too_many_is_mended_and_one_by_half_a_cell_is_not() -> None:
    almost = [Placed(0, 20, 0), Placed(0, 27, 1)]
    assert not Balance(almost, LEVELS).stands
    mended = steadied(almost, LEVELS)
    assert mended is not None and Balance(mended, LEVELS).stands
    assert steadied([Placed(0, 20, 0), Placed(0, 31, 1)], LEVELS) is None


def test_a_counterweight_holds_what_leans() -> None:
    beam = [Placed(0, 0, 0), Placed(2, 0, 1)]
    assert not Balance(beam, LEVELS).stands
    assert Balance([*beam, Placed(0, 0, 2), Placed(0, 0, 3)], LEVELS).holds() is False
    assert Balance([*beam, Placed(0, 28, 0)], LEVELS).stands
