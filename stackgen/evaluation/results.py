"""What an evaluation found, and the files that it is kept in.

There is one format, `stackgen.evaluation/2`: a list of rows, each with its metrics. The files that the report reads
also have all that became of every sample, and the **question** that the row answers; `metrics.json` has the metrics.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stackgen.errors import MALFORMED, StackgenError
from stackgen.evaluation.intervals import Estimate, clustered_percentile, clustered_ratio
from stackgen.evaluation.metrics import DEPTHS, METRICS, SampleScore, SceneScore, in_both
from stackgen.io.files import write_atomically, write_json
from stackgen.io.text import read_json
from stackgen.stack import Stack
from stackgen.world import VIEWS, Catalogue

FORMAT = "stackgen.evaluation/2"
_BEFORE = "stackgen.evaluation/1"

TRUE_LIST, PREDICTED_LIST = "true", "predicted"
"""Whose block lists a row was asked with: those of the scenes, or a network's."""

TOP = 3
"""How many block lists a predictor is asked for; the first is built from, the rest count for top 3."""

PERCENT = 95
"""Share of the samples whose overlaps and gaps are at most as large as is said."""

Question = dict[str, Any]
"""All that an evaluation depends on, as plain data; see stackgen.evaluation.requests."""


@dataclass(frozen=True)
class SceneResult:
    """What became of the samples of one scene.

    Args:
        name: Name of the scene.
        counts: (S,) block list that was asked for.
        score: Scores of its samples.
        fell: For each sample the numbers of the blocks that fell.
        drop: For each sample how far the block that sank most did [cell].
        list_rank: Place of the true list among the predicted ones, from 0; None if the list was given.
        feasible: Whether the predicted list can make the silhouette; None if it was given, or cannot be told.
        seconds: Wall time of the sampler for each sample, among those it was asked for at once; None if
            nothing was sampled.
        stacks: The samples themselves.
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
    """What a method came to with one kind of block list, down to its samples.

    Args:
        method: Name of the method.
        block_list: `true` or `predicted`.
        scenes: Results, in the order of the scenes.
        num_samples: Samples of each scene.
        seed: Seed of the sampler.
        physics: Numbers that the verdicts depend on.
        facts: What else the reader should know (weights, dataset), as JSON allows.
        checking_seconds: Wall time of checking and scoring all samples [s].
        second: Numbers of the second engine that was asked about them; None if there was none.
    """

    method: str
    block_list: str
    scenes: tuple[SceneResult, ...]
    num_samples: int
    seed: int
    physics: dict[str, Any]
    facts: dict[str, Any] = field(default_factory=dict)
    checking_seconds: float | None = field(default=None, compare=False)
    second: dict[str, Any] | None = None

    def estimate(self, metric: str) -> Estimate | None:
        """Give a metric of METRICS with its 95 % interval, clustered by scene."""
        parts = [METRICS[metric](scene.score) for scene in self.scenes]
        return clustered_ratio([p[0] for p in parts], [p[1] for p in parts])

    def fit(self) -> dict[str, Estimate | None]:
        """Say how blocks lie to each other.

        Returns:
            `overlap` and `gap`, which 95 % of the samples do not exceed [cell], and `in_both`, the share that stands
            in both engines; None where that was not measured.
        """
        depths = {
            name: [[d for s in scene.score.samples if (d := getattr(s, name)) is not None] for scene in self.scenes]
            for name in DEPTHS
        }
        parts = [in_both(scene.score) for scene in self.scenes]
        return {
            **{name: clustered_percentile(values, PERCENT) for name, values in depths.items()},
            "in_both": clustered_ratio([p[0] for p in parts], [p[1] for p in parts]),
        }

    @property
    def seconds_per_sample(self) -> float | None:
        """Mean wall time of the sampler [s]; None if nothing was sampled."""
        known = [scene.seconds for scene in self.scenes if scene.seconds is not None]
        return float(np.mean(known)) if known else None

    @property
    def sampling_seconds(self) -> float:
        """Wall time of the sampler for all samples [s]."""
        return (self.seconds_per_sample or 0.0) * sum(len(scene.score.samples) for scene in self.scenes)

    def list_estimates(self) -> dict[str, Estimate | None]:
        """Give the predictor's own metrics; empty where the true list was given."""
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
        """Give a row of `metrics.json`: shares in [0, 1], null where a metric does not exist."""
        values = {name: self.estimate(name) for name in METRICS}
        return {
            **self.facts,
            "method": self.method,
            "block_list": self.block_list,
            "scenes": len(self.scenes),
            "samples": sum(len(s.score.samples) for s in self.scenes),
            "samples_per_scene": self.num_samples,
            "seed": self.seed,
            "physics": self.physics,
            "interval": "95 %, cluster bootstrap over scenes",
            "metrics": estimates_to_json(values),
            "fit": estimates_to_json(self.fit()),
            "second_engine": self.second,
            "block_lists": estimates_to_json(self.list_estimates()) or None,
        }


def estimates_to_json(estimates: Mapping[str, Estimate | None]) -> dict[str, dict[str, float] | None]:
    """Give estimates in plain form, null where a metric does not exist."""
    return {name: None if value is None else value.to_json() for name, value in estimates.items()}


def write_metrics(path: str | Path, evaluations: Sequence[Evaluation]) -> None:
    """Write the metrics of some evaluations as `metrics.json`.

    Raises:
        StackgenError: If it cannot be written.
    """
    write_json(path, {"format": FORMAT, "rows": [evaluation.summary() for evaluation in evaluations]})


def write_evaluation(path: Path, evaluation: Evaluation, question: Question) -> None:
    """Write an evaluation down to its samples, with the question it answers.

    Raises:
        StackgenError: If it cannot be written.
    """
    named = {name: getattr(evaluation, name) for name in _KEPT}
    catalogue = next(stack.catalogue for scene in evaluation.scenes for stack in scene.stacks).to_json()
    results = [_scene_to_json(scene) for scene in evaluation.scenes]
    row = {**evaluation.summary(), "question": question, "kept": named, "catalogue": catalogue, "results": results}
    write_json(path, {"format": FORMAT, "rows": [row]}, indent=None)


_OF_SAMPLE = ("stable", "ious", "front_iou_before", "layout")
_OF_SAMPLE_OR_NULL = (*DEPTHS, "in_both")  # files of earlier versions lack them
_OF_SCENE = ("name", "counts", "fell", "drop", "list_rank", "feasible", "seconds")
_KEPT = ("method", "block_list", "num_samples", "seed", "physics", "facts", "checking_seconds", "second")


def read_evaluation(path: Path) -> tuple[Evaluation, Question]:
    """Read what :func:`write_evaluation` wrote.

    Raises:
        StackgenError: If the file is missing, damaged or something else.
    """
    try:
        data = read_json(path)
        if data["format"] == _BEFORE:
            raise StackgenError(f"{path} was written by an older version, and is not read")
        if data["format"] != FORMAT:
            raise ValueError(data["format"])
        (row,) = data["rows"]
        catalogue = Catalogue.from_json(row["catalogue"])
        scenes = tuple(_scene_from_json(scene, catalogue) for scene in row["results"])
        if not scenes or not isinstance(row["question"], dict):
            raise ValueError("empty")
        return Evaluation(scenes=scenes, **row["kept"]), row["question"]
    except OSError as error:
        raise StackgenError(f"{path} cannot be read: {error.strerror or error}") from error
    except MALFORMED as error:
        raise StackgenError(f"{path} is damaged or no evaluation: remove it") from error


def _scene_to_json(scene: SceneResult) -> dict[str, Any]:
    return {
        **{name: getattr(scene, name) for name in _OF_SCENE},
        "samples": [
            {name: getattr(sample, name) for name in (*_OF_SAMPLE, *_OF_SAMPLE_OR_NULL)}
            for sample in scene.score.samples
        ],
        "shapes": [stack.shapes.tolist() for stack in scene.stacks],
        "poses": [stack.poses.tolist() for stack in scene.stacks],
    }


def _scene_from_json(data: Mapping[str, Any], catalogue: Catalogue) -> SceneResult:
    samples = [
        {name: _tuples(sample[name]) for name in _OF_SAMPLE} | {name: sample.get(name) for name in _OF_SAMPLE_OR_NULL}
        for sample in data["samples"]
    ]
    stacks = (Stack(np.array(shapes, dtype=np.int64), np.array(poses), catalogue)
              for shapes, poses in zip(data["shapes"], data["poses"], strict=True))  # fmt: skip
    score = SceneScore(tuple(SampleScore(**sample) for sample in samples))
    return SceneResult(score=score, stacks=tuple(stacks), **{name: _tuples(data[name]) for name in _OF_SCENE})


def _tuples(value: Any) -> Any:
    """Turn lists, and lists in lists, into tuples, as they were written."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def write_scenes(path: str | Path, evaluation: Evaluation) -> None:
    """Write one line of CSV for each sample of each scene; empty where a metric does not exist.

    Raises:
        StackgenError: If it cannot be written.
    """
    write_csv(path, [row for scene in evaluation.scenes for row in _sample_rows(scene)])


def write_csv(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the same columns as CSV.

    Raises:
        StackgenError: If it cannot be written.
    """
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, rows[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _no_formula(value) for name, value in row.items()} for row in rows)
    write_atomically(path, buffer.getvalue().encode())


def _no_formula(value: Any) -> Any:
    """Keep a spreadsheet from taking text for a formula; numbers stay as they are."""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r") else value


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
            **{f"{name}_cells": "" if (depth := getattr(score, name)) is None else depth for name in DEPTHS},
            "valid": int(score.valid),
            "fell": " ".join(map(str, fell)),
            "max_drop_cells": drop,
            "layout": "/".join(" ".join(map(str, row)) for row in score.layout),
            "true_list_rank": "" if scene.list_rank is None else scene.list_rank,
            "list_feasible": "" if scene.feasible is None else int(scene.feasible),
        }
