"""Answers for the rows: those that are there already, and those that must be run first.

An answer is looked for in the report's cache, then among what `stackgen test` left in the folder of runs,
by its question: everything it depends on. What answers another question, be it only of another physics,
is never taken for it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import Progress, Scene, ceiling, evaluate
from stackgen.evaluation.report.pick import pick_examples
from stackgen.evaluation.report.rows import Line, Row
from stackgen.evaluation.report.store import (
    PREFIX,
    Question,
    differences,
    from_json,
    key_of,
    read_evaluation,
    to_json,
    write_evaluation,
)
from stackgen.evaluation.results import PREDICTED_LIST, Evaluation
from stackgen.io.files import write_atomically
from stackgen.protocols import BlockListPredictor, StabilityChecker, StackSampler
from stackgen.world import PAPER_GRID, Grid

RECORDED_FORMAT = "stackgen.recorded/1"
WORLD = ("physics", "test_set", "protocol")
"""Parts of a question: where they differ, results cannot be compared."""


class Store:
    """Where answers are kept and found.

    Args:
        cache: Folder of the report's own; made when it is needed.
        runs: Folder in which `stackgen test` left its runs.
    """

    def __init__(self, cache: Path, runs: Path) -> None:
        self.cache, self.runs = cache, runs

    def find(self, question: Question) -> tuple[Evaluation, Path] | None:
        """The answer to a question and where it was, if there is one."""
        own = self._path(question)
        paths = [*([own] if own.exists() else []), *(p for p, asked in self._tests.items() if asked == question)]
        for path in paths:
            try:
                evaluation, answered = read_evaluation(path)
            except StackgenError:
                continue  # half of an answer is none: it is asked again
            if answered == question:
                return evaluation, path
        return None

    def left_out(self, question: Question) -> Iterator[tuple[Path, str]]:
        """Tests of the same sampler in another world, and in what that differs."""
        for path, asked in self._tests.items():
            same = all(asked.get(part) == question[part] for part in ("sampler", "block_list"))
            if same and (remarks := world_apart(question, asked)):
                yield path, "; ".join(remarks)

    def keep(self, evaluation: Evaluation, question: Question) -> None:
        """Put an answer into the cache.

        Raises:
            StackgenError: If it cannot be written.
        """
        try:
            self.cache.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StackgenError(f"{self.cache}: no folder to keep results in: {error.strerror}") from error
        write_evaluation(self._path(question), evaluation, question)

    def _path(self, question: Question) -> Path:
        return self.cache / f"{PREFIX}{key_of(question)}.json"

    @cached_property
    def _tests(self) -> dict[Path, Question]:
        """What each test was asked."""
        found = {}
        for path in sorted(self.runs.glob(f"*/test_*/{PREFIX}*.json")):
            try:
                found[path] = read_evaluation(path)[1]
            except StackgenError:
                continue  # a test that was interrupted
        return found


def world_apart(question: Question, other: Question) -> tuple[str, ...]:
    """In what world another question was answered, in words; empty if it is the same.

    >>> world_apart({"physics": {"friction": 0.5}}, {"physics": {"friction": 0.4}})
    ('other physics: friction 0.4, not 0.5',)
    """
    apart = differences(*({part: q.get(part) for part in WORLD} for q in (question, other)))
    physics = [f"{path.removeprefix('physics.')} {theirs}, not {ours}"
               for path, (ours, theirs) in apart.items() if path.startswith("physics")]  # fmt: skip
    remarks = [f"other physics: {', '.join(physics)}"] if physics else []
    if "test_set" in apart:
        remarks.append(f"another test set: {str(apart['test_set'][1])[:12]}")
    if "protocol" in apart:
        remarks.append(f"another version of the protocol: {apart['protocol'][1]}")
    return tuple(remarks)


@dataclass(frozen=True)
class Subject:
    """What a row's options stand for.

    Args:
        sampler: Whom to ask; None for the true stacks.
        predictor: Gives the block lists; None takes the true ones.
        facts: To be quoted with the results.
    """

    sampler: StackSampler | None
    predictor: BlockListPredictor | None
    facts: Mapping[str, Any]


@dataclass(frozen=True)
class Task:
    """A row with one of the block lists.

    Args:
        row: Whose.
        block_list: `ground truth` or `predicted`.
        question: What is asked of it.
        subject: Loads whom to ask.
    """

    row: Row
    block_list: str
    question: Question
    subject: Callable[[], Subject]


@dataclass(frozen=True)
class Asked:
    """How all rows are asked.

    Args:
        scenes: Of the test set.
        num_samples: A scene.
        seed, batch_size: Which samples of all that there could be.
        grid: Of the scenes.
    """

    scenes: Sequence[Scene]
    num_samples: int
    seed: int
    batch_size: int = 64
    grid: Grid = PAPER_GRID


def answer(task: Task, asked: Asked, checker: StabilityChecker, progress: Progress) -> Evaluation:
    """Run a row with one of the block lists; what it took is among the facts."""
    subject = task.subject()
    began = time.perf_counter()
    if subject.sampler is None:
        found = replace(ceiling(asked.scenes, checker, asked.grid), facts=dict(subject.facts))
        progress(len(asked.scenes), len(asked.scenes))
    else:
        found = evaluate(
            subject.sampler,
            asked.scenes,
            checker,
            asked.num_samples,
            asked.seed,
            subject.predictor,
            progress,
            method=task.row.name,
            batch_size=asked.batch_size,
            grid=asked.grid,
            facts=dict(subject.facts),
        )
    whole = time.perf_counter() - began
    sampling = (found.seconds_per_sample or 0.0) * sum(len(scene.score.samples) for scene in found.scenes)
    return replace(found, facts={**found.facts, "sampling_s": sampling, "judging_s": whole - sampling})


def write_record(lines: Sequence[Line]) -> None:
    """Keep a row's results for good, with the stacks of its contact sheet alone.

    Raises:
        StackgenError: If it cannot be written.
    """
    row = lines[0].row
    assert row.recorded is not None
    content = {
        "format": RECORDED_FORMAT,
        "row": row.name,
        "training": row.training and asdict(row.training),
        "evaluations": [to_json(_thinned(line.evaluation), line.question) for line in lines],
    }
    write_atomically(row.recorded, (json.dumps(content, allow_nan=False) + "\n").encode())


def _thinned(evaluation: Evaluation) -> Evaluation:
    """The same without the stacks that are on no contact sheet."""
    shown = {example.scene.name for examples in pick_examples(evaluation) for example in examples}
    scenes = (scene if scene.name in shown else replace(scene, stacks=()) for scene in evaluation.scenes)
    return replace(evaluation, scenes=tuple(scenes))


def read_record(row: Row, questions: Mapping[str, Question]) -> list[Line]:
    """A row's recorded results, with remarks where they were asked otherwise than the others.

    Args:
        row: Whose `recorded` file there is.
        questions: What the other rows are asked, by block list, as far as it is no matter of the sampler.

    Raises:
        StackgenError: If the file is missing or damaged.
    """
    assert row.recorded is not None
    try:
        data = json.loads(row.recorded.read_text())
        if data["format"] != RECORDED_FORMAT:
            raise ValueError(data["format"])
        pairs = [from_json(item) for item in data["evaluations"]]
    except OSError as error:
        raise StackgenError(f"{row.recorded} cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, StackgenError) as error:
        raise StackgenError(f"{row.recorded} is damaged or no {RECORDED_FORMAT} file") from error
    return [
        Line(row, found, asked, True, _remarks(questions.get(found.block_list, asked), asked)) for found, asked in pairs
    ]


def _remarks(question: Question, recorded: Question) -> tuple[str, ...]:
    """In what a recorded result was asked otherwise, in words."""
    others = ("scenes", "num_samples", "seed", "batch_size")
    pairs = [(part, question.get(part), recorded.get(part)) for part in others]
    remarks = [f"{part.replace('_', ' ')} {theirs}, not {ours}" for part, ours, theirs in pairs if ours != theirs]
    if recorded.get("block_list") == PREDICTED_LIST and question.get("predictor") != recorded.get("predictor"):
        remarks.append("block lists of another network")
    return (*world_apart(question, recorded), *remarks)
