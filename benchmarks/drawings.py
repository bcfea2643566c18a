"""What a dataset of drawings holds: kinds, how well they are answered, and a sheet of drawings with their answers."""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from PIL import Image

from benchmarks.common import argument_parser, plain_table, report, start
from stackgen.data.dataset import Dataset

if TYPE_CHECKING:
    from stackgen.data.shards import Sample
    from stackgen.viz.render import Picture
    from stackgen.world import World

_SCALE, _ACROSS = 2, 14
_GREY, _BLUE = (190, 190, 190), (0, 60, 200)


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("data", nargs="?", default="data/drawings", help="dataset of drawings")
    options.add_argument("--split", default="train", help="split to look at")
    options.add_argument("--picture", type=Path, help="file of the sheet")
    options.add_argument("--tiles", type=int, default=56, help="drawings on the sheet, evenly spread")
    return options


def tile(sample: Sample, world: World) -> Picture:
    """The drawing in grey, the outlines of the blocks in blue, the kind above."""
    grid = world.grid
    picture = np.full((grid.image_size, grid.image_size, 3), 255, np.uint8)
    picture[sample.silhouette] = _GREY
    picture = picture.repeat(_SCALE, axis=0).repeat(_SCALE, axis=1)
    for shape, pose in zip(sample.shapes.tolist(), sample.poses, strict=True):
        corners = (np.asarray(world.catalogue[shape].outline) + pose[[0, 2]]) * [1, -1] * grid.pixels_per_cell
        corners += [grid.image_size / 2, grid.image_size - grid.ground_margin]
        cv2.polylines(picture, [np.round(corners * _SCALE).astype(np.int32)], True, _BLUE, 1, cv2.LINE_AA)
    label = f"{sample.meta['kind']} {sample.meta['fit']:.2f}"
    cv2.putText(picture, label, (2, 9), cv2.FONT_HERSHEY_SIMPLEX, 0.32, (0, 0, 0), 1, cv2.LINE_AA)
    return np.pad(picture, ((1, 1), (1, 1), (0, 0)))


def main() -> None:
    """Read the dataset, count, draw."""
    options = parser().parse_args()
    dataset = Dataset.open(options.data)
    samples = list(dataset.samples(options.split))
    by_kind: dict[str, list[Sample]] = defaultdict(list)
    for sample in samples:
        by_kind[sample.meta["kind"]].append(sample)
    rows: list[dict[str, Any]] = [
        {
            "kind": kind,
            "drawings": len({sample.meta["template"] for sample in those}),
            "answers": len(those),
            "best": float(np.mean([sample.meta["best"] for sample in those])),
            "blocks": float(np.mean([len(sample.shapes) for sample in those])),
        }
        for kind, those in sorted(by_kind.items())
    ]
    if options.picture:
        chosen = np.linspace(0, len(samples) - 1, options.tiles).round().astype(int)
        tiles = [tile(samples[i], dataset.world) for i in chosen]
        lines = [np.hstack(tiles[i : i + _ACROSS]) for i in range(0, len(tiles) - _ACROSS + 1, _ACROSS)]
        Image.fromarray(np.vstack(lines)).quantize(32).save(options.picture, optimize=True)
    table = plain_table(
        f"{options.split} split of {options.data}",
        ("kind", "drawings", "answers", "IoU of the best", "blocks"),
        [[r["kind"], str(r["drawings"]), str(r["answers"]), f"{r['best']:.3f}", f"{r['blocks']:.1f}"] for r in rows],
    )
    report("drawings", {"dataset": dataset.manifest.sha256, "rows": rows}, [table], options.out)


if __name__ == "__main__":
    start(main)
