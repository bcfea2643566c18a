"""Verified sampling, with samplers and checkers whose answers are known."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.protocols import StabilityChecker, Verdict
from stackgen.sampling.verified import (
    FIRST_ROUND,
    Budget,
    Candidate,
    Choice,
    VerifiedSampler,
    best,
    checker_named,
    choose_list,
)
from stackgen.sim.physics import Physics
from stackgen.sim.statics.checker import StaticsChecker
from stackgen.stack import Stack
from stackgen.world import PAPER_GRID, PAPER_WORLD, Mask
from tests.conftest import Cli, TinyWeights

CUBES = np.array([2, 0, 0, 0])
TOWER = Stack(np.array([0, 0]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]]))
TARGET = silhouette(TOWER, PAPER_GRID)


def moved(x: float, dy: float = 0.0) -> Stack:
    """The tower, moved; blocks of different y are told apart by the checkers below."""
    return TOWER.with_poses(TOWER.poses + [x, dy, 0, 0, 0, 0])


class Draws:
    """Answers scene i with stacks from a list of its own, in turn, from the seed on; keeps what it was asked."""

    world = PAPER_WORLD
    card: Mapping[str, Any] = {}
    settings: Mapping[str, Any] = {}

    def __init__(self, *scenes: Sequence[Stack]) -> None:
        self.scenes = scenes
        self.asked: list[tuple[int, int, int, Any]] = []

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        self.asked.append((len(silhouettes), num_samples, seed, counts.tolist()))
        answers = []
        for picture in silhouettes:
            scene = self.scenes[int(picture[0, :8].dot(1 << np.arange(8)))]
            answers.append([scene[(seed + i) % len(scene)] for i in range(num_samples)])
        return answers


def numbered(scene: int) -> Mask:
    """The tower's silhouette, with the scene's number in its upper row."""
    picture = TARGET.copy()
    picture[0, :8] = [scene >> bit & 1 for bit in range(8)]
    return picture


class ByDepth(StabilityChecker):
    """A stack stands if it is at y = 0; counts what it is asked."""

    physics = Physics()

    def __init__(self) -> None:
        self.asked: list[Stack] = []

    def check(self, stack: Stack) -> Verdict:
        self.asked.append(stack)
        stable = abs(stack.poses[0, 1]) < 0.5
        return Verdict(stable, np.full(len(stack), not stable), np.full(len(stack), 0.0 if stable else 1.0), stack)


GOOD, FALLS, BESIDE = moved(0.0), moved(0.0, 1.0), moved(0.5)


def test_it_stops_as_soon_as_enough_is_found() -> None:
    sampler, checker = Draws([GOOD]), ByDepth()
    choice = VerifiedSampler(sampler, checker).choose(numbered(0)[None], CUBES[None], 3, 0)[0]
    assert (choice.drawn, choice.checked, choice.stable) == (FIRST_ROUND, 3, 3)
    assert [candidate.matches for candidate in choice.chosen] == [True] * 3 and len(checker.asked) == 3


def test_it_draws_until_the_budget_is_spent_and_says_that_nothing_stands() -> None:
    sampler, checker = Draws([FALLS]), ByDepth()
    choice = VerifiedSampler(sampler, checker, Budget(50)).choose(numbered(0)[None], CUBES[None], 2, 0)[0]
    assert (choice.drawn, choice.checked, choice.stable) == (50, 50, 0)
    assert [number for _, number, _, _ in sampler.asked] == [8, 8, 16, 18]  # as many as all before
    assert len({seed for _, _, seed, _ in sampler.asked}) == 4
    assert len(choice.chosen) == 2 and not any(candidate.verdict.stable for candidate in choice.chosen)


def test_scenes_that_are_done_are_left_alone() -> None:
    sampler = Draws([GOOD], [FALLS], [FALLS, GOOD, FALLS])
    pictures = np.stack([numbered(i) for i in range(3)])
    found = VerifiedSampler(sampler, ByDepth(), Budget(16)).choose(pictures, np.tile(CUBES, (3, 1)), 1, 0)
    assert [scenes for scenes, *_ in sampler.asked] == [3, 1]
    assert [choice.chosen[0].verdict.stable for choice in found] == [True, False, True]
    assert [choice.drawn for choice in found] == [8, 16, 8]


def test_the_block_list_is_the_one_that_was_given() -> None:
    sampler = Draws([FALLS])
    VerifiedSampler(sampler, ByDepth(), Budget(20)).sample_batch(numbered(0)[None], CUBES[None], 1, 0)
    assert all(counts == [CUBES.tolist()] for *_, counts in sampler.asked)


def test_what_matches_is_preferred_to_what_only_stands() -> None:
    sampler = VerifiedSampler(Draws([BESIDE, FALLS, BESIDE, GOOD]), ByDepth(), Budget(8))
    first, second = sampler.choose(numbered(0)[None], CUBES[None], 2, 0)[0].chosen
    assert first.matches and second.matches and first.front_iou > 0.99
    only = VerifiedSampler(Draws([BESIDE, FALLS]), ByDepth(), Budget(16))
    stacks = only.choose(numbered(0)[None], CUBES[None], 9, 0)[0].chosen
    assert [c.verdict.stable for c in stacks] == [True] * 8 + [False]


def candidate(stable: bool, iou: float, name: int, fallen: int = 1) -> Candidate:
    fell = np.arange(2) < (0 if stable else fallen)
    return Candidate(TOWER, Verdict(stable, fell, fell.astype(np.float64), TOWER), iou, ((name,),))


def test_distinct_layouts_come_first_among_those_that_match() -> None:
    a, again, b = candidate(True, 0.99, 1), candidate(True, 0.98, 1), candidate(True, 0.96, 2)
    poor, falls, worse = candidate(True, 0.7, 3), candidate(False, 0.9, 4), candidate(False, 0.95, 5, fallen=2)
    assert best([worse, falls, poor, again, b, a], 6) == (a, b, again, poor, falls, worse)


def test_new_layouts_are_checked_first() -> None:
    """So that few verdicts give distinct stacks: here one side by side among many towers of the same picture."""
    wide = Stack(np.array([1]), np.array([[0, 0, 0.5, 0, 0, 0]]))
    pair = Stack(np.array([0, 0]), np.array([[-0.5, 0, 0.5, 0, 0, 0], [0.5, 0, 0.5, 0, 0, 0]]))
    target, checker = silhouette(wide, PAPER_GRID), ByDepth()
    draws = Draws([pair] * 7 + [wide])
    found = VerifiedSampler(draws, checker).choose(target[None], CUBES[None], 2, 0)[0]
    assert {len(c.stack) for c in found.chosen} == {1, 2} and found.checked == 2


def test_same_seed_same_answer() -> None:
    rng = np.random.default_rng(0)
    scene = [moved(x, y) for x, y in zip(rng.normal(0, 0.1, 97), rng.choice([0, 1], 97), strict=True)]

    def answer(seed: int) -> list[Any]:
        found = VerifiedSampler(Draws(scene), ByDepth()).sample_batch(numbered(0)[None], CUBES[None], 4, seed)[0]
        return [stack.poses.tolist() for stack in found]

    assert answer(3) == answer(3) != answer(4)


class SlowChecker(ByDepth):
    """Each verdict takes a second, on a clock of its own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        monkeypatch.setattr("stackgen.sampling.verified.time.perf_counter", lambda: float(len(self.asked)))


@pytest.mark.parametrize(("seconds", "checked"), [(0.5, 2), (7.0, 8), (23.0, 16), (24.0, 16), (33.0, 32)])
def test_time_is_kept_to(seconds: float, checked: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A round that would end too late is not begun; a first look there always is."""
    checker = SlowChecker(monkeypatch)
    sampler = VerifiedSampler(Draws([FALLS]), checker, Budget(4096, seconds))
    choice = sampler.choose(numbered(0)[None], CUBES[None], 2, 0)[0]
    assert choice.checked == checked and len(choice.chosen) == 2


def test_a_budget_is_a_time_or_a_number() -> None:
    assert Budget.parse("2s").seconds == 2 and Budget.parse(" 1.5 min").seconds == 90
    assert Budget.parse("7") == Budget(7)
    for wrong in ("", "s", "-1s", "0", "0s", "1h", "1e3", "many"):
        with pytest.raises(StackgenError, match="budget"):
            Budget.parse(wrong)


# Several block lists.


class ByList:
    """Answers each block list with a stack of its own."""

    world = PAPER_WORLD
    card: Mapping[str, Any] = {}
    settings: Mapping[str, Any] = {}

    def __init__(self, answers: dict[int, Stack]) -> None:
        self.answers, self.calls = answers, count()

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        next(self.calls)
        return [[self.answers[int(list_[0])]] * num_samples for list_ in counts]


LISTS = np.array([[1, 0, 0, 0], [2, 0, 0, 0], [3, 0, 0, 0]])


@pytest.mark.parametrize(
    ("answers", "cubes", "tried"),
    [
        ({1: GOOD, 2: GOOD, 3: GOOD}, 1, 1),
        ({1: FALLS, 2: GOOD, 3: GOOD}, 2, 2),
        ({1: FALLS, 2: FALLS, 3: FALLS}, 1, 3),
        ({1: FALLS, 2: BESIDE, 3: FALLS}, 2, 3),  # it stands, if beside the target
    ],
)
def test_the_next_list_is_tried_where_nothing_valid_stands(answers: dict[int, Stack], cubes: int, tried: int) -> None:
    sampler = VerifiedSampler(ByList(answers), ByDepth(), Budget(16))
    counts, choice, lists = choose_list(sampler, TARGET, LISTS, 2, 0)
    assert (counts[0], lists) == (cubes, tried)
    assert choice.checked == sum(16 if answers[i] is not GOOD else 2 for i in range(1, tried + 1))


def test_every_list_has_half_of_the_time_that_is_left_and_the_last_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    checker = SlowChecker(monkeypatch)
    sampler = VerifiedSampler(ByList(dict.fromkeys((1, 2, 3), FALLS)), checker, Budget(4096, 60.0))
    _, choice, lists = choose_list(sampler, TARGET, LISTS, 2, 0)
    assert lists == 3 and 40 <= choice.checked <= 60
    short = VerifiedSampler(ByList(dict.fromkeys((1, 2, 3), FALLS)), SlowChecker(monkeypatch), Budget(4096, 0.5))
    assert choose_list(short, TARGET, LISTS, 2, 0)[2] == 1  # the time is up after the first


# Checkers.


def test_the_checkers_have_names() -> None:
    simulator = ByDepth()
    assert checker_named("simulator", simulator) is simulator
    assert isinstance(checker_named("statics", simulator), StaticsChecker)
    with pytest.raises(StackgenError, match="simulator or statics"):
        checker_named("oracle", simulator)  # type: ignore[arg-type]


def test_statics_keeps_what_stands_of_good_and_bad_draws() -> None:
    leaning = Stack(np.array([0, 0]), np.array([[0, 0, 0.5, 0, 0, 0], [0.6, 0, 1.5, 0, 0, 0]]))
    sampler = VerifiedSampler(Draws([leaning, leaning, GOOD]), checker_named("statics", ByDepth()), name="statics")
    stacks = sampler.sample_batch(numbered(0)[None], CUBES[None], 2, 1)[0]
    assert all((stack.poses == GOOD.poses).all() for stack in stacks)
    assert sampler.settings == {"verify": "statics", "draws": 64}


def test_the_record_says_how_it_was_sampled() -> None:
    inner = Draws([GOOD])
    inner.settings = {"kind": "dpm", "steps": 8}
    timed = VerifiedSampler(inner, ByDepth(), Budget(4096, 2.0), name="simulator")
    assert timed.settings == {"kind": "dpm", "steps": 8, "verify": "simulator", "seconds": 2.0}


def test_a_choice_counts_what_is_valid() -> None:
    chosen = (candidate(True, 0.99, 1), candidate(True, 0.5, 1), candidate(False, 0.99, 1))
    assert Choice(chosen, 8, 8, 2).valid == 1


@pytest.mark.parametrize("wrong", [0, -1])
def test_no_samples_are_refused(wrong: int) -> None:
    with pytest.raises(StackgenError, match="at least 1"):
        VerifiedSampler(Draws([GOOD]), ByDepth()).choose(numbered(0)[None], CUBES[None], wrong, 0)


# The protocol.


def test_the_protocol_measures_verified_sampling_under_its_own_name(
    cli: Cli, tiny: TinyWeights, towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    options = [
        *("--test_set", towers_dataset, "--weights", tiny.sampler, "--predicted_lists", "false", "--num_samples", 1),
        *("--sampler.kind", "dpm", "--sampler.steps", 2, "--verify", "statics", "--draws", 4),
    ]
    answer = cli("test", *options)
    assert answer.code == 0, answer.err
    content = json.loads(next(tmp_path.glob("runs/*/test_0/metrics.json")).read_text())
    row = content["rows"][0]
    assert row["method"] == "ddpm, verified by statics" and row["scenes"] == 12
    settings = {"kind": "dpm", "steps": 2, "verify": "statics", "draws": 4}
    assert settings.items() <= row["sampler"].items()
