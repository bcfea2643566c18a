"""Drawings of a dataset: which kinds, how large, how untidy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stackgen.data.generation.drawing.figures import Figure, Pencil
from stackgen.data.generation.drawing.hands import EFFECTS, put_down
from stackgen.data.generation.drawing.kinds import KINDS, draw_figure
from stackgen.errors import StackgenError
from stackgen.world import Mask, World

DESIGN = "design"
"""Kind of the silhouettes that the paper's recipe makes: random designs, some of their blocks taken out."""

RULERS = {"cell": 1.0, "half": 0.5, "anywhere": 0.0}
"""Distance of the lines that edges lie on [cell]."""

_KINDS = {
    "block": 1.0, "rows": 5.0, "boxes": 5.0, "slopes": 2.0, "arch": 2.0, "bridge": 2.0, "stairs": 2.0, "tower": 3.0,
    "wall": 2.0, "skyline": 2.0, "house": 2.0, "tree": 1.0, "animal": 2.0, "furniture": 1.0, "letter": 2.0,
    "digit": 1.0, DESIGN: 20.0,
}  # fmt: skip
_RULERS = {"cell": 0.4, "half": 0.3, "anywhere": 0.3}
_EFFECTS = dict.fromkeys(EFFECTS, 1.0) | {"specks": 0.3}


@dataclass(frozen=True)
class DrawingSettings:
    """How drawings are made, and how the search answers them.

    Args:
        kinds: Weight of each kind of drawing; `design` is the paper's recipe, and kinds without weight are not drawn.
        rulers: Weight of each ruler that edges lie on: `cell`, `half` (half cells), `anywhere`.
        smallest: Least width or height, whichever is larger [cell]; the largest is the grid.
        untidy: Share of the drawings with one or two effects of a hand.
        effects: Weight of each effect: turned, slanted, scaled, wavering, rounded, rough, specks.
        effort: Effort of the search, as that of `stackgen sample`.
        known: Number of good layouts that the search looks for.
        answers: Largest number of them that are stored, drawn evenly.
        near: How much less IoU than the best an answer may have.
        margin: Least tilt of the ground, to either side, that an answer survives [rad].
        sure_margin: Tilt that a sure answer survives [rad]; others are left out where some are sure.
        least_fit: Least IoU of the best answer; drawings that blocks cannot make are left out.

    Raises:
        StackgenError: If a number is out of range, or a name is unknown.
    """

    kinds: Mapping[str, float] = field(default_factory=lambda: dict(_KINDS))
    rulers: Mapping[str, float] = field(default_factory=lambda: dict(_RULERS))
    smallest: float = 1.0
    untidy: float = 0.45
    effects: Mapping[str, float] = field(default_factory=lambda: dict(_EFFECTS))
    effort: float = 0.2
    known: int = 16
    answers: int = 4
    near: float = 0.02
    margin: float = 0.03
    sure_margin: float = 0.0
    least_fit: float = 0.5

    def __post_init__(self) -> None:
        for name, known in (("kinds", (*KINDS, DESIGN)), ("rulers", tuple(RULERS)), ("effects", EFFECTS)):
            weights = getattr(self, name)
            if unknown := sorted(set(weights) - set(known)):
                raise StackgenError(f"drawings: {name} {unknown[0]!r} is none of {', '.join(known)}")
            if any(not 0 <= weight < np.inf for weight in weights.values()) or sum(weights.values()) <= 0:
                raise StackgenError(f"drawings: {name} needs weights of at least 0, and one above it")
        if not (0 <= self.untidy <= 1 and 0 <= self.near <= 1 and 0 <= self.least_fit <= 1):
            raise StackgenError("drawings: untidy, near and least_fit lie in 0..1")
        if not (self.margin >= 0 and self.sure_margin >= 0):
            raise StackgenError("drawings: margin and sure_margin are at least 0")
        if not (0 < self.effort < np.inf and self.smallest > 0 and 1 <= self.answers <= self.known):
            raise StackgenError("drawings: effort and smallest must be positive, and answers lie in 1..known")


class Drawing(NamedTuple):
    """A silhouette (H, W) and the kind of thing that it shows."""

    kind: str
    silhouette: Mask


def choose(weights: Mapping[str, float], rng: np.random.Generator) -> str:
    """Draw a name by its weight."""
    names = sorted(weights)
    share = np.array([weights[name] for name in names], dtype=np.float64)
    return names[int(rng.choice(len(names), p=share / share.sum()))]


def draw(kind: str, world: World, settings: DrawingSettings, rng: np.random.Generator) -> Figure:
    """Draw a figure of a kind; of every kind but `design`."""
    step = RULERS[choose(settings.rulers, rng)]
    grid = world.grid
    while True:
        wide, high = rng.triangular(0.6, grid.width, grid.width), rng.triangular(0.6, grid.height, grid.height)
        if max(wide, high) >= min(settings.smallest, grid.width, grid.height):
            break
    pencil = Pencil(rng, wide, high, step, world.catalogue)
    size = pencil.snapped(wide, step or 0.6), pencil.snapped(high, step or 0.6)
    return draw_figure(kind, Pencil(rng, *size, step, world.catalogue))


def finish(
    kind: str, figure: Figure, world: World, settings: DrawingSettings, rng: np.random.Generator
) -> Drawing | None:
    """Put a figure into a silhouette, some of them untidily; None if nothing is left of it."""
    effects: list[str] = []
    if rng.random() < settings.untidy:
        effects = [choose(settings.effects, rng) for _ in range(int(rng.integers(1, 3)))]
    mask = put_down(figure, world.grid, effects, rng)
    return None if mask is None else Drawing(kind, mask)
