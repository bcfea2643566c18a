"""Which samples a method's contact sheet shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stackgen.evaluation.results import Evaluation, SceneResult

EXAMPLES = 4
"""Successes, and as many failures."""


@dataclass(frozen=True)
class Example:
    """A sample.

    Args:
        scene: Of which scene.
        number: Among its samples.
    """

    scene: SceneResult
    number: int

    @property
    def front_iou(self) -> float:
        """Of what stood at the end."""
        return self.scene.score.samples[self.number].front_iou


def pick_examples(evaluation: Evaluation, number: int = EXAMPLES) -> tuple[list[Example], list[Example]]:
    """Successes and failures of a method, neither the best nor the worst: spread evenly over the scenes.

    A success is valid: it stands and matches; everything else is a failure. At most one of each kind is
    taken from a scene.
    """
    found: tuple[list[Example], list[Example]] = ([], [])
    for scene in evaluation.scenes:
        valid = [sample.valid for sample in scene.score.samples]
        for kind, wanted in enumerate((True, False)):
            if wanted in valid:
                found[kind].append(Example(scene, valid.index(wanted)))
    return _spread(found[0], number), _spread(found[1], number)


def _spread(examples: Sequence[Example], number: int) -> list[Example]:
    """So many of them, evenly spaced."""
    places = np.linspace(0, len(examples) - 1, min(number, len(examples))).round().astype(int)
    return [examples[place] for place in places]
