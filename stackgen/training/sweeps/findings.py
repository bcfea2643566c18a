"""What a sweep found, as files: leaderboard, best configuration, importance and slice plots."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from rich.table import Table

from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.training.runs import RUNS
from stackgen.training.sweeps.child import RUN
from stackgen.training.sweeps.file import Sweep
from stackgen.training.sweeps.space import constants_of, space_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from optuna import Study

BEST, LEADERBOARD, IMPORTANCE, SLICES = "best.yaml", "leaderboard.csv", "importance.png", "slices.png"
_COLOURS = {"complete": "#3b78b4", "pruned": "#b9bec7", "best": "#c8402f"}
_DPI = 130
_LETTERS = 24  # of a setting that is a text


@dataclass(frozen=True)
class Row:
    """A trial as the leaderboard shows it.

    Args:
        trial: Its number.
        state: `complete`, `pruned` (given up), `fail` or `running`.
        value: Of the metric, the last that was told; NaN if none was.
        reports: How often it told.
        seconds: From its beginning to its end; NaN while it runs [s].
        values: Of the parameters.
    """

    trial: int
    state: str
    value: float
    reports: int
    seconds: float
    values: Mapping[str, Any]


def ranking(study: Study) -> list[Row]:
    """All trials: those that ran to their end, the best first, then the others."""
    rows = []
    for trial in study.get_trials(deepcopy=False):
        told = trial.intermediate_values
        last = told[max(told)] if told else math.nan
        seconds = trial.duration.total_seconds() if trial.duration else math.nan
        value = last if trial.value is None else trial.value
        rows.append(Row(trial.number, trial.state.name.lower(), value, len(told), seconds, trial.params))
    sign = -1 if study.direction.name == "MAXIMIZE" else 1
    order = {"complete": 0, "pruned": 1}

    def key(row: Row) -> tuple[int, float]:
        return order.get(row.state, 2), math.inf if math.isnan(row.value) else sign * row.value

    return sorted(rows, key=key)


def write_findings(study: Study, sweep: Sweep, folder: Path) -> list[Path]:
    """Write everything that a sweep found; answers the files.

    Raises:
        StackgenError: If no trial ran to its end.
    """
    rows = ranking(study)
    done = [row for row in rows if row.state == "complete"]
    if not done:
        raise StackgenError(f"no trial of {folder} ran to its end; look into {folder}/trials/*/log.txt")
    write_atomically(folder / LEADERBOARD, leaderboard(rows, sweep).encode())
    write_atomically(folder / BEST, best_configuration(done[0], sweep, folder, len(rows)).encode())
    _save(slice_figure(rows, sweep), folder / SLICES)
    written = [folder / BEST, folder / LEADERBOARD, folder / SLICES]
    shares = importances(study)
    if shares:
        _save(importance_figure(shares, sweep), folder / IMPORTANCE)
        written.append(folder / IMPORTANCE)
    return written


def leaderboard(rows: Sequence[Row], sweep: Sweep) -> str:
    """The trials as CSV, the best first."""
    names = list(space_of(sweep.parameters))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["rank", "trial", "state", sweep.metric.name, "reports", "seconds", *names])
    for rank, row in enumerate(rows, 1):
        figures = [f"{row.value:.6g}", row.reports, f"{row.seconds:.1f}"]
        table.writerow([rank, row.trial, row.state, *figures, *(row.values.get(name) for name in names)])
    return text.getvalue()


def leaderboard_table(rows: Sequence[Row], sweep: Sweep, most: int = 10) -> Table:
    """The best trials for the terminal."""
    names = list(space_of(sweep.parameters))
    short = [name.rpartition(".")[2] for name in names]
    heads = [s if short.count(s) == 1 else name for s, name in zip(short, names, strict=True)]
    table = Table("trial", "state", sweep.metric.name, *heads, box=None, pad_edge=False)
    for row in rows[:most]:
        values = [_shown(row.values.get(name)) for name in names]
        table.add_row(str(row.trial), row.state, f"{row.value:.4g}", *values)
    return table


def _shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)[:_LETTERS]


def best_configuration(best: Row, sweep: Sweep, folder: Path, trials: int) -> str:
    """A YAML for `stackgen fit`: the whole configuration of the best trial's run; for other programs its values."""
    title = f"# The best of {trials} trials of the sweep {sweep.name}: trial {best.trial}, "
    title += f"{sweep.metric.name} {best.value:.4g}.\n"
    runs = sorted(
        (folder / "trials" / f"{best.trial:04d}" / RUN).glob("version_*/config.yaml"),
        key=lambda path: path.stat().st_mtime,
    )
    if not runs:
        return title + yaml.safe_dump(nested({**constants_of(sweep.parameters), **best.values}), sort_keys=False)
    config = yaml.safe_load(runs[-1].read_text())
    config["name"] = f"{sweep.name}-best"
    config.pop("ckpt_path", None)
    config["trainer"] |= {"default_root_dir": str(RUNS), "enable_progress_bar": None, "enable_model_summary": None}
    return title + f"#   stackgen fit --config {folder / BEST}\n" + yaml.safe_dump(config, sort_keys=False)


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted names as groups.

    >>> nested({"a.b": 1, "a.c": 2, "d": 3})
    {'a': {'b': 1, 'c': 2}, 'd': 3}
    """
    found: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        place = found
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = value
    return found


def importances(study: Study) -> dict[str, float]:
    """How much of what makes a trial good each parameter is (PED-ANOVA, Watanabe et al. 2023); empty for too few."""
    from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

    done = [t for t in study.get_trials(deepcopy=False) if t.state.name == "COMPLETE"]
    if len(done) < 4 or len({t.value for t in done}) < 2:
        return {}
    return get_param_importances(study, evaluator=PedAnovaImportanceEvaluator())


def importance_figure(shares: Mapping[str, float], sweep: Sweep) -> Figure:
    """Bars, the most important parameter on top."""
    from matplotlib.figure import Figure

    names = list(shares)[::-1]
    figure = Figure((7, 1.2 + 0.4 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    axes.barh(names, [shares[name] for name in names], color=_COLOURS["complete"])
    axes.set(xlabel=f"share of the importance for {sweep.metric.name} (PED-ANOVA)", title=sweep.name)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def slice_figure(rows: Sequence[Row], sweep: Sweep) -> Figure:
    """The metric over each parameter, a point a trial."""
    from matplotlib.figure import Figure

    space = space_of(sweep.parameters)
    columns = min(3, len(space))
    lines = math.ceil(len(space) / columns)
    figure = Figure((4.2 * columns, 3.2 * lines), layout="constrained")
    figure.suptitle(f"{sweep.name}: blue ran to the end, grey was given up, red is best")
    for place, (name, distribution) in enumerate(space.items()):
        axes = figure.add_subplot(lines, columns, place + 1)
        choices = getattr(distribution, "choices", None)
        _draw_slice(axes, rows, name, choices)
        if getattr(distribution, "log", False):
            _logarithmic(axes)
        axes.set(xlabel=name, ylabel=sweep.metric.name if place % columns == 0 else "")
    return figure


def _logarithmic(axes: Axes) -> None:
    """A logarithmic x axis with numbers at 1, 2 and 5 times powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def _draw_slice(axes: Axes, rows: Sequence[Row], name: str, choices: Sequence[Any] | None) -> None:
    told = [row for row in rows if name in row.values and not math.isnan(row.value)]
    for kind in ("pruned", "complete", "best"):
        shown = [row for row in told if row.state == kind] if kind != "best" else told[:1]
        at = [choices.index(row.values[name]) if choices else row.values[name] for row in shown]
        axes.scatter(at, [row.value for row in shown], s=26, color=_COLOURS[kind], zorder=3 if kind == "best" else 2)
    if choices:
        axes.set_xticks(range(len(choices)), [str(choice)[:_LETTERS] for choice in choices])
        axes.set_xlim(-0.5, len(choices) - 0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", alpha=0.3)


def _save(figure: Figure, path: Path) -> None:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=_DPI, metadata={"Software": None})  # no version in the file
    write_atomically(path, data.getvalue())
