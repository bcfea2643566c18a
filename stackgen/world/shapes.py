"""The shapes of blocks, and catalogues of them. The unit is the cell, the edge of a cube."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import MALFORMED, StackgenError

Floats = NDArray[np.float64]

MOST_SHAPES = 127
"""Shapes of a catalogue, at most: datasets count them in a signed byte."""

_MOST_CELLS = 1000


@dataclass(frozen=True)
class Shape:
    """A convex prism: an outline in the (x, z) plane extruded along y.

    Args:
        name: Name in block lists, files and tables.
        outline: Corners (x, z) [cell] in the block frame, counter-clockwise seen from the front;
            the origin is the centre of the outline's box.
        depth: Extent along y [cell].

    Raises:
        StackgenError: If the name could not stand in a block list or a program, or the outline is not convex, not
            counter-clockwise or not centred.

    >>> Shape("plank", ((-1, -0.25), (1, -0.25), (1, 0.25), (-1, 0.25))).size
    (2.0, 1.0, 0.5)
    """

    name: str
    outline: tuple[tuple[float, float], ...]
    depth: float = 1.0

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and self.name.isprintable() and re.fullmatch(r"[^\s,=]{1,100}", self.name)):
            raise StackgenError(
                "catalogue: a shape's name is 1 to 100 printable characters, no space, comma or equals sign, got"
                f" {_short(self.name)}"
            )
        corners = np.asarray(self.outline, dtype=float)
        if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 2 or not np.isfinite(corners).all():
            raise self._refused("must be at least three (x, z) corners, finite numbers")
        if np.abs(corners).max() > _MOST_CELLS:
            raise self._refused(f"must lie within {_MOST_CELLS} cells")
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
        if not 0 < self.depth <= _MOST_CELLS:
            raise StackgenError(
                f"shape {self.name!r}: depth must be positive and at most {_MOST_CELLS} cells, got {self.depth}"
            )

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

    @property
    def faces(self) -> list[list[int]]:
        """The corners of each face as indices into `vertices`, counter-clockwise seen from outside.

        >>> Shape("wedge", ((-1, -1), (1, -1), (0, 1))).faces
        [[0, 1, 2], [5, 4, 3], [0, 3, 4, 1], [1, 4, 5, 2], [2, 5, 3, 0]]
        """
        n = len(self.outline)
        sides = [[i, i + n, (i + 1) % n + n, (i + 1) % n] for i in range(n)]
        return [list(range(n)), list(range(2 * n - 1, n - 1, -1)), *sides]

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
            return Catalogue(tuple(_prism(str(item["name"]), item) for item in items))
        except MALFORMED as error:
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
    try:
        if "width" in item:
            extents = [float(item.get(key, 1)) for key in ("width", "height", "depth")]
            if not all(0 < extent < np.inf for extent in extents):
                raise StackgenError(f"shape {name!r}: width, height and depth must be positive and finite")
            return Shape.box(name, *extents)
        return _prism(name, item)
    except MALFORMED as error:
        raise StackgenError(f"shape {name!r}: extents are numbers, an outline [[x, z], ...]: {error}") from error


def _prism(name: str, item: Mapping) -> Shape:
    return Shape(name, tuple((float(x), float(z)) for x, z in item["outline"]), float(item.get("depth", 1)))


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
"""The four shapes of the paper: the long rectangle has three cells, the triangle one, apex up."""
