"""Each metric against a naive reference, and the scores that it is made from."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from stackgen.evaluation.metrics import METRICS, SCENE_METRICS, SampleScore, SceneScore, list_rank, score_sample
from stackgen.geometry import iou, silhouette
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.world import PAPER_GRID, View

CUBE = 0


def row(*blocks: tuple[int, float], level: int = 0) -> Stack:
    """Blocks of one layer: (shape, x of the centre)."""
    return Stack(np.array([s for s, _ in blocks]), np.array([[x, 0, level + 0.5, 0, 0, 0] for _, x in blocks]))


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


REFERENCES: dict[str, Callable[[list[SceneScore]], float]] = {
    "stability": ref_stability,
    "diversity": ref_diversity,
    "front_iou": ref_front,
    "avg_iou": ref_average,
    "valid_diversity": ref_valid_diversity,
    "iou_given_stable": ref_given_stable,
    "front_iou_before_physics": ref_before,
}


def test_every_metric_has_a_reference() -> None:
    assert set(REFERENCES) == set(SCENE_METRICS) and set(METRICS) == {*SCENE_METRICS, "side_iou", "top_iou"}


@pytest.mark.parametrize("name", REFERENCES)
def test_a_metric_is_its_reference_summed_in_any_parts(name: str) -> None:
    reference, scenes = REFERENCES[name], random_scenes(40, seed=1)
    parts = [SCENE_METRICS[name](scene) for scene in scenes]
    assert sum(p[0] for p in parts) / sum(p[1] for p in parts) == pytest.approx(reference(scenes))
    halves = [tuple(map(sum, zip(*some, strict=True))) for some in (parts[:13], parts[13:])]
    assert sum(h[0] for h in halves) / sum(h[1] for h in halves) == pytest.approx(reference(scenes))


def test_the_views_are_averaged_where_they_have_a_target() -> None:
    scenes = random_scenes(40, seed=3)
    for view in ("side", "top"):
        seen = [s.ious[view] for scene in scenes for s in scene.samples if view in s.ious]
        parts = [METRICS[f"{view}_iou"](scene) for scene in scenes]
        assert sum(p[0] for p in parts) == pytest.approx(sum(seen)) and sum(p[1] for p in parts) == len(seen)


def test_iou_given_stable_does_not_exist_if_nothing_stands() -> None:
    nothing = SceneScore((SampleScore(False, {"front": 0.0}, 0.5, ()),))
    assert SCENE_METRICS["iou_given_stable"](nothing) == (0, 0)


def test_scores_follow_the_paper_unstable_is_zero_and_stable_is_the_settled_structure() -> None:
    target, generated, settled = row((CUBE, 0)), row((CUBE, 0.5)), row((CUBE, 0.25))
    targets = {view: silhouette(target, PAPER_GRID, view) for view in ("front", "side", "top")}
    for stable in (True, False):
        verdict = Verdict(stable, np.array([not stable]), np.zeros(1), settled)
        score = score_sample(generated, verdict, targets, PAPER_GRID)  # type: ignore[arg-type]
        assert (score.overlap, score.gap, score.in_both) == (0, 0, None)
        assert score.front_iou_before == pytest.approx(
            iou(silhouette(generated, PAPER_GRID), silhouette(target, PAPER_GRID))
        )
        if stable:
            each = [
                iou(silhouette(settled, PAPER_GRID, view), silhouette(target, PAPER_GRID, view))
                for view in ("front", "side", "top")
            ]
            assert each[1] == 1 and 0.5 < each[0] < 0.7  # shifted along x: the side view cannot see it
            assert list(score.ious.values()) == pytest.approx(each)
            assert score.average_iou == pytest.approx(np.mean(each))
        else:
            assert set(score.ious.values()) == {0.0} and score.average_iou == 0
    drawing = score_sample(
        settled, Verdict(True, np.zeros(1, bool), np.zeros(1), settled), {"front": targets["front"]}, PAPER_GRID
    )
    assert list(drawing.ious) == ["front"] and drawing.average_iou == drawing.front_iou


def test_a_block_that_rolled_off_the_canvas_counts_as_outside_the_target() -> None:
    target = silhouette(row((CUBE, 0)), PAPER_GRID)
    settled = row((CUBE, 0), (CUBE, 30))
    score = score_sample(settled, Verdict(True, np.zeros(2, bool), np.zeros(2), settled), {"front": target}, PAPER_GRID)
    assert score.front_iou == pytest.approx(0.5, abs=0.01)


def test_the_rank_is_the_place_of_the_true_list() -> None:
    rng = np.random.default_rng(3)
    ranked, truth = rng.integers(0, 2, (50, 4, 3)), rng.integers(0, 2, (50, 3))
    places = []
    for lists, true in zip(ranked.tolist(), truth.tolist(), strict=True):
        places.append(lists.index(true) if true in lists else 4)
    assert list_rank(ranked, truth).tolist() == places
