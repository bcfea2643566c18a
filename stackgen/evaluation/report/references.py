"""What is known of the test scenes beforehand: how diverse samples can be, and which scenes training has seen.

Both files ship with the package, so that neither the search nor the training sets are needed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stackgen.errors import MALFORMED, StackgenError
from stackgen.evaluation.diversity_limit import expected_diversity
from stackgen.evaluation.intervals import Estimate, clustered_ratio
from stackgen.evaluation.metrics import valid_diversity
from stackgen.evaluation.results import Evaluation
from stackgen.stack import Layout

_ASSETS = Path(__file__).parents[2] / "assets"
LIMIT_FILE = _ASSETS / "testset-v1-diversity-limit.json"
SEEN_FILE = _ASSETS / "testset-v1-unseen.json"
SEEN_FORMAT = "stackgen.unseen/1"
NOTIONS = {
    "designs": "no training stack has the same shapes in the same cells, nor their mirror image",
    "layouts": "no training stack has the same shapes in each layer from left to right, nor their mirror image",
}
"""What unseen means, from fine to coarse; see stackgen.data.inspection.seen_layouts."""


@dataclass(frozen=True)
class DiversityLimit:
    """The valid layouts of each scene with some block list, as benchmarks.diversity_limit finds them.

    Args:
        layouts: By scene and block list, all layouts that stand and match.
    """

    layouts: Mapping[tuple[str, tuple[int, ...]], frozenset[Layout]]

    def estimates(self, evaluation: Evaluation) -> tuple[int, dict[str, Estimate | None]]:
        """Compare an evaluation with the limit, on the scenes that both know.

        Returns:
            The number of those scenes, and three estimates: the limit itself at so many samples a scene
            (`diversity_limit`), the share of it that was reached (`of_diversity_limit`), and the share of valid
            samples whose layout was not enumerated, since they match only roughly (`beyond_diversity_limit`).
        """
        known = [scene for scene in evaluation.scenes if (scene.name, scene.counts) in self.layouts]
        if not known:
            return 0, {}
        layouts = [self.layouts[scene.name, scene.counts] for scene in known]
        reached = [valid_diversity(scene.score)[0] for scene in known]
        most = [expected_diversity(len(some), evaluation.num_samples) for some in layouts]
        valid = [[sample.layout for sample in scene.score.samples if sample.valid] for scene in known]
        beyond = [sum(layout not in some for layout in found) for found, some in zip(valid, layouts, strict=True)]
        estimates = {
            "diversity_limit": clustered_ratio(most, [1.0] * len(most)),
            "of_diversity_limit": clustered_ratio(reached, most),
            "beyond_diversity_limit": clustered_ratio(beyond, [len(found) for found in valid]),
        }
        return len(known), estimates


def read_diversity_limit(path: Path, test_set: str, physics: Mapping[str, Any]) -> DiversityLimit:
    """Read the file that `python -m benchmarks.diversity_limit` writes.

    Raises:
        StackgenError: If it is missing, damaged, or about another test set or other physics.
    """
    how = "`python -m benchmarks.diversity_limit` makes it"
    try:
        content = json.loads(path.read_text())["figures"]  # the word of all files that benchmarks write
        if content["test_set"] != test_set or content["physics"] != physics:
            raise StackgenError(f"{path} is about another test set or other physics; {how}")
        layouts = {
            (str(scene["scene"]), tuple(scene["counts"])): frozenset(map(parse_layout, scene["valid"]))
            for part in content["lists"].values()
            for scene in part["scenes"]
        }
    except OSError as error:
        raise StackgenError(f"{path} cannot be read: {error.strerror or error}; {how}") from error
    except MALFORMED as error:
        raise StackgenError(f"{path} is damaged or another file; {how}") from error
    return DiversityLimit(layouts)


def format_layout(layout: Layout) -> str:
    """Write a layout as text, the bottom layer first.

    >>> format_layout(((0, 1), (2,), (), ()))
    '0 1/2//'
    """
    return "/".join(" ".join(map(str, row)) for row in layout)


def parse_layout(text: str) -> Layout:
    """Invert :func:`format_layout`."""
    return tuple(tuple(map(int, row.split())) for row in text.split("/"))


@dataclass(frozen=True)
class Unseen:
    """Test scenes that none of some training sets holds.

    Args:
        names: Names of the training sets.
        hashes: Hashes of their manifests.
        scenes: By notion (see NOTIONS), the names of the scenes.
    """

    names: tuple[str, ...]
    hashes: frozenset[str]
    scenes: Mapping[str, frozenset[str]]


def read_unseen(test_set: str, training_sets: Sequence[str] | None = None, path: Path = SEEN_FILE) -> Unseen:
    """Read which test scenes training has not seen.

    Args:
        test_set: Hash of the test set's manifest.
        training_sets: Names of the training sets to compare it with; all that the file knows by default.
        path: File that `python -m benchmarks.unseen_layouts` writes.

    Raises:
        StackgenError: If the file is missing, damaged, about another test set, or knows no such training set.
    """
    how = "`python -m benchmarks.unseen_layouts` makes it"
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
    except MALFORMED as error:
        raise StackgenError(f"{path} is damaged or another file; {how}") from error
