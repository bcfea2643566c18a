"""Every drawing of examples/silhouettes can be built, and the stacks of examples/stacks do what they say."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stackgen.geometry import silhouette_iou, tilt
from stackgen.io.stacks_file import read_stacks
from stackgen.sim.checkers import SimulatorChecker
from stackgen.stack import Stack
from stackgen.vision.reader import read_silhouette
from stackgen.world import MAX_BLOCKS, PAPER_CATALOGUE, PAPER_GRID

EXAMPLES = Path(__file__).parents[1] / "examples"
WORD = {"c": "cube", "r": "rectangle", "l": "long_rectangle", "t": "triangle"}

# Rows from the ground up; a letter for each block and the x of its centre.
BUILDINGS = {
    "arch.png": ["c-1 c1", "c-1 c1", "c-1 c1", "l0"],
    "bridge.jpg": ["c-1.5 c1.5", "c-1.5 c1.5", "r-1 r1", "c-1.5 c1.5"],
    "castle.jpg": ["r-1 r1", "r-1 r1", "c-1.5 c1.5", "t-1.5 t1.5"],
    "chair.png": ["c-1 c1", "l0", "c-1", "c-1"],
    "church.png": ["c-1.5 l0.5", "c-1.5 l0.5", "c-1.5", "t-1.5"],
    "gate.png": ["c-1 c1", "c-1 c1", "l0", "t-1 t1"],
    "house.png": ["c-1 c1", "l0", "r0", "t0"],
    "pyramid.jpg": ["r-1 r1", "l0", "r0", "c0"],
    "stairs.jpg": ["r-1 r1", "l0.5", "r1", "c1.5"],
    "t.png": ["c0", "c0", "c0", "l0"],
    "terrace.png": ["l0", "l0", "l0", "t-1 t0 t1"],
    "tower.png": ["l0", "c0", "c0", "t0"],
}


def building(rows: list[str]) -> Stack:
    """The stack that the rows describe."""
    blocks = [(WORD[word[0]], float(word[1:]), z + 0.5) for z, row in enumerate(rows) for word in row.split()]
    shapes = np.array([PAPER_CATALOGUE.index(name) for name, _, _ in blocks])
    return Stack(shapes, np.array([[x, 0, z, 0, 0, 0] for _, x, z in blocks]))


@pytest.fixture(scope="module")
def checker() -> SimulatorChecker:
    return SimulatorChecker()


def test_every_drawing_has_a_building() -> None:
    assert {path.name for path in (EXAMPLES / "silhouettes").iterdir()} == set(BUILDINGS)


@pytest.mark.parametrize("name", BUILDINGS)
def test_a_stack_that_stands_matches_the_drawing(name: str, checker: SimulatorChecker) -> None:
    stack = building(BUILDINGS[name])
    target = read_silhouette(EXAMPLES / "silhouettes" / name, PAPER_GRID)
    verdict = checker.check(stack)
    assert len(stack) <= MAX_BLOCKS
    assert silhouette_iou(stack, target, PAPER_GRID) >= 0.95
    assert verdict.stable
    assert verdict.at_rest
    assert np.abs(verdict.settled.poses[:, :3] - stack.poses[:, :3]).max() < 0.05
    assert tilt(verdict.settled.poses).max() < 0.02
    assert silhouette_iou(verdict.settled, target, PAPER_GRID) >= 0.95


def test_the_drawings_can_be_drawn_again(tmp_path: Path) -> None:
    script = runpy.run_path(str(EXAMPLES / "draw_silhouettes.py"))
    assert {drawing.file for drawing in script["DRAWINGS"]} == set(BUILDINGS)
    for drawing in script["DRAWINGS"]:
        script["save"](drawing, tmp_path)
        again, there = (
            np.asarray(Image.open(folder / drawing.file).convert("RGBA"), float)
            for folder in (tmp_path, EXAMPLES / "silhouettes")
        )
        assert np.abs(again - there).mean() < 0.5


def test_the_stacks_do_what_their_comments_say(checker: SimulatorChecker) -> None:
    def fell(name: str) -> list[list[int]]:
        stacks = read_stacks(EXAMPLES / "stacks" / name).stacks
        return [np.flatnonzero(checker.check(stack).fell).tolist() for stack in stacks]

    assert fell("arch.json") == [[]]
    assert fell("cantilever.json") == [[3, 4]]
    assert fell("bridge.json") == [[], [2, 3]]
