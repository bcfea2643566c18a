"""What is known of the test scenes beforehand: how diverse answers can be, and which of them training has seen."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stackgen.errors import StackgenError
from stackgen.evaluation.diversity_limit import expected_diversity
from stackgen.evaluation.intervals import Estimate, clustered_ratio
from stackgen.evaluation.metrics import valid_diversity
from stackgen.evaluation.results import Evaluation, SceneResult
from stackgen.sampling.feasible import Layout

SEEN_FILE = Path(__file__).parents[2] / "assets" / "testset-v1-unseen.json"
SEEN_FORMAT = "stackgen.unseen/1"
NOTIONS = {
    "designs": "no training stack has the same shapes in the same cells, nor their mirror image",
    "layouts": "no training stack has the same shapes in each layer from left to right, nor their mirror image",
}
"""What unseen means, from fine to coarse; see stackgen.data.inspection.seen_layouts."""


@dataclass(frozen=True)
class Ceiling:
    """The valid layouts of each scene with some block list, see benchmarks.diversity_ceiling.

    Args:
        layouts: By scene and block list, all that stand and match.
    """

    layouts: Mapping[tuple[str, tuple[int, ...]], frozenset[Layout]]

    def share(self, evaluation: Evaluation) -> tuple[int, Estimate, Estimate] | None:
        """On the scenes that both know: their number, the ceiling at so many samples, and the share of it reached."""
        known = self._known(evaluation)
        reached = [valid_diversity(scene.score)[0] for scene in known]
        most = [expected_diversity(len(self._of(scene)), evaluation.num_samples) for scene in known]
        whole, part = clustered_ratio(most, [1.0] * len(most)), clustered_ratio(reached, most)
        return None if whole is None or part is None else (len(known), whole, part)

    def outside(self, evaluation: Evaluation) -> Estimate | None:
        """Share of the valid samples whose layout was not enumerated: those that match only roughly."""
        known = self._known(evaluation)
        valid = [[sample.layout for sample in scene.score.samples if sample.valid] for scene in known]
        missing = [sum(layout not in self._of(scene) for layout in some)
                   for scene, some in zip(known, valid, strict=True)]  # fmt: skip
        return clustered_ratio(missing, [len(some) for some in valid]) if known else None

    def _known(self, evaluation: Evaluation) -> list[SceneResult]:
        return [scene for scene in evaluation.scenes if (scene.name, scene.counts) in self.layouts]

    def _of(self, scene: SceneResult) -> frozenset[Layout]:
        return self.layouts[scene.name, scene.counts]


def read_ceiling(path: Path, test_set: str, physics: Mapping[str, Any] | None) -> Ceiling:
    """The file that `python -m benchmarks.diversity_ceiling` writes.

    Raises:
        StackgenError: If it is missing, damaged, or about another test set or other physics.
    """
    how = "make it by `python -m benchmarks.diversity_ceiling`"
    try:
        figures = json.loads(path.read_text())["figures"]
        if figures["test_set"] != test_set or figures["physics"] != physics:
            raise StackgenError(f"{path} is about another test set or other physics; {how}")
        layouts = {
            (str(scene["scene"]), tuple(scene["counts"])): frozenset(map(parse_layout, scene["valid"]))
            for part in figures["lists"].values()
            for scene in part["scenes"]
        }
    except OSError as error:
        raise StackgenError(f"{path} cannot be read: {error.strerror or error}; {how}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StackgenError(f"{path} is damaged or another file; {how}") from error
    return Ceiling(layouts)


def format_layout(layout: Layout) -> str:
    """A layout as text, the bottom layer first.

    >>> format_layout(((0, 1), (2,), (), ()))
    '0 1/2//'
    """
    return "/".join(" ".join(map(str, row)) for row in layout)


def parse_layout(text: str) -> Layout:
    """Inverse of :func:`format_layout`."""
    return tuple(tuple(map(int, row.split())) for row in text.split("/"))


@dataclass(frozen=True)
class Unseen:
    """Test scenes that none of some training sets holds.

    Args:
        names: Of the training sets.
        hashes: Of their manifests.
        scenes: By notion (:data:`NOTIONS`), the names of the scenes.
    """

    names: tuple[str, ...]
    hashes: frozenset[str]
    scenes: Mapping[str, frozenset[str]]


def read_unseen(test_set: str, training_sets: Sequence[str] | None = None, path: Path = SEEN_FILE) -> Unseen:
    """Which test scenes training has not seen.

    Args:
        test_set: Hash of the test set's manifest.
        training_sets: Names of those to be held against it; all that the file knows by default.
        path: That `python -m benchmarks.unseen_layouts` writes.

    Raises:
        StackgenError: If the file is missing, damaged, about another test set, or knows no such training set.
    """
    how = "make it by `python -m benchmarks.unseen_layouts`"
    try:
        data = json.loads(path.read_text())
        if data["format"] != SEEN_FORMAT or data["test_set"] != test_set:
            raise StackgenError(f"{path} is about another test set; {how}")
        known = {str(entry["name"]): entry for entry in data["training_sets"]}
        chosen = list(known) if training_sets is None else list(training_sets)
        if not chosen or not set(chosen) <= set(known):
            raise StackgenError(f"{path} knows the training sets {', '.join(known)}, not {', '.join(chosen)}; {how}")
        scenes = {
            notion: frozenset.intersection(*(frozenset(known[name]["unseen"][notion]) for name in chosen))
            for notion in NOTIONS
        }
        return Unseen(tuple(chosen), frozenset(str(known[name]["sha256"]) for name in chosen), scenes)
    except OSError as error:
        raise StackgenError(f"{path} cannot be read: {error.strerror or error}; {how}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StackgenError(f"{path} is damaged or another file; {how}") from error
