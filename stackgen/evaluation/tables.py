"""Evaluations as tables for the terminal, beside the numbers of the paper."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE
from rich.table import Table

from stackgen.evaluation.intervals import Estimate
from stackgen.evaluation.results import PREDICTED_LIST, TOP, TRUE_LIST, Evaluation

PAPER = {
    "Brute Force": {TRUE_LIST: (67.33, 38.73, 62.72, 58.45), PREDICTED_LIST: (58.13, 39.73, 53.39, 50.31)},
    "Greedy": {TRUE_LIST: (68.80, 56.53, 56.01, 53.51), PREDICTED_LIST: (67.67, 57.53, 55.13, 52.72)},
    "Tran-Reg": {TRUE_LIST: (49.73, 38.80, 44.57, 42.97), PREDICTED_LIST: (36.13, 46.73, 31.78, 30.86)},
    "Tran-VAE": {TRUE_LIST: (71.87, 56.27, 65.46, 63.36), PREDICTED_LIST: (56.53, 60.33, 50.19, 48.58)},
    "StackGen": {TRUE_LIST: (84.20, 66.87, 74.39, 71.31), PREDICTED_LIST: (85.20, 64.53, 75.08, 71.84)},
}
"""The paper's table [%], its columns in the order of PAPER_COLUMNS; from its own data and physics."""

PAPER_COLUMNS = ("stability", "diversity", "front_iou", "avg_iou")

HEADINGS = {
    "stability": "stability",
    "diversity": "diversity",
    "front_iou": "front IoU",
    "avg_iou": "avg IoU",
    "valid_diversity": "valid diversity",
    "iou_given_stable": "IoU if stable",
    "front_iou_before_physics": "IoU as generated",
}


def paper_metrics(method: str, block_list: str) -> dict[str, float]:
    """Look up a row of the paper's table [%], by metric.

    >>> paper_metrics("StackGen", PREDICTED_LIST)["stability"]
    85.2
    """
    return dict(zip(PAPER_COLUMNS, PAPER[method][block_list], strict=True))


def metrics_table(evaluations: Sequence[Evaluation]) -> Table:
    """Make a table with a column for each evaluation, in percent, and the paper's on the right; 80 characters wide."""
    table = Table(
        title="Mean [%], 95 % interval clustered by scene",
        caption="The paper's numbers come from its own data and physics.",
        box=SIMPLE,
    )
    table.add_column("\nblock list\nscenes x samples")
    for row in evaluations:
        size = f"{len(row.scenes)} x {row.num_samples}"
        table.add_column(f"{row.method}\n{row.block_list} list\n{size}", justify="right")
    paper = [paper_metrics("StackGen", source) for source in (TRUE_LIST, PREDICTED_LIST)]
    for source in (TRUE_LIST, PREDICTED_LIST):
        table.add_column(f"paper\n{source} list\n500 x 3", justify="right", style="dim")
    for name, heading in HEADINGS.items():
        quoted = [f"{numbers[name]:.2f}" if name in numbers else "" for numbers in paper]
        table.add_row(heading, *(_percent(row.estimate(name), "\n") for row in evaluations), *quoted)
    return table


def list_table(evaluations: Sequence[Evaluation]) -> Table | None:
    """Make a table of the block-list predictor's own metrics, in percent; None if there are none."""
    predicted = [(row, row.list_estimates()) for row in evaluations if row.list_estimates()]
    if not predicted:
        return None
    table = Table(title="Block lists [%]")
    table.add_column("method")
    for heading in ("exact match", f"top {TOP}", "can make the silhouette"):
        table.add_column(heading, justify="right")
    for row, estimates in predicted:
        table.add_row(row.method, *(_percent(estimate) for estimate in estimates.values()))
    return table


def _percent(estimate: Estimate | None, between: str = " ") -> str:
    if estimate is None:
        return "-"
    low, high = f"{100 * estimate.low:.1f}", f"{100 * estimate.high:.1f}"
    return f"{100 * estimate.value:.2f}{between}{low}-{high}"
