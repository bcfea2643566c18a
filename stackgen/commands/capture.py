"""stackgen capture: from a depth frame or the photo of a drawing to a silhouette."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stackgen.commands.parsing import Command
from stackgen.errors import StackgenError
from stackgen.geometry import iou, silhouette
from stackgen.io.files import write_atomically
from stackgen.io.stacks_file import read_stacks
from stackgen.stack import format_block_list
from stackgen.vision.drawings import read_silhouette
from stackgen.world import PAPER_GRID, Mask

if TYPE_CHECKING:
    from stackgen.vision.depth import Frame

Picture = NDArray[np.uint8]

_FOUND = (214, 39, 40)
_LEFT_OUT = 0.05  # worth telling


@dataclass(frozen=True)
class _Result:
    """What is written and printed.

    Args:
        silhouette: (H, W).
        overlay: What was seen, with what was found in it.
        lines: To print.
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
    """Find the silhouette of a structure before a depth camera, or in a photo of a drawing.

    Args:
        out: The silhouette to write, PNG; it can be given to `stackgen sample`.
        depth: A depth frame: a PNG of 16 bits in mm, or a .npy in m.
        color: The picture of the same pixels, for the overlay.
        sketch: A photo of a drawing on paper, filled or in outline.
        simulate: A stacks.json, of which a simulated depth camera sees one stack.
        stack: Which one, counted from 1.
        focal: Focal length of the depth frame [pixel]; that of a RealSense D435 by default.
        elevation: Of the simulated camera above the horizontal [deg].
        azimuth: Of the simulated camera, to the right of the front [deg].
        seed: Of the simulated camera's noise.
        truth: A picture of the structure, to say how well the silhouette fits.
        overlay: The picture of what was found; by default beside the silhouette.
    """
    sources = [bool(depth), bool(sketch), bool(simulate), realsense]
    if sum(sources) != 1:
        raise StackgenError("give one of --depth FILE, --sketch PHOTO, --simulate STACKS and --realsense")
    if color and not depth:
        raise StackgenError("--color belongs to --depth: give both")
    expected = None if truth is None else read_silhouette(truth)
    if sketch:
        result = _from_sketch(sketch, freehand)
    elif simulate:
        frame, expected_of_stack = _simulated(simulate, stack, elevation, azimuth, seed)
        expected = expected_of_stack if expected is None else expected
        result = _from_frame(frame, freehand)
    elif depth:
        from stackgen.vision.depth import read_frame

        result = _from_frame(read_frame(depth, color, focal), freehand, str(depth))
    else:
        from stackgen.vision.cameras import realsense_frame

        result = _from_frame(realsense_frame(), freehand)
    _write(result, out, overlay or out.with_name(f"{out.stem}-overlay.png"))
    if network:
        from stackgen.api import load

        model = load()
        counts = model.predict_blocks(result.silhouette)
        print(f"block list by the network: {format_block_list(counts, model.catalogue)}")
    if expected is not None:
        print(f"IoU with the truth: {iou(result.silhouette, expected):.3f}")


def _from_sketch(path: Path, freehand: bool) -> _Result:
    """The drawing in a photo."""
    from stackgen.vision.sketches import read_sketch

    found = read_sketch(path)
    shown = found.drawn if freehand else found.silhouette
    lines = _made_of(found.cells, found.counts)
    return _Result(shown, _sketch_overlay(found.photo, found.sheet, shown), lines)


def _from_frame(frame: Frame, freehand: bool, name: str = "") -> _Result:
    """The structure in a frame."""
    from stackgen.vision.depth import capture

    try:
        found = capture(frame)
    except StackgenError as error:
        raise StackgenError(f"{name}: {error}" if name else str(error)) from error
    width, height = found.size
    shown = found.as_seen if freehand else found.silhouette
    lines = [f"structure: {1e3 * width:.0f} mm wide, {1e3 * height:.0f} mm high"]
    if found.left_out > _LEFT_OUT:
        lines.append(f"left out: what stands beside it and touches it nowhere, {found.left_out:.0%} of its size")
    lines += _made_of(found.cells, found.counts)
    return _Result(shown, _frame_overlay(frame, found.seen, found.outline, shown), tuple(lines))


def _made_of(cells: NDArray[np.int64] | None, counts: NDArray[np.int64] | None) -> tuple[str, ...]:
    """Lines about the cells that were found."""
    if cells is None:
        return ("not made of whole cells: the silhouette is as seen",)
    drawn = "\n".join("  " + "".join(".#^"[cell] for cell in row) for row in cells[::-1])
    lines = [f"cells:\n{drawn}"]
    if counts is not None:
        lines.append(f"block list by the heuristic: {format_block_list(counts)}")
    return tuple(lines)


def _simulated(path: Path, number: int, elevation: float, azimuth: float, seed: int) -> tuple[Frame, Mask]:
    """What a simulated camera sees of a stack of a file, and the stack's own silhouette."""
    from stackgen.vision.cameras import Rig, simulated_frame

    content = read_stacks(path)
    if not 1 <= number <= len(content.stacks):
        raise StackgenError(f"{path}: --stack must lie in 1..{len(content.stacks)}, got {number}")
    stack = content.stacks[number - 1]
    frame = simulated_frame(stack, Rig(elevation=elevation, azimuth=azimuth), content.cell_size, seed)
    return frame, read_silhouette(silhouette(stack, "front", PAPER_GRID, PAPER_GRID.image_size), exact=False)


def _frame_overlay(frame: Frame, seen: Mask, outline: NDArray[np.float64], result: Mask) -> Picture:
    """The frame with the structure's pixels reddened and its front framed; the silhouette beside it."""
    near = np.where(frame.depth > 0, frame.depth, frame.depth.max())
    grey = 255 * (near.max() - near) / max(float(np.ptp(near)), 1e-6)
    picture = frame.colour if frame.colour is not None else np.repeat(grey[..., None], 3, axis=2)
    shown = picture.astype(np.float64)
    shown[seen] = 0.55 * shown[seen] + 0.45 * np.array(_FOUND)
    return _beside(_framed(shown.astype(np.uint8), outline), result)


def _sketch_overlay(photo: Picture, sheet: NDArray[np.float64], result: Mask) -> Picture:
    """The photo with the sheet framed; the silhouette beside it."""
    return _beside(_framed(photo, sheet), result)


def _framed(picture: Picture, corners: NDArray[np.float64]) -> Picture:
    import cv2

    framed = np.ascontiguousarray(picture)
    cv2.polylines(framed, [np.round(corners).astype(np.int32)], True, _FOUND, max(1, picture.shape[1] // 300))
    return framed


def _beside(picture: Picture, result: Mask) -> Picture:
    """The picture and, as high as it, the silhouette."""
    import cv2

    height = len(picture)
    large = cv2.resize(result.astype(np.uint8) * 255, (height, height), interpolation=cv2.INTER_NEAREST)
    return np.concatenate([picture, np.repeat(large[..., None], 3, axis=2)], axis=1)


def _write(result: _Result, out: Path, overlay: Path) -> None:
    """Both pictures, and what was found in words."""
    write_atomically(out, _png(result.silhouette.astype(np.uint8) * 255))
    write_atomically(overlay, _png(result.overlay[..., ::-1]))
    print(*result.lines, sep="\n")
    print(f"wrote {out}\nwrote {overlay}")


def _png(picture: NDArray[np.uint8]) -> bytes:
    import cv2

    return bytes(cv2.imencode(".png", picture)[1])


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
        "realsense": "Take a frame of the first RealSense camera.",
        "freehand": "Write what was drawn or seen, not the cells that it is made of.",
        "network": "Also ask the network for a block list.",
    },
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
