"""The one format of a sweep: a W&B sweep file, read the same by `stackgen sweep` and by `wandb sweep`.

https://docs.wandb.ai/guides/sweeps/define-sweep-configuration
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from stackgen.errors import StackgenError
from stackgen.io.text import to_yaml

DEFAULT_COMMAND = ("${env}", "${interpreter}", "${program}", "${args}")
"""What W&B runs where a file has no `command`."""


@dataclass(frozen=True)
class Metric:
    """What a sweep optimises.

    Args:
        name: Name of the metric, as the program logs it; without one, which `bayes` needs, no trial is the best.
        goal: Direction that is better.
        target: Value of a whole trial after which no other is started.
    """

    name: str | None = None
    goal: Literal["minimize", "maximize"] = "minimize"
    target: float | None = None

    def is_reached_by(self, value: float) -> bool:
        """Tell whether a value is as good as the target.

        >>> Metric("loss", target=0.1).is_reached_by(0.2), Metric("iou", "maximize", 0.9).is_reached_by(0.9)
        (False, True)
        """
        if self.target is None:
            return False
        return value >= self.target if self.goal == "maximize" else value <= self.target


@dataclass(frozen=True)
class EarlyTerminate:
    """When a trial is given up: successive halving, as W&B's `hyperband` is (Li et al. 2018).

    At the rungs min_iter, eta * min_iter, eta^2 * min_iter, ... only the best 1 / eta of the trials that came
    so far continue.

    Args:
        type: Name of the rule; W&B knows no other.
        min_iter: First rung, in reports of the metric.
        max_iter: Reports of a whole trial; with `s` instead of `min_iter`, the first rung is max_iter / eta^s.
        s: Number of rungs below `max_iter`.
        eta: Trials that come to a rung for each one that continues.
    """

    type: Literal["hyperband"] = "hyperband"
    min_iter: int | None = None
    max_iter: int | None = None
    s: int | None = None
    eta: int = 3

    @property
    def first_rung(self) -> int:
        """Reports before a trial can be given up."""
        if self.min_iter is not None:
            return self.min_iter
        if self.max_iter is None or self.s is None:  # W&B takes no less
            raise StackgenError("early_terminate: give min_iter, or max_iter and s")
        return max(1, self.max_iter // self.eta**self.s)


@dataclass(frozen=True)
class Sweep:
    """A sweep file.

    Args:
        program: Program that every trial runs.
        parameters: Parameters to try: for each name `value`, `values`, or `min` and `max` with a `distribution`.
        metric: Metric that is optimised.
        method: Way to propose values: `bayes` learns from the trials so far (here TPE), `random` and `grid` do not.
        command: Words of a trial's command line; W&B's macros, such as `${program}` and `${args}`, are filled in.
        early_terminate: Rule by which a trial is stopped early; without it none is.
        run_cap: Number of trials in all; 30 by default, for a grid all its points.
        name: Name of the sweep; its files go to runs/sweeps/NAME.
        description: Description for people.
        project: Project at W&B.
        entity: Account at W&B.
    """

    program: str
    parameters: dict[str, dict[str, Any]]
    metric: Metric = Metric()
    method: Literal["bayes", "random", "grid"] = "bayes"
    command: list[str | int | float | bool] | None = None
    early_terminate: EarlyTerminate | None = None
    run_cap: int | None = None
    name: str = "sweep"
    description: str | None = None
    project: str | None = None
    entity: str | None = None

    def __post_init__(self) -> None:
        if self.run_cap is not None and self.run_cap < 1:
            raise StackgenError(f"--run_cap must be at least 1, got {self.run_cap}")
        if self.metric.name is None and (self.method == "bayes" or self.early_terminate or self.metric.target):
            raise StackgenError("a sweep that learns from its trials needs a metric, such as {name: validation/loss}")
        stop = self.early_terminate
        if stop is not None and (stop.eta < 2 or stop.first_rung < 1):
            raise StackgenError("early_terminate: eta must be at least 2 and min_iter at least 1")
        if not self.parameters:
            raise StackgenError("a sweep needs parameters, such as {model.draws: {values: [1, 2, 4]}}")

    def to_json(self) -> dict[str, Any]:
        """Give the plain form, a W&B sweep file, without what was left out; a parameter's value may be null."""
        plain = asdict(self, dict_factory=lambda items: {name: value for name, value in items if value is not None})
        if self.metric.name is None:
            del plain["metric"]  # its goal alone says nothing
        return plain

    def to_yaml(self) -> str:
        """Write the file for `wandb sweep`."""
        return to_yaml(self.to_json())
