"""stackgen capture: from a drawing, the photo of a sketch or a depth frame to a silhouette."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from stackgen.commands.output import tell, wrote
from stackgen.commands.parsing import Command, Files
from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.geometry import silhouette as silhouette_of
from stackgen.io.stacks_file import read_stacks
from stackgen.stack import format_block_list
from stackgen.vision.cameras import Rig, realsense_frame, simulated_frame
from stackgen.vision.cells import Ints, in_cells, squared
from stackgen.vision.depth import DepthFrame
from stackgen.vision.images import Picture
from stackgen.vision.masks import fitted
from stackgen.vision.options import PictureOptions
from stackgen.vision.reader import Reading, read_picture, read_silhouette
from stackgen.viz.render import save_image
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, Mask


@dataclass(frozen=True)
class Source:
    """Where the picture comes from.

    Args:
        depth: Depth frame: a 16-bit PNG or TIFF, or a .npy (H, W).
        color: Picture of the same pixels as a depth frame, for the overlay.
        sketch: Drawing, or photo of a drawing on paper, filled or in outline.
        simulate: File of stacks (stacks.json); a simulated depth camera looks at one of them.
        stack: Number of the stack in the file of --simulate, from 1.
        realsense: Take a frame from the first RealSense camera.
        elevation: Angle of the simulated camera above the horizontal [deg].
        azimuth: Angle of the simulated camera to the right of the front [deg].
        seed: Seed of the simulated camera's noise.
    """

    depth: Path | None = None
    color: Path | None = None
    sketch: Path | None = None
    simulate: Path | None = None
    stack: int = 1
    realsense: bool = False
    elevation: float = 8.0
    azimuth: float = 0.0
    seed: int = 0


def main(
    source: Source,
    picture: PictureOptions,
    out: Path,
    image: Path | None = None,
    freehand: bool = False,
    network: bool = False,
    truth: Path | None = None,
    overlay: Path | None = None,
) -> None:
    """Find the silhouette of a structure in a drawing, in the photo of one, or before a depth camera.

    Args:
        source: Where the picture comes from.
        picture: What the user says of it.
        out: PNG file to write the silhouette to; `stackgen sample` takes it.
        image: Picture of any kind.
        truth: Picture of the structure, with which the silhouette is compared.
        overlay: PNG or JPEG file to write the picture with what was found to; by default it lies beside the silhouette.
    """
    if sum([bool(image), bool(source.depth), bool(source.sketch), bool(source.simulate), source.realsense]) != 1:
        raise StackgenError("give one of IMAGE, --depth FILE, --sketch PHOTO, --simulate STACKS and --realsense")
    if source.seed < 0:
        raise StackgenError(f"--seed must be at least 0, got {source.seed}")
    expected = None if truth is None else read_silhouette(truth, PAPER_GRID)
    reading, own = _read(source, picture, image)
    expected = own if expected is None else expected
    silhouette, lines = _found(reading, freehand)
    _write(reading, silhouette, lines, out, overlay or out.with_name(f"{out.stem}-overlay.png"))
    if network:
        from stackgen.api import load

        model = load()
        block_list = model.predict_blocks(silhouette)
        blocks = format_block_list(block_list, model.world.catalogue)
        tell(f"block list by the network: {blocks}", network_blocks=blocks)
    if expected is not None:
        tell(f"IoU with the truth: {iou(silhouette, expected):.3f}", iou=iou(silhouette, expected))


def _read(source: Source, picture: PictureOptions, image: Path | None) -> tuple[Reading, Mask | None]:
    """Read the picture; return the stack's own silhouette, too, where a simulated camera looks at one."""
    if source.simulate:
        frame, own = _simulated(source.simulate, source)
        return read_picture(frame, PAPER_GRID, cell_size=picture.cell_size), own
    if source.realsense:
        return read_picture(realsense_frame(), PAPER_GRID, cell_size=picture.cell_size), None
    if source.depth:
        picture = replace(picture, as_="depth")
    if source.color and picture.as_ not in ("depth", None):
        raise StackgenError("--color belongs to a depth frame")
    path = image or source.depth or source.sketch
    assert path is not None
    reading = read_picture(path, PAPER_GRID, **vars(picture), colour=source.color)
    if source.color and reading.kind != "depth":
        raise StackgenError(f"--color belongs to a depth frame, and {path} is none")
    return reading, None


def _found(reading: Reading, freehand: bool) -> tuple[Mask, list[str]]:
    """Set what was read on the paper's grid, in cells where it is made of them; say what was found."""
    as_seen = reading.silhouette(PAPER_GRID)
    reading = reading if freehand else squared(reading, PAPER_GRID)
    lines = [f"read as a {reading.describe()}", *reading.notes]
    known = None if reading.cell is None else reading.height(PAPER_GRID)
    silhouette, cells, block_list = in_cells(reading.figure, PAPER_GRID, known)
    return (as_seen if freehand else silhouette), [*lines, *_made_of(cells, block_list)]


def _made_of(cells: Ints | None, block_list: Ints | None) -> tuple[str, ...]:
    """Draw the cells that were found in letters, and name their block list."""
    if cells is None:
        return ("not made of whole cells: the silhouette is as seen",)
    drawn = "\n".join("  " + "".join(".#/\\"[half] for half in row) for row in cells[::-1])
    if block_list is None:
        return (f"cells:\n{drawn}",)
    return f"cells:\n{drawn}", f"block list by the heuristic: {format_block_list(block_list, PAPER_CATALOGUE)}"


def _simulated(path: Path, source: Source) -> tuple[DepthFrame, Mask]:
    """Simulate the camera before a stack of a file; return the frame and the stack's own silhouette."""
    content = read_stacks(path)
    if not 1 <= source.stack <= len(content.stacks):
        raise StackgenError(f"{path}: --stack must lie in 1..{len(content.stacks)}, got {source.stack}")
    stack = content.stacks[source.stack - 1]
    rig = Rig(elevation=source.elevation, azimuth=source.azimuth)
    frame = simulated_frame(stack, rig, content.cell_size, source.seed)
    return frame, fitted(silhouette_of(stack, PAPER_GRID, "front", PAPER_GRID.image_size), PAPER_GRID)


def _beside(picture: Picture, silhouette: Mask) -> Picture:
    """Set the silhouette beside a picture, as high as it."""
    height = len(picture)
    large = cv2.resize(silhouette.astype(np.uint8) * 255, (height, height), interpolation=cv2.INTER_NEAREST)
    return np.concatenate([picture, np.repeat(large[..., None], 3, axis=2)], axis=1)


def _write(reading: Reading, silhouette: Mask, lines: Sequence[str], out: Path, overlay: Path) -> None:
    """Write both pictures, and print what was found."""
    save_image(out, silhouette)
    save_image(overlay, _beside(reading.overlay, silhouette))
    tell(*lines, read_as=reading.describe(), found=lines)
    wrote(out, overlay)


COMMAND = Command(
    "capture",
    main,
    """
    stackgen capture examples/photos/sketch-house.jpg --out house.png
    stackgen capture photo.jpg --as photo --which 2 --out second.png
    stackgen capture --depth examples/photos/stack-castle-depth.png --cell_size 0.05 --out castle.png
    stackgen capture --simulate examples/stacks/arch.json --elevation 15 --out arch.png
    stackgen capture --realsense --out seen.png
    """,
    files=Files("image", "IMAGE", "Drawing, photo of a sketch, or depth frame.", optional=True),
    settings={"source": Source, "picture": PictureOptions},
    reports=True,
    flags={
        "realsense": "Take a frame from the first RealSense camera.",
        "freehand": "Write the silhouette as drawn or seen, not that of the cells it is made of.",
        "network": "Also ask the block-list network for a block list.",
    },
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
