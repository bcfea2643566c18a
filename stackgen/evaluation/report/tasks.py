"""From the rows of the report to what is asked of each method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from stackgen.data.manifest import Manifest
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import Request
from stackgen.evaluation.report.rows import GROUND_TRUTH, ReportSettings, Row
from stackgen.evaluation.requests import load_method, question_of, require_one_world
from stackgen.evaluation.results import Question


class Task(NamedTuple):
    """A row with one kind of block list, to be answered.

    Args:
        row: The method.
        request: What is asked of it.
        question: What the answer depends on.
    """

    row: Row
    request: Request
    question: Question

    @property
    def place(self) -> tuple[str, str]:
        """Name of the row and kind of block list."""
        return self.row.name, self.request.block_list


def tasks_of(
    settings: ReportSettings, manifest: Manifest, scenes: int, *, physics: Mapping[str, Any], facts: Mapping[str, Any]
) -> list[Task]:
    """Load what the rows name, and say what is asked of each.

    Args:
        settings: The report's, with the rows.
        manifest: Manifest of the test set.
        scenes: How many of its scenes are asked about, from the first.
        physics: Numbers that the verdicts depend on.
        facts: What is to be quoted with all results.

    Raises:
        StackgenError: If a row's weights are not here, or are of another world.
    """
    tasks = []
    for row in settings.rows:
        try:
            requests = _requests(row, settings, manifest, facts)
        except StackgenError as error:
            raise StackgenError(f"report: row {row.name!r}: {error}") from error
        tasks += [Task(row, request, question_of(request, manifest.sha256, scenes, physics)) for request in requests]
    return tasks


def _requests(row: Row, settings: ReportSettings, manifest: Manifest, facts: Mapping[str, Any]) -> list[Request]:
    if row.is_ground_truth:
        request = Request.ground_truth(manifest.world, {**facts, "weights": GROUND_TRUTH})
        return [replace(request, method=row.name)]
    loaded = load_method(row.model)
    require_one_world(loaded, manifest.world, manifest.name)
    return loaded.requests(row.name, settings.num_samples, settings.seed, facts=facts)
