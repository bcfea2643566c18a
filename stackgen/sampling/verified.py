"""Verified sampling: draw many stacks, check them, keep the best.

The paper measures the first stack that comes out. With a checker at hand, one can draw more than is asked
for and keep what stands and matches. That is another question, so it has a row of its own in the tables.

Legend: B scenes, n stacks asked for, S shapes, H x W pixels.
"""

from __future__ import annotations

import math
import re
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette_iou
from stackgen.names import CheckerName
from stackgen.protocols import StabilityChecker, StackSampler, Verdict
from stackgen.sampling.feasible import VALID_IOU
from stackgen.stack import Layout, Stack, layout
from stackgen.world import Grid, Mask, World

MATCH = 0.95
"""Front IoU from which a standing stack is good enough to stop looking for a better one."""

FIRST_ROUND = 8
"""Smallest number of stacks drawn for a scene in the first round; every later round draws as many as all before."""

MOST_DRAWS = 4096
"""Largest number of stacks drawn for a scene where time alone is the limit."""


@dataclass(frozen=True)
class Budget:
    """What may be spent on a scene.

    Args:
        draws: Largest number of stacks drawn. The same seed gives the same answer.
        seconds: Time [s], where it is not null; a round does not begin if it would end too late. The answer
            then depends on the machine.

    Raises:
        StackgenError: If it allows nothing.
    """

    draws: int = 64
    seconds: float | None = None

    def __post_init__(self) -> None:
        if self.draws < 1 or (self.seconds is not None and not 0 < self.seconds < math.inf):
            raise StackgenError(f"budget: draws and seconds must be positive, got {self.draws} and {self.seconds}")

    @staticmethod
    def parse(text: str) -> Budget:
        """Read a budget from a time or a number of draws.

        Raises:
            StackgenError: If it is neither.

        >>> Budget.parse("64"), Budget.parse("500ms").seconds
        (Budget(draws=64, seconds=None), 0.5)
        """
        found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(ms|s|min)", text.strip(), re.ASCII)
        if found:
            scale = {"ms": 0.001, "s": 1.0, "min": 60.0}[found[2]]
            return Budget(MOST_DRAWS, float(found[1]) * scale)
        if re.fullmatch(r"\d{1,9}", text.strip(), re.ASCII):
            return Budget(int(text))
        raise StackgenError(f"budget {text!r}: give a time, such as 1s or 500ms, or a number of draws, such as 64")


@dataclass(frozen=True)
class Candidate:
    """A stack that was drawn and checked.

    Args:
        stack: Stack as drawn.
        verdict: Verdict of the checker.
        front_iou: Front IoU of the settled stack with the target; of an unstable one, as it was drawn.
        layout: Layout of the stack as drawn.
    """

    stack: Stack
    verdict: Verdict
    front_iou: float
    layout: Layout

    @property
    def matches(self) -> bool:
        """Whether it stands and nothing better need be looked for."""
        return self.verdict.stable and self.front_iou >= MATCH

    @property
    def valid(self) -> bool:
        """Whether it stands and is like the target at all."""
        return self.verdict.stable and self.front_iou >= VALID_IOU

    @property
    def rank(self) -> tuple[bool, int, float]:
        """Key that is larger for better candidates: stable, few blocks fallen, like the target."""
        return self.verdict.stable, -int(np.count_nonzero(self.verdict.fell)), self.front_iou


@dataclass(frozen=True)
class Choice:
    """What was chosen for a scene.

    Args:
        chosen: n candidates, the best first.
        drawn: Number of stacks drawn.
        checked: Number of these that were checked.
        stable: Number of those that stand.
    """

    chosen: tuple[Candidate, ...]
    drawn: int
    checked: int
    stable: int

    @property
    def valid(self) -> int:
        """Number of the chosen that stand and are like the target at all."""
        return sum(candidate.valid for candidate in self.chosen)


def best(candidates: Sequence[Candidate], number: int) -> tuple[Candidate, ...]:
    """Choose the best candidates, the best first: those that match, of distinct layouts as far as there are.

    What stands but does not match comes after them, and what falls comes last.
    """
    ranked = sorted(candidates, key=lambda candidate: candidate.rank, reverse=True)
    again = _repetitions([candidate.layout for candidate in ranked])
    order = sorted(range(len(ranked)), key=lambda i: (not ranked[i].matches, again[i] if ranked[i].matches else 0))
    return tuple(ranked[i] for i in order[:number])


def _repetitions(layouts: Sequence[Layout]) -> list[int]:
    """Count how many of the same layout come before each."""
    seen: Counter[Layout] = Counter()
    numbers = []
    for item in layouts:
        numbers.append(seen[item])
        seen[item] += 1
    return numbers


@dataclass
class _Search:
    """What is known of one scene during the search."""

    target: Mask
    wanted: int
    drawn: int = 0
    queue: list[tuple[Stack, Layout]] = field(default_factory=list)
    checked: list[Candidate] = field(default_factory=list)

    @property
    def missing(self) -> int:
        """Number of matching stacks that are not found yet."""
        return max(0, self.wanted - sum(candidate.matches for candidate in self.checked))

    def add(self, stacks: Sequence[Stack], grid: Grid) -> None:
        """Queue new draws: layouts not checked yet first, among equals the one that looks most like the target."""
        alike = [silhouette_iou(stack, self.target, grid) for stack in stacks]
        order = sorted(range(len(stacks)), key=lambda i: -alike[i])
        layouts = [layout(stacks[i], grid) for i in order]
        checked = Counter(candidate.layout for candidate in self.checked)
        again = [checked[kind] + before for kind, before in zip(layouts, _repetitions(layouts), strict=True)]
        urgency = [again[place] if alike[i] >= MATCH else math.inf for place, i in enumerate(order)]
        places = sorted(range(len(order)), key=lambda place: urgency[place])
        self.queue = [(stacks[order[place]], layouts[place]) for place in places]
        self.drawn += len(stacks)

    def take(self) -> list[tuple[Stack, Layout]]:
        """Take the next draws to be checked: as many as are missing."""
        number = self.missing
        taken, self.queue = self.queue[:number], self.queue[number:]
        return taken

    def keep(self, stack: Stack, verdict: Verdict, kind: Layout, grid: Grid) -> None:
        """Add a verdict."""
        shown = verdict.settled if verdict.stable else stack
        self.checked.append(Candidate(stack, verdict, silhouette_iou(shown, self.target, grid), kind))

    def choice(self) -> Choice:
        """Sum up the search."""
        stable = sum(candidate.verdict.stable for candidate in self.checked)
        return Choice(best(self.checked, self.wanted), self.drawn, len(self.checked), stable)


class _Clock:
    """Says when the time is up."""

    def __init__(self, seconds: float | None) -> None:
        self.began = self.lap = time.perf_counter()
        self.seconds = seconds

    @property
    def over(self) -> bool:
        """Whether there is no time left."""
        return self.seconds is not None and time.perf_counter() - self.began >= self.seconds

    def another_round(self, larger: float) -> bool:
        """Say whether a round `larger` times as large as the last fits; to be called before each but the first."""
        now = time.perf_counter()
        last, self.lap = now - self.lap, now
        return self.seconds is None or now - self.began + larger * last <= self.seconds


def checker_named(name: CheckerName, simulator: StabilityChecker) -> StabilityChecker:
    """Make the checker that verified sampling asks while it draws: the simulator, or statics with its physics.

    Raises:
        StackgenError: If there is no such checker.
    """
    if name == "simulator":
        return simulator
    if name == "statics":
        from stackgen.sim.statics.checker import StaticsChecker  # loads a solver that nothing else needs

        return StaticsChecker(simulator.physics)  # type: ignore[arg-type]
    raise StackgenError(f"verify: the checker is simulator or statics, not {name!r}")


@dataclass(frozen=True)
class VerifiedSampler:
    """A StackSampler that asks another for more than is wanted, has them checked and keeps the best.

    It draws in rounds until a scene has as many stacks that match as are wanted, or the budget is spent.
    Within a round new layouts are checked first, so the stacks it keeps differ where they can. The block
    list is the one it is given; where nothing stands it answers with the best of what falls, since a
    sampler must answer: `choose` says which is which.

    Args:
        sampler: Sampler that draws the stacks.
        checker: Checker that says which stand.
        budget: Budget of each scene; time is shared by the scenes of a batch.
        name: Name of the checker, for the record.
    """

    sampler: StackSampler
    checker: StabilityChecker
    budget: Budget = Budget()
    name: str = ""

    @property
    def world(self) -> World:
        """World of the sampler that draws."""
        return self.sampler.world

    @property
    def card(self) -> Mapping[str, Any]:
        """Card of the sampler that draws."""
        return self.sampler.card

    @cached_property
    def settings(self) -> dict[str, Any]:
        """How it samples, for the record."""
        spent = {"draws": self.budget.draws} if self.budget.seconds is None else {"seconds": self.budget.seconds}
        return {**self.sampler.settings, "verify": self.name or type(self.checker).__name__, **spent}

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """See StackSampler."""
        choices = self.choose(silhouettes, counts, num_samples, seed)
        return [[candidate.stack for candidate in choice.chosen] for choice in choices]

    def choose(self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int) -> list[Choice]:
        """Sample as `sample_batch` does, and give the verdicts and what was spent, too.

        Raises:
            StackgenError: If the sampler raises it, or no stack is asked for.
        """
        if num_samples < 1:
            raise StackgenError(f"the number of samples must be at least 1, got {num_samples}")
        limit = max(self.budget.draws, num_samples)
        seconds = self.budget.seconds
        clock = _Clock(None if seconds is None else seconds * max(1, len(silhouettes)))
        searches = [_Search(target, num_samples) for target in silhouettes]
        drawn = number = 0  # by every scene that is still open
        for turn in range(limit):
            open_ = [i for i, search in enumerate(searches) if search.missing]
            before, number = number, min(max(FIRST_ROUND, 2 * num_samples, drawn), limit - drawn)
            if not open_ or not number or (turn and not clock.another_round(number / before)):
                break
            fresh = int(np.random.SeedSequence([seed, turn]).generate_state(1, np.uint64)[0] >> 1)
            batch = self.sampler.sample_batch(silhouettes[open_], np.asarray(counts)[open_], number, fresh)
            for i, stacks in zip(open_, batch, strict=True):
                searches[i].add(stacks, self.world.grid)
            drawn += number
            self._check([searches[i] for i in open_], clock)
        return [search.choice() for search in searches]

    def _check(self, searches: Sequence[_Search], clock: _Clock) -> None:
        """Check queued stacks, of each scene only as many as it still misses, until nothing is missing."""
        while True:
            wave = [(search, *item) for search in searches for item in search.take()]
            if not wave:
                return
            verdicts = self.checker.check_all([stack for _, stack, _ in wave])
            for (search, stack, kind), verdict in zip(wave, verdicts, strict=True):
                search.keep(stack, verdict, kind, self.world.grid)
            if clock.over:
                return


def choose_list(
    sampler: VerifiedSampler, silhouette: Mask, lists: NDArray[np.int64], num_samples: int, seed: int
) -> tuple[NDArray[np.int64], Choice, int]:
    """Choose among block lists too: try the next one where too few valid stacks were found with those before.

    Every list has the whole number of draws; each has half of the time that is left, and the last all of it.

    Args:
        sampler: Sampler that draws and checks, and its budget.
        silhouette: (H, W) target.
        lists: (T, S) block lists, the most likely first.
        num_samples: Number of stacks n.
        seed: Seed; the same one gives the same answer, unless time is the budget.

    Returns:
        Block list (S,), what was chosen with it and was spent on all lists, and how many were tried.
    """
    tried: list[Choice] = []
    seconds, began = sampler.budget.seconds, time.perf_counter()
    for number, counts in enumerate(lists, 1):
        budget = sampler.budget
        if seconds is not None:
            left = seconds - (time.perf_counter() - began)
            if tried and left <= 0:
                break
            budget = replace(budget, seconds=max(1e-9, left if number == len(lists) else left / 2))
        part = VerifiedSampler(sampler.sampler, sampler.checker, budget)
        tried.append(part.choose(silhouette[None], counts[None], num_samples, seed)[0])
        if tried[-1].valid == num_samples:
            break
    number = max(range(len(tried)), key=lambda i: (tried[i].valid, tried[i].chosen[0].rank))
    drawn, checked, stable = (sum(getattr(choice, name) for choice in tried) for name in ("drawn", "checked", "stable"))
    return lists[number], Choice(tried[number].chosen, drawn, checked, stable), len(tried)
