"""The card that comes with a dataset: its README.md, for people who have the folder and nothing else.

It is made from the manifest alone, so equal datasets have equal cards; `stackgen dataset info` adds what it measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stackgen.data.manifest import FORMAT, SPLITS, Manifest
from stackgen.io.files import write_atomically
from stackgen.io.text import in_markdown

CARD = "README.md"
MARK = "<!-- Dataset card, written by stackgen: what is changed here by hand is lost when it is written again. -->"

_READING = """```python
import io
import json

import numpy as np
import webdataset

for sample in webdataset.WebDataset("{shard}", shardshuffle=False):
    shapes = np.load(io.BytesIO(sample["shapes.npy"]))  # (k,) places in the catalogue
    poses = np.load(io.BytesIO(sample["poses.npy"]))  # (k, 6) x, y, z [cell] and rotation vector [rad]
    packed = np.load(io.BytesIO(sample["silhouette.npy"]))
    silhouette = np.unpackbits(packed, axis=1).astype(bool)  # {pixels} x {pixels}, first row at the top
    meta = json.loads(sample["meta.json"])  # {meta}
    break
```"""


_META = "template, layout, removed"


def write_card(folder: Path, manifest: Manifest, measured: Sequence[str] = ()) -> bool:
    """Write a dataset's card; a README.md that is not ours is left alone.

    Args:
        folder: Folder of the dataset.
        manifest: Manifest of the dataset.
        measured: Paragraphs on what is in it, for the section of that name.

    Returns:
        Whether it was written.

    Raises:
        StackgenError: If it cannot be written.
    """
    path = folder / CARD
    if path.exists() and not path.read_bytes().startswith(MARK.encode()):
        return False
    write_atomically(path, dataset_card(manifest, measured).encode())
    return True


def dataset_card(manifest: Manifest, measured: Sequence[str] = ()) -> str:
    """Write the text of a card in Markdown."""
    stacks = sum(manifest.count(split) for split in SPLITS)
    example = manifest.shards[0]["file"] if manifest.shards else "train-000000.tar"
    meta = "template (number of the drawing), kind, fit, best, margin" if manifest.of_drawings else _META
    reading = _READING.format(shard=example, pixels=manifest.world.grid.image_size, meta=meta)
    sections = {
        "": _about(manifest, stacks),
        "Counts": markdown_table(
            ["split", "stacks", "shards"],
            [
                [split, f"{manifest.count(split):,}", str(sum(s["split"] == split for s in manifest.shards))]
                for split in SPLITS
            ],
        ),
        "How it was made": _making(manifest),
        "Blocks": _blocks(manifest),
        "Physics": _physics(manifest),
        "Reading it": f"A sample is four members of a tar that share a key ({FORMAT}):\n\n{reading}\n\n"
        "With stackgen: `--data.path FOLDER` trains on it, `stackgen dataset verify FOLDER` checks every byte.",
        "Limits": _limits(manifest),
    }
    if measured:
        sections["What is in it"] = "\n\n".join(measured)
    title = f"# {in_markdown(manifest.name)}: {stacks:,} stacks of blocks that stand"
    parts = [MARK, title, *(f"## {name}\n\n{text}" if name else text for name, text in sections.items())]
    return "\n\n".join(parts) + "\n"


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lay out a table whose first column is text and whose others are numbers.

    >>> print(markdown_table(["a", "b"], [["x", "1"]]))
    | a | b |
    | --- | ---: |
    | x | 1 |
    """
    lines = [headings, ["---", *["---:"] * (len(headings) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _about(manifest: Manifest, stacks: int) -> str:
    grid = manifest.world.grid
    what = "the drawing that it answers, which it need not match," if manifest.of_drawings else "its front silhouette"
    return (
        f"{stacks:,} stacks of at most {manifest.world.max_blocks} blocks on a {grid.width} x {grid.height} grid, each "
        f"settled in a physics simulator, with {what} ({grid.image_size} x {grid.image_size} pixels, "
        f"{grid.pixels_per_cell:g} a cell). For learning to build a stable structure of a given silhouette. "
        "The checksum of every shard is in `dataset.json`."
    )


def _making(manifest: Manifest) -> str:
    s = manifest.settings
    if "template" not in s:
        return "`dataset.json` does not say."
    what, lines = ("drawing", [_answering(manifest)]) if manifest.of_drawings else ("design", [_removing(manifest)])
    if s.get("draw"):
        lines.append(f"Of {s['stacks']:,} stacks made so, {s['draw']:,} were drawn uniformly without replacement.")
    if s.get("exclude_testset"):
        more = ", its silhouettes" if manifest.of_drawings else ""
        lines.append(f"Designs that `testset-v1` uses{more}, and their mirror images, are left out.")
    lines.append(
        f"All stacks made from one {what} are in one split. Shares asked for: validation {s['validation']:g}, test "
        f"{s['test']:g}, counted in {what}s."
    )
    if "resplit" in s:
        split = s["resplit"]
        lines.append(
            f"Split again by {split['by']}: validation {split['validation']:g}, test {split['test']:g}, seed "
            f"{split['seed']}; from the dataset with manifest hash `{split['source']}`."
        )
    return "\n".join(lines)


def _removing(manifest: Manifest) -> str:
    s, width = manifest.settings, manifest.world.grid.width
    fill, shift = s["template"]["minimum_fill"], s["template"]["displacement"]
    return (
        f"By construction and deconstruction, seed {manifest.seed}. Rows are filled from the bottom with random blocks "
        f"until at least {fill} of {width} cells are occupied; each block is shifted along x within "
        f"{shift:g} cell. The design is {_accepted(s)} From what stands, up to {s['max_removals']} blocks are removed "
        "one at a time, and each rest is checked in the same way."
    )


def _answering(manifest: Manifest) -> str:
    s = manifest.settings
    how = s["drawings"]
    kinds = ", ".join(in_markdown(kind) for kind, weight in how["kinds"].items() if weight)
    sure = f" (of {how['sure_margin']:g} rad, where some do)" if how.get("sure_margin") else ""
    return (
        f"The program draws silhouettes as people make them, seed {manifest.seed}, of these kinds: {kinds}; "
        f"{100 * how['untidy']:g} % of them untidily. A search finds up to {how['known']} layouts for each that stand "
        f"and fit within {how['near']:g} IoU of the best; of those that survive a tilt of {how['margin']:g} rad{sure} "
        f"up to {how['answers']} are drawn evenly. Each is {_accepted(s)} Drawings whose best answer has an IoU below "
        f"{how['least_fit']:g} are left out. `meta.json` names the kind of the drawing, and gives the IoU of the stack "
        "with it, that of the best answer, and the margin [rad]."
    )


def _accepted(settings: Mapping[str, Any]) -> str:
    accept, twice = settings["accept"], " twice" if settings.get("settle_twice") else ""
    return (
        f"simulated{twice} and kept if it comes to rest, no block moved by more than {accept['displacement']:g} cell "
        f"along an axis or leaned by more than {accept['tilt']:g} rad."
    )


def _blocks(manifest: Manifest) -> str:
    rows = [
        [f"{index}: {in_markdown(shape.name)}", *(f"{extent:g}" for extent in shape.size), f"{shape.volume:g}"]
        for index, shape in enumerate(manifest.world.catalogue)
    ]
    return markdown_table(["shape", "width [cell]", "depth [cell]", "height [cell]", "volume [cell^3]"], rows)


def _physics(manifest: Manifest) -> str:
    rows = [[in_markdown(name), in_markdown(_number(value))] for name, value in manifest.physics.items()]
    return (
        "A verdict holds for these numbers alone; lengths in metres unless stackgen's docs/physics.md says cells.\n\n"
        + markdown_table(["setting", "value"], rows)
    )


def _limits(manifest: Manifest) -> str:
    shift = manifest.settings.get("template", {}).get("displacement", 0.1)
    within = "" if manifest.of_drawings else f", and within {shift:g} cell of a grid"
    what = "Drawings are a program's" if manifest.of_drawings else "They are random, not what people would build"
    return (
        "Stacks are two-dimensional: all blocks stand at y = 0 with yaw 0 but for what settling does"
        f"{within}. {what}. Stable means stable in this "
        "simulator: rigid blocks, one friction coefficient, uniform density, placed all at once; marginal stacks may "
        "fall under other settings. Equal settings give equal bytes on one kind of machine and one set of versions."
    )


def _number(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
