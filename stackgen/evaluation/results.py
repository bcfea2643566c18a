"""What an evaluation found: rows of the table, and the files they are kept in."""

from __future__ import annotations

import csv
import io
import json
from collections import ChainMap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE
from rich.table import Table

from stackgen.evaluation.intervals import Estimate, clustered_ratio
from stackgen.evaluation.metrics import SCENE_METRICS, SceneMetric, SceneScore
from stackgen.io.files import write_atomically
from stackgen.stack import Stack
from stackgen.world import VIEWS, View

TRUE_LIST, PREDICTED_LIST = "ground truth", "predicted"

TOP = 3
"""How many block lists a predictor is asked for; the first is built from, the rest count for top 3."""

_LISTS = {TRUE_LIST: "true list", PREDICTED_LIST: "predicted"}

PAPER = {
    "Brute Force": {TRUE_LIST: (67.33, 38.73, 62.72, 58.45), PREDICTED_LIST: (58.13, 39.73, 53.39, 50.31)},
    "Greedy": {TRUE_LIST: (68.80, 56.53, 56.01, 53.51), PREDICTED_LIST: (67.67, 57.53, 55.13, 52.72)},
    "Tran-Reg": {TRUE_LIST: (49.73, 38.80, 44.57, 42.97), PREDICTED_LIST: (36.13, 46.73, 31.78, 30.86)},
    "Tran-VAE": {TRUE_LIST: (71.87, 56.27, 65.46, 63.36), PREDICTED_LIST: (56.53, 60.33, 50.19, 48.58)},
    "StackGen": {TRUE_LIST: (84.20, 66.87, 74.39, 71.31), PREDICTED_LIST: (85.20, 64.53, 75.08, 71.84)},
}
"""The paper's table [%], its columns in the order of :data:`PAPER_COLUMNS`; from its own data and physics."""

PAPER_COLUMNS = ("stability", "diversity", "front_iou", "avg_iou")


def paper_figures(method: str, block_list: str) -> dict[str, float]:
    """A row of the paper's table [%], by metric.

    >>> paper_figures("StackGen", PREDICTED_LIST)["stability"]
    85.2
    """
    return dict(zip(PAPER_COLUMNS, PAPER[method][block_list], strict=True))


PAPER_ROWS = {source: paper_figures("StackGen", source) for source in (TRUE_LIST, PREDICTED_LIST)}
"""StackGen in the paper's table [%]."""

HEADINGS = {
    "stability": "stability",
    "diversity": "diversity",
    "front_iou": "front IoU",
    "avg_iou": "avg IoU",
    "valid_diversity": "valid diversity",
    "iou_given_stable": "IoU if stable",
    "front_iou_before_physics": "IoU as generated",
}


def view_iou(view: View) -> SceneMetric:
    """IoU of one view of the settled stacks, over the scenes that have a target for it; unstable stacks score 0."""

    def metric(scene: SceneScore) -> tuple[float, float]:
        ious = [sample.ious[view] for sample in scene.samples if view in sample.ious]
        return float(sum(ious)), len(ious)

    return metric


METRICS = ChainMap[str, SceneMetric]({"side_iou": view_iou("side"), "top_iou": view_iou("top")}, SCENE_METRICS)
"""All that is measured of a scene's samples: the protocol's metrics, and the views that its average is made of."""


@dataclass(frozen=True)
class SceneResult:
    """What became of the samples of one scene.

    Args:
        name: Of the scene.
        counts: (S,) block list that was asked for.
        score: Of its samples.
        fell: For each sample the numbers of the blocks that fell.
        drop: For each sample how far the block that sank most did [cell].
        list_rank: Place of the true list among the predicted ones, from 0; None if it was given.
        feasible: Whether the predicted list can make the silhouette; None if it was given, or cannot be told.
        seconds: Wall time of the sampler for each sample, among those it was asked for at once; None if
            nothing was sampled.
        stacks: The samples themselves, as far as they were kept.
    """

    name: str
    counts: tuple[int, ...]
    score: SceneScore
    fell: tuple[tuple[int, ...], ...]
    drop: tuple[float, ...]
    list_rank: int | None = None
    feasible: bool | None = None
    seconds: float | None = field(default=None, compare=False)
    stacks: tuple[Stack, ...] = field(default=(), compare=False, repr=False)


@dataclass(frozen=True)
class Evaluation:
    """A row of the table, down to its samples.

    Args:
        method: Name of who sampled.
        block_list: `ground truth` or `predicted`.
        scenes: Results, in the order of the scenes.
        num_samples: A scene.
        seed: Of the sampler.
        physics: Numbers the verdicts hold for, if the checker told them.
        facts: What else the reader should know (weights, dataset), as JSON allows.
    """

    method: str
    block_list: str
    scenes: tuple[SceneResult, ...]
    num_samples: int
    seed: int
    physics: dict[str, Any] | None = None
    facts: dict[str, Any] = field(default_factory=dict)

    def estimate(self, metric: str) -> Estimate | None:
        """A metric of :data:`METRICS` with its 95 % interval, clustered by scene."""
        parts = [METRICS[metric](scene.score) for scene in self.scenes]
        return clustered_ratio([p[0] for p in parts], [p[1] for p in parts])

    @property
    def seconds_per_sample(self) -> float | None:
        """Mean wall time of the sampler [s]; None if nothing was sampled."""
        known = [scene.seconds for scene in self.scenes if scene.seconds is not None]
        return float(np.mean(known)) if known else None

    def list_estimates(self) -> dict[str, Estimate | None]:
        """The predictor's own metrics; empty where the true list was given."""
        predicted = [s for s in self.scenes if s.list_rank is not None]
        if not predicted:
            return {}
        hits = {
            "exact_match": [s.list_rank == 0 for s in predicted],
            f"top{TOP}": [s.list_rank is not None and s.list_rank < TOP for s in predicted],
            "feasible": [s.feasible for s in predicted if s.feasible is not None],
        }
        return {name: clustered_ratio(hit, np.ones(len(hit))) for name, hit in hits.items()}

    def summary(self) -> dict[str, Any]:
        """What `metrics.json` holds: shares in [0, 1], null where a metric does not exist."""
        values = {name: self.estimate(name) for name in METRICS}
        lists = self.list_estimates()
        return {
            **self.facts,
            "format": "stackgen.metrics/1",
            "method": self.method,
            "block_list": self.block_list,
            "scenes": len(self.scenes),
            "samples": sum(len(s.score.samples) for s in self.scenes),
            "samples_per_scene": self.num_samples,
            "seed": self.seed,
            "physics": self.physics,
            "interval": "95 %, cluster bootstrap over scenes",
            "metrics": {name: value and value.to_json() for name, value in values.items()},
            "block_lists": {name: value and value.to_json() for name, value in lists.items()} or None,
        }


def write_metrics(path: str | Path, evaluation: Evaluation) -> None:
    """Write the summary as `metrics.json`.

    Raises:
        StackgenError: If it cannot be written.
    """
    text = json.dumps(evaluation.summary(), indent=1, allow_nan=False)
    write_atomically(path, (text + "\n").encode())


def write_scenes(path: str | Path, evaluation: Evaluation) -> None:
    """Write one line of CSV for each sample of each scene; empty where a figure does not exist.

    Raises:
        StackgenError: If it cannot be written.
    """
    rows = [row for scene in evaluation.scenes for row in _sample_rows(scene)]
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, rows[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, buffer.getvalue().encode())


def _sample_rows(scene: SceneResult) -> Iterator[dict[str, Any]]:
    for number, (score, fell, drop) in enumerate(zip(scene.score.samples, scene.fell, scene.drop, strict=True)):
        yield {
            "scene": scene.name,
            "sample": number,
            "block_list": " ".join(map(str, scene.counts)),
            "stable": int(score.stable),
            **{f"{view}_iou": score.ious.get(view, "") for view in VIEWS},
            "avg_iou": score.average_iou,
            "front_iou_before_physics": score.front_iou_before,
            "valid": int(score.valid),
            "fell": " ".join(map(str, fell)),
            "max_drop_cells": drop,
            "layout": "/".join(" ".join(map(str, row)) for row in score.layout),
            "true_list_rank": "" if scene.list_rank is None else scene.list_rank,
            "list_feasible": "" if scene.feasible is None else int(scene.feasible),
        }


def format_table(rows: Sequence[Evaluation]) -> Table:
    """A column for each row of the protocol, in percent, the paper's own to their right; it fits 80 characters."""
    table = Table(
        title="Mean [%], 95 % interval clustered by scene",
        caption="The paper's figures come from its own data and physics.",
        box=SIMPLE,
    )
    table.add_column("\nblock list\nscenes x samples")
    for row in rows:
        size = f"{len(row.scenes)} x {row.num_samples}"
        table.add_column(f"{row.method}\n{_LISTS[row.block_list]}\n{size}", justify="right")
    for source in PAPER_ROWS:
        table.add_column(f"paper\n{_LISTS[source]}\n500 x 3", justify="right", style="dim")
    for name, heading in HEADINGS.items():
        paper = [f"{figures[name]:.2f}" if name in figures else "" for figures in PAPER_ROWS.values()]
        table.add_row(heading, *(_percent(row.estimate(name), "\n") for row in rows), *paper)
    return table


def format_list_table(rows: Sequence[Evaluation]) -> Table | None:
    """The block-list predictor's own metrics, in percent; None if no row has one."""
    predicted = [(row, row.list_estimates()) for row in rows if row.list_estimates()]
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
