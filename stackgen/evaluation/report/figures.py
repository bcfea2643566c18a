"""From answers to figures: every metric of a line, with its interval, on all scenes and on the unseen ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from stackgen.evaluation.intervals import Estimate
from stackgen.evaluation.report.known import NOTIONS, Ceiling, Unseen
from stackgen.evaluation.report.rows import Line
from stackgen.evaluation.results import METRICS, Evaluation, paper_figures

ALL = "all"
DIVERSITIES = ("diversity", "valid_diversity")


@dataclass(frozen=True)
class Figures:
    """What a line came to on some scenes.

    Args:
        scenes: How many.
        metrics: By the name of :data:`stackgen.evaluation.results.METRICS`; None where a metric does not exist.
        ceiling: Of valid diversity, on the scenes where it is known.
        ceiling_scenes: How many those are.
        of_ceiling: Share of the ceiling that valid diversity reached there.
        outside: Share of the valid samples there whose layout was not enumerated.
    """

    scenes: int
    metrics: dict[str, Estimate | None]
    ceiling: Estimate | None = None
    ceiling_scenes: int = 0
    of_ceiling: Estimate | None = None
    outside: Estimate | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain form: shares in [0, 1], null where a figure does not exist."""
        beside = {name: getattr(self, name) for name in ("ceiling", "of_ceiling", "outside")}
        named = {**self.metrics, **{f"valid_diversity_{name}": value for name, value in beside.items()}}
        return {
            "scenes": self.scenes,
            "ceiling_scenes": self.ceiling_scenes,
            "metrics": {name: value and value.to_json() for name, value in named.items()},
        }


@dataclass(frozen=True)
class Result:
    """A line with its figures.

    Args:
        line: The answer.
        figures: By the scenes they are about: `all` and the notions of unseen.
    """

    line: Line
    figures: dict[str, Figures]

    @property
    def paper(self) -> dict[str, float]:
        """The paper's figures for the same method and block list [%]; empty where it has none."""
        row = self.line.row
        return paper_figures(row.paper, self.line.block_list) if row.paper else {}


def results_of(lines: Sequence[Line], ceiling: Ceiling | None, unseen: Unseen | None) -> list[Result]:
    """All figures of the lines.

    Args:
        lines: Answers.
        ceiling: Of valid diversity, if it is known.
        unseen: Scenes to look at on their own, if they are known.
    """
    return [Result(line, _figures_of(line, ceiling, unseen)) for line in lines]


def _figures_of(line: Line, ceiling: Ceiling | None, unseen: Unseen | None) -> dict[str, Figures]:
    found = {ALL: figures(line.evaluation, ceiling)}
    for notion in NOTIONS if unseen else ():
        assert unseen is not None
        scenes = tuple(scene for scene in line.evaluation.scenes if scene.name in unseen.scenes[notion])
        if scenes:
            found[notion] = figures(replace(line.evaluation, scenes=scenes), ceiling)
    return found


def figures(evaluation: Evaluation, ceiling: Ceiling | None) -> Figures:
    """Every metric of an evaluation; diversity needs more than one sample a scene."""
    alone = evaluation.num_samples == 1
    metrics = {name: None if alone and name in DIVERSITIES else evaluation.estimate(name) for name in METRICS}
    share = None if ceiling is None or alone else ceiling.share(evaluation)
    if ceiling is None or share is None:
        return Figures(len(evaluation.scenes), metrics)
    number, most, reached = share
    return Figures(len(evaluation.scenes), metrics, most, number, reached, ceiling.outside(evaluation))
