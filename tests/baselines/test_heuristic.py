"""One contract over all heuristics, found by name or by class, in the library and on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

import stackgen
from stackgen.baselines import HEURISTICS
from stackgen.data.dataset import TESTSET
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import load_scenes
from stackgen.io.stacks_file import read_stacks
from stackgen.sampling.methods import load_sampler
from stackgen.stack import Stack
from stackgen.world import Mask
from tests.conftest import Cli, TinyWeights

CONFIGS = Path(__file__).parents[2] / "configs" / "baselines"
NAMES = sorted(HEURISTICS)
every_heuristic = pytest.mark.parametrize("name", NAMES)


@pytest.fixture(scope="module")
def scenes() -> tuple[Mask, np.ndarray]:
    """Ten of the frozen test scenes: silhouettes and block lists."""
    found = load_scenes(TESTSET)[0][::50]
    return np.stack([s.silhouette for s in found]), np.stack([s.counts for s in found])


def same(a: list[Stack], b: list[Stack]) -> bool:
    pairs = list(zip(a, b, strict=True))
    return all(np.array_equal(x.shapes, y.shapes) and np.array_equal(x.poses, y.poses) for x, y in pairs)


@every_heuristic
def test_every_block_of_the_list_gets_a_pose(name: str, scenes: tuple[Mask, np.ndarray]) -> None:
    pictures, lists = scenes
    for counts in (lists, np.roll(lists, 1, axis=0)):  # the second: lists that do not make the silhouettes
        stacks = HEURISTICS[name]().sample_batch(pictures, counts, 2, 0)
        assert [[s.counts.tolist() for s in samples] for samples in stacks] == [[c] * 2 for c in counts.tolist()]
        assert all((s.poses[:, 1] == 0).all() and (s.poses[:, 3:] == 0).all() for samples in stacks for s in samples)


@every_heuristic
def test_same_seed_same_stacks_whatever_else_is_in_the_batch(name: str, scenes: tuple[Mask, np.ndarray]) -> None:
    pictures, lists = scenes
    method = HEURISTICS[name]()
    together = method.sample_batch(pictures, lists, 3, 5)
    backwards = method.sample_batch(pictures[::-1], lists[::-1], 3, 5)[::-1]
    alone = [method.sample_batch(pictures[i : i + 1], lists[i : i + 1], 3, 5)[0] for i in range(len(lists))]
    fewer = method.sample_batch(pictures, lists, 2, 5)
    for i, stacks in enumerate(together):
        assert same(stacks, backwards[i]) and same(stacks, alone[i]) and same(stacks[:2], fewer[i])


@every_heuristic
def test_samples_and_seeds_differ(name: str, scenes: tuple[Mask, np.ndarray]) -> None:
    pictures, lists = scenes
    first, second = (HEURISTICS[name]().sample_batch(pictures, lists, 6, seed) for seed in (0, 1))
    assert not all(same(a, b) for a, b in zip(first, second, strict=True))
    assert any(not same(stacks[:1] * 5, stacks[1:]) for stacks in first)


@every_heuristic
def test_bad_questions_are_one_line(name: str) -> None:
    method, picture = HEURISTICS[name](), np.ones((1, 64, 64), bool)
    good = np.array([[1, 0, 0, 0]])
    for pictures, counts, number in (
        (picture, good * 11, 1),
        (picture, good * 0, 1),
        (picture, good, 0),
        (picture[:, :32], good, 1),
        (picture, np.array([[1, 0, 0]]), 1),
        (picture, np.repeat(good, 2, axis=0), 1),
    ):
        with pytest.raises(StackgenError) as caught:
            method.sample_batch(pictures, counts, number, 0)
        assert "\n" not in str(caught.value)


def test_the_card_tells_settings_apart() -> None:
    brute = HEURISTICS["brute-force"]
    assert brute().card == brute().card
    assert brute().card["sha256"] != brute(sigma=0.5).card["sha256"]  # type: ignore[call-arg]
    assert len({HEURISTICS[name]().card["sha256"] for name in NAMES}) == len(NAMES)
    json.dumps([HEURISTICS[name]().card for name in NAMES])


@every_heuristic
def test_a_name_stands_for_a_heuristic(name: str, tower_image: Path) -> None:
    model = stackgen.load(name)
    assert type(model.sampler) is HEURISTICS[name] and type(load_sampler(name)) is HEURISTICS[name]
    assert model.weights is not None and model.weights.name == name
    stacks = model.sample(tower_image, num_samples=2, blocks="cube=3")
    assert [stack.names for stack in stacks] == [["cube"] * 3] * 2


def test_a_sampler_itself_is_taken_too(tower_image: Path) -> None:
    method = HEURISTICS["brute-force"]()
    assert stackgen.load(method).sampler is method
    with pytest.raises(StackgenError, match=r"no weights called greedy.*greedy-random"):
        stackgen.load("greedy")


def test_sample_on_the_command_line(cli: Cli, tower_image: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    answer = cli("sample", tower_image, "--weights", "greedy-random", "--blocks", "cube=3", "--out", out)
    assert answer.code == 0, answer.err
    content = read_stacks(out / "stacks.json")
    assert content.weights is not None and content.weights.name == "greedy-random"
    assert all(entry.verdict is not None and entry.verdict.stable for entry in content.entries)


# `stackgen test`.


@every_heuristic
def test_a_configuration_holds_the_settings_that_the_name_stands_for(name: str) -> None:
    weights = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())["test"]["weights"]
    assert weights["class_path"] == f"stackgen.baselines.{HEURISTICS[name].__name__}"
    assert weights.get("init_args", {}) == HEURISTICS[name]().settings


@every_heuristic
def test_the_protocol_runs_on_a_configuration(
    name: str, cli: Cli, tiny: TinyWeights, towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    data = ["--test_set", towers_dataset, "--block_list_weights", tiny.predictor]
    answer = cli("test", "--config", CONFIGS / f"{name}.yaml", *data)
    assert answer.code == 0, answer.err
    rows = json.loads((tmp_path / "runs" / name / "test_0" / "metrics.json").read_text())["rows"]
    assert [row["block_list"] for row in rows] == ["true", "predicted", "true"]
    assert [row["scenes"] for row in rows] == [12, 12, 12]
    assert rows[0]["weights"] == name
    assert rows[0].get("sampler", {}) == HEURISTICS[name]().settings
    assert rows[0]["weights_sha256"] == HEURISTICS[name]().card["sha256"]


def test_a_name_is_enough_for_a_test_and_what_is_no_sampler_is_refused(cli: Cli) -> None:
    answer = cli("test", "--weights", "greedy")
    assert answer.code == 2 and "no weights called greedy" in answer.line
    assert cli("test", '--weights={"class_path": "stackgen.stack.Stack"}').code == 2


def test_a_checkpoint_beside_a_configuration_of_weights_is_refused(
    cli: Cli, tiny: TinyWeights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    answer = cli("test", "--config", CONFIGS / "brute-force.yaml", "--ckpt_path", tiny.sampler)
    assert answer.code == 2 and "give one of them" in answer.line
    assert not (tmp_path / "runs").exists()
