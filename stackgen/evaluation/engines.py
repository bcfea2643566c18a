"""What the other engine says of the same stacks: what stands in both hangs on neither engine's way with contacts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from itertools import islice

from stackgen.evaluation.metrics import SampleScore
from stackgen.evaluation.parallel import simulating
from stackgen.evaluation.results import Evaluation
from stackgen.protocols import StabilityChecker
from stackgen.sim.physics import Physics
from stackgen.sim.statics.fit import overlaps_and_gaps
from stackgen.stack import Stack


@contextmanager
def second_engine(physics: Physics, workers: int = 1) -> Iterator[StabilityChecker | None]:
    """Open a checker that asks the engine that a physics does not name; None where that is not installed."""
    bullet = physics.engine == "bullet"
    if not find_spec("mujoco" if bullet else "pybullet"):
        yield None
        return
    other = Physics.recorded(physics.to_json(), Physics(engine="mujoco" if bullet else "bullet"))
    with simulating(other, workers) as checker:
        yield checker


def completed(evaluation: Evaluation, second: StabilityChecker | None) -> Evaluation:
    """Measure what an evaluation lacks: how the blocks of its samples lie, and whether they stand in a second engine.

    Args:
        evaluation: The same object is given back where it lacks nothing.
        second: Asked about the samples that stand, where these numbers were not asked; None asks nobody.
    """
    pairs = [pair for scene in evaluation.scenes for pair in zip(scene.score.samples, scene.stacks, strict=True)]
    ask = second is not None and evaluation.second != second.physics.to_json()
    if not ask and all(score.overlap is not None for score, _ in pairs):
        return evaluation
    scores = [_measured(score, stack) for score, stack in pairs]
    if ask and second is not None:
        verdicts = iter(second.check_all([stack for score, stack in pairs if score.stable]))
        scores = [replace(score, in_both=score.stable and next(verdicts).stable) for score in scores]
        evaluation = replace(evaluation, second=second.physics.to_json())
    found = iter(scores)
    scenes = (
        replace(scene, score=replace(scene.score, samples=tuple(islice(found, len(scene.stacks)))))
        for scene in evaluation.scenes
    )
    return replace(evaluation, scenes=tuple(scenes))


def _measured(score: SampleScore, stack: Stack) -> SampleScore:
    """Add how the blocks lie, where that is not known."""
    if score.overlap is not None:
        return score
    fit = overlaps_and_gaps(stack)
    return replace(score, overlap=fit.largest_overlap, gap=fit.largest_gap)
