"""What a generated stack is worth: the paper's metrics, and ours beside them.

Each metric is a pure function of one scene's scores, and a thin torchmetrics class that only adds up
what the function says. Percentages are left to whoever prints: everything here lies in [0, 1].

Legend: n samples a scene, S shapes, H x W pixels, B scenes, T ranked block lists a scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torchmetrics import Metric, MetricCollection

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette_iou
from stackgen.protocols import Verdict
from stackgen.sampling.feasible import VALID_IOU, Layout, can_make, layout
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, Catalogue, Grid, Mask, View


@dataclass(frozen=True)
class SampleScore:
    """What one generated stack came to.

    Args:
        stable: No block fell.
        ious: IoU of the settled structure with the target, for each view that has one; 0 if unstable.
        front_iou_before: IoU of the front silhouette before physics.
        layout: Shape indices of each layer from left to right, as generated; see :func:`layout`.
    """

    stable: bool
    ious: Mapping[View, float]
    front_iou_before: float
    layout: Layout

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


def score_sample(stack: Stack, verdict: Verdict, targets: Mapping[View, Mask], grid: Grid = PAPER_GRID) -> SampleScore:
    """Score a generated stack.

    Args:
        stack: As generated.
        verdict: What the simulator said of it.
        targets: Silhouette of each view that has one, (H, W); a mere drawing has `front` alone.
        grid: Scale of the silhouettes.
    """
    ious: dict[View, float] = dict.fromkeys(targets, 0.0)
    if verdict.stable:
        ious = {view: silhouette_iou(verdict.settled, target, view, grid) for view, target in targets.items()}
    before = silhouette_iou(stack, targets["front"], "front", grid)
    return SampleScore(verdict.stable, ious, before, layout(stack, grid))


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


class _Ratio(Metric):
    """A sum over a weight, accumulated over updates and processes; NaN while the weight is 0."""

    full_state_update = False
    higher_is_better = True
    total: Tensor
    weight: Tensor

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("weight", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def _add(self, parts: Iterable[tuple[float, float]]) -> None:
        for total, weight in parts:
            self.total += total
            self.weight += weight

    def compute(self) -> Tensor:
        """The ratio so far."""
        return (self.total / self.weight).float()


class _SceneMean(_Ratio):
    per_scene: SceneMetric

    @classmethod
    def of(cls, per_scene: SceneMetric) -> type[_SceneMean]:
        """The class of a metric; one that has none is made here."""
        known = next((c for c in cls.__subclasses__() if c.per_scene is per_scene), None)
        return known or type(per_scene.__name__, (cls,), {"per_scene": staticmethod(per_scene)})

    def update(self, scenes: Sequence[SceneScore]) -> None:
        """Add some scenes."""
        self._add(type(self).per_scene(scene) for scene in scenes)


class StabilityRate(_SceneMean):
    """See :func:`stability`."""

    per_scene = staticmethod(stability)


class FrontIoU(_SceneMean):
    """See :func:`front_iou`."""

    per_scene = staticmethod(front_iou)


class AverageIoU(_SceneMean):
    """See :func:`average_iou`."""

    per_scene = staticmethod(average_iou)


class Diversity(_SceneMean):
    """See :func:`diversity`."""

    per_scene = staticmethod(diversity)


class ValidDiversity(_SceneMean):
    """See :func:`valid_diversity`."""

    per_scene = staticmethod(valid_diversity)


class IoUGivenStable(_SceneMean):
    """See :func:`iou_given_stable`."""

    per_scene = staticmethod(iou_given_stable)


class FrontIoUBeforePhysics(_SceneMean):
    """See :func:`front_iou_before`."""

    per_scene = staticmethod(front_iou_before)


def scene_metrics(prefix: str = "") -> MetricCollection:
    """All metrics of generated stacks, to be updated with sequences of :class:`SceneScore`."""
    named: dict[str, Metric | MetricCollection] = {n: _SceneMean.of(f)() for n, f in SCENE_METRICS.items()}
    return MetricCollection(named, prefix=prefix, compute_groups=False)


def list_rank(ranked: ArrayLike, truth: ArrayLike) -> NDArray[np.int64]:
    """Place of the true block list (B, S) among the ranked ones (B, T, S), counted from 0; T if absent.

    >>> list_rank([[[1, 0], [0, 1]], [[1, 0], [2, 0]]], [[0, 1], [0, 2]]).tolist()
    [1, 2]
    """
    equal = (np.asarray(ranked) == np.asarray(truth)[:, None]).all(axis=-1)
    return np.where(equal.any(axis=1), equal.argmax(axis=1), equal.shape[1])


class TopK(_Ratio):
    """How often the true block list is among a predictor's first k; `k=1` is the exact match."""

    def __init__(self, k: int = 1, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.k = k

    def update(self, ranked: ArrayLike, truth: ArrayLike) -> None:
        """Add B scenes: ranked lists (B, T, S) and true ones (B, S)."""
        rank = list_rank(np.asarray(ranked)[:, : self.k], truth)
        self._add([(float((rank < self.k).sum()), len(rank))])


class ListFeasibility(_Ratio):
    """How often a block list is one that can make the silhouette; see :func:`can_make`."""

    def __init__(self, catalogue: Catalogue = PAPER_CATALOGUE, grid: Grid = PAPER_GRID, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.catalogue, self.grid = catalogue, grid

    def update(self, counts: ArrayLike, silhouettes: ArrayLike) -> None:
        """Add B scenes: block lists (B, S) and silhouettes (B, H, W)."""
        pairs = zip(np.asarray(silhouettes, dtype=bool), np.asarray(counts), strict=True)
        self._add((float(can_make(image, c, self.catalogue, self.grid)), 1) for image, c in pairs)
