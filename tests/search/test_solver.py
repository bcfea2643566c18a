"""The search: its answers stand, fit, differ, and are the best of all on small worlds."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette, silhouette_iou
from stackgen.search.balance import Balance
from stackgen.search.problem import SearchSettings
from stackgen.search.rows import Levels, Placed
from stackgen.search.sampler import SearchBlockLists, SearchSampler
from stackgen.search.scale import Cells, best_scale
from stackgen.search.solver import solve
from stackgen.sim.checkers import SimulatorChecker
from stackgen.stack import Stack, layout
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Catalogue, Grid, Shape, World

HOUSE = Stack(
    np.array([1, 0, 0, 3, 3]),
    np.array([[0, 0, 0.5, 0, 0, 0]] + [[x, 0, z, 0, 0, 0] for z in (1.5, 2.5) for x in (-0.5, 0.5)]),
)
TARGET = silhouette(HOUSE, PAPER_GRID)


def test_answers_fit_stand_differ_and_are_clean() -> None:
    found = solve(TARGET, PAPER_WORLD)
    assert len(found) == 3 and len({answer.layout for answer in found}) == 3
    assert all(verdict.stable for verdict in SimulatorChecker().check_all([answer.stack for answer in found]))
    for answer in found:
        assert answer.iou == silhouette_iou(answer.stack, TARGET, PAPER_GRID) > 0.98
        assert answer.layout == layout(answer.stack, PAPER_GRID) and answer.margin > np.radians(1.4)


def test_a_given_list_is_used_up_and_an_inventory_is_not_exceeded() -> None:
    (given,) = {tuple(a.stack.counts.tolist()) for a in solve(TARGET, PAPER_WORLD, 3, block_list=HOUSE.counts)}
    assert given == tuple(HOUSE.counts.tolist())
    for answer in solve(TARGET, PAPER_WORLD, 3, inventory=np.array([4, 0, 0, 2])):
        assert (answer.stack.counts <= [4, 0, 0, 2]).all()


def test_the_firmest_answer_comes_first_where_that_is_preferred() -> None:
    by_margin = solve(TARGET, PAPER_WORLD, 3, settings=SearchSettings(prefer="margin"))
    by_fit = solve(TARGET, PAPER_WORLD, 3)
    assert by_margin[0].margin >= max(answer.margin for answer in by_fit) - 1e-9
    assert [a.margin for a in by_margin] == sorted((a.margin for a in by_margin), reverse=True)


@pytest.mark.parametrize("seed", range(4))
def test_no_combination_is_better_on_a_small_world(seed: int) -> None:
    world = World(Catalogue(PAPER_CATALOGUE.shapes[:2]), Grid(2, 2, 16, 4.0, 2.0), 4)
    rng = np.random.default_rng(seed)
    target = np.zeros((16, 16), dtype=bool)
    target[6:14, 4:12] = rng.random((2, 2)).repeat(4, 0).repeat(4, 1) < 0.7
    target[10:14, 4:8] = True
    levels = Levels(target, world)
    best = -np.inf
    rows: list[tuple[tuple[int, int], ...]] = [()]
    rows += [((s, a),) for s, a in product(range(2), range(16))]
    rows += [((0, a), (0, b)) for a in range(12) for b in range(a + 4, 13)]
    rows = [row for row in rows if all(a + levels.pieces[s].width <= 16 for s, a in row)]
    for lower in filter(None, rows):
        for upper in rows if levels.number > 1 else [()]:
            gain = sum(float(levels.gains[k, s, a]) for k, row in enumerate((lower, upper)) for s, a in row)
            if gain > best:
                blocks = [Placed(s, a, k) for k, row in enumerate((lower, upper)) for s, a in row]
                best = gain if Balance(blocks, levels).stands else best
    found = solve(target, world, 1)
    stack = found[0].stack
    left = np.round((stack.poses[:, 0] * 4 + 8) - [levels.pieces[s].width / 2 for s in stack.shapes]).astype(int)
    ours = sum(float(levels.gains[int(z), s, a]) for s, a, z in zip(stack.shapes, left, stack.poses[:, 2], strict=True))
    assert ours == pytest.approx(best)


def test_planks_and_cubes_stand_in_rows_of_their_own_heights() -> None:
    catalogue = Catalogue((Shape.box("cube", 1), Shape.box("plank", 3, 0.5)))
    world = World(catalogue, PAPER_GRID, 10)
    poses = np.array([[-1, 0, 0.5, 0, 0, 0], [1, 0, 0.5, 0, 0, 0], [0, 0, 1.25, 0, 0, 0]])
    table = Stack(np.array([0, 0, 1]), poses, catalogue)
    found = solve(silhouette(table, PAPER_GRID), world)
    assert found[0].iou > 0.97 and found[0].stack.counts.tolist() == [2, 1]


def test_the_scale_belongs_to_the_drawing() -> None:
    for high, wide in ((1, 1), (6, 1), (3, 4)):
        found = best_scale(np.ones((100 * high, 100 * wide), dtype=bool), PAPER_WORLD, Cells())
        assert found.cells == high and found.answers[0].iou > 0.98
        assert found.answers[0].stack.poses[:, 2].max() == high - 0.5
    assert best_scale(np.ones((50, 50), dtype=bool), PAPER_WORLD, Cells.parse("6x5")).world.grid.width == 6


def test_the_sampler_answers_whatever_it_is_asked() -> None:
    target = np.zeros((64, 64), dtype=bool)
    target[46:60, 25:39] = True
    stacks = SearchSampler().sample_batch(target[None], np.array([[0, 0, 0, 5]]), 2, seed=0)
    assert [len(stack) for stack in stacks[0]] == [5, 5]
    assert SearchBlockLists().predict(target[None], top=2)[0, 0].tolist() == [1, 0, 0, 0]


def test_an_inventory_that_ends_before_the_silhouette_gives_what_it_can_or_nothing() -> None:
    planks = World(Catalogue((Shape.box("cube", 1), Shape.box("plank", 3, 0.5))), PAPER_GRID, 10)
    for inventory in ([1, 0], [0, 1]):
        for answer in solve(TARGET, planks, 3, inventory=np.array(inventory)):
            assert (answer.stack.counts <= inventory).all()
    tall = silhouette(Stack(np.zeros(4, int), np.array([[0, 0, z + 0.5, 0, 0, 0] for z in range(4)])), PAPER_GRID)
    assert solve(tall, PAPER_WORLD, 3, inventory=np.array([0, 0, 0, 1]))[0].stack.counts.tolist() == [0, 0, 0, 1]


def test_bad_input_is_one_line() -> None:
    with pytest.raises(StackgenError, match="nothing is set"):
        solve(np.zeros((64, 64), dtype=bool), PAPER_WORLD)
    with pytest.raises(StackgenError, match="64 pixels square"):
        solve(np.ones((32, 32), dtype=bool), PAPER_WORLD)
    with pytest.raises(StackgenError, match="effort"):
        SearchSettings(effort=0)
    for text in ("9", "0", "6x", "axb", "6x9", ""):
        with pytest.raises(StackgenError, match="cells"):
            Cells.parse(text)
