"""What a generated stack is worth: the paper's metrics, and ours beside them.

Each metric is a pure function of one scene's scores, and a thin torchmetrics class that only adds up
what the function says. Percentages are left to whoever prints: everything here lies in [0, 1].

Legend: n samples a scene, S shapes, H x W pixels, B scenes, T ranked block lists a scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torchmetrics import Metric, MetricCollection

from stackgen.geometry import PAPER_GRID, Grid, Mask, View, silhouette_iou
from stackgen.protocols import Verdict
from stackgen.stack import PAPER_CATALOGUE, Catalogue, Shape, Stack, StackgenError

VALID_IOU = 0.8
"""Front IoU from which a standing stack counts as matching the target, for valid diversity."""

Layout = tuple[tuple[int, ...], ...]


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


def layout(stack: Stack, grid: Grid = PAPER_GRID) -> Layout:
    """Per-layer block lists, bottom layer first (SPEC: nearest layer of a block's centre, left to right by x).

    >>> layout(Stack([0, 1, 0], [[1, 0, 0.5, 0, 0, 0], [0, 0, 1.6, 0, 0, 0], [-1, 0, 0.4, 0, 0, 0]]))
    ((0, 0), (1,), (), ())
    """
    layers = np.clip(np.floor(stack.poses[:, 2]), 0, grid.height - 1).astype(int)
    order = np.argsort(stack.poses[:, 0], kind="stable")
    return tuple(tuple(int(stack.shapes[i]) for i in order if layers[i] == level) for level in range(grid.height))


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


RUN_TOLERANCE = 0.24
"""How much a run of pixels may be wider or narrower than the blocks that fill it [cell]: what
displacement, settling, tilt and whole pixels do. Less than half the step between a triangle's middle
(0.5) and a cube, so that no run has two meanings."""


def can_make(
    silhouette: ArrayLike, counts: ArrayLike, catalogue: Catalogue = PAPER_CATALOGUE, grid: Grid = PAPER_GRID
) -> bool:
    """Whether a block list can make a silhouette, its blocks lying in rows of cells.

    At half height of each row the silhouette is cut into runs of pixels; the blocks of the list must
    fill all runs, each block once. Shapes that taper (the triangle is half as wide there) never touch
    their neighbours at half height, so each is a run of its own. Whether the structure would stand is
    not asked.

    Args:
        silhouette: (H, W).
        counts: (S,) block list.
        catalogue: Of shapes one cell high.
        grid: Scale of the silhouette.

    Raises:
        StackgenError: If a shape of the list is not one cell high.
    """
    wanted = tuple(int(c) for c in np.asarray(counts))
    return wanted in lists_that_make(silhouette, wanted, catalogue, grid)


def lists_that_make(
    silhouette: ArrayLike, limit: ArrayLike, catalogue: Catalogue = PAPER_CATALOGUE, grid: Grid = PAPER_GRID
) -> set[tuple[int, ...]]:
    """All block lists of at most `limit` (S,) of each shape that can make a silhouette; see :func:`can_make`."""
    most = tuple(int(c) for c in np.asarray(limit))
    sections = tuple(cross_section(shape) if c else (np.inf, True) for shape, c in zip(catalogue, most, strict=True))
    used = {(0,) * len(most)}
    for left, right in (run for row in row_runs(np.asarray(silhouette, dtype=bool), grid) for run in row):
        fillings = _fillings(round(right - left, 9), sections)
        sums = {tuple(a + b for a, b in zip(u, f, strict=True)) for u in used for f in fillings}
        used = {s for s in sums if all(a <= b for a, b in zip(s, most, strict=True))}
    return {s for s in used if any(s)}


def has_plain_rows(catalogue: Catalogue) -> bool:
    """Whether all shapes are one cell high, so that :func:`can_make` can answer."""
    return all(abs(shape.size[2] - 1) < 1e-6 for shape in catalogue)


def cross_section(shape: Shape) -> tuple[float, bool]:
    """Width at half height [cell], and whether the shape is narrower there than its box."""
    width, _, height = shape.size
    if abs(height - 1) > 1e-6:
        raise StackgenError(f"block lists can be matched with silhouettes for shapes one cell high, not {shape.name!r}")
    corners = np.asarray(shape.outline, dtype=float)
    following = np.roll(corners, -1, axis=0)
    crossing = (corners[:, 1] > 0) != (following[:, 1] > 0)
    a, b = corners[crossing], following[crossing]
    x = a[:, 0] + a[:, 1] / (a[:, 1] - b[:, 1]) * (b[:, 0] - a[:, 0])
    return float(np.ptp(x)), bool(np.ptp(x) < width - 1e-6)


def row_runs(silhouette: Mask, grid: Grid = PAPER_GRID) -> list[list[tuple[float, float]]]:
    """For each row of cells, from the ground up, the runs of pixels at half height: their ends in x [cell]."""
    z, x = grid.vertical("front"), grid.horizontal()
    half = 0.5 / grid.pixels_per_cell
    rows = []
    for level in range(grid.height):
        band = silhouette[np.abs(z - level - 0.5) < 0.15]
        filled = np.concatenate([[False], 2 * band.sum(axis=0) >= len(band), [False]])
        edges = np.flatnonzero(filled[1:] != filled[:-1])
        rows.append(
            [(float(x[a] - half), float(x[b - 1] + half)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        )
    return rows


@lru_cache(maxsize=4096)
def _fillings(width: float, sections: tuple[tuple[float, bool], ...]) -> frozenset[tuple[int, ...]]:
    """Block lists that fill a run: one tapering shape, or boxes side by side."""
    alone = {i for i, (w, tapers) in enumerate(sections) if tapers and abs(w - width) <= RUN_TOLERANCE}
    found = {tuple(int(i == j) for j in range(len(sections))) for i in alone}

    def fill(first: int, left: float, taken: tuple[int, ...]) -> None:
        if abs(left) <= RUN_TOLERANCE and any(taken):
            found.add(taken)
        for i in range(first, len(sections)):
            w, tapers = sections[i]
            if not tapers and w <= left + RUN_TOLERANCE:
                fill(i, left - w, tuple(t + (i == j) for j, t in enumerate(taken)))

    fill(0, width, (0,) * len(sections))
    return frozenset(found)
