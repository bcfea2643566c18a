"""What a test asks, as plain data: so that the report knows its answers again."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stackgen.baselines.heuristic import Heuristic
from stackgen.evaluation.report.rows import GROUND_TRUTH
from stackgen.evaluation.report.store import Question, question_of
from stackgen.evaluation.results import PREDICTED_LIST, TRUE_LIST
from stackgen.models.weights import resolve, resolve_weights
from stackgen.protocols import StackSampler
from stackgen.sampling.verified import VerifiedSampler

if TYPE_CHECKING:
    from stackgen.commands.test import WeightsUnderTest


def question(
    subject: WeightsUnderTest,
    block_list: str,
    test_set: str,
    scenes: int,
    batch_size: int,
    physics: Mapping[str, Any] | None,
) -> Question:
    """What some weights are asked with one of the block lists.

    Args:
        subject: The weights and how they sample.
        block_list: `ground truth` or `predicted`.
        test_set: Hash of the manifest.
        scenes: How many, from the first.
        batch_size: Scenes sampled at once.
        physics: Of the verdicts.
    """
    return question_of(
        sampler_identity(subject),
        block_list,
        predictor_identity(subject) if block_list == PREDICTED_LIST else None,
        test_set=test_set,
        scenes=scenes,
        num_samples=subject.num_samples,
        seed=subject.seed,
        batch_size=batch_size,
        physics=physics,
    )


def ground_truth_question(test_set: str, scenes: int, physics: Mapping[str, Any] | None) -> Question:
    """What the true stacks are asked: whether they stand once more."""
    return question_of(
        {"weights": GROUND_TRUTH},
        TRUE_LIST,
        None,
        test_set=test_set,
        scenes=scenes,
        num_samples=1,
        seed=0,
        batch_size=scenes,
        physics=physics,
    )


def sampler_identity(subject: WeightsUnderTest) -> dict[str, Any]:
    """Hash of the weights, and how they sample as far as the sampler tells; of a heuristic, its code."""
    weights, sampler = subject.model.weights, _base(subject.model.sampler)
    settings = dict(getattr(subject.model.sampler, "settings", {}))
    if settings.get("guide") is not None:
        settings["guide"] = _weights_hash(settings["guide"])
    if isinstance(sampler, Heuristic):
        code = _code_hash(Path(inspect.getfile(Heuristic)).parent)
        return {"weights": sampler.kind, "settings": settings, "code": code}
    return {"weights": weights.sha256 if weights else subject.weights, "settings": settings}


def predictor_identity(subject: WeightsUnderTest) -> str:
    """Hash of the weights that predict the block lists."""
    known = getattr(subject.model.predictor, "card", {}).get("sha256")
    return str(known) if known else _weights_hash(subject.block_list_weights, "predictor")


def origin(subject: WeightsUnderTest) -> dict[str, Any]:
    """What a reader should know of the sampler: the hash of its weights, how it samples, what it was trained on."""
    weights, settings = subject.model.weights, getattr(subject.model.sampler, "settings", {})
    dataset = getattr(_base(subject.model.sampler), "card", {}).get("dataset") or {}
    return {
        **({"weights_sha256": weights.sha256} if weights else {}),
        **({"sampler": settings} if settings else {}),
        **({"trained_on": {name: dataset.get(name) for name in ("name", "sha256")}} if dataset else {}),
    }


def _base(sampler: StackSampler) -> StackSampler:
    """Who draws where verified sampling chooses."""
    return sampler.sampler if isinstance(sampler, VerifiedSampler) else sampler


def _weights_hash(name: str, role: str = "sampler") -> str:
    return hashlib.sha256(resolve(resolve_weights(name), role).read_bytes()).hexdigest()


def _code_hash(folder: Path) -> str:
    """Of the modules of a package: a heuristic has no weights, it is its code."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
