"""What a sampled stack is worth: the paper's metrics, and ours beside them.

Each metric is a pure function of one scene's scores. Percentages are left to the code that prints: everything here
lies in [0, 1].

Legend: n samples a scene, S shapes, H x W pixels, B scenes, T ranked block lists a scene.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette_iou
from stackgen.protocols import Verdict
from stackgen.sampling.feasible import VALID_IOU
from stackgen.sim.statics.fit import overlaps_and_gaps
from stackgen.stack import Layout, Stack, layout
from stackgen.world import Grid, Mask, View


@dataclass(frozen=True)
class SampleScore:
    """What one generated stack came to.

    Args:
        stable: No block fell.
        ious: IoU of the settled structure with the target, for each view that has one; 0 if unstable.
        front_iou_before: IoU of the front silhouette before physics.
        layout: Shape indices of each layer from left to right, as generated; see :func:`layout`.
        overlap: Largest overlap of two blocks, or of a block and the ground, as generated [cell]; None if not measured.
        gap: Largest gap below a block, as generated [cell]; None if not measured.
        in_both: Whether it stands in a second engine too; None if that was not asked.
    """

    stable: bool
    ious: Mapping[View, float]
    front_iou_before: float
    layout: Layout
    overlap: float | None = None
    gap: float | None = None
    in_both: bool | None = None

    @property
    def front_iou(self) -> float:
        """IoU of the front view after physics, 0 if unstable."""
        return self.ious["front"]

    @property
    def average_iou(self) -> float:
        """Mean IoU over the views that have a target."""
        return float(np.mean(list(self.ious.values())))

    @property
    def valid(self) -> bool:
        """Whether the stack stands and matches the target."""
        return self.stable and self.front_iou >= VALID_IOU


@dataclass(frozen=True)
class SceneScore:
    """The scores of all samples of one scene."""

    samples: tuple[SampleScore, ...]

    def __post_init__(self) -> None:
        if not self.samples:
            raise StackgenError("a scene's score needs at least one sample")


def score_sample(stack: Stack, verdict: Verdict, targets: Mapping[View, Mask], grid: Grid) -> SampleScore:
    """Score a generated stack.

    Args:
        stack: As generated.
        verdict: What the simulator said of it.
        targets: Silhouette of each view that has one, (H, W); a mere drawing has `front` alone.
        grid: Scale of the silhouettes.
    """
    ious: dict[View, float] = dict.fromkeys(targets, 0.0)
    if verdict.stable:
        ious = {view: silhouette_iou(verdict.settled, target, grid, view) for view, target in targets.items()}
    before = silhouette_iou(stack, targets["front"], grid, "front")
    fit = overlaps_and_gaps(stack)
    return SampleScore(verdict.stable, ious, before, layout(stack, grid), fit.largest_overlap, fit.largest_gap)


# Of one scene: (sum, weight). A metric is the sum of the sums over the sum of the weights, over scenes.

SceneMetric = Callable[[SceneScore], tuple[float, float]]


def stability(scene: SceneScore) -> tuple[float, float]:
    """Share of stacks in which no block fell to a lower layer."""
    return float(sum(s.stable for s in scene.samples)), len(scene.samples)


def front_iou(scene: SceneScore) -> tuple[float, float]:
    """Front IoU of the settled stacks; unstable ones score 0."""
    return sum(s.front_iou for s in scene.samples), len(scene.samples)


def average_iou(scene: SceneScore) -> tuple[float, float]:
    """Average over front, side and top IoU of the settled stacks; unstable ones score 0."""
    return sum(s.average_iou for s in scene.samples), len(scene.samples)


def diversity(scene: SceneScore) -> tuple[float, float]:
    """Number of distinct layouts over the number of samples, wrong ones included (paper)."""
    return len({s.layout for s in scene.samples}) / len(scene.samples), 1


def valid_diversity(scene: SceneScore) -> tuple[float, float]:
    """Number of distinct layouts among the samples that stand and match, over the number of samples (ours)."""
    return len({s.layout for s in scene.samples if s.valid}) / len(scene.samples), 1


def iou_given_stable(scene: SceneScore) -> tuple[float, float]:
    """Front IoU of the stable samples alone."""
    stable = [s.front_iou for s in scene.samples if s.stable]
    return sum(stable), len(stable)


def front_iou_before(scene: SceneScore) -> tuple[float, float]:
    """Front IoU of the stacks as generated, before physics."""
    return sum(s.front_iou_before for s in scene.samples), len(scene.samples)


SCENE_METRICS: dict[str, SceneMetric] = {
    "stability": stability,
    "diversity": diversity,
    "front_iou": front_iou,
    "avg_iou": average_iou,
    "valid_diversity": valid_diversity,
    "iou_given_stable": iou_given_stable,
    "front_iou_before_physics": front_iou_before,
}
"""By the name they have in logs, tables and `metrics.json`; what is added here is measured too."""


def view_iou(view: View) -> SceneMetric:
    """Make the metric of one view: IoU of the settled stacks where there is a target for it; 0 if unstable."""

    def metric(scene: SceneScore) -> tuple[float, float]:
        ious = [sample.ious[view] for sample in scene.samples if view in sample.ious]
        return float(sum(ious)), len(ious)

    return metric


METRICS = ChainMap[str, SceneMetric]({"side_iou": view_iou("side"), "top_iou": view_iou("top")}, SCENE_METRICS)
"""All that is measured of a scene's samples: SCENE_METRICS, and the views that the average is made of."""


def in_both(scene: SceneScore) -> tuple[float, float]:
    """Share of stacks in which no block fell in either engine, of those that both were asked about."""
    known = [s.in_both for s in scene.samples if s.in_both is not None]
    return float(sum(known)), len(known)


DEPTHS = ("overlap", "gap")
"""Lengths of a sample's score [cell]; of many samples we give the 95th percentile."""


def list_rank(ranked: ArrayLike, truth: ArrayLike) -> NDArray[np.int64]:
    """Find the place of the true block list (B, S) among the ranked ones (B, T, S), counted from 0; T if absent.

    >>> list_rank([[[1, 0], [0, 1]], [[1, 0], [2, 0]]], [[0, 1], [0, 2]]).tolist()
    [1, 2]
    """
    equal = (np.asarray(ranked) == np.asarray(truth)[:, None]).all(axis=-1)
    return np.where(equal.any(axis=1), equal.argmax(axis=1), equal.shape[1])
