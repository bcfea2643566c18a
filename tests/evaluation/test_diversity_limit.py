"""The search for layouts against naive counting, and the diversity limit against all draws there are."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest

from stackgen.data.generation.designs import Design, DesignSettings, draw_design, realize
from stackgen.errors import StackgenError
from stackgen.evaluation.diversity_limit import answers, cell_runs, designs, expected_diversity, layout_of
from stackgen.evaluation.metrics import SampleScore, SceneScore, valid_diversity
from stackgen.geometry import silhouette
from stackgen.protocols import StabilityChecker, Verdict
from stackgen.sampling.feasible import can_make
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.physics import Physics
from stackgen.stack import Stack, layout
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Grid, Mask, Shape, World
from stackgen.world import Catalogue as Shapes

EXACT = DesignSettings(displacement=0.0)
SMALL = Grid(width=3, height=2)
SMALL_WORLD = World(PAPER_CATALOGUE, SMALL, 10)
WIDTHS = (1, 2, 3, 1)
TRIANGLE = 3


def put(template: Design, grid: Grid = PAPER_GRID, displaced: int | None = None) -> Stack:
    """A design on its cells, or displaced at random."""
    settings = EXACT if displaced is None else DesignSettings()
    return realize(template, np.random.default_rng(displaced), World(PAPER_CATALOGUE, grid, 10), settings)


def drawn(number: int, seed: int = 0) -> list[Design]:
    rng = np.random.default_rng(seed)
    return [draw_design(rng, PAPER_WORLD) for _ in range(number)]


def every_row(width: int, triangles: bool) -> list[tuple[tuple[int, int], ...]]:
    """All rows of blocks on so many cells, gaps and all, the empty one too."""

    def from_cell(cell: int) -> Iterator[tuple[tuple[int, int], ...]]:
        if cell >= width:
            yield ()
            return
        yield from from_cell(cell + 1)
        for shape, wide in enumerate(WIDTHS):
            if cell + wide <= width and (triangles or shape != TRIANGLE):
                yield from (((shape, cell), *rest) for rest in from_cell(cell + wide))

    return list(from_cell(0))


def hangs(template: Design) -> bool:
    """Whether a block of the upper row has nothing below it, nor right beside that."""
    lower = {left + i for shape, left in template.rows[0] for i in range(WIDTHS[shape])}
    return any(lower.isdisjoint(range(left - 1, left + WIDTHS[shape] + 1)) for shape, left in template.rows[1])


def test_the_search_finds_what_naive_counting_finds() -> None:
    by_question: dict[tuple[bytes, tuple[int, ...]], set[Design]] = {}
    pictures: dict[bytes, Mask] = {}
    for lower, upper in itertools.product(every_row(3, False), every_row(3, True)):
        template = Design((lower, upper))
        if lower and upper and not hangs(template):
            stack = put(template, SMALL)
            picture = silhouette(stack, SMALL)
            pictures[picture.tobytes()] = picture
            by_question.setdefault((picture.tobytes(), tuple(stack.counts.tolist())), set()).add(template)
    assert max(map(len, by_question.values())) > 2
    for (picture_bytes, counts), expected in by_question.items():
        found = list(designs(pictures[picture_bytes], counts, SMALL_WORLD))
        assert Counter(found) == Counter(expected)  # each once


@pytest.mark.parametrize("displaced", [None, 1, 2])
def test_a_design_is_among_the_answers_to_its_own_silhouette(displaced: int | None) -> None:
    for template in drawn(15):
        stack = put(template, displaced=displaced)
        found = list(designs(silhouette(stack, PAPER_GRID), stack.counts, PAPER_WORLD))
        assert template in found


def test_all_answers_fill_the_same_cells_with_the_same_blocks() -> None:
    several = 0
    for template in drawn(15):
        stack = put(template)
        target, runs = silhouette(stack, PAPER_GRID), cell_runs(silhouette(stack, PAPER_GRID), PAPER_WORLD)
        found = [put(other) for other in designs(target, stack.counts, PAPER_WORLD)]
        several += len(found) > 1
        for other in found:
            assert np.array_equal(other.counts, stack.counts)
            assert np.array_equal(silhouette(other, PAPER_GRID), target)
            assert cell_runs(silhouette(other, PAPER_GRID), PAPER_WORLD) == runs
        assert len({layout(other, PAPER_GRID) for other in found}) == len(found)  # a design is a layout
    assert several > 5


def test_the_layout_of_a_design_is_that_of_its_stack() -> None:
    for template in drawn(10):
        assert layout_of(template, PAPER_GRID) == layout(put(template, displaced=3), PAPER_GRID)


def test_the_mirror_image_has_as_many_answers() -> None:
    for template in drawn(10, seed=1):
        stack = put(template)
        target = silhouette(stack, PAPER_GRID)
        found = {other.mirrored(PAPER_WORLD) for other in designs(target, stack.counts, PAPER_WORLD)}
        assert set(designs(target[:, ::-1], stack.counts, PAPER_WORLD)) == found


def test_a_list_has_answers_only_if_it_can_make_the_silhouette() -> None:
    target = silhouette(put(drawn(1, seed=4)[0]), PAPER_GRID)
    lists = [counts for counts in itertools.product(range(7), range(5), range(4), range(3)) if 0 < sum(counts) <= 10]
    some = {counts for counts in lists if any(True for _ in designs(target, counts, PAPER_WORLD))}
    assert some and some <= {counts for counts in lists if can_make(target, counts, PAPER_WORLD)}


def test_a_triangle_stands_on_top_alone() -> None:
    low = put(Design((((0, 0), (3, 2)), ((0, 0),))))
    assert list(designs(silhouette(low, PAPER_GRID), low.counts, PAPER_WORLD)) == []
    assert (
        len(list(designs(silhouette(low, PAPER_GRID), low.counts, PAPER_WORLD, DesignSettings(top_row_only=())))) == 1
    )


def test_shapes_of_another_height_are_refused_in_one_line() -> None:
    flat = Shapes((Shape.box("cube", 1), Shape.box("tile", 1, 0.5)))
    with pytest.raises(StackgenError, match="one cell high"):
        list(designs(np.ones((64, 64), bool), [1, 1], World(flat, PAPER_GRID, 10)))


class Says(StabilityChecker):
    """A checker that says the same of all stacks, or asks for blocks off their cells; nothing moves."""

    physics = Physics()

    def __init__(self, stable: bool = True, off_the_cells: bool = False, shift: float = 0.0) -> None:
        self.stable, self.off_the_cells, self.shift = stable, off_the_cells, shift

    def check(self, stack: Stack) -> Verdict:
        """Give its opinion."""
        off = bool(np.abs(2 * stack.poses[:, 0] - np.round(2 * stack.poses[:, 0])).max() > 1e-9)
        stands = self.stable and (off or not self.off_the_cells)
        moved = stack.with_poses(stack.poses + np.eye(6)[0] * self.shift)
        return Verdict(stands, np.full(len(stack), not stands), np.zeros(len(stack)), moved)


def test_valid_is_what_stands_and_matches() -> None:
    stack = put(drawn(1, seed=2)[0])
    target, counts = silhouette(stack, PAPER_GRID), stack.counts
    everything = answers(target, counts, Says(), PAPER_WORLD)
    assert everything.valid == everything.matching and len(everything.matching) > 1
    assert answers(target, counts, Says(stable=False), PAPER_WORLD).valid == ()
    assert answers(target, counts, Says(shift=2.0), PAPER_WORLD).valid == ()


def test_a_design_is_displaced_before_it_is_given_up() -> None:
    stack = put(drawn(1, seed=2)[0])
    target, counts = silhouette(stack, PAPER_GRID), stack.counts
    lucky = Says(off_the_cells=True)
    assert answers(target, counts, lucky, PAPER_WORLD, placements=0).valid == ()
    assert (
        answers(target, counts, lucky, PAPER_WORLD, placements=2).valid
        == answers(target, counts, Says(), PAPER_WORLD).matching
    )


def test_the_simulator_keeps_what_is_held_up() -> None:
    """A tower stands; a cube beside another, with nothing but air below, does not, though it matches."""
    simulator = SimulatorChecker(until_fall=True)
    tower = put(Design((((0, 2),), ((0, 2),), ((3, 2),))))
    found = answers(silhouette(tower, PAPER_GRID), tower.counts, simulator, PAPER_WORLD)
    assert found.matching == found.valid == (((0,), (0,), (3,), ()),)
    ledge = put(Design((((0, 2),), ((0, 2), (0, 3)))))
    fallen = answers(silhouette(ledge, PAPER_GRID), ledge.counts, simulator, PAPER_WORLD, placements=4)
    assert len(fallen.matching) == 1 and fallen.valid == ()


@pytest.mark.parametrize(("number", "samples"), [(1, 3), (2, 3), (3, 3), (4, 2), (5, 1)])
def test_the_limit_is_the_metric_s_mean_over_all_draws(number: int, samples: int) -> None:
    rows = [((shape,), (), (), ()) for shape in range(number)]
    scores = [SampleScore(True, {"front": 1.0}, 1.0, row) for row in rows]
    draws = [valid_diversity(SceneScore(some))[0] for some in itertools.product(scores, repeat=samples)]
    assert expected_diversity(number, samples) == pytest.approx(np.mean(draws))


def test_uneven_draws_are_less_diverse() -> None:
    rng = np.random.default_rng(0)
    for shares in rng.dirichlet(np.ones(6), size=20):
        assert (1 - (1 - shares) ** 3).sum() / 3 <= expected_diversity(6, 3) + 1e-12
