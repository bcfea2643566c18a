"""Each metric against a naive reference, in every form it can be accumulated."""

from __future__ import annotations

import copy
import itertools
import pickle
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torchmetrics import Metric

from stackgen.data.generation.templates import draw_template, realize
from stackgen.errors import StackgenError
from stackgen.evaluation.metrics import (
    SCENE_METRICS,
    AverageIoU,
    Diversity,
    FrontIoU,
    FrontIoUBeforePhysics,
    IoUGivenStable,
    ListFeasibility,
    SampleScore,
    SceneScore,
    StabilityRate,
    TopK,
    ValidDiversity,
    list_rank,
    scene_metrics,
    score_sample,
)
from stackgen.geometry import iou, silhouette
from stackgen.protocols import Verdict
from stackgen.sampling.feasible import can_make, layout
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, Catalogue, Shape, View

CUBE, RECTANGLE, LONG, TRIANGLE = range(4)


def row(*blocks: tuple[int, float], level: int = 0) -> Stack:
    """Blocks of one layer: (shape, x of the centre)."""
    return Stack(np.array([s for s, _ in blocks]), np.array([[x, 0, level + 0.5, 0, 0, 0] for _, x in blocks]))


def pile(*rows: Stack) -> Stack:
    """Rows on top of each other."""
    shapes = np.concatenate([r.shapes for r in rows])
    poses = np.concatenate([r.poses + np.array([0, 0, level, 0, 0, 0]) for level, r in enumerate(rows)])
    return Stack(shapes, poses)


def random_scenes(count: int, seed: int) -> list[SceneScore]:
    """Scores of all kinds: fallen, standing, alike, with and without side and top."""
    rng = np.random.default_rng(seed)
    scenes = []
    for _ in range(count):
        views: tuple[View, ...] = ("front", "side", "top") if rng.random() < 0.7 else ("front",)
        samples = []
        for _ in range(3):
            stable = bool(rng.random() < 0.7)
            ious = {view: float(rng.uniform(0.6, 1)) if stable else 0.0 for view in views}
            samples.append(SampleScore(stable, ious, float(rng.random()), ((int(rng.integers(3)),), (0,))))
        scenes.append(SceneScore(tuple(samples)))
    return scenes


# The references: loops over what the definition says, sharing nothing with the code under test.


def ref_stability(scenes: list[SceneScore]) -> float:
    return float(np.mean([s.stable for scene in scenes for s in scene.samples]))


def ref_front(scenes: list[SceneScore]) -> float:
    return float(np.mean([s.ious["front"] for scene in scenes for s in scene.samples]))


def ref_average(scenes: list[SceneScore]) -> float:
    return float(np.mean([sum(s.ious.values()) / len(s.ious) for scene in scenes for s in scene.samples]))


def ref_diversity(scenes: list[SceneScore]) -> float:
    shares = []
    for scene in scenes:
        distinct: list[object] = []
        for s in scene.samples:
            if s.layout not in distinct:
                distinct.append(s.layout)
        shares.append(len(distinct) / len(scene.samples))
    return sum(shares) / len(shares)


def ref_valid_diversity(scenes: list[SceneScore]) -> float:
    shares = []
    for scene in scenes:
        distinct: list[object] = []
        for s in scene.samples:
            if s.stable and s.ious["front"] >= 0.8 and s.layout not in distinct:
                distinct.append(s.layout)
        shares.append(len(distinct) / len(scene.samples))
    return sum(shares) / len(shares)


def ref_given_stable(scenes: list[SceneScore]) -> float:
    return float(np.mean([s.ious["front"] for scene in scenes for s in scene.samples if s.stable]))


def ref_before(scenes: list[SceneScore]) -> float:
    return float(np.mean([s.front_iou_before for scene in scenes for s in scene.samples]))


REFERENCES: dict[type[Metric], Callable[[list[SceneScore]], float]] = {
    StabilityRate: ref_stability,
    Diversity: ref_diversity,
    FrontIoU: ref_front,
    AverageIoU: ref_average,
    ValidDiversity: ref_valid_diversity,
    IoUGivenStable: ref_given_stable,
    FrontIoUBeforePhysics: ref_before,
}


@pytest.mark.parametrize("kind", REFERENCES)
def test_a_metric_is_its_reference_in_batch_accumulated_pickled_and_merged_form(kind: type[Metric]) -> None:
    reference, scenes = REFERENCES[kind], random_scenes(40, seed=1)
    at_once, accumulated = kind(), kind()
    assert float(at_once(scenes)) == pytest.approx(reference(scenes), abs=1e-6)
    for start in range(0, 40, 7):
        part = scenes[start : start + 7]
        assert float(accumulated(part)) == pytest.approx(reference(part), abs=1e-6)  # of the batch alone
        accumulated = pickle.loads(pickle.dumps(accumulated))
    assert float(accumulated.compute()) == pytest.approx(reference(scenes), abs=1e-6)
    # Two processes: their states, reduced as declared.
    halves = [kind(), kind()]
    halves[0].update(scenes[:13])
    halves[1].update(scenes[13:])
    merged = copy.deepcopy(halves[0])
    merged.merge_state(halves[1])
    assert float(merged.compute()) == pytest.approx(reference(scenes), abs=1e-6)
    merged.reset()
    merged.update(scenes[:5])
    assert float(merged.compute()) == pytest.approx(reference(scenes[:5]), abs=1e-6)


def test_the_collection_logs_every_metric_under_its_name() -> None:
    scenes, metrics = random_scenes(9, seed=2), scene_metrics("test/")
    metrics.update(scenes)
    values = metrics.compute()
    assert set(values) == {f"test/{name}" for name in SCENE_METRICS}
    for (name, function), reference in zip(SCENE_METRICS.items(), REFERENCES.values(), strict=True):
        parts = [function(scene) for scene in scenes]
        assert sum(p[0] for p in parts) / sum(p[1] for p in parts) == pytest.approx(reference(scenes))
        assert float(values[f"test/{name}"]) == pytest.approx(reference(scenes), abs=1e-6)


def test_iou_given_stable_does_not_exist_if_nothing_stands() -> None:
    metric = IoUGivenStable()
    metric.update([SceneScore((SampleScore(False, {"front": 0.0}, 0.5, ()),))])
    assert torch.isnan(metric.compute())


def test_a_layout_reads_layers_from_the_bottom_and_blocks_from_the_left() -> None:
    stack = pile(row((RECTANGLE, 1), (CUBE, -1.5)), row((LONG, 0.3)), row((CUBE, 0)), row((TRIANGLE, 1), (CUBE, -1)))
    assert layout(stack) == ((CUBE, RECTANGLE), (LONG,), (CUBE,), (CUBE, TRIANGLE))
    rng = np.random.default_rng(0)
    order = rng.permutation(len(stack))
    assert layout(Stack(stack.shapes[order], stack.poses[order])) == layout(stack)  # the order of blocks is no layout
    near = stack.with_poses(stack.poses + rng.uniform(-0.2, 0.2, stack.poses.shape))
    assert layout(near) == layout(stack)  # small errors neither
    sunk, lifted = (stack.poses + np.array([0, 0, dz, 0, 0, 0]) for dz in (-9, 9))
    assert layout(stack.with_poses(sunk))[1:] == ((), (), ())
    assert layout(stack.with_poses(lifted))[:3] == ((), (), ())


def test_scores_follow_the_paper_unstable_is_zero_and_stable_is_the_settled_structure() -> None:
    target, generated, settled = row((CUBE, 0)), row((CUBE, 0.5)), row((CUBE, 0.25))
    targets = {view: silhouette(target, view) for view in ("front", "side", "top")}
    for stable in (True, False):
        verdict = Verdict(stable, np.array([not stable]), np.zeros(1), settled)
        score = score_sample(generated, verdict, targets)  # type: ignore[arg-type]
        assert score.front_iou_before == pytest.approx(iou(silhouette(generated), silhouette(target)))
        if stable:
            each = [iou(silhouette(settled, view), silhouette(target, view)) for view in ("front", "side", "top")]
            assert each[1] == 1 and 0.5 < each[0] < 0.7  # shifted along x: the side view cannot see it
            assert list(score.ious.values()) == pytest.approx(each)
            assert score.average_iou == pytest.approx(np.mean(each))
        else:
            assert set(score.ious.values()) == {0.0} and score.average_iou == 0
    drawing = score_sample(settled, Verdict(True, np.zeros(1, bool), np.zeros(1), settled), {"front": targets["front"]})
    assert list(drawing.ious) == ["front"] and drawing.average_iou == drawing.front_iou


def test_a_block_that_rolled_off_the_canvas_counts_as_outside_the_target() -> None:
    target = silhouette(row((CUBE, 0)))
    settled = row((CUBE, 0), (CUBE, 30))
    score = score_sample(settled, Verdict(True, np.zeros(2, bool), np.zeros(2), settled), {"front": target})
    assert score.front_iou == pytest.approx(0.5, abs=0.01)


def test_top_k_counts_the_true_list_among_the_first_k() -> None:
    rng = np.random.default_rng(3)
    ranked, truth = rng.integers(0, 2, (50, 4, 3)), rng.integers(0, 2, (50, 3))
    places = []
    for lists, true in zip(ranked.tolist(), truth.tolist(), strict=True):
        places.append(lists.index(true) if true in lists else 4)
    assert list_rank(ranked, truth).tolist() == places
    for k in (1, 3):
        metric = TopK(k)
        for part in np.array_split(np.arange(50), 4):
            metric.update(ranked[part], truth[part])
        metric = pickle.loads(pickle.dumps(metric))
        assert float(metric.compute()) == pytest.approx(np.mean([place < k for place in places]))
        assert 0 < float(metric.compute()) < 1


def brute_force_can_make(image: np.ndarray, counts: list[int]) -> bool:
    """Fills the half-height rows of a picture made of whole cells with every arrangement of the list."""
    cells = image[[PAPER_GRID.image_size - 4 - 7 - 14 * level for level in range(4)]][:, 4 + 7 + 14 * np.arange(4)]

    def fill(level: int, x: int, left: tuple[int, ...]) -> bool:
        if level == 4:
            return not any(left)
        if x == 4:
            return fill(level + 1, 0, left)
        if not cells[level, x]:
            return fill(level, x + 1, left)
        for shape, width in ((CUBE, 1), (RECTANGLE, 2), (LONG, 3)):
            if left[shape] and cells[level, x : x + width].sum() == width:
                rest = tuple(n - (i == shape) for i, n in enumerate(left))
                if fill(level, x + width, rest):
                    return True
        return False

    return fill(0, 0, tuple(counts))


def test_can_make_agrees_with_trying_every_arrangement_on_whole_cells() -> None:
    rng = np.random.default_rng(4)
    answers = []
    for _ in range(300):
        cells = rng.random((4, 4)) < 0.5
        image = np.zeros((64, 64), bool)
        for level, x in zip(*np.nonzero(cells), strict=True):
            image[60 - 14 * (level + 1) : 60 - 14 * level, 4 + 14 * x : 18 + 14 * x] = True
        counts = [0, 0, 0, 0]
        left = int(cells.sum())
        while left > 0:  # the right area, so that some lists fit
            width = int(rng.integers(1, min(3, left) + 1))
            counts[width - 1] += 1
            left -= width
        if any(counts):
            answers.append(can_make(image, counts))
            assert answers[-1] == brute_force_can_make(image, counts), (cells, counts)
    assert 20 < sum(answers) < len(answers) - 20


def test_the_true_list_of_generated_stacks_can_make_their_silhouettes() -> None:
    rng = np.random.default_rng(5)
    stacks = []
    for _ in range(300):
        stack = realize(draw_template(rng), rng)
        keep = rng.random(len(stack)) > 0.2  # as deconstruction leaves them
        if keep.any():
            stacks.append(Stack(stack.shapes[keep], stack.poses[keep]))
    noise = [
        s.with_poses(s.poses + rng.uniform(-1, 1, s.poses.shape) * [0.005, 0.02, 0.03, 0, 0.03, 0]) for s in stacks
    ]
    metric = ListFeasibility()
    metric.update(np.stack([s.counts for s in noise]), np.stack([silhouette(s) for s in noise]))
    assert float(metric.compute()) >= 0.99
    wrong = [can_make(silhouette(s), t.counts) for s, t in itertools.pairwise(stacks)]
    assert np.mean(wrong) < 0.25


def test_can_make_tells_lists_apart() -> None:
    four_wide = silhouette(row((RECTANGLE, -1), (RECTANGLE, 1)))
    for counts, possible in (
        ([0, 2, 0, 0], True), ([1, 0, 1, 0], True), ([4, 0, 0, 0], True), ([2, 1, 0, 0], True),
        ([3, 0, 0, 0], False), ([0, 2, 0, 1], False), ([1, 2, 0, 0], False), ([0, 0, 0, 0], False),
    ):  # fmt: skip
        assert can_make(four_wide, counts) is possible, counts
    roof = silhouette(pile(row((LONG, 0)), row((TRIANGLE, -1), (CUBE, 0.1))))
    assert can_make(roof, [1, 0, 1, 1])
    assert not can_make(roof, [2, 0, 1, 0]) and not can_make(roof, [0, 0, 1, 2])
    assert not can_make(np.zeros((64, 64)), [1, 0, 0, 0])


def test_can_make_takes_any_shape_of_one_cell_and_refuses_others() -> None:
    wide = Catalogue((*PAPER_CATALOGUE, Shape.box("four", 4), Shape.box("flat", 1, height=0.5)))
    image = silhouette(Stack(np.array([4]), np.array([[0, 0, 0.5, 0, 0, 0]]), wide))
    assert can_make(image, [0, 0, 0, 0, 1, 0], wide) and can_make(image, [0, 2, 0, 0, 0, 0], wide)
    with pytest.raises(StackgenError, match="flat"):
        can_make(image, [0, 0, 0, 0, 0, 1], wide)
