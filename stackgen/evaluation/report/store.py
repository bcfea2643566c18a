"""Evaluations as files: what `stackgen test` leaves behind, what the report keeps, what is recorded for good.

A file holds everything that the tables, intervals and pictures are made from, down to the sample, and the
**question** it answers: all that the answer depends on, as plain data. Equal questions have equal keys.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stackgen.errors import StackgenError
from stackgen.evaluation.metrics import SampleScore, SceneScore
from stackgen.evaluation.results import Evaluation, SceneResult
from stackgen.io.files import write_atomically
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, Catalogue

FORMAT = "stackgen.evaluation/1"
PREFIX = "evaluation-"
"""How the names of such files begin."""

PROTOCOL = 1
"""To be raised whenever the same question is answered differently: what was kept is then asked again."""

Question = dict[str, Any]


def question_of(
    sampler: Mapping[str, Any],
    block_list: str,
    predictor: str | None,
    *,
    test_set: str,
    scenes: int,
    num_samples: int,
    seed: int,
    batch_size: int,
    physics: Mapping[str, Any] | None,
) -> Question:
    """All that an evaluation depends on.

    Args:
        sampler: Of what is measured: the hash of its weights and its settings.
        block_list: `ground truth` or `predicted`.
        predictor: Hash of the weights that predict the lists; None where they are given.
        test_set: Hash of the manifest.
        scenes: How many of its scenes, from the first.
        num_samples: A scene.
        seed, batch_size: Which samples of all that there could be.
        physics: Of the verdicts.
    """
    plain = {
        "protocol": PROTOCOL,
        "sampler": sampler,
        "block_list": block_list,
        "predictor": predictor,
        "test_set": test_set,
        "scenes": scenes,
        "num_samples": num_samples,
        "seed": seed,
        "batch_size": batch_size,
        "physics": physics,
    }
    return json.loads(json.dumps(plain, sort_keys=True))  # as it will be read back


def key_of(question: Question) -> str:
    """Short name of a question, from its content."""
    text = json.dumps(question, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def differences(question: Question, other: Question) -> dict[str, tuple[Any, Any]]:
    """Where two questions differ: the path of each value, with both.

    >>> differences({"seed": 0, "physics": {"friction": 0.5}}, {"seed": 0, "physics": {"friction": 0.4}})
    {'physics.friction': (0.5, 0.4)}
    """
    found: dict[str, tuple[Any, Any]] = {}
    for name in sorted(question.keys() | other.keys()):
        a, b = question.get(name), other.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            found |= {f"{name}.{inner}": pair for inner, pair in differences(a, b).items()}
        elif a != b:
            found[name] = (a, b)
    return found


def write_evaluation(path: Path, evaluation: Evaluation, question: Question) -> None:
    """Write an evaluation with the question it answers.

    Raises:
        StackgenError: If it cannot be written.
    """
    write_atomically(path, (json.dumps(to_json(evaluation, question), allow_nan=False) + "\n").encode())


def read_evaluation(path: Path) -> tuple[Evaluation, Question]:
    """Inverse of :func:`write_evaluation`.

    Raises:
        StackgenError: If the file is missing, damaged or something else.
    """
    try:
        return from_json(json.loads(path.read_text()))
    except OSError as error:
        raise StackgenError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, StackgenError) as error:
        raise StackgenError(f"{path} is damaged or no evaluation: remove it") from error


def to_json(evaluation: Evaluation, question: Question) -> dict[str, Any]:
    """Plain form."""
    catalogue = next((s.catalogue for scene in evaluation.scenes for s in scene.stacks), PAPER_CATALOGUE)
    return {
        "format": FORMAT,
        "question": question,
        "method": evaluation.method,
        "block_list": evaluation.block_list,
        "num_samples": evaluation.num_samples,
        "seed": evaluation.seed,
        "physics": evaluation.physics,
        "facts": evaluation.facts,
        "catalogue": catalogue.to_json(),
        "scenes": [_scene_to_json(scene) for scene in evaluation.scenes],
    }


def from_json(data: Any) -> tuple[Evaluation, Question]:
    """Inverse of :func:`to_json`.

    Raises:
        StackgenError: If it is not such a plain form.
    """
    try:
        if data["format"] != FORMAT:
            raise ValueError(data["format"])
        catalogue = Catalogue.from_json(data["catalogue"])
        scenes = tuple(_scene_from_json(scene, catalogue) for scene in data["scenes"])
        named = {name: data[name] for name in ("method", "block_list", "num_samples", "seed", "physics", "facts")}
        if not scenes or not isinstance(data["question"], dict):
            raise ValueError("empty")
        return Evaluation(scenes=scenes, **named), data["question"]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise StackgenError(f"no {FORMAT} file: {error!r}") from error


def _scene_to_json(scene: SceneResult) -> dict[str, Any]:
    samples = scene.score.samples
    return {
        "name": scene.name,
        "counts": scene.counts,
        "stable": [sample.stable for sample in samples],
        "ious": [dict(sample.ious) for sample in samples],
        "front_iou_before": [sample.front_iou_before for sample in samples],
        "layouts": [sample.layout for sample in samples],
        "fell": scene.fell,
        "drop": scene.drop,
        "list_rank": scene.list_rank,
        "feasible": scene.feasible,
        "seconds": scene.seconds,
        "shapes": [stack.shapes.tolist() for stack in scene.stacks],
        "poses": [stack.poses.tolist() for stack in scene.stacks],
    }


def _scene_from_json(data: Mapping[str, Any], catalogue: Catalogue) -> SceneResult:
    layouts = [tuple(tuple(row) for row in layout) for layout in data["layouts"]]
    columns = zip(data["stable"], data["ious"], data["front_iou_before"], layouts, strict=True)
    pairs = zip(data["shapes"], data["poses"], strict=True)
    return SceneResult(
        str(data["name"]),
        tuple(data["counts"]),
        SceneScore(tuple(SampleScore(*column) for column in columns)),
        tuple(tuple(blocks) for blocks in data["fell"]),
        tuple(data["drop"]),
        data["list_rank"],
        data["feasible"],
        data["seconds"],
        tuple(Stack(np.array(shapes, dtype=np.int64), np.array(poses), catalogue) for shapes, poses in pairs),
    )
