"""The rows of the report, and the lines they come to: one for each row and block list."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from stackgen.errors import StackgenError
from stackgen.evaluation.report.store import Question
from stackgen.evaluation.results import PAPER, PREDICTED_LIST, TRUE_LIST, Evaluation

GROUND_TRUTH = "ground-truth"
"""As `weights`: the true stacks, simulated again."""

Kind = Literal["one-shot", "verified"]
KINDS: tuple[Kind, ...] = ("one-shot", "verified")
LIST_NAMES = {TRUE_LIST: "true", PREDICTED_LIST: "CNN's"}


@dataclass(frozen=True)
class Training:
    """How the weights of a row were made, so that others can.

    Args:
        name: Of what is made.
        command: Command lines.
        hours: What they took.
        machine: Where.
    """

    name: str
    command: str
    hours: float
    machine: str


@dataclass(frozen=True)
class Row:
    """A method, and how it is asked.

    Args:
        name: In the tables.
        model: Options of `stackgen test --model.*`: `weights` (a name, a file, or `ground-truth` for the true
            stacks simulated again) and whatever else says how it samples.
        kind: One-shot: a sample is what comes out first. Verified: it was chosen with the judge at hand;
            such rows stand in a section of their own.
        paper: The method in the paper's table whose figures stand beside.
        training: How the weights were made.
        recorded: File the results are kept in for good, for weights too large to ship: written where the
            weights are, read where they are not.
        note: What the reader should know.
    """

    name: str
    model: dict[str, Any]
    kind: Kind = "one-shot"
    paper: str | None = None
    training: Training | None = None
    recorded: Path | None = None
    note: str = ""

    @property
    def weights(self) -> str:
        """Name or file of the weights."""
        return str(self.model["weights"])

    @property
    def is_ground_truth(self) -> bool:
        """Whether nothing is sampled."""
        return self.weights == GROUND_TRUTH

    @property
    def block_lists(self) -> tuple[str, ...]:
        """The block lists it is asked with."""
        return (TRUE_LIST,) if self.is_ground_truth else (TRUE_LIST, PREDICTED_LIST)

    @property
    def slug(self) -> str:
        """Its name as part of file names."""
        words = "".join(c if c.isalnum() else " " for c in self.name.lower()).split()
        return "-".join(words)


def check_rows(rows: Sequence[Row]) -> None:
    """Raise StackgenError unless the rows can be told apart and name what exists."""
    if not rows:
        raise StackgenError("report: there are no rows; give --config configs/report.yaml")
    slugs = [row.slug for row in rows]
    for row in rows:
        if not row.slug or slugs.count(row.slug) > 1:
            raise StackgenError(f"report: rows need names of their own, {row.name!r} is none")
        if "weights" not in row.model:
            raise StackgenError(f"report: row {row.name!r} names no weights: model: {{weights: NAME}}")
        if (row.kind == "verified") != ("verify" in row.model):
            raise StackgenError(
                f"report: row {row.name!r}: verified is what has `verify` in its model, and nothing else"
            )
        if row.paper is not None and row.paper not in PAPER:
            raise StackgenError(f"report: row {row.name!r}: the paper has {', '.join(PAPER)}, not {row.paper!r}")


@dataclass(frozen=True)
class Line:
    """A row with one of the block lists, answered.

    Args:
        row: Whose.
        evaluation: The answer.
        question: What was asked.
        recorded: Whether the answer was read from the row's record.
        remarks: In what the question differs from the other lines', in words.
    """

    row: Row
    evaluation: Evaluation
    question: Question
    recorded: bool = False
    remarks: tuple[str, ...] = ()

    @property
    def block_list(self) -> str:
        """Whose block lists."""
        return self.evaluation.block_list

    @property
    def has_diversity(self) -> bool:
        """Whether there is more than one sample a scene to tell apart."""
        return self.evaluation.num_samples > 1


def run_seconds(lines: Iterable[Line]) -> float:
    """What sampling and judging took where it was told and done here, of all lines together [s]."""
    told = [line.evaluation.facts for line in lines if not line.recorded]
    return float(sum(facts.get(part) or 0 for facts in told for part in ("sampling_s", "judging_s")))


def trainings(rows: Sequence[Row], groundwork: Sequence[Training]) -> list[Training]:
    """Everything to be done before the rows can be asked."""
    return [*groundwork, *(row.training for row in rows if row.training)]
