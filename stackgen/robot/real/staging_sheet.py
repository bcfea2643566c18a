"""A sheet to lay the blocks out on: their outlines to scale, seen from above, in numbered slots.

A PDF has an overview and pages of A4 to be printed at 100 % and joined at the marks of the table's coordinates; an
SVG is one drawing of the whole area for a plotter. Lengths in millimetres.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from stackgen.errors import StackgenError, require
from stackgen.io.files import write_atomically
from stackgen.io.text import in_a_plot
from stackgen.robot.planning.clearance import block_corners
from stackgen.robot.planning.staging import Waiting, lay_out
from stackgen.robot.workcell import Workcell, pose
from stackgen.stack import Stack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

PAGE = (210.0, 297.0)  # A4
MARGIN = 12.0  # of a page, which printers leave white
_INCH = 25.4
_MARKS = 50.0  # between the crosses of the table's coordinates
_SKETCH = 0.3  # scale of the front view beside an outline
SUFFIXES = (".pdf", ".svg")


@dataclass(frozen=True, kw_only=True)
class SlotDrawing:
    """A block in its slot, on paper.

    Args:
        slot: Number of the slot, from 1.
        block: Number of the block in the stack.
        shape: Name of its shape.
        border: (4, 2) border of the slot.
        outline: (V, 2) outline of the block as it lies, seen from above.
        front: (V, 2) outline of the block as it lies, seen from the front of its slot, around the origin.
    """

    slot: int
    block: int
    shape: str
    border: Floats
    outline: Floats
    front: Floats


def places(stack: Stack, order: tuple[int, ...], workcell: Workcell, cell_size: float) -> list[SlotDrawing]:
    """Draw where the blocks lie, in the order in which they are fetched.

    Raises:
        StackgenError: If they do not fit into the staging area.
    """
    waiting = lay_out(stack, order, workcell, cell_size)
    return [
        _drawing(number, waiting[block], block, stack, workcell=workcell, cell_size=cell_size)
        for number, block in enumerate(order, 1)
    ]


def _drawing(
    number: int, waiting: Waiting, block: int, stack: Stack, *, workcell: Workcell, cell_size: float
) -> SlotDrawing:
    corners = block_corners(stack, block, waiting.frame, cell_size)
    x, y, turn = workcell.staging.slots[number - 1]
    slot = pose((x, y, 0.0), turn)
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [workcell.staging.length / 2, workcell.staging.depth / 2]
    front = _hull(((corners - slot[:3, 3]) @ slot[:3, :3])[:, [0, 2]])
    middle = (front.min(axis=0) + front.max(axis=0)) / 2
    return SlotDrawing(
        slot=number,
        block=block,
        shape=stack.names[block],
        border=(half @ slot[:2, :2].T + [x, y]) * 1e3,
        outline=_hull(corners[:, :2]) * 1e3,
        front=(front - middle) * 1e3,
    )


def write_staging_sheet(
    path: Path, stack: Stack, *, order: tuple[int, ...], workcell: Workcell, cell_size: float
) -> None:
    """Write the sheet.

    Args:
        path: File to write, a .pdf or an .svg.
        stack: Stack that is built.
        order: (k,) numbers of its blocks in the order in which they are fetched.
        workcell: Workcell with the slots.
        cell_size: Edge of a cube [m].

    Raises:
        StackgenError: If the suffix is another, the blocks do not fit, or the file cannot be written.
    """
    check_suffix(path)
    found = places(stack, order, workcell, cell_size)
    write_atomically(path, _svg(found, workcell) if path.suffix.lower() == ".svg" else _pdf(found, workcell))


def check_suffix(path: Path) -> None:
    """See that a sheet can be written under this name.

    Raises:
        StackgenError: If not.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise StackgenError(f"--staging_sheet {path}: sheets are written as {' or '.join(SUFFIXES)}; change the suffix")


def area(found: list[SlotDrawing]) -> tuple[Floats, Floats]:
    """Find the corners of the rectangle around slots and structure."""
    points = np.concatenate([place.border for place in found] + [np.array([[-20.0, -20.0], [20.0, 20.0]])])
    return points.min(axis=0), points.max(axis=0)


def tiles(found: list[SlotDrawing]) -> Iterator[tuple[Floats, tuple[int, int]]]:
    """Yield the lower left corner of each page with something on it, and its row (from below) and column, from 1."""
    low, high = area(found)
    size = np.array(PAGE) - 2 * MARGIN
    columns, rows = np.ceil((high - low) / size).astype(int)
    drawn = [np.concatenate([place.border, place.outline]) for place in found] + [np.zeros((1, 2))]
    for row in range(rows):
        for column in range(columns):
            corner = low + size * [column, row]
            if any((p.max(axis=0) > corner).all() and (p.min(axis=0) < corner + size).all() for p in drawn):
                yield corner, (row + 1, column + 1)


def _pdf(found: list[SlotDrawing], workcell: Workcell) -> bytes:
    data = io.BytesIO()
    pdf_pages = require("matplotlib.backends.backend_pdf", "robot").PdfPages
    size = np.array(PAGE) - 2 * MARGIN
    with pdf_pages(data, metadata={"Title": "stackgen staging sheet", "CreationDate": None}) as pages:
        low, high = area(found)
        title = "Overview (not to scale)"
        window = low - 30, high + 30
        _page(pages.savefig, PAGE[::-1], window, found=found, workcell=workcell, title=title, overview=True)
        for corner, (row, column) in tiles(found):
            title = f"Row {row} from below, column {column} from the left: print at 100 %, cut along the frame"
            _page(pages.savefig, PAGE, (corner, corner + size), found=found, workcell=workcell, title=title)
    return data.getvalue()


def _svg(found: list[SlotDrawing], workcell: Workcell) -> bytes:
    data = io.BytesIO()
    low, high = area(found)
    size = tuple(high - low + 2 * MARGIN)

    def save(figure: Figure) -> None:
        figure.savefig(data, format="svg", metadata={"Date": None})

    _page(save, (float(size[0]), float(size[1])), (low, high), found=found, workcell=workcell, title="Plot at 100 %")
    return data.getvalue()


def _page(
    save: Callable[[Figure], Any],
    page: tuple[float, float],
    window: tuple[Floats, Floats],
    *,
    found: list[SlotDrawing],
    workcell: Workcell,
    title: str,
    overview: bool = False,
) -> None:
    """Draw a page that shows a window of the table; 1 mm is 1 mm unless it is the overview."""
    figure = require("matplotlib.figure", "robot").Figure(figsize=(page[0] / _INCH, page[1] / _INCH))
    box = (MARGIN / page[0], MARGIN / page[1], 1 - 2 * MARGIN / page[0], 1 - 2 * MARGIN / page[1])
    axes = figure.add_axes(box)
    (left, bottom), (right, top) = window
    axes.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
    if overview:
        axes.set_aspect("equal")
    for place in found:
        _draw(axes, place, 6 if overview else 11)
    _marks(axes, window, overview)
    x, y, _ = (1e3 * number for number in workcell.base.position)
    axes.plot([x], [y], "o", color="black", markersize=8)
    axes.annotate("arm", (x, y), (6, 6), textcoords="offset points", fontsize=7, annotation_clip=True)
    axes.plot([0], [0], "+", color="black", markersize=18)
    axes.annotate("middle of the structure", (0, 0), (6, 9), textcoords="offset points", fontsize=7)
    figure.text(0.5, 1 - MARGIN / page[1] / 2, title, ha="center", va="center", fontsize=9)
    note = "seen from above; the camera is below, the arm above; small: the block as seen from the front of its slot"
    figure.text(0.5, MARGIN / page[1] / 2, note, ha="center", va="center", fontsize=7)
    save(figure)


def _draw(axes: Axes, place: SlotDrawing, font: float) -> None:
    from matplotlib.patches import Polygon

    axes.add_patch(Polygon(place.border, closed=True, fill=False, linestyle=":", linewidth=0.5))
    axes.add_patch(Polygon(place.outline, closed=True, facecolor="0.93", edgecolor="black", linewidth=1.0))
    middle = (place.outline.min(axis=0) + place.outline.max(axis=0)) / 2
    axes.text(middle[0], middle[1], f"{place.slot}", ha="center", va="center", fontsize=2 * font, clip_on=True)
    corner = place.border.min(axis=0)
    text = in_a_plot(f"slot {place.slot}: block {place.block}, {place.shape}")
    axes.text(corner[0] + 3, corner[1] + 3, text, va="bottom", fontsize=0.7 * font, clip_on=True)
    sketch = place.front * _SKETCH
    at = np.array([place.border[:, 0].min(), place.border[:, 1].max()])
    sketch = sketch - [sketch[:, 0].min(), sketch[:, 1].max()] + at + [3, -3]
    axes.add_patch(Polygon(sketch, closed=True, fill=False, linewidth=0.8))


def _marks(axes: Axes, window: tuple[Floats, Floats], overview: bool) -> None:
    """Draw crosses of the table's coordinates, to join pages and to check the scale with a ruler."""
    low, high = window
    step = 2 * _MARKS if overview else _MARKS
    xs, ys = (np.arange(np.ceil(a / step), b / step + 1e-9) * step for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    axes.plot(*grid.T, "+", color="0.4", markersize=6, markeredgewidth=0.4)
    for x, y in grid[(grid % (2 * _MARKS) == 0).all(axis=1)]:
        axes.annotate(f"{x:.0f}, {y:.0f}", (x, y), (2, 2), textcoords="offset points", fontsize=4, color="0.4")


def _hull(points: Floats) -> Floats:
    """Corners (V, 2) of the convex hull, anticlockwise."""
    return np.asarray(points[ConvexHull(points).vertices])
