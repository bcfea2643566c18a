"""The results of the rows: every metric with its interval, on all scenes and on those that training has not seen."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any

from stackgen.evaluation.intervals import Estimate
from stackgen.evaluation.metrics import METRICS
from stackgen.evaluation.report.references import NOTIONS, DiversityLimit, Unseen
from stackgen.evaluation.report.rows import Row
from stackgen.evaluation.results import Evaluation, Question, estimates_to_json
from stackgen.evaluation.tables import paper_metrics

ALL = "all"
DIVERSITIES = ("diversity", "valid_diversity")
"""Metrics that a single sample of a scene does not have."""


@dataclass(frozen=True)
class Result:
    """What a row came to with one kind of block list.

    Args:
        row: The method.
        evaluation: Its answer, down to the samples.
        question: What the answer depends on.
        metrics: Estimates by set of scenes (`all` and the notions of unseen) and by the name of the metric: those
            of METRICS and of DiversityLimit.estimates; None where a metric does not exist.
        scenes: Number of scenes of each set.
        limit_scenes: Number of scenes of each set whose diversity limit is known.
        fit: How the blocks of the samples lie to each other, and whether they stand in both engines, on all scenes.
        remark: What the reader must know to compare it with the others.
    """

    row: Row
    evaluation: Evaluation
    question: Question
    metrics: dict[str, dict[str, Estimate | None]]
    scenes: dict[str, int]
    limit_scenes: dict[str, int]
    fit: dict[str, Estimate | None]
    remark: str = ""

    @property
    def block_list(self) -> str:
        """Whose block lists: `true` or `predicted`."""
        return self.evaluation.block_list

    @property
    def list_name(self) -> str:
        """Whose block lists, for people."""
        return self.row.list_name(self.block_list)

    @property
    def paper(self) -> dict[str, float]:
        """The paper's numbers for the same method and block list [%]; empty where it has none."""
        return paper_metrics(self.row.paper, self.block_list) if self.row.paper else {}

    def to_json(self) -> dict[str, Any]:
        """Give the plain form: shares in [0, 1], null where a metric does not exist."""
        answer = self.evaluation
        return {
            "method": self.row.name,
            "kind": self.row.kind,
            "block_list": self.block_list,
            "remark": self.remark,
            "samples_per_scene": answer.num_samples,
            "seconds_per_sample": answer.seconds_per_sample,
            "seconds": {"sampling": answer.sampling_seconds, "checking": answer.checking_seconds},
            "facts": answer.facts,
            "question": self.question,
            "training": self.row.training and asdict(self.row.training),
            "paper_percent": self.paper or None,
            "scenes": self.scenes,
            "limit_scenes": self.limit_scenes,
            "metrics": {subset: estimates_to_json(estimates) for subset, estimates in self.metrics.items()},
            "fit": estimates_to_json(self.fit),
            "second_engine": answer.second,
            "block_lists": estimates_to_json(answer.list_estimates()) or None,
        }


def result_of(
    row: Row,
    evaluation: Evaluation,
    question: Question,
    *,
    limit: DiversityLimit | None = None,
    unseen: Unseen | None = None,
) -> Result:
    """Compute all metrics of a row's answer.

    Args:
        row: The method.
        evaluation: Its answer.
        question: What the answer depends on.
        limit: Diversity limit, if it is known.
        unseen: Scenes to look at on their own, if they are known.
    """
    subsets = {ALL: evaluation}
    for notion in NOTIONS if unseen else ():
        assert unseen is not None
        scenes = tuple(scene for scene in evaluation.scenes if scene.name in unseen.scenes[notion])
        if scenes:
            subsets[notion] = replace(evaluation, scenes=scenes)
    metrics, limit_scenes = {}, {}
    for subset, some in subsets.items():
        alone = some.num_samples == 1
        limit_scenes[subset], compared = (0, {}) if limit is None or alone else limit.estimates(some)
        own = {name: None if alone and name in DIVERSITIES else some.estimate(name) for name in METRICS}
        metrics[subset] = {**own, **compared}
    numbers = {subset: len(some.scenes) for subset, some in subsets.items()}
    fit, remark = evaluation.fit(), _remark(evaluation, unseen)
    return Result(row, evaluation, question, metrics, numbers, limit_scenes, fit, remark)


def _remark(evaluation: Evaluation, unseen: Unseen | None) -> str:
    """Say so where it is not known what training has seen."""
    trained_on = evaluation.facts.get("trained_on") or {}
    if unseen is None or not trained_on or trained_on["sha256"] in unseen.hashes:
        return ""
    return f"trained on {trained_on['name']}, of which it is not known what it holds of the test set"


def run_seconds(results: Iterable[Result]) -> float:
    """Sum what sampling and checking took for some results together [s]."""
    answers = [result.evaluation for result in results]
    return sum(answer.sampling_seconds + (answer.checking_seconds or 0.0) for answer in answers)
