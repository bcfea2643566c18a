"""The paper's bar charts (its Fig. 5), with both block lists, error bars and the paper's own numbers."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stackgen.evaluation.intervals import Estimate
from stackgen.evaluation.report.results import ALL, Result
from stackgen.evaluation.results import PREDICTED_LIST, TRUE_LIST
from stackgen.io.files import write_atomically
from stackgen.io.text import in_a_plot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {TRUE_LIST: "#3b78b4", PREDICTED_LIST: "#e8963a"}
VIEW_COLOURS = ("#3b78b4", "#e8963a", "#5a9e6f", "#8c8c8c")
_DPI = 130


class Chart(NamedTuple):
    """A chart with a panel for each metric, its bars by method and block list.

    Args:
        file: Name of its file.
        title: What it shows.
        panels: Metrics and their headings.
    """

    file: str
    title: str
    panels: tuple[tuple[str, str], ...]


CHARTS = (
    Chart("chart-stability.png", "Stability", (("stability", "samples in which no block fell [%]"),)),
    Chart(
        "chart-iou.png",
        "IoU with the target after physics, 0 for what fell",
        (("front_iou", "front IoU [%]"), ("avg_iou", "average of front, side and top IoU [%]")),
    ),
    Chart(
        "chart-diversity.png",
        "Diversity of three samples",
        (
            ("diversity", "distinct layouts, wrong ones too (paper) [%]"),
            ("valid_diversity", "distinct valid layouts [%]"),
        ),
    ),
)
VIEWS_FILE = "chart-iou-views.png"


def draw_charts(results: Sequence[Result], folder: Path) -> list[str]:
    """Draw all charts into a folder; answer the lines of Markdown that show them.

    Raises:
        StackgenError: If they cannot be written.
    """
    lines = []
    for chart in CHARTS:
        _draw_chart(chart, results, folder / chart.file)
        lines.append(f"![{chart.title}, by method and block list]({chart.file})")
    _draw_views(results, folder / VIEWS_FILE)
    lines.append(f"![IoU of the three views with predicted block lists]({VIEWS_FILE})")
    return lines


def _draw_chart(chart: Chart, results: Sequence[Result], path: Path) -> None:
    drawn = [result for result in results if any(_estimate(result, metric) for metric, _ in chart.panels)]
    names = list(dict.fromkeys(result.row.name for result in drawn))
    figure, axes = _panels(len(chart.panels), len(names), chart.title)
    for panel, (metric, heading) in zip(axes, chart.panels, strict=True):
        for place, source in enumerate((TRUE_LIST, PREDICTED_LIST)):
            some = [result for result in drawn if result.block_list == source]
            x = np.array([names.index(result.row.name) for result in some]) + 0.38 * (place - 0.5)
            _bars(panel, x, [(r, metric) for r in some], 0.36, COLOURS[source], f"{source} list")
            quoted = [(at, r.paper[metric]) for at, r in zip(x, some, strict=True) if metric in r.paper]
            if quoted:
                label = "paper" if place else None
                panel.plot(*zip(*quoted, strict=True), "D", color="black", markersize=4, label=label)
        _finish(panel, names, heading)
    _save(figure, path)


def _draw_views(results: Sequence[Result], path: Path) -> None:
    """Draw IoU by view as the paper does, with predicted lists (the true stacks have no other list than theirs)."""
    lists = {result.row.name: result for result in results}  # the last of each row: predicted where there is one
    names = list(lists)
    figure, (panel,) = _panels(1, len(names), "IoU by view, predicted block lists")
    views = (("front_iou", "front"), ("side_iou", "side"), ("top_iou", "top"), ("avg_iou", "average"))
    for place, (metric, label) in enumerate(views):
        x = np.arange(len(names)) + 0.2 * (place - 1.5)
        _bars(panel, x, [(result, metric) for result in lists.values()], 0.19, VIEW_COLOURS[place], label)
    _finish(panel, names, "IoU after physics [%]")
    _save(figure, path)


def _panels(number: int, methods: int, title: str) -> tuple[Figure, list[Axes]]:
    """Make empty panels side by side."""
    from matplotlib.figure import Figure  # without pyplot: no window, no state

    figure = Figure(figsize=(number * max(4.2, 1.05 * methods + 1.2), 3.9), layout="constrained")
    figure.suptitle(title, fontsize=12)
    return figure, list(figure.subplots(1, number, squeeze=False)[0])


def _bars(
    panel: Axes, x: np.ndarray, some: Sequence[tuple[Result, str]], width: float, colour: str, label: str
) -> None:
    """Draw bars with their intervals, in percent; none where the metric does not exist."""
    found = [(at, _estimate(result, metric)) for at, (result, metric) in zip(x, some, strict=True)]
    known = [(at, estimate) for at, estimate in found if estimate is not None]
    if not known:
        return
    places = [at for at, _ in known]
    values = np.array([[e.value, e.value - e.low, e.high - e.value] for _, e in known]) * 100
    style = {"linewidth": 1, "ecolor": "#333333"}
    panel.bar(places, values[:, 0], width, yerr=values[:, 1:].T, color=colour, label=label, capsize=2, error_kw=style)


def _estimate(result: Result, metric: str) -> Estimate | None:
    return result.metrics[ALL][metric]


def _finish(panel: Axes, names: Sequence[str], heading: str) -> None:
    panel.set_xticks(range(len(names)), [textwrap.fill(in_a_plot(name), 14) for name in names], fontsize=8)
    panel.set_xlim(-0.6, len(names) - 0.4)
    panel.set_ylim(0, 105)
    panel.set_ylabel(heading, fontsize=9)
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(axis="y", color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.legend(fontsize=7, frameon=False, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _save(figure: Figure, path: Path) -> None:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=_DPI, metadata={"Software": None})
    write_atomically(path, data.getvalue())
