"""What a sweep found, as files: leaderboard, best configuration, and plots of the parameters and their importance."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jsonargparse import Namespace
from rich.table import Table

from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.io.text import read_yaml, to_yaml
from stackgen.training.runs import RUNS
from stackgen.training.sweeps.child import RUN
from stackgen.training.sweeps.file import Sweep
from stackgen.training.sweeps.space import constants_of, space_of
from stackgen.training.sweeps.telling import DIVERGED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial

BEST, LEADERBOARD, IMPORTANCE, SLICES = "best.yaml", "leaderboard.csv", "importance.png", "slices.png"
_COLOURS = {"PRUNED": "#b9bec7", "COMPLETE": "#3b78b4", "best": "#c8402f"}
_DPI = 130
_LETTERS = 24
"""Letters of a setting that is a text, at most."""


def value_of(trial: FrozenTrial) -> float:
    """Give a trial's value of the metric: the last that was told; NaN if none was, or if the trial diverged."""
    if state_of(trial) == DIVERGED:
        return math.nan
    told = trial.intermediate_values
    return trial.value if trial.value is not None else told[max(told)] if told else math.nan


def state_of(trial: FrozenTrial) -> str:
    """Say how a trial ended, in a word."""
    return DIVERGED if DIVERGED in trial.user_attrs else trial.state.name.lower()


def ranking(study: Study) -> list[FrozenTrial]:
    """Sort all trials: those that ran to their end, the best first, then those given up, then the others."""
    sign = -1 if study.direction.name == "MAXIMIZE" else 1
    order = {"COMPLETE": 0, "PRUNED": 1}

    def key(trial: FrozenTrial) -> tuple[int, float]:
        value = value_of(trial)
        return order.get(trial.state.name, 2), math.inf if math.isnan(value) else sign * value

    return sorted(study.get_trials(deepcopy=False), key=key)


def write_findings(study: Study, sweep: Sweep, folder: Path) -> list[Path]:
    """Write everything that a sweep found, and list the files; without a metric that is what became of the trials.

    Raises:
        StackgenError: If no trial ran to its end.
    """
    trials = ranking(study)
    values = {trial.value for trial in trials if trial.state.name == "COMPLETE"}
    if not values:
        raise StackgenError(f"no trial of {folder} ran to its end; look into {folder}/trials/*/log.txt")
    write_atomically(folder / LEADERBOARD, leaderboard(trials, sweep).encode())
    if sweep.metric.name is None:
        return [folder / LEADERBOARD]
    write_atomically(folder / BEST, best_configuration(trials[0], sweep, folder, len(trials)).encode())
    write_slices(trials, sweep, folder / SLICES)
    written = [folder / BEST, folder / LEADERBOARD, folder / SLICES]
    if sum(trial.state.name == "COMPLETE" for trial in trials) >= 4 and len(values) > 1:
        write_importance(study, sweep, folder / IMPORTANCE)
        written.append(folder / IMPORTANCE)
    return written


def leaderboard(trials: Sequence[FrozenTrial], sweep: Sweep) -> str:
    """Write the trials as CSV, the best first."""
    names = list(space_of(sweep.parameters))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["rank", "trial", "state", sweep.metric.name or "-", "reports", "seconds", *names])
    for rank, trial in enumerate(trials, 1):
        seconds = trial.duration.total_seconds() if trial.duration else math.nan
        metrics = [f"{value_of(trial):.6g}", len(trial.intermediate_values), f"{seconds:.1f}"]
        values = [trial.params.get(name) for name in names]
        table.writerow([rank, trial.number, state_of(trial), *metrics, *values])
    return text.getvalue()


def leaderboard_table(trials: Sequence[FrozenTrial], sweep: Sweep, most: int = 10) -> Table:
    """Make a table of the best trials for the terminal."""
    names = list(space_of(sweep.parameters))
    short = [name.rpartition(".")[2] for name in names]
    heads = [s if short.count(s) == 1 else name for s, name in zip(short, names, strict=True)]
    table = Table("trial", "state", sweep.metric.name or "-", *heads, box=None, pad_edge=False)
    for trial in trials[:most]:
        values = [_shown(trial.params.get(name)) for name in names]
        table.add_row(str(trial.number), state_of(trial), f"{value_of(trial):.4g}", *values)
    return table


def _shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)[:_LETTERS]


def best_configuration(best: FrozenTrial, sweep: Sweep, folder: Path, trials: int) -> str:
    """Write the configuration of the best trial's run, for `stackgen fit`; for other programs the trial's values."""
    title = f"# The best of {trials} trials of the sweep {sweep.name}: trial {best.number}, "
    title += f"{sweep.metric.name} {best.value:.4g}.\n"
    runs = sorted(
        (folder / "trials" / f"{best.number:04d}" / RUN).glob("version_*/config.yaml"),
        key=lambda path: path.stat().st_mtime,
    )
    if not runs:
        return title + to_yaml(grouped({**constants_of(sweep.parameters), **best.params}))
    config = read_yaml(runs[-1])
    config["name"] = f"{sweep.name}-best"
    config.pop("ckpt_path", None)
    config["trainer"] |= {"default_root_dir": str(RUNS), "enable_progress_bar": None, "enable_model_summary": None}
    return title + f"#   stackgen fit --config {folder / BEST}\n" + to_yaml(config)


def grouped(values: Mapping[str, Any]) -> dict[str, Any]:
    """Make groups of dotted names; if a name is a value and a group too, all stay as they are.

    >>> grouped({"a.b": 1, "a.c": 2}), grouped({"a.b": 1, "a": 2})
    ({'a': {'b': 1, 'c': 2}}, {'a.b': 1, 'a': 2})
    """
    if any(other.startswith(f"{name}.") for name in values for other in values):
        return dict(values)
    groups = Namespace()
    for name, value in values.items():
        groups[name] = value
    return groups.as_dict()


def write_importance(study: Study, sweep: Sweep, path: Path) -> None:
    """Plot how much of what makes a trial good each parameter is (PED-ANOVA, Watanabe et al. 2023)."""
    from matplotlib import pyplot
    from optuna.visualization.matplotlib import plot_param_importances

    pyplot.switch_backend("agg")  # no window, no display
    with pyplot.style.context("default"):  # Optuna sets a style for good
        axes = plot_param_importances(study, target_name=sweep.metric.name or "")
        axes.set_title(f"{sweep.name}: importance of each parameter (PED-ANOVA)", loc="left")
        _save(pyplot.gcf(), path)
        pyplot.close()


def write_slices(trials: Sequence[FrozenTrial], sweep: Sweep, path: Path) -> None:
    """Plot the metric over each parameter, a point a trial.

    Optuna's own plot leaves out the trials that were given up, and its names overlap from five parameters on.
    """
    from matplotlib.figure import Figure

    space = space_of(sweep.parameters)
    columns = min(3, len(space))
    lines = math.ceil(len(space) / columns)
    figure = Figure((4.2 * columns, 3.2 * lines), layout="constrained")
    figure.suptitle(f"{sweep.name}: blue ran to the end, grey was given up, red is best")
    for place, (name, distribution) in enumerate(space.items()):
        axes = figure.add_subplot(lines, columns, place + 1)
        _draw_slice(axes, trials, name, distribution)
        axes.set(xlabel=name, ylabel=sweep.metric.name if place % columns == 0 else "")
    _save(figure, path)


def _draw_slice(axes: Axes, trials: Sequence[FrozenTrial], name: str, distribution: BaseDistribution) -> None:
    choices = getattr(distribution, "choices", None)
    for kind, colour in _COLOURS.items():
        shown = trials[:1] if kind == "best" else [trial for trial in trials if trial.state.name == kind]
        at = [choices.index(trial.params[name]) if choices else trial.params[name] for trial in shown]
        axes.scatter(at, [value_of(trial) for trial in shown], s=26, color=colour, zorder=2)
    if choices:
        axes.set_xticks(range(len(choices)), [str(choice)[:_LETTERS] for choice in choices])
        axes.set_xlim(-0.5, len(choices) - 0.5)
    elif getattr(distribution, "log", False):
        from matplotlib.ticker import LogLocator, NullLocator

        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", alpha=0.3)


def _save(figure: Figure, path: Path) -> None:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=_DPI, bbox_inches="tight", metadata={"Software": None})  # no version in it
    write_atomically(path, data.getvalue())
