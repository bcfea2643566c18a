"""Shapes, block lists, stacks: the nouns everything else speaks in.

Units: cells (the edge of a cube) for lengths, radians for rotation vectors.
World frame: x to the right as the camera sees it, y away from the camera, z up, ground at z = 0.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_BLOCKS = 10
"""N, the number of object tokens of the paper; the longest block list its models accept."""

MOST_SHAPES = 127
"""Shapes of a catalogue, at most: datasets count them in a signed byte."""

Floats = NDArray[np.float64]


class StackgenError(Exception):
    """Something a user can mend: the message names what was wrong and what would be right.

    The command line prints it as one line and exits with 2.
    """


@dataclass(frozen=True)
class Shape:
    """A convex prism: an outline in the (x, z) plane extruded along y.

    Args:
        name: Word used in block lists, files and tables.
        outline: Corners (x, z) [cell] in the block frame, counter-clockwise seen from the front;
            the origin is the centre of the outline's box.
        depth: Extent along y [cell].

    Raises:
        StackgenError: If the outline is not convex, not counter-clockwise or not centred.

    >>> Shape("plank", ((-1, -0.25), (1, -0.25), (1, 0.25), (-1, 0.25))).size
    (2.0, 1.0, 0.5)
    """

    name: str
    outline: tuple[tuple[float, float], ...]
    depth: float = 1.0

    def __post_init__(self) -> None:
        corners = np.asarray(self.outline, dtype=float)
        if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 2 or not np.isfinite(corners).all():
            raise self._refused("must be at least three (x, z) corners, finite numbers")
        edges = np.roll(corners, -1, axis=0) - corners
        after = np.roll(edges, -1, axis=0)
        turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
        around = np.arctan2(turns, (edges * after).sum(axis=1)).sum()  # a star turns left too, but more than once
        if np.abs(turns).max() <= 1e-9 * (edges**2).max():
            raise self._refused("has no area; it must be convex and counter-clockwise")
        if (turns < 0).all():
            raise self._refused("must be convex and counter-clockwise; it is clockwise, so reverse its corners")
        if (turns <= 0).any() or abs(around - 2 * np.pi) > 1e-6:
            raise self._refused("must be convex and counter-clockwise, without a corner in the middle of an edge")
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
        if np.abs(middle).max() > 5e-7:
            raise self._refused(f"must have its box centred on (0, 0); subtract ({middle[0]:g}, {middle[1]:g})")
        if not 0 < self.depth < np.inf:
            raise StackgenError(f"shape {self.name!r}: depth must be positive and finite, got {self.depth}")

    def _refused(self, reason: str) -> StackgenError:
        return StackgenError(f"shape {self.name!r}: the outline {reason}")

    @cached_property
    def size(self) -> tuple[float, float, float]:
        """Extents of the box along x, y, z [cell]."""
        corners = np.asarray(self.outline, dtype=float)
        width, height = np.ptp(corners, axis=0)
        return float(width), float(self.depth), float(height)

    @cached_property
    def _moments(self) -> tuple[float, Floats]:
        """Area [cell^2] and centroid (x, z) [cell] of the outline, by the shoelace formula."""
        a = np.asarray(self.outline, dtype=float)
        b = np.roll(a, -1, axis=0)
        cross = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
        area = cross.sum() / 2
        return float(area), ((a + b) * cross[:, None]).sum(axis=0) / (6 * area)

    @property
    def area(self) -> float:
        """Area of the outline [cell^2]."""
        return self._moments[0]

    @property
    def volume(self) -> float:
        """Volume [cell^3]; mass is proportional to it."""
        return self.area * self.depth

    @property
    def center_of_mass(self) -> Floats:
        """(3,) centre of mass in the block frame [cell]."""
        x, z = self._moments[1]
        return np.array([x, 0.0, z])

    @cached_property
    def vertices(self) -> Floats:
        """(2n, 3) corners of the prism in the block frame [cell], front face first."""
        corners = np.asarray(self.outline, dtype=float)
        front = np.insert(corners, 1, -self.depth / 2, axis=1)
        return np.concatenate([front, front * [1, -1, 1]])

    @cached_property
    def is_box(self) -> bool:
        """Whether the prism fills its box."""
        width, depth, height = self.size
        return abs(self.volume - width * depth * height) < 1e-9

    @property
    def level(self) -> tuple[bool, bool]:
        """Whether there is a level edge at the bottom, to stand on, and at the top, to bear.

        >>> PAPER_CATALOGUE[3].level
        (True, False)
        """
        z = np.sort([corner[1] for corner in self.outline])
        return bool(z[1] - z[0] < 1e-6), bool(z[-1] - z[-2] < 1e-6)

    @staticmethod
    def box(name: str, width: float, height: float = 1.0, depth: float = 1.0) -> Shape:
        """A cuboid of the given extents [cell]."""
        w, h = width / 2, height / 2
        return Shape(name, ((-w, -h), (w, -h), (w, h), (-w, h)), depth)


@dataclass(frozen=True)
class Catalogue:
    """The ordered shapes a world is made of; a shape's place in it is its index everywhere.

    >>> PAPER_CATALOGUE.names
    ('cube', 'rectangle', 'long_rectangle', 'triangle')
    """

    shapes: tuple[Shape, ...]

    def __post_init__(self) -> None:
        if not self.shapes or len(set(self.names)) != len(self.shapes):
            raise StackgenError(f"a catalogue needs at least one shape and distinct names, got {list(self.names)}")

    @property
    def names(self) -> tuple[str, ...]:
        """The shapes' names, in order."""
        return tuple(shape.name for shape in self.shapes)

    def __len__(self) -> int:
        return len(self.shapes)

    def __iter__(self) -> Iterator[Shape]:
        return iter(self.shapes)

    def __getitem__(self, index: int) -> Shape:
        return self.shapes[index]

    def index(self, name: str) -> int:
        """Index of a shape by name.

        Raises:
            StackgenError: If there is no such shape.
        """
        if name not in self.names:
            raise StackgenError(f"unknown shape {name!r}: the catalogue has {', '.join(self.names)}")
        return self.names.index(name)

    def to_json(self) -> list[dict]:
        """Plain form for manifests, cards and `stacks.json`."""
        return [
            {"name": s.name, "outline": [[float(x), float(z)] for x, z in s.outline], "depth": float(s.depth)}
            for s in self.shapes
        ]

    @staticmethod
    def from_json(items: Sequence[Mapping]) -> Catalogue:
        """Inverse of :meth:`to_json`.

        Raises:
            StackgenError: If an entry is malformed.
        """
        try:
            return Catalogue(
                tuple(
                    Shape(
                        str(i["name"]), tuple((float(x), float(z)) for x, z in i["outline"]), float(i.get("depth", 1))
                    )
                    for i in items
                )
            )
        except (KeyError, TypeError, ValueError) as error:
            raise StackgenError(
                f'a catalogue is a list of {{"name", "outline": [[x, z], ...], "depth"}}: {error!r}'
            ) from error

    @staticmethod
    def from_config(items: Sequence[str | Mapping]) -> Catalogue:
        """A catalogue as people write it: each entry the name of one of the paper's shapes, a box given by
        `width` and, where they are not 1, `height` and `depth`, or a prism given by its `outline`.

        Raises:
            StackgenError: If an entry is none of these, or its name could not stand in a block list.

        >>> Catalogue.from_config(["cube", {"name": "plank", "width": 2, "height": 0.5}]).names
        ('cube', 'plank')
        """
        if isinstance(items, str | Mapping) or not isinstance(items, Sequence):
            raise StackgenError(f"catalogue: it is a list of shapes, got {_short(items)}")
        if len(items) > MOST_SHAPES:
            raise StackgenError(f"catalogue: at most {MOST_SHAPES} shapes are possible, got {len(items)}")
        return Catalogue(tuple(_shape_from_config(item) for item in items))


def _shape_from_config(item: str | Mapping) -> Shape:
    if isinstance(item, str):
        return PAPER_CATALOGUE[PAPER_CATALOGUE.index(item)]
    kind = {"outline"} if isinstance(item, Mapping) and "outline" in item else {"width", "height"}
    if not isinstance(item, Mapping) or not {"name", max(kind)} <= set(item) <= {"name", "depth"} | kind:
        raise StackgenError(
            "catalogue: a shape is a name of the paper's, {name, width, height, depth} or {name, outline, depth},"
            f" got {_short(item)}"
        )
    name = item["name"]
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w{0,99}", name, re.ASCII):
        raise StackgenError(f"catalogue: a shape's name is letters, digits and _, from a letter on, got {_short(name)}")
    try:
        if "width" in item:
            extents = [float(item.get(key, 1)) for key in ("width", "height", "depth")]
            if not all(0 < extent < np.inf for extent in extents):
                raise StackgenError(f"shape {name!r}: width, height and depth must be positive and finite")
            return Shape.box(name, *extents)
        return Shape(name, tuple((float(x), float(z)) for x, z in item["outline"]), float(item.get("depth", 1)))
    except (TypeError, ValueError) as error:
        raise StackgenError(f"shape {name!r}: extents are numbers, an outline [[x, z], ...]: {error}") from error


def _short(value: object) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:80]} ..."


PAPER_CATALOGUE = Catalogue(
    (
        Shape.box("cube", 1),
        Shape.box("rectangle", 2),
        Shape.box("long_rectangle", 3),
        Shape("triangle", ((-0.5, -0.5), (0.5, -0.5), (0.0, 0.5))),
    )
)
"""The four shapes of the paper; SPEC: the long rectangle is three cells, the triangle one cell, apex up."""


@dataclass(frozen=True)
class Stack:
    """Blocks with poses.

    Args:
        shapes: (k,) indices into the catalogue.
        poses: (k, 6) position [cell] and rotation vector [rad] of each block frame in the world.
        catalogue: What the indices mean.

    Raises:
        StackgenError: If the arrays do not fit each other or hold a value that is not finite.
    """

    shapes: NDArray[np.int64]
    poses: Floats
    catalogue: Catalogue = PAPER_CATALOGUE

    def __post_init__(self) -> None:
        shapes = np.asarray(self.shapes, dtype=np.int64)
        poses = np.asarray(self.poses, dtype=np.float64)
        if shapes.ndim != 1 or poses.shape != (len(shapes), 6):
            raise StackgenError(f"a stack is shapes (k,) and poses (k, 6), got {shapes.shape} and {poses.shape}")
        if len(shapes) and not (0 <= shapes.min() and shapes.max() < len(self.catalogue)):
            raise StackgenError(f"shape indices must lie in 0..{len(self.catalogue) - 1}")
        if not np.isfinite(poses).all():
            raise StackgenError("poses must be finite numbers")
        object.__setattr__(self, "shapes", shapes)
        object.__setattr__(self, "poses", poses)

    def __len__(self) -> int:
        return len(self.shapes)

    @property
    def names(self) -> list[str]:
        """Shape name of each block."""
        return [self.catalogue.names[s] for s in self.shapes]

    @property
    def counts(self) -> NDArray[np.int64]:
        """(S,) block list of the stack: how many of each shape."""
        return np.bincount(self.shapes, minlength=len(self.catalogue))

    def with_poses(self, poses: ArrayLike) -> Stack:
        """The same blocks at other poses."""
        return Stack(self.shapes, np.asarray(poses, dtype=np.float64), self.catalogue)


def parse_block_list(
    text: str, catalogue: Catalogue = PAPER_CATALOGUE, max_blocks: int = MAX_BLOCKS
) -> NDArray[np.int64]:
    """Counts (S,) from `"cube=3,rectangle=2"`.

    Raises:
        StackgenError: On an unknown shape, a count that is not a whole number of at least 0,
            an empty list, or more than `max_blocks` blocks.

    >>> parse_block_list("cube=3, triangle=1").tolist()
    [3, 0, 0, 1]
    """
    counts = np.zeros(len(catalogue), dtype=np.int64)
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, equals, number = (p.strip() for p in part.partition("="))
        index = catalogue.index(name)
        if not equals or not number.isascii() or not number.isdigit() or len(number) > 9:
            raise StackgenError(f"block list: {part!r} should read {name}=COUNT, a whole number from 0 to {max_blocks}")
        counts[index] += int(number)
    check_block_list(counts, max_blocks)
    return counts


def check_block_list(counts: ArrayLike, max_blocks: int = MAX_BLOCKS) -> None:
    """Raise StackgenError unless the counts (S,) are those of 1..max_blocks blocks."""
    array = np.asarray(counts)
    if (array < 0).any():
        raise StackgenError(f"block list: counts must be at least 0, got {array.tolist()}")
    if not 1 <= array.sum() <= max_blocks:
        raise StackgenError(f"block list: {int(array.sum())} blocks, but 1 to {max_blocks} are possible")


def format_block_list(counts: ArrayLike, catalogue: Catalogue = PAPER_CATALOGUE) -> str:
    """Inverse of :func:`parse_block_list`; shapes with count 0 are left out.

    >>> format_block_list([3, 0, 0, 1])
    'cube=3,triangle=1'
    """
    return ",".join(f"{name}={int(n)}" for name, n in zip(catalogue.names, np.asarray(counts), strict=True) if n)


def shapes_of(counts: ArrayLike) -> NDArray[np.int64]:
    """(k,) shape indices of a block list (S,), in catalogue order.

    >>> shapes_of([2, 0, 1]).tolist()
    [0, 0, 2]
    """
    array = np.asarray(counts, dtype=np.int64)
    return np.repeat(np.arange(len(array)), array)
