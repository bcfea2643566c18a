"""The picture of scenes that dashboards show."""

from __future__ import annotations

import numpy as np

from stackgen.evaluation.protocol import Scene
from stackgen.geometry import silhouette
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.training.plots import silhouette_sheet
from stackgen.viz.render import FALLEN
from stackgen.world import PAPER_GRID


def cube(z: float = 0.5) -> Stack:
    return Stack(np.array([0]), np.array([[0.0, 0, z, 0, 0, 0]]))


def test_a_column_shows_target_generated_and_settled() -> None:
    scenes = [Scene("a", silhouette(cube(), PAPER_GRID), np.array([1, 0, 0, 0]))] * 2
    fell = Verdict(False, np.array([True]), np.array([2.0]), cube())
    sheet = silhouette_sheet(scenes, [cube(), cube(2.5)], [None, fell], PAPER_GRID)
    red = (sheet == FALLEN).all(axis=-1)
    assert red[:, : sheet.shape[1] // 2].sum() == 0  # no verdict, no settled silhouette
    settled = int(silhouette(cube(), PAPER_GRID).sum()) * 4
    assert settled <= red.sum() <= settled + 400  # and the words below it
    targets = (sheet[: sheet.shape[0] // 3] == (40, 42, 48)).all(axis=-1)
    assert targets.sum() >= 2 * settled


def test_scenes_that_do_not_fit_beside_each_other_go_below() -> None:
    scene = Scene("a", silhouette(cube(), PAPER_GRID), np.array([1, 0, 0, 0]))
    sheets = [silhouette_sheet([scene] * n, [cube()] * n, [None] * n, PAPER_GRID) for n in (4, 5, 8)]
    four, five, eight = (sheet.shape for sheet in sheets)
    assert four[1] == five[1] == eight[1] and four[0] < five[0] == eight[0]
    ink = [int((sheet[:, 122:] == (40, 42, 48)).all(axis=-1).sum()) for sheet in sheets]
    assert ink[0] // 4 == ink[1] // 5 == ink[2] // 8 == 8 * int(silhouette(cube(), PAPER_GRID).sum())
