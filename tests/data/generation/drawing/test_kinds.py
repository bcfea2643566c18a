"""Every kind of figure gives a silhouette that a sampler can be shown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stackgen.data.generation.drawing.drawings import RULERS, DrawingSettings, choose, draw, finish
from stackgen.data.generation.drawing.figures import Figure, Pencil, of_blocks, rectangle
from stackgen.data.generation.drawing.hands import EFFECTS, put_down
from stackgen.data.generation.drawing.kinds import KINDS, draw_figure
from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Grid, Shape, World

LARGE = World(PAPER_CATALOGUE, Grid(8, 8, 128, 14, 6), 40)
FOOT = PAPER_GRID.image_size - round(PAPER_GRID.ground_margin)

seeds = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds)
@settings(max_examples=10, deadline=None)
def test_a_drawing_stands_on_the_ground_and_below_the_edge_of_its_picture(kind: str, seed: int) -> None:
    for world in (PAPER_WORLD, LARGE):
        rng = np.random.default_rng(seed)
        figure = draw(kind, world, DrawingSettings(), rng)
        drawing = finish(kind, figure, world, DrawingSettings(untidy=0), rng)
        assert drawing is not None and drawing.kind == kind
        mask, foot = drawing.silhouette, world.grid.image_size - round(world.grid.ground_margin)
        assert mask.shape == (world.grid.image_size,) * 2 and mask.dtype == bool
        assert mask[foot - 1].any() and not mask[foot:].any()
        assert not mask[0].any()


@pytest.mark.parametrize("effect", EFFECTS)
@given(seed=seeds)
@settings(max_examples=10, deadline=None)
def test_an_effect_leaves_a_figure_on_the_ground(effect: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    wide, high = rng.uniform(1, 4, size=2)
    mask = put_down(Figure((rectangle(0, 0, wide, high),)), PAPER_GRID, [effect], rng)
    assert mask is not None and mask[FOOT - 1].any() and not mask[FOOT:].any()
    if effect in ("wavering", "rounded", "rough"):
        assert mask.sum() == pytest.approx(wide * high * 14**2, rel=0.35)


@pytest.mark.parametrize("kind", KINDS)
def test_a_figure_on_a_ruler_is_as_large_as_asked_for_or_smaller(kind: str) -> None:
    for seed in range(20):
        pencil = Pencil(np.random.default_rng(seed), 4.0, 3.0, 1.0, PAPER_CATALOGUE)
        low, high = draw_figure(kind, pencil).box
        assert (high - low <= np.array([4.0, 3.0]) + 1.6).all() and (high - low > 0.2).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(7.9, 0.6), (0.6, 7.9), (2.2, 1.0)])
def test_a_figure_can_be_far_wider_than_high(kind: str, size: tuple[float, float]) -> None:
    for step in RULERS.values():
        for seed in range(40):
            assert draw_figure(kind, Pencil(np.random.default_rng(seed), *size, step, PAPER_CATALOGUE)).parts


def test_edges_of_boxes_lie_on_the_ruler() -> None:
    for step in (1.0, 0.5):
        for seed in range(40):
            pencil = Pencil(np.random.default_rng(seed), 4.0, 4.0, step, PAPER_CATALOGUE)
            for part in draw_figure("boxes", pencil).parts:
                if len(part) == 4:
                    assert np.abs(part[:, 0] / step - np.round(part[:, 0] / step)).max() < 1e-9


def test_blocks_are_painted_as_their_silhouette() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        poses = np.zeros((5, 6))
        poses[:, 0], poses[:, 2] = rng.uniform(-1.5, 1.5, 5), rng.uniform(0.5, 3.5, 5)
        stack = Stack(rng.integers(0, 4, 5), poses, PAPER_CATALOGUE)
        assert (of_blocks(stack).painted(PAPER_GRID) == silhouette(stack, PAPER_GRID)).all()


def test_rows_are_blocks_on_blocks_whatever_the_catalogue() -> None:
    shapes = (*PAPER_CATALOGUE, Shape.box("plank", 2, 0.5), Shape.box("beam", 4))
    catalogue = type(PAPER_CATALOGUE)(shapes)
    for seed in range(40):
        figure = draw_figure("rows", Pencil(np.random.default_rng(seed), 4.0, 4.0, 1.0, catalogue))
        for part in figure.parts:
            low = part[:, 1].min()
            tops = [other[:, 1].max() for other in figure.parts]
            assert low == pytest.approx(0) or any(low == pytest.approx(top) for top in tops)


def test_names_are_drawn_by_their_weight() -> None:
    rng = np.random.default_rng(0)
    drawn = [choose({"a": 3, "b": 1, "c": 0}, rng) for _ in range(2000)]
    assert drawn.count("a") / 2000 == pytest.approx(0.75, abs=0.04) and "c" not in drawn


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kinds": {"unicorn": 1.0}}, "'unicorn' is none of block"),
        ({"kinds": {}}, "one above it"),
        ({"rulers": {"cell": -1.0}}, "at least 0"),
        ({"untidy": 1.5}, "lie in 0..1"),
        ({"answers": 9, "known": 8}, "answers lie in 1..known"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change: dict, message: str) -> None:
    with pytest.raises(StackgenError, match=message):
        replace(DrawingSettings(), **change)
    assert set(DrawingSettings().rulers) == set(RULERS)
