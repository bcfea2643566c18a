"""The rows of the report: which methods are measured, and how their weights were made."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from stackgen.data.dataset import TESTSET
from stackgen.errors import StackgenError
from stackgen.evaluation.report.references import LIMIT_FILE
from stackgen.evaluation.requests import Method
from stackgen.evaluation.results import TRUE_LIST
from stackgen.evaluation.tables import PAPER

GROUND_TRUTH = "ground-truth"
"""As `weights`: the true stacks, simulated again."""

Kind = Literal["one-shot", "verified"]
KINDS: tuple[Kind, ...] = ("one-shot", "verified")
TRUE, NETWORKS, OWN = "true", "CNN's", "own"
"""Whose block lists: those of the scenes, the network's, or those that the method finds itself."""


@dataclass(frozen=True)
class Training:
    """How the weights of a row were made, so that others can make them.

    Args:
        name: Name of what is made.
        command: Command lines that make it.
        hours: Time that they took [h].
        machine: Machine that they ran on.
    """

    name: str
    command: str
    hours: float
    machine: str


@dataclass(frozen=True)
class Row:
    """One method in the table.

    Args:
        name: Its name in the tables.
        model: Options of `stackgen test` that say who samples and how; `weights: ground-truth` are the true
            stacks, simulated again.
        kind: One-shot: a sample is what comes out first. Verified: it was chosen with the help of a checker;
            such rows stand in a section of their own.
        paper: Method of the paper's table whose numbers stand beside.
        training: How the weights were made.
        note: What the reader should know.
    """

    name: str
    model: Method
    kind: Kind = "one-shot"
    paper: str | None = None
    training: Training | None = None
    note: str = ""

    @property
    def is_ground_truth(self) -> bool:
        """Whether nothing is sampled."""
        return self.model.weights == GROUND_TRUTH

    def list_name(self, block_list: str) -> str:
        """Name whose block lists it is asked with."""
        if block_list == TRUE_LIST:
            return TRUE
        return OWN if self.model.block_list_weights == self.model.weights else NETWORKS

    @property
    def slug(self) -> str:
        """Its name as part of file names."""
        words = "".join(c if c.isalnum() else " " for c in self.name.lower()).split()
        return "-".join(words)


@dataclass(frozen=True)
class ReportSettings:
    """How the table is made.

    Args:
        rows: Methods, in their order; by default those of the paper's table.
        groundwork: Steps before the rows when everything is made from scratch: data, block-list network.
        test_set: Dataset whose test scenes are asked about.
        num_samples: Number of stacks sampled for each scene.
        seed: Seed of the samplers.
        training_sets: Training sets whose layouts count as seen, by the names that ship with the package; null
            takes all of them.
        diversity_limit: File with the valid layouts of the scenes, as `python -m benchmarks.diversity_limit` writes
            it; null leaves the diversity limit out.
    """

    rows: list[Row] = field(default_factory=list)
    groundwork: list[Training] = field(default_factory=list)
    test_set: Path = TESTSET
    num_samples: int = 3
    seed: int = 0
    training_sets: list[str] | None = None
    diversity_limit: Path | None = LIMIT_FILE

    def __post_init__(self) -> None:
        if self.num_samples < 1 or not 0 <= self.seed < 2**63:
            raise StackgenError("report: num_samples must be at least 1 and seed at least 0")


def check_rows(rows: Sequence[Row]) -> None:
    """See that the rows can be told apart and name what exists.

    Raises:
        StackgenError: If not.
    """
    if not rows:
        raise StackgenError("report: there are no rows; leave --rows out for the paper's table")
    slugs = [row.slug for row in rows]
    for row in rows:
        if not row.slug or slugs.count(row.slug) > 1:
            raise StackgenError(f"report: each row needs a name of its own, {row.name!r} is none")
        if (row.kind == "verified") != (row.model.verify is not None):
            raise StackgenError(f"report: row {row.name!r}: a row is verified if its model has `verify`, and only then")
        if row.paper is not None and row.paper not in PAPER:
            raise StackgenError(f"report: row {row.name!r}: the paper has {', '.join(PAPER)}, not {row.paper!r}")


def trainings(rows: Iterable[Row], groundwork: Sequence[Training]) -> list[Training]:
    """List everything that must be made before the rows can be asked."""
    return [*groundwork, *(row.training for row in rows if row.training)]
