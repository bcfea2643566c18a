"""stackgen capture: from a depth frame or the photo of a drawing to a silhouette."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stackgen.commands.parsing import Command
from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.geometry import silhouette as silhouette_of
from stackgen.io.stacks_file import read_stacks
from stackgen.stack import format_block_list
from stackgen.vision.cameras import Rig, realsense_frame, simulated_frame
from stackgen.vision.cells import Ints
from stackgen.vision.depth import DepthFrame, Floats, Picture, find_structure, read_frame
from stackgen.vision.drawings import read_silhouette
from stackgen.vision.sketches import read_sketch
from stackgen.viz.render import save_image
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, Mask

_RED = (214, 39, 40)
_LEFT_OUT = 0.05
"""Share of the structure from which on what was left out beside it is worth telling."""


@dataclass(frozen=True)
class _Result:
    """The silhouette that was found, and how it is shown.

    Args:
        silhouette: (H, W).
        overlay: (h, w, 3) the picture with what was found in it.
        lines: Lines to print.
    """

    silhouette: Mask
    overlay: Picture
    lines: tuple[str, ...]


def main(
    out: Path,
    depth: Path | None = None,
    color: Path | None = None,
    sketch: Path | None = None,
    simulate: Path | None = None,
    realsense: bool = False,
    freehand: bool = False,
    network: bool = False,
    stack: int = 1,
    focal: float | None = None,
    elevation: float = 8.0,
    azimuth: float = 0.0,
    seed: int = 0,
    truth: Path | None = None,
    overlay: Path | None = None,
) -> None:
    """Find the silhouette of a structure before a depth camera, or in the photo of a drawing.

    Args:
        out: PNG file to write the silhouette to; `stackgen sample` takes it.
        depth: Depth frame: a 16-bit PNG in mm, or a .npy in m.
        color: Picture of the same pixels as --depth, for the overlay.
        sketch: Photo of a drawing on paper, filled or in outline.
        simulate: File of stacks (stacks.json); a simulated depth camera looks at one of them.
        stack: Number of the stack in the file of --simulate, from 1.
        focal: Focal length of --depth [pixel]; that of a RealSense D435 by default.
        elevation: Angle of the simulated camera above the horizontal [deg].
        azimuth: Angle of the simulated camera to the right of the front [deg].
        seed: Seed of the simulated camera's noise.
        truth: Picture of the structure, with which the silhouette is compared.
        overlay: PNG or JPEG file to write the picture with what was found to; by default it lies beside the silhouette.
    """
    if sum([bool(depth), bool(sketch), bool(simulate), realsense]) != 1:
        raise StackgenError("give one of --depth FILE, --sketch PHOTO, --simulate STACKS and --realsense")
    if seed < 0:
        raise StackgenError(f"--seed must be at least 0, got {seed}")
    if color and not depth:
        raise StackgenError("--color belongs to --depth: give both")
    expected = None if truth is None else read_silhouette(truth, PAPER_GRID)
    if sketch:
        result = _from_sketch(sketch, freehand)
    elif simulate:
        frame, own = _simulated(simulate, stack, elevation, azimuth, seed)
        expected = own if expected is None else expected
        result = _from_frame(frame, freehand)
    elif depth:
        result = _from_frame(read_frame(depth, color, focal), freehand, f"{depth}: ")
    else:
        result = _from_frame(realsense_frame(), freehand)
    _write(result, out, overlay or out.with_name(f"{out.stem}-overlay.png"))
    if network:
        from stackgen.api import load

        model = load()
        block_list = model.predict_blocks(result.silhouette)
        print(f"block list by the network: {format_block_list(block_list, model.world.catalogue)}")
    if expected is not None:
        print(f"IoU with the truth: {iou(result.silhouette, expected):.3f}")


def _from_sketch(path: Path, freehand: bool) -> _Result:
    """Read the drawing in a photo."""
    found = read_sketch(path, PAPER_GRID)
    silhouette = found.drawn if freehand else found.silhouette
    overlay = _beside(_framed(found.photo, found.sheet), silhouette)
    return _Result(silhouette, overlay, _made_of(found.cells, found.block_list))


def _from_frame(frame: DepthFrame, freehand: bool, name: str = "") -> _Result:
    """Find the structure in a frame; `name` begins the line of an error."""
    try:
        found = find_structure(frame, PAPER_GRID)
    except StackgenError as error:
        raise StackgenError(f"{name}{error}") from error
    width, height = found.size
    silhouette = found.as_seen if freehand else found.silhouette
    lines = [f"structure: {1e3 * width:.0f} mm wide, {1e3 * height:.0f} mm high"]
    if found.left_out > _LEFT_OUT:
        lines.append(f"left out: what stands beside it and touches it nowhere, {found.left_out:.0%} of its size")
    shown = _photo(frame)
    shown[found.seen] = 0.55 * shown[found.seen] + 0.45 * np.array(_RED)
    overlay = _beside(_framed(shown.astype(np.uint8), found.outline), silhouette)
    return _Result(silhouette, overlay, (*lines, *_made_of(found.cells, found.block_list)))


def _made_of(cells: Ints | None, block_list: Ints | None) -> tuple[str, ...]:
    """Draw the cells that were found in letters, and name their block list."""
    if cells is None:
        return ("not made of whole cells: the silhouette is as seen",)
    drawn = "\n".join("  " + "".join(".#^"[cell] for cell in row) for row in cells[::-1])
    if block_list is None:
        return (f"cells:\n{drawn}",)
    return f"cells:\n{drawn}", f"block list by the heuristic: {format_block_list(block_list, PAPER_CATALOGUE)}"


def _simulated(path: Path, number: int, elevation: float, azimuth: float, seed: int) -> tuple[DepthFrame, Mask]:
    """Simulate the camera before a stack of a file; return the frame and the stack's own silhouette."""
    content = read_stacks(path)
    if not 1 <= number <= len(content.stacks):
        raise StackgenError(f"{path}: --stack must lie in 1..{len(content.stacks)}, got {number}")
    stack = content.stacks[number - 1]
    frame = simulated_frame(stack, Rig(elevation=elevation, azimuth=azimuth), content.cell_size, seed)
    whole = silhouette_of(stack, PAPER_GRID, "front", PAPER_GRID.image_size)
    return frame, read_silhouette(whole, PAPER_GRID, exact=False)


def _photo(frame: DepthFrame) -> Floats:
    """Return the frame's colours (H, W, 3), or its depth in grey where it has none."""
    if frame.colour is not None:
        return frame.colour.astype(np.float64)
    near = np.where(frame.depth > 0, frame.depth, frame.depth.max())
    grey = 255 * (near.max() - near) / max(float(np.ptp(near)), 1e-6)
    return np.repeat(grey[..., None], 3, axis=2)


def _framed(picture: Picture, corners: Floats) -> Picture:
    """Draw a red quadrangle into a picture."""
    framed = np.ascontiguousarray(picture)
    cv2.polylines(framed, [np.round(corners).astype(np.int32)], True, _RED, max(1, picture.shape[1] // 300))
    return framed


def _beside(picture: Picture, silhouette: Mask) -> Picture:
    """Set the silhouette beside a picture, as high as it."""
    height = len(picture)
    large = cv2.resize(silhouette.astype(np.uint8) * 255, (height, height), interpolation=cv2.INTER_NEAREST)
    return np.concatenate([picture, np.repeat(large[..., None], 3, axis=2)], axis=1)


def _write(result: _Result, out: Path, overlay: Path) -> None:
    """Write both pictures, and print what was found."""
    save_image(out, result.silhouette)
    save_image(overlay, result.overlay)
    print(*result.lines, f"wrote {out}", f"wrote {overlay}", sep="\n")


COMMAND = Command(
    "capture",
    main,
    """
    stackgen capture --sketch examples/photos/sketch-house.jpg --out house.png
    stackgen capture --depth examples/photos/stack-castle-depth.png --out castle.png
    stackgen capture --simulate examples/stacks/arch.json --elevation 15 --out arch.png
    stackgen capture --realsense --out seen.png
    """,
    flags={
        "realsense": "Take a frame from the first RealSense camera.",
        "freehand": "Write the silhouette as drawn or seen, not that of the cells it is made of.",
        "network": "Also ask the block-list network for a block list.",
    },
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
