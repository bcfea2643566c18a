"""What `stackgen report` asks of each row, and what of it is answered already."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jsonargparse import ArgumentParser

from stackgen.commands.parsing import parse
from stackgen.commands.test import WeightsUnderTest, require_one_world
from stackgen.data.generation.generate import TESTSET
from stackgen.data.shards import manifest_sha256
from stackgen.errors import StackgenError
from stackgen.evaluation.report.collect import Asked, Subject, Task, read_record
from stackgen.evaluation.report.questions import ground_truth_question, origin, question
from stackgen.evaluation.report.rows import Line, Row, Training
from stackgen.evaluation.report.store import Question, question_of
from stackgen.evaluation.results import PREDICTED_LIST, TRUE_LIST

OURS = ("num_samples", "seed", "predicted_lists", "method", "workers")
"""Options of a test that are the report's to choose, not a row's."""


@dataclass(frozen=True)
class ReportSettings:
    """How the table is made.

    Args:
        rows: Methods, in their order.
        groundwork: What comes before the rows when everything is made from scratch: data, block-list network.
        test_set: Folder of the scenes.
        num_samples: A scene.
        seed: Of the samplers.
        training_sets: Whose layouts count as seen, by the names that ship with the package; all by default.
        ceiling: Valid layouts of the scenes, as `python -m benchmarks.diversity_ceiling` writes them; null
            leaves the ceiling of valid diversity out.
    """

    rows: list[Row] = field(default_factory=list)
    groundwork: list[Training] = field(default_factory=list)
    test_set: Path = TESTSET
    num_samples: int = 3
    seed: int = 0
    training_sets: list[str] | None = None
    ceiling: Path | None = Path("docs/results/diversity_ceiling.json")

    def __post_init__(self) -> None:
        if self.num_samples < 1 or not 0 <= self.seed < 2**63:
            raise StackgenError("report: num_samples and seed must be whole numbers, of at least 1 and 0")


@dataclass(frozen=True)
class Plan:
    """The tasks of each row; none for a row that is recorded and whose weights are not here.

    Args:
        tasks: By the row's name.
        absent: Why a row has none.
    """

    tasks: Mapping[str, Sequence[Task]]
    absent: Mapping[str, str]

    def record_of(self, row: Row, asked: Asked, test_set: str, physics: Mapping[str, Any] | None) -> list[Line]:
        """The recorded lines of a row, with remarks on how they were asked.

        Raises:
            StackgenError: If there is no record, or it is damaged.
        """
        alike = [task.question for tasks in self.tasks.values() for task in tasks]
        predictors = [asked["predictor"] for asked in alike if asked["block_list"] == PREDICTED_LIST]
        questions = {}
        for source in (TRUE_LIST, PREDICTED_LIST):
            predictor = predictors[0] if predictors and source == PREDICTED_LIST else None
            questions[source] = question_of(
                {},
                source,
                predictor,
                test_set=test_set,
                scenes=len(asked.scenes),
                num_samples=asked.num_samples,
                seed=asked.seed,
                batch_size=asked.batch_size,
                physics=physics,
            )
        return read_record(row, questions)


def make_plan(
    settings: ReportSettings,
    asked: Asked,
    facts: Mapping[str, Any],
    manifest: Mapping[str, Any],
    physics: Mapping[str, Any] | None,
) -> Plan:
    """Load what the rows name, and say what is to be asked of it.

    Args:
        settings: With the rows.
        asked: How all of them are asked.
        facts: To be quoted with all results.
        manifest: Of the test set.
        physics: Of the verdicts.

    Raises:
        StackgenError: If a row's weights are not here and it has no record either.
    """
    tasks: dict[str, list[Task]] = {}
    absent: dict[str, str] = {}
    for row in settings.rows:
        try:
            tasks[row.name] = _tasks(row, settings, asked, facts, manifest, physics)
        except StackgenError as error:
            if row.recorded is None or not row.recorded.is_file():
                record = f", and no record at {row.recorded}" if row.recorded else ""
                raise StackgenError(f"report: row {row.name!r}: {error}{record}") from error
            absent[row.name] = str(error)
    return Plan(tasks, absent)


def _tasks(
    row: Row,
    settings: ReportSettings,
    asked: Asked,
    facts: Mapping[str, Any],
    manifest: Mapping[str, Any],
    physics: Mapping[str, Any] | None,
) -> list[Task]:
    number, test_set = len(asked.scenes), manifest_sha256(dict(manifest))
    if row.is_ground_truth:
        truth = Subject(None, None, {**facts, "weights": row.weights})
        return [Task(row, TRUE_LIST, ground_truth_question(test_set, number, physics), lambda: truth)]
    subject = under_test(row, settings)
    require_one_world(subject, manifest)

    def task(source: str) -> Task:
        asks: Question = question(subject, source, test_set, number, asked.batch_size, physics)
        predictor = subject.model.predictor if source == PREDICTED_LIST else None
        own = {**facts, "weights": subject.weights, **origin(subject)}
        return Task(row, source, asks, lambda: Subject(subject.model.sampler, predictor, own))

    return [task(source) for source in row.block_lists]


def under_test(row: Row, settings: ReportSettings) -> WeightsUnderTest:
    """A row's options as those of `stackgen test --model.*`.

    Raises:
        StackgenError: If there is no such option or no such weights.
    """
    taken = sorted(set(row.model) & set(OURS))
    if taken:
        raise StackgenError(f"{', '.join(taken)} of a row's model: the report chooses that for all rows alike")
    parser = ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(WeightsUnderTest, "model", sub_configs=True)
    options = {**row.model, "num_samples": settings.num_samples, "seed": settings.seed, "method": row.name}
    values = parse(parser, "test", [f"--model={json.dumps(options)}"])
    return parser.instantiate(values).model


def machine() -> str:
    """Processor and cores, for the seconds."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{cores} cores of {names[0] if names else platform.processor() or platform.machine()}"
