"""The protocol, with samplers and checkers whose results are known."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from stackgen.data.arrays import StackArrays
from stackgen.data.generation.designs import draw_design, realize
from stackgen.data.manifest import Manifest
from stackgen.data.shards import Sample, write_shard
from stackgen.errors import StackgenError
from stackgen.evaluation.intervals import clustered_percentile, clustered_ratio
from stackgen.evaluation.metrics import METRICS, SCENE_METRICS
from stackgen.evaluation.parallel import simulating
from stackgen.evaluation.protocol import Request, Scene, evaluate, load_scenes, scenes_of
from stackgen.evaluation.results import Evaluation, write_metrics, write_scenes
from stackgen.evaluation.tables import list_table, metrics_table
from stackgen.geometry import silhouette
from stackgen.protocols import StabilityChecker, Verdict
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Mask


def made_samples(count: int, seed: int = 0) -> list[Sample]:
    rng = np.random.default_rng(seed)
    made: list[Sample] = []
    while len(made) < count:
        stack = realize(draw_design(rng, PAPER_WORLD), rng, PAPER_WORLD)
        if len(stack) <= 10:
            arrays = stack.shapes.astype(np.uint8), stack.poses.astype(np.float32)
            made.append(Sample(f"{len(made):04d}", *arrays, silhouette(stack, PAPER_GRID), {"template": len(made)}))
    return made


@pytest.fixture(scope="module")
def arrays() -> StackArrays:
    return StackArrays.from_samples(made_samples(20), PAPER_WORLD)


@pytest.fixture(scope="module")
def scenes(arrays: StackArrays) -> list[Scene]:
    return scenes_of(arrays, PAPER_CATALOGUE)


class Truth:
    """Looks the answer up, and lifts every sample whose number is divisible by three a layer."""

    def __init__(self, scenes: list[Scene]) -> None:
        self.world = PAPER_WORLD
        self.settings: dict[str, Any] = {}
        self.card: dict[str, Any] = {}
        self.known = {scene.silhouette.tobytes(): scene.truth for scene in scenes}
        self.seeds: list[int] = []

    def sample_batch(self, silhouettes: Mask, counts: np.ndarray, num_samples: int, seed: int) -> list[list[Stack]]:
        self.seeds.append(seed)
        stacks = []
        for image in silhouettes:
            truth = self.known[image.tobytes()]
            assert truth is not None
            stacks.append([truth.with_poses(truth.poses + np.eye(6)[2] * (j % 3 == 0)) for j in range(num_samples)])
        return stacks


class Ground(StabilityChecker):
    """By which a stack falls unless a block lies on the ground; nothing moves."""

    physics = Physics()

    def check(self, stack: Stack) -> Verdict:
        stable = bool(stack.poses[:, 2].min() < 1)
        return Verdict(stable, np.full(len(stack), not stable), np.full(len(stack), 0.0 if stable else 1.0), stack)


class Lists:
    """Predicts the truth for even scenes, for odd ones a list that is never right and the truth second."""

    def __init__(self, scenes: list[Scene]) -> None:
        self.world = PAPER_WORLD
        self.card: dict[str, Any] = {}
        self.known = {scene.silhouette.tobytes(): (i, scene.counts) for i, scene in enumerate(scenes)}

    def predict(self, silhouettes: Mask, top: int = 1, limit: NDArray[np.int64] | None = None) -> np.ndarray:
        answers = []
        for image in silhouettes:
            number, counts = self.known[image.tobytes()]
            wrong = counts + np.array([9, 0, 0, 0])
            ranked = [counts, wrong, wrong] if number % 2 == 0 else [wrong, counts, wrong]
            answers.append(ranked[:top])
        return np.array(answers)


def asked(scenes: Sequence[Scene], truth: Truth | None = None, **options: Any) -> Evaluation:
    """Evaluate a sampler that knows the truth."""
    progress = options.pop("progress", None)
    request = Request("Truth", PAPER_WORLD, truth or Truth(list(scenes)), **options)
    return evaluate(request, scenes, Ground(), progress)


def test_the_protocol_counts_what_a_known_sampler_does(scenes: list[Scene]) -> None:
    steps: list[tuple[int, int]] = []
    result = asked(scenes, progress=lambda done, total: steps.append((done, total)), batch_size=8)
    assert steps == [(8, 20), (16, 20), (20, 20)]
    values = {name: result.estimate(name) for name in SCENE_METRICS}
    expected = {
        "stability": 2 / 3, "diversity": 2 / 3, "front_iou": 2 / 3, "avg_iou": 2 / 3,
        "valid_diversity": 1 / 3, "iou_given_stable": 1.0,
    }  # fmt: skip
    for name, value in expected.items():
        estimate = values[name]
        assert estimate is not None and estimate.value == pytest.approx(value)
        assert (estimate.low, estimate.high) == pytest.approx((value, value))  # all scenes are alike
    before = values["front_iou_before_physics"]
    assert before is not None and 2 / 3 < before.value < 1
    assert all(scene.fell[0] and not scene.fell[1] and scene.drop == (1, 0, 0) for scene in result.scenes)


def test_same_seed_same_questions_and_each_batch_its_own(scenes: list[Scene]) -> None:
    first, again, other = Truth(scenes), Truth(scenes), Truth(scenes)
    for sampler, seed in ((first, 0), (again, 0), (other, 1)):
        asked(scenes, sampler, seed=seed, batch_size=8)
    assert first.seeds == again.seeds and len(set(first.seeds) | set(other.seeds)) == 6


def test_predicted_lists_are_asked_for_and_measured_themselves(scenes: list[Scene]) -> None:
    result = asked(scenes, predictor=Lists(scenes))
    assert result.block_list == "predicted"
    lists = {name: e.value for name, e in result.list_estimates().items() if e}
    assert lists == {"exact_match": 0.5, "top3": 1.0, "feasible": 0.5}
    assert all((np.array(r.counts) == s.counts).all() == (i % 2 == 0) for i, (r, s) in
               enumerate(zip(result.scenes, scenes, strict=True)))  # fmt: skip
    assert asked(scenes).list_estimates() == {}


def test_a_drawing_has_no_side_and_no_top(scenes: list[Scene], tmp_path: Path) -> None:
    drawings = [Scene(s.name, s.silhouette, s.counts) for s in scenes]
    result = asked(drawings, Truth(scenes))
    front, average = result.estimate("front_iou"), result.estimate("avg_iou")
    assert front == average
    write_scenes(tmp_path / "s.csv", result)
    with (tmp_path / "s.csv").open() as file:
        assert all(row["side_iou"] == row["top_iou"] == "" for row in csv.DictReader(file))
    with pytest.raises(StackgenError, match="taken from stacks"):
        evaluate(Request.ground_truth(PAPER_WORLD), drawings, Ground())


def test_nothing_to_evaluate_is_one_line(scenes: list[Scene]) -> None:
    for some, samples in (([], 3), (scenes, 0)):
        with pytest.raises(StackgenError, match="at least"):
            asked(some, Truth(scenes), num_samples=samples)


def test_ground_truth_is_simulated_again_alike_on_one_process_and_on_two(scenes: list[Scene]) -> None:
    request = Request.ground_truth(PAPER_WORLD)
    with simulating(workers=2) as parallel, simulating() as alone:
        shared = evaluate(request, scenes[:6], parallel)
        assert shared == evaluate(request, scenes[:6], alone)
    assert shared.physics == Physics().to_json() and shared.sampling_seconds == 0
    for scene, result in zip(scenes, shared.scenes, strict=False):
        assert scene.truth is not None
        score = result.score.samples[0]
        assert score.front_iou_before > 0.999
        assert score.stable == SimulatorChecker().check(scene.truth).stable
        assert score.front_iou > 0.85 or not score.stable


@pytest.fixture
def some(scenes: list[Scene]) -> Evaluation:
    return asked(scenes, predictor=Lists(scenes), facts={"weights": "default"})


def test_metrics_json_says_what_was_measured_and_how(some: Evaluation, tmp_path: Path) -> None:
    write_metrics(tmp_path / "metrics.json", [some])
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.json"]
    content = json.loads((tmp_path / "metrics.json").read_text())
    (found,) = content["rows"]
    assert content["format"] == "stackgen.evaluation/2"
    assert (found["scenes"], found["samples"], found["samples_per_scene"], found["seed"]) == (20, 60, 3, 0)
    assert found["block_list"] == "predicted" and found["weights"] == "default"
    assert set(found["metrics"]) == set(METRICS) and set(found["block_lists"]) == {
        "exact_match", "top3", "feasible",
    }  # fmt: skip
    for estimate in found["metrics"].values():
        assert 0 <= estimate["low"] <= estimate["value"] <= estimate["high"] <= 1
    assert found["fit"]["gap"]["value"] > 0.9  # a third of the samples is lifted by a layer
    assert found["fit"]["in_both"] is None and found["second_engine"] is None
    write_metrics(tmp_path / "new" / "metrics.json", [some])
    with pytest.raises(StackgenError, match="cannot be written"):
        write_metrics(tmp_path / "metrics.json" / "metrics.json", [some])


def test_the_scenes_file_adds_up_to_the_metrics(some: Evaluation, tmp_path: Path) -> None:
    write_scenes(tmp_path / "scenes.csv", some)
    with (tmp_path / "scenes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 60 and len({row["scene"] for row in rows}) == 20
    for column, metric in (("stable", "stability"), ("front_iou", "front_iou"), ("avg_iou", "avg_iou")):
        estimate = some.estimate(metric)
        assert estimate is not None and np.mean([float(row[column]) for row in rows]) == pytest.approx(estimate.value)


def test_the_table_shows_the_paper_beside(some: Evaluation) -> None:
    console = Console(width=80, record=True)
    with console.capture() as capture:
        console.print(metrics_table([some]))
        console.print(list_table([some]))
    text = capture.get()
    for figure in ("84.20", "66.87", "74.39", "71.31", "85.20", "64.53", "75.08", "71.84", "66.67", "66.7-66.7"):
        assert figure in text
    assert "50.00" in text and "100.0-100.0" in text
    assert list_table([]) is None


def test_scenes_are_loaded_from_a_dataset(tmp_path: Path, scenes: list[Scene]) -> None:
    shard = write_shard(tmp_path / "test-000000.tar", made_samples(20))
    Manifest("t", 0, PAPER_WORLD, {}, {}, (shard,)).save(tmp_path)
    loaded, dataset = load_scenes(tmp_path)
    assert dataset.manifest.count("test") == 20
    for a, b in zip(loaded, scenes, strict=True):
        assert a.name == b.name and np.array_equal(a.silhouette, b.silhouette) and np.array_equal(a.counts, b.counts)
        assert a.truth is not None and b.truth is not None and np.array_equal(a.truth.poses, b.truth.poses)
    with pytest.raises(StackgenError, match="no train split"):
        load_scenes(tmp_path, "train")


def test_intervals_cover_the_truth_as_often_as_they_say_when_samples_of_a_scene_agree() -> None:
    rng = np.random.default_rng(0)
    covered, naive = [], []
    for _ in range(150):
        hits = 3 * (rng.random(100) < 0.8)  # three samples a scene that always agree
        estimate = clustered_ratio(hits, np.full(100, 3))
        assert estimate is not None
        covered.append(estimate.low <= 0.8 <= estimate.high)
        naive.append(abs(estimate.value - 0.8) <= 1.96 * (0.16 / 300) ** 0.5)
    assert np.mean(covered) >= 0.9 > np.mean(naive)
    assert clustered_ratio([0, 0], [0, 0]) is None
    assert clustered_ratio([1, 2], [3, 3]) == clustered_ratio([1, 2], [3, 3])


@pytest.mark.parametrize("percent", [5.0, 50.0, 95.0, 100.0])
def test_a_percentile_is_the_least_value_that_so_many_do_not_exceed(percent: float) -> None:
    rng = np.random.default_rng(int(percent))
    values = [list(rng.integers(0, 9, rng.integers(0, 4)).astype(float)) for _ in range(40)]
    flat = np.sort([value for some in values for value in some])
    expected = next(v for v in flat if np.count_nonzero(flat <= v) >= percent / 100 * len(flat))
    estimate = clustered_percentile(values, percent)
    assert estimate is not None and estimate.value == expected and flat[0] <= estimate.low <= estimate.high <= flat[-1]
    assert clustered_percentile([[], []], percent) is None
