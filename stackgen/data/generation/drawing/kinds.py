"""Kinds of figures that people draw: boxes, arches, stairs, letters, trees, animals.

A kind is a pure function of a pencil: its random numbers, the size that it may fill, and the ruler that its edges lie
on (whole cells, half cells, anywhere). Lengths in cells, x from 0 on to the right, z from the ground up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from stackgen.data.generation.drawing.figures import Figure, Floats, Pencil, gable, oval, rectangle
from stackgen.errors import StackgenError


def _boxes(p: Pencil) -> Figure:
    """Some boxes, each on the ground or on another; sometimes with a gable on one."""
    placed: list[tuple[float, float, float, float]] = []
    for _ in range(int(p.rng.integers(1, 8))):
        wide, high = min(p.wide, p.length(0.5, p.wide)), p.length(0.5, max(0.5, p.high / 2))
        under = placed[int(p.rng.integers(len(placed)))] if placed and p.chance(0.6) else (0.0, 0.0, p.wide, 0.0)
        low = under[1] + under[3]
        left = p.place(under[0] - wide / 2, under[0] + under[2] - wide / 2)
        left = min(max(left, 0.0), p.wide - wide)
        if low + high <= p.high + 1e-9:
            placed.append((left, low, wide, high))
    placed = placed or [(0.0, 0.0, p.wide, p.high)]
    parts = [rectangle(*box) for box in placed]
    top = max(placed, key=lambda box: box[1] + box[3])
    if p.chance(0.33) and top[1] + top[3] + 0.5 <= p.high:
        parts.append(gable(top[0], top[1] + top[3], top[2], min(p.length(0.5, 1.5), p.high - top[1] - top[3])))
    return Figure(tuple(parts))


def _slopes(p: Pencil) -> Figure:
    """A ramp, a hill, a pyramid or a hip, on a box or on the ground."""
    low = p.length(0, p.high / 2) if p.chance(0.5) else 0.0
    high = max(0.5, p.high - low)
    kind, parts = int(p.rng.integers(4)), [rectangle(0, 0, p.wide, low)] if low else []
    if kind == 3:  # a hip, or a slope that is cut off
        left, right = (p.place(0, p.wide / 2) for _ in range(2))
        parts.append(np.array([[0, low], [p.wide, low], [p.wide - right, low + high], [left, low + high]]))
    else:
        parts.append(gable(0, low, p.wide, high, (0.0, 1.0, 0.5)[kind]))
    return Figure(tuple(parts))


def _arch(p: Pencil) -> Figure:
    """A gate: two piers and what lies on them, the opening flat, round or pointed."""
    pier, lintel = min(p.length(0.5, 1.5), p.wide / 3), min(p.length(0.5, 1.5), p.high / 2)
    wide, high = p.wide - 2 * pier, p.high - lintel
    kind, holes = int(p.rng.integers(3)), [rectangle(pier, -1, wide, high + 1)]
    if kind:
        spring = max(0.0, high - wide / 2)
        round_top = oval(pier, 2 * spring - high, wide, 2 * (high - spring))
        holes = [rectangle(pier, -1, wide, spring + 1), round_top if kind == 1 else gable(pier, spring, wide, wide / 2)]
    parts = [rectangle(0, 0, p.wide, p.high)]
    if p.chance(0.3):
        parts.append(gable(0, p.high, p.wide, p.length(0.5, 1)))
    return Figure(tuple(parts), tuple(holes))


def _bridge(p: Pencil) -> Figure:
    """A deck on two to four piers, sometimes with ends that reach out or something on it."""
    deck = min(p.length(0.5, 1), p.high / 2)
    low = p.length(0.5, p.high - deck)
    pier = min(p.length(0.5, 1), p.wide / 4)
    number = int(p.rng.integers(2, max(3, min(5, int(p.wide / pier / 1.5)) + 1)))
    inset = p.length(0, p.wide / 6) if p.chance(0.4) else 0.0
    lefts = [p.snapped(left) for left in np.linspace(inset, p.wide - inset - pier, number)]
    parts = [rectangle(left, 0, pier, low) for left in lefts] + [rectangle(0, low, p.wide, deck)]
    if p.chance(0.4) and low + deck < p.high:
        wide = min(p.length(0.5, p.wide), p.wide)
        parts.append(rectangle(p.place(0, p.wide - wide), low + deck, wide, p.high - low - deck))
    return Figure(tuple(parts))


def _stairs(p: Pencil) -> Figure:
    """Steps up to one side, or up and down again."""
    number = int(p.rng.integers(2, max(3, round(p.high)) + 1))
    if p.step:
        number = max(2, min(number, round(p.high / p.step), round(p.wide / p.step)))
    rise, run = p.high / number, p.wide / number
    tops = [p.snapped(rise * (i + 1), p.step or 0.2) for i in range(number)]
    lefts = [p.snapped(run * i) for i in range(number)] + [p.wide]
    match int(p.rng.integers(3)):
        case 0:
            tops = tops[::-1]
        case 1:
            tops = [max(tops[i], tops[number - 1 - i]) for i in range(number)][::-1]
            tops = tops if p.chance(0.5) else [max(tops) + min(tops) - top for top in tops]
    return Figure(tuple(rectangle(a, 0, b - a, top) for a, b, top in zip(lefts, lefts[1:], tops, strict=False)))


def _tower(p: Pencil) -> Figure:
    """Storeys that narrow or widen, with a spire, battlements or a flat top."""
    parts, low, wide = [], 0.0, p.wide
    top = p.length(0.5, 1.5) if p.chance(0.6) and p.high > 1.5 else 0.0
    while low < p.high - top - 0.2:
        high = min(p.length(0.5, p.high), p.high - top - low)
        parts.append(rectangle((p.wide - wide) / 2, low, wide, high))
        low += high
        wide = min(p.wide, max(0.5, wide + p.place(-1.6, 0.4)))
    if top and p.chance(0.6):
        parts.append(gable((p.wide - wide) / 2, low, wide, top))
    elif top and wide > 1:
        parts += [rectangle((p.wide - wide) / 2 + i * wide / 3, low, wide / 3, top) for i in (0, 2)]
    return Figure(tuple(parts) or (rectangle(0, 0, p.wide, p.high),))


def _wall(p: Pencil) -> Figure:
    """A wall or a castle: battlements, windows, a gate, towers at its ends."""
    top = min(p.length(0.5, 1), p.high / 2)
    parts, holes = [rectangle(0, 0, p.wide, p.high - top)], []
    number = int(p.rng.integers(0, max(1, int(p.wide / 1.5)) + 1))
    merlon = min(p.length(0.5, 1), p.wide / max(1, 2 * number - 1))
    for left in np.linspace(0, p.wide - merlon, number):
        parts.append(rectangle(p.snapped(left), p.high - top, merlon, top))
    if p.chance(0.5) and p.wide > 2:
        wide, high = p.length(0.5, p.wide / 2), p.length(0.5, max(0.5, p.high - top - 0.5))
        left = p.snapped((p.wide - wide) / 2 if p.chance(0.6) else p.place(0.5, p.wide - wide - 0.5))
        sill = -1.0 if p.chance(0.6) else p.place(0.5, p.high / 2)
        holes.append(rectangle(left, sill, wide, high - min(sill, 0)))
    return Figure(tuple(parts), tuple(holes))


def _skyline(p: Pencil) -> Figure:
    """Houses of a street, each of its own height, some with a roof."""
    parts, left = [], 0.0
    while left < p.wide - 0.2:
        wide, high = min(p.length(0.5, max(1, p.wide / 2)), p.wide - left), p.length(0.5, p.high)
        parts.append(rectangle(left, 0, wide, high))
        if p.chance(0.25) and high + 0.5 <= p.high:
            parts.append(gable(left, high, wide, min(p.length(0.5, 1), p.high - high)))
        left += wide + (p.length(0.5, 1) if p.chance(0.1) else 0)
    return Figure(tuple(parts))


def _house(p: Pencil) -> Figure:
    """Walls under a roof, with a door or a chimney."""
    roof = min(p.length(0.5, 2), 0.6 * p.high)
    low, eaves = p.high - roof, p.length(0.25, 0.5) if p.chance(0.3) else 0.0
    parts, holes = [rectangle(eaves, 0, max(0.5, p.wide - 2 * eaves), low)], []
    if p.chance(0.75):
        parts.append(gable(0, low, p.wide, roof, float(p.rng.choice([0.5, 0.5, 0.5, 0, 1]))))
    else:
        cut = p.wide / 4
        parts.append(np.array([[0, low], [p.wide, low], [p.wide - cut, p.high], [cut, p.high]]))
    if p.chance(0.3):
        parts.append(rectangle(p.wide * 0.65, low, min(0.8, p.wide / 4), roof * p.rng.uniform(0.7, 1.1)))
    if p.chance(0.3) and p.wide > 2:
        wide = min(p.length(0.5, 1), p.wide / 2)
        holes.append(rectangle(p.snapped((p.wide - wide) / 2), -1, wide, 1 + min(p.length(0.75, 1.5), 0.8 * low)))
    return Figure(tuple(parts), tuple(holes))


def _tree(p: Pencil) -> Figure:
    """A trunk with a crown, or a fir of one to three gables."""
    trunk, low = min(p.length(0.5, 1.2), p.wide), min(p.length(0.5, p.high / 2), 0.6 * p.high)
    high = p.high - low
    parts = [rectangle((p.wide - trunk) / 2, 0, trunk, low + 0.1)]
    match int(p.rng.integers(4)):
        case 0:
            parts.append(oval(0, low, p.wide, high))
        case 1:
            parts.append(rectangle(0, low, p.wide, high))
        case 2:
            parts.append(gable(0, low, p.wide, high))
        case _:
            n = int(p.rng.integers(2, 4))
            wides = np.linspace(p.wide, max(0.8, p.wide / 2), n)
            parts += [gable((p.wide - w) / 2, low + i * high / n, w, 1.2 * high / n) for i, w in enumerate(wides)]
    return Figure(tuple(parts))


def _animal(p: Pencil) -> Figure:
    """A body on legs, a neck or none, a head, ears, a tail."""
    leg, legs = min(p.length(0.5, 1), p.wide / 4), int(p.rng.choice([2, 2, 2, 3]))
    low = min(p.length(0.5, p.high / 2), p.high / 2)
    body = min(p.length(0.75, 1.5), p.high - low)
    long = max(p.wide * 0.7, p.wide - p.length(0.25, 1))
    parts = [rectangle(left, 0, leg, low) for left in np.linspace(0, long - leg, legs)]
    parts.append(rectangle(0, low, long, body) if p.chance(0.8) else oval(0, low - 0.1, long, body + 0.1))
    over = p.high - low - body
    neck = min(p.length(0.5, 1), long / 2)
    head = min(p.length(0.75, 1.5), p.wide / 2)
    if over > 0.4:
        parts.append(rectangle(long - neck, low + body / 2, neck, over + body / 2))
        parts.append(rectangle(p.wide - max(head, neck), low + body + over / 2, max(head, neck), over / 2))
        if p.chance(0.3):
            parts.append(gable(long - neck, p.high, neck / 2, 0.4))
    else:
        parts.append(rectangle(long - 0.1, low + body / 3, p.wide - long + 0.1, body / 2))
    return Figure(tuple(parts))


def _furniture(p: Pencil) -> Figure:
    """A table, a chair, a bed or a shelf."""
    leg, top = min(p.length(0.4, 1), p.wide / 3), min(p.length(0.4, 1), p.high / 2)
    low = max(0.5, (p.high - top) * (1.0 if p.chance(0.4) else 0.5))
    parts = [rectangle(0, 0, leg, low), rectangle(p.wide - leg, 0, leg, low), rectangle(0, low, p.wide, top)]
    if low + top < p.high:
        parts.append(rectangle(0, low + top, leg, p.high - low - top))
        if p.chance(0.4):
            parts.append(rectangle(p.wide - leg, low + top, leg, (p.high - low - top) * p.rng.uniform(0.4, 1)))
    return Figure(tuple(parts))


_GLYPHS = {
    "A": "00 04 44 40;02 42", "B": "00 04 34 32 02;32 42 40 00", "C": "44 04 00 40", "D": "00 04 34 43 41 30 00",
    "E": "44 04 00 40;02 32", "F": "44 04 00;02 32", "G": "44 04 00 40 42 22", "H": "00 04;40 44;02 42", "I": "20 24",
    "J": "44 40 00 01", "K": "00 04;44 02 40", "L": "04 00 40", "M": "00 04 22 44 40", "N": "00 04 40 44",
    "O": "00 04 44 40 00", "P": "00 04 44 42 02", "Q": "00 04 44 40 00;22 40", "R": "00 04 44 42 02;22 40",
    "S": "44 04 02 42 40 00", "T": "04 44;24 20", "U": "04 00 40 44", "V": "04 20 44", "W": "04 00 22 40 44",
    "X": "00 44;04 40", "Y": "04 22 44;22 20", "Z": "04 44 00 40", "1": "13 24 20", "2": "04 44 42 02 00 40",
    "3": "04 44 40 00;02 42", "4": "04 02 42;44 40", "5": "44 04 02 42 40 00", "6": "44 04 00 40 42 02",
    "7": "04 44 20", "8": "00 04 44 40 00;02 42", "9": "42 02 04 44 40 00",
}  # fmt: skip
"""Strokes of letters and digits: places (x, z) of five by five, joined by lines."""


def _glyph(p: Pencil, names: Sequence[str]) -> Figure:
    thick = min(p.length(0.5, 1.25), p.wide / 2, p.high / 2)
    size = np.array([p.wide - thick, p.high - thick]) / 4
    parts = []
    for stroke in _GLYPHS[names[int(p.rng.integers(len(names)))]].split(";"):
        places = [np.array([int(place[0]), int(place[1])]) * size + thick / 2 for place in stroke.split()]
        parts += [_line(a, b, thick) for a, b in pairwise(places)]
    return Figure(tuple(parts))


def _line(a: Floats, b: Floats, thick: float) -> Floats:
    """Give the corners of a line with square ends."""
    along = (b - a) / max(float(np.hypot(*(b - a))), 1e-9) * thick / 2
    aside = np.array([-along[1], along[0]])
    return np.stack([a - along - aside, b + along - aside, b + along + aside, a - along + aside])


def _letter(p: Pencil) -> Figure:
    """A letter of strokes."""
    return _glyph(p, [name for name in _GLYPHS if name.isalpha()])


def _digit(p: Pencil) -> Figure:
    """A digit of strokes."""
    return _glyph(p, [name for name in _GLYPHS if name.isdigit()])


def _block(p: Pencil) -> Figure:
    """One block."""
    shape = p.catalogue[int(p.rng.integers(len(p.catalogue)))]
    return Figure((np.asarray(shape.outline, dtype=np.float64),))


def _rows(p: Pencil) -> Figure:
    """Rows of blocks, each as wide as the one below or less, with a gap here and there."""
    parts: list[Floats] = []
    low, left, right = 0.0, 0.0, p.wide
    while low < p.high - 0.2:
        fitting = [s for s in p.catalogue if s.size[2] <= p.high - low + 1e-6 and s.size[0] <= right - left + 1e-6]
        if not fitting:
            break
        height = fitting[int(p.rng.integers(len(fitting)))].size[2]
        last = low + height > p.high - 0.2
        choices = [s for s in fitting if s.size[2] == height and (last or s.level[1])]
        x, row = left, []
        while choices := [s for s in choices if s.size[0] <= right - x + 1e-6]:
            shape = choices[int(p.rng.integers(len(choices)))]
            row.append(np.asarray(shape.outline) + [x + shape.size[0] / 2, low + height / 2])
            x += shape.size[0] + (p.length(0.5, 1) if p.chance(0.12) else 0.0)
        if not row:
            break
        parts += row
        left, right = row[0][:, 0].min(), row[-1][:, 0].max()
        if p.chance(0.4):
            cut = p.place(0, (right - left) / 2)
            left, right = (left + cut, right) if p.chance(0.5) else (left, right - cut)
        low += height
    return Figure(tuple(parts)) if parts else _block(p)


KINDS: dict[str, Callable[[Pencil], Figure]] = {
    "block": _block, "rows": _rows, "boxes": _boxes, "slopes": _slopes, "arch": _arch, "bridge": _bridge,
    "stairs": _stairs, "tower": _tower, "wall": _wall, "skyline": _skyline, "house": _house, "tree": _tree,
    "animal": _animal, "furniture": _furniture, "letter": _letter, "digit": _digit,
}  # fmt: skip
"""Every kind of figure by its name."""


def draw_figure(kind: str, pencil: Pencil) -> Figure:
    """Draw a figure of a kind.

    Raises:
        StackgenError: If there is no such kind.
    """
    if kind not in KINDS:
        raise StackgenError(f"drawings: there is no kind {kind!r}; there are {', '.join(KINDS)}")
    return KINDS[kind](pencil)
