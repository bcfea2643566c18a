"""What is in a dataset: counts, distributions, duplicates, and how near it is to the frozen test scenes.

Needs no simulator: margins come from a checker that is handed in. Legend: M stacks, N blocks at most.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from stackgen.data.arrays import PADDING, StackArrays
from stackgen.data.dataset import Dataset
from stackgen.data.decoding import decode_shard
from stackgen.data.generation.designs import cells_wide
from stackgen.data.inspection.seen_layouts import as_scalars, layout_codes, seen_layouts
from stackgen.data.manifest import SPLITS, Manifest
from stackgen.geometry import tilt
from stackgen.protocols import StabilityChecker
from stackgen.stack import Stack
from stackgen.world import World

SAME = 0.01
"""Stacks of the same shapes whose poses differ by no more than this [cell, rad] are duplicates."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Contents:
    """All stacks of a dataset.

    Args:
        arrays: M stacks, split by split.
        split: (M,) number of each one's split.
        depth: (M,) blocks removed from its template, -1 where that is not recorded (in a compact file).
        manifest: Manifest of the dataset.
    """

    arrays: StackArrays
    split: NDArray[np.int64]
    depth: NDArray[np.int64]
    manifest: Manifest

    @staticmethod
    def load(path: Path) -> Contents:
        """Read a dataset, a folder or a compact file.

        Raises:
            StackgenError: If it cannot be read, or a shard is damaged.
        """
        dataset = Dataset.open(path)
        parts = [dataset.split(name) for name in dataset.splits]
        arrays = StackArrays.concatenate(parts)
        number = np.repeat([SPLITS.index(name) for name in dataset.splits], [len(part) for part in parts])
        depth = np.full(len(arrays), -1)
        if not dataset.is_compact:
            depth = _depths(dataset)
        return Contents(arrays, number, depth, dataset.manifest)

    def of(self, split: str) -> StackArrays:
        """Select the stacks of one split."""
        return self.arrays.select(np.flatnonzero(self.split == SPLITS.index(split)))

    def stack(self, index: int) -> Stack:
        """Give one stack."""
        k = int(self.arrays.lengths[index])
        return Stack(
            self.arrays.shapes[index, :k].astype(np.int64),
            self.arrays.poses[index, :k].astype(np.float64),
            self.manifest.world.catalogue,
        )


_KEY = re.compile(r"\d+-(whole|\d\d(?:_\d\d)*)")


def _depths(dataset: Dataset) -> NDArray[np.int64]:
    """Count the blocks removed from each stack's template, by its key, split by split."""
    depths: list[int] = []
    for split in dataset.splits:
        for shard in dataset.shards(split):
            for key in decode_shard(shard.read(), dataset.world).keys:
                match = _KEY.fullmatch(key)
                depths.append(-1 if match is None else 0 if match[1] == "whole" else match[1].count("_") + 1)
    return np.array(depths, np.int64)


def facts(contents: Contents, testset: Path | None = None, margins: Floats | None = None) -> dict[str, Any]:
    """Collect all facts about a dataset, as JSON allows. Shares lie in [0, 1].

    Args:
        contents: The dataset.
        testset: Folder of the frozen test scenes; None leaves the comparison out.
        margins: Margins of some stacks [degrees], from :func:`sample_margins`; None leaves them out.
    """
    manifest = contents.manifest
    found: dict[str, Any] = {
        "name": manifest.name,
        "stacks": len(contents.arrays),
        "counts": counts(contents),
        "distributions": {name: describe(values) for name, values in distributions(contents).items()},
        "duplicates": duplicates(contents),
    }
    if margins is not None:
        found["margins"] = describe_margins(margins)
    if testset is not None:
        found["testset"] = nearness(contents, testset)
    return found


def counts(contents: Contents) -> dict[str, dict[str, int]]:
    """Count the stacks, or blocks, of each kind."""
    arrays, catalogue = contents.arrays, contents.manifest.world.catalogue
    real = arrays.shapes != PADDING
    heights = np.array([shape.size[2] for shape in catalogue])[np.where(real, arrays.shapes, 0)]
    tops = np.where(real, arrays.poses[..., 2] + heights / 2, 0).max(axis=1)
    by: dict[str, dict[str, int]] = {
        "split": {split: int((contents.split == i).sum()) for i, split in enumerate(SPLITS)},
        "templates by split": {
            split: len(np.unique(arrays.template[contents.split == i])) for i, split in enumerate(SPLITS)
        },
        "blocks by shape": {name: int(arrays.counts[:, i].sum()) for i, name in enumerate(catalogue.names)},
        "stacks by blocks": _tally(arrays.lengths),
        "stacks by height [cell]": _tally(np.round(2 * tops) / 2),
        "distinct": {
            "layouts": len(np.unique(_layouts(contents, positions=False))),
            "designs": len(np.unique(_layouts(contents, positions=True))),
            "silhouettes": len(np.unique(_rows(arrays.silhouettes))),
            "block lists": len(np.unique(arrays.counts, axis=0)),
        },
    }
    if (contents.depth >= 0).all():
        by["stacks by removals"] = _tally(contents.depth)
    return by


def distributions(contents: Contents) -> dict[str, Floats]:
    """Measure the distance of all blocks from their place in the design, their yaw and tilt."""
    arrays = contents.arrays
    real = arrays.shapes != PADDING
    poses = arrays.poses[real].astype(np.float64)
    beside = beside_design(arrays.shapes[real], poses[:, 0], contents.manifest.world)
    return {
        "x beside the design [cell]": beside,
        "y beside the design [cell]": poses[:, 1],
        "yaw [degrees]": np.degrees(poses[:, 5]),
        "tilt [degrees]": np.degrees(tilt(poses)),
    }


def beside_design(shapes: ArrayLike, x: Floats, world: World) -> Floats:
    """Measure the distance (n,) [cell] of blocks from the nearest place at which they fill whole cells.

    >>> from stackgen.world import PAPER_WORLD
    >>> beside_design([0, 1], np.array([0.45, -0.9]), PAPER_WORLD).round(6).tolist()
    [-0.05, 0.1]
    """
    cells = np.array([cells_wide(shape) for shape in world.catalogue])
    left = x - cells[np.asarray(shapes)] / 2 + world.grid.width / 2
    return left - np.round(left)


def describe(values: Floats) -> dict[str, float]:
    """Compute moments, percentiles and the largest magnitude."""
    low, median, high = np.percentile(values, [1, 50, 99])
    return {
        "mean": float(values.mean()),
        "std": float(values.std()),
        "p1": float(low),
        "median": float(median),
        "p99": float(high),
        "largest": float(np.abs(values).max()),
    }


def sample_margins(contents: Contents, checker: StabilityChecker, number: int, seed: int = 0) -> Floats:
    """Compute the largest tilt of the ground (number,) [degrees] that stacks drawn without replacement survive."""
    size = min(number, len(contents.arrays))
    chosen = np.random.default_rng(seed).choice(len(contents.arrays), size, replace=False)
    verdicts = checker.check_all([contents.stack(i) for i in chosen])
    return np.degrees([verdict.margin or 0.0 for verdict in verdicts])


def describe_margins(margins: Floats) -> dict[str, float]:
    """Compute percentiles of the margins [degrees], and the shares of marginal stacks."""
    shares = {f"share below {limit:g} degrees": float((margins < limit).mean()) for limit in (0.5, 1, 2, 5)}
    return {"stacks": len(margins), **describe(margins), **shares}


def duplicates(contents: Contents, same: float = SAME) -> dict[str, int]:
    """Count the stacks that are there more than once: the same shapes, all poses within `same` [cell, rad].

    Returns:
        `stacks`, how many have a twin; `surplus`, how many could go; `across splits`, how many have a twin in
        another split.
    """
    twins = twin_pairs(contents.arrays, contents.manifest.world, same)
    if not len(twins):
        return {"stacks": 0, "surplus": 0, "across splits": 0}
    across = twins[contents.split[twins[:, 0]] != contents.split[twins[:, 1]]]
    keeper = np.arange(len(contents.arrays))
    np.minimum.at(keeper, twins[:, 1], twins[:, 0])
    surplus = int((keeper != np.arange(len(keeper))).sum())
    return {"stacks": len(np.unique(twins)), "surplus": surplus, "across splits": len(np.unique(across))}


def twin_pairs(arrays: StackArrays, world: World, same: float = SAME) -> NDArray[np.int64]:
    """Find pairs (P, 2) of stacks, the earlier first, of the same shapes with all poses within `same` [cell, rad]."""
    codes = as_scalars(layout_codes(arrays, world), arrays.shapes.shape[1])
    order = np.argsort(codes, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], codes[order][1:] != codes[order][:-1]]))
    pairs = [np.empty((0, 2), np.int64)]
    for group in np.split(order, starts[1:]):
        if len(group) > 1:
            found = cKDTree(_sorted_poses(arrays, group)).query_pairs(same, p=np.inf, output_type="ndarray")
            pairs.append(np.sort(group[found], axis=1))
    return np.concatenate(pairs)


def _sorted_poses(arrays: StackArrays, group: NDArray[np.int64]) -> Floats:
    """(n, k * 6) poses of stacks of one layout, their blocks from the bottom up and from left to right."""
    k = int(arrays.lengths[group[0]])
    poses = arrays.poses[group, :k].astype(np.float64)
    order = np.lexsort((poses[..., 0], np.floor(poses[..., 2])), axis=-1)
    return np.take_along_axis(poses, order[..., None], axis=1).reshape(len(group), -1)


def nearness(contents: Contents, testset: Path) -> dict[str, Any] | None:
    """Measure how much of the frozen test scenes the training split holds already; None in another world.

    A mirror image counts as held, since training may mirror.
    """
    scenes, ours = Dataset.open(testset), contents.manifest.world
    train, test = contents.of("train"), scenes.split("test")
    if (scenes.world.catalogue, scenes.world.grid) != (ours.catalogue, ours.grid) or not len(train):
        return None
    seen = partial(seen_layouts, train, test, ours)
    best = nearest_silhouettes(train.silhouettes, test.silhouettes, test.image_size)
    return {
        "scenes": len(test),
        "layout in training": int(seen().sum()),
        "design in training": int(seen(positions=True).sum()),
        "stack in training": int(_held(train, test, ours)),
        "silhouette in training": int((best == 1).sum()),
        "nearest silhouette, IoU": describe(best),
    }


def _held(train: StackArrays, test: StackArrays, world: World) -> int:
    """Count the test stacks of which training has a twin."""
    columns = max(train.shapes.shape[1], test.shapes.shape[1])
    both = StackArrays.concatenate([_widened(train, columns), _widened(test, columns)])
    twins = twin_pairs(both, world)
    across = twins[(twins[:, 0] < len(train)) & (twins[:, 1] >= len(train))]
    return len(np.unique(across[:, 1]))


def _widened(arrays: StackArrays, columns: int) -> StackArrays:
    more = columns - arrays.shapes.shape[1]
    shapes = np.pad(arrays.shapes, ((0, 0), (0, more)), constant_values=PADDING)
    poses = np.pad(arrays.poses, ((0, 0), (0, more), (0, 0)))
    return StackArrays(shapes, poses, arrays.silhouettes, arrays.template, arrays.num_shapes)


def nearest_silhouettes(train: NDArray[np.uint8], test: NDArray[np.uint8], image_size: int) -> Floats:
    """Compute the IoU (T,) of each test silhouette with the training silhouette, or its mirror image, most like it.

    Args:
        train, test: (M, H * W / 8) and (T, H * W / 8), packed row by row.
        image_size: H = W [pixel].
    """
    distinct = np.unique(_rows(train), return_index=True)[1]
    words = np.ascontiguousarray(train[distinct]).view(np.uint64)
    areas = np.bitwise_count(words).sum(axis=1, dtype=np.int64)
    order = np.argsort(areas, kind="stable")
    words, areas = words[order], areas[order]

    def best_of(scene: NDArray[np.uint64], area: int, least: float) -> float:
        """Find the best IoU among silhouettes whose area alone allows at least so much."""
        first, last = np.searchsorted(areas, (area * least, area / least))
        common = np.bitwise_count(words[first:last] & scene).sum(axis=1, dtype=np.int64)
        return float((common / np.maximum(areas[first:last] + area - common, 1)).max(initial=0.0))

    best = np.zeros(len(test))
    for i, packed in enumerate(test):
        pixels = np.unpackbits(packed).reshape(image_size, image_size)
        for picture in (pixels, pixels[:, ::-1]):
            scene = np.packbits(picture).view(np.uint64)
            area = int(np.bitwise_count(scene).sum())
            best[i] = max(best[i], best_of(scene, area, 0.97))
            if best[i] < 0.97:  # areas that differ more may hold a better one
                best[i] = max(best[i], best_of(scene, area, max(best[i], 0.01)))
    return best


def _layouts(contents: Contents, positions: bool) -> NDArray[np.void]:
    codes = layout_codes(contents.arrays, contents.manifest.world, positions=positions)
    return as_scalars(codes, codes.shape[1])


def _rows(packed: NDArray[np.uint8]) -> NDArray[np.void]:
    return np.ascontiguousarray(packed).view(np.dtype((np.void, packed.shape[1]))).ravel()


def _tally(values: NDArray[Any]) -> dict[str, int]:
    numbers, times = np.unique(values, return_counts=True)
    return {f"{number:g}": int(n) for number, n in zip(numbers.tolist(), times, strict=True)}
