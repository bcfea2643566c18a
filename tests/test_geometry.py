"""Poses, silhouettes and IoU against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stackgen.geometry import (
    block_vertices,
    centers_of_mass,
    iou,
    mirror,
    quaternions,
    rotation_matrices,
    rotation_vectors,
    silhouette,
    silhouette_iou,
    tilt,
)
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, VIEWS, Grid, View

FINE = Grid(image_size=1200, pixels_per_cell=200.0, ground_margin=100.0)
AXES = {"front": 1, "side": 0, "top": 2}
"""World axis along which each view looks."""

angles = st.floats(-3.1, 3.1)
small = st.floats(-0.5, 0.5)


def one(shape: int, x: float = 0, y: float = 0, z: float = 0.5, rotation: tuple[float, ...] = (0, 0, 0)) -> Stack:
    """A stack of one block."""
    return Stack(np.array([shape]), np.array([[x, y, z, *rotation]]))


def random_stack(seed: int, k: int = 6) -> Stack:
    """Blocks anywhere, turned anyhow."""
    rng = np.random.default_rng(seed)
    position = rng.uniform([-2, -2, 0], [2, 2, 4], (k, 3))
    return Stack(rng.integers(0, 4, k), np.concatenate([position, rng.normal(0, 1, (k, 3))], axis=1))


def area(stack: Stack, view: View, grid: Grid = FINE) -> float:
    """Of a silhouette [cell^2]."""
    return np.count_nonzero(silhouette(stack, grid, view)) / grid.pixels_per_cell**2


# Areas: a digital picture of a convex outline errs by less than its perimeter times a pixel.


@pytest.mark.parametrize("shape", [0, 1, 2])
@given(x=small, y=small, z=st.floats(0.5, 3))
@settings(max_examples=5, deadline=None)
def test_a_box_shows_its_faces(shape: int, x: float, y: float, z: float) -> None:
    width, depth, height = PAPER_CATALOGUE[shape].size
    stack = one(shape, x, y, z)
    for view, sides in (("front", (width, height)), ("side", (depth, height)), ("top", (width, depth))):
        assert area(stack, view) == pytest.approx(sides[0] * sides[1], abs=2 * sum(sides) / 200)  # type: ignore[arg-type]


def test_a_triangle_shows_its_outline_from_the_front_and_its_box_from_elsewhere() -> None:
    stack = one(3, z=1.3)
    assert area(stack, "front") == pytest.approx(0.5, abs=4 / 200)
    assert area(stack, "side") == pytest.approx(1, abs=4 / 200)
    assert area(stack, "top") == pytest.approx(1, abs=4 / 200)


@pytest.mark.parametrize("shape", [0, 1, 2])
@pytest.mark.parametrize("seed", range(4))
def test_a_turned_box_shows_each_face_by_its_cosine(shape: int, seed: int) -> None:
    """The shadow of a box along a direction n is the sum of (face area) |n . face normal|."""
    rotation = np.random.default_rng(seed).normal(0, 1, 3)
    width, depth, height = PAPER_CATALOGUE[shape].size
    faces = np.array([depth * height, width * height, width * depth])
    stack = one(shape, z=2, rotation=tuple(rotation))
    for view in VIEWS:
        expected = faces @ np.abs(rotation_matrices(rotation)[AXES[view]])
        assert area(stack, view) == pytest.approx(expected, abs=2 * (width + depth + height) / 200)


@given(angle=st.floats(-1.5, 1.5))
@settings(max_examples=10, deadline=None)
def test_turning_in_the_picture_keeps_the_area(angle: float) -> None:
    for shape, expected in ((0, 1.0), (1, 2.0), (3, 0.5)):
        assert area(one(shape, z=2, rotation=(0, angle, 0)), "front") == pytest.approx(expected, abs=6 / 200)


@pytest.mark.parametrize("view", VIEWS)
def test_a_pixel_is_set_when_its_centre_is_covered(view: View) -> None:
    x, y, z = 0.31, -0.22, 1.77
    picture = silhouette(one(1, x, y, z), PAPER_GRID, view)
    right, up = np.meshgrid(PAPER_GRID.horizontal(), PAPER_GRID.vertical(view))
    across = {"front": (x, 2, z, 1), "side": (y, 1, z, 1), "top": (x, 2, y, 1)}[view]
    covered = (np.abs(right - across[0]) <= across[1] / 2) & (np.abs(up - across[2]) <= across[3] / 2)
    assert picture.any() and (picture == covered).all()


def test_the_ground_line_and_the_scale_are_the_grid_s() -> None:
    picture = silhouette(one(0), PAPER_GRID)
    rows, columns = np.nonzero(picture)
    assert (rows.min(), rows.max()) == (64 - 4 - 14, 64 - 4 - 1)
    assert (columns.min(), columns.max()) == (32 - 7, 32 + 7 - 1)


# Unions, margins, symmetry.


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("seed", range(3))
def test_a_stack_shows_the_union_of_its_blocks(view: View, seed: int) -> None:
    stack = random_stack(seed)
    blocks = [
        silhouette(Stack(stack.shapes[i : i + 1], stack.poses[i : i + 1]), PAPER_GRID, view) for i in range(len(stack))
    ]
    assert (silhouette(stack, PAPER_GRID, view) == np.any(blocks, axis=0)).all()
    assert not silhouette(Stack([], np.zeros((0, 6))), PAPER_GRID, view).any()  # type: ignore[arg-type]


@pytest.mark.parametrize("view", VIEWS)
def test_margins_add_what_lies_outside_and_change_nothing_inside(view: View) -> None:
    stack = random_stack(7)
    wide = silhouette(stack, PAPER_GRID, view, 40)
    assert wide.shape == (144, 144)
    assert (wide[40:-40, 40:-40] == silhouette(stack, PAPER_GRID, view)).all()
    away = one(0, x=3.5, y=3.5, z=0.5)
    assert not silhouette(away, PAPER_GRID, view).any()
    assert np.count_nonzero(silhouette(away, PAPER_GRID, view, 40)) == 14 * 14


@pytest.mark.parametrize(("x", "z"), [(-1.78, 0.5), (1.78, 0.5), (0, 3.77), (1.78, 3.77)])
def test_nothing_of_a_legal_stack_is_cut_off(x: float, z: float) -> None:
    """0.28 cells beyond the 4 x 4 grid are still on the canvas."""
    for view in VIEWS:
        stack = one(0, x, x, z)
        assert (silhouette(stack, PAPER_GRID, view, 20) == np.pad(silhouette(stack, PAPER_GRID, view), 20)).all()


@pytest.mark.parametrize("seed", range(5))
def test_the_mirrored_stack_has_the_mirrored_silhouette(seed: int) -> None:
    stack = random_stack(seed)
    there = mirror(stack)
    assert (silhouette(there, PAPER_GRID, "front") == np.fliplr(silhouette(stack, PAPER_GRID, "front"))).all()
    assert (silhouette(there, PAPER_GRID, "top") == np.fliplr(silhouette(stack, PAPER_GRID, "top"))).all()
    assert (silhouette(there, PAPER_GRID, "side") == silhouette(stack, PAPER_GRID, "side")).all()


@pytest.mark.parametrize("seed", range(5))
def test_mirroring_reflects_every_corner_and_twice_is_nothing(seed: int) -> None:
    stack = random_stack(seed)
    for here, there in zip(block_vertices(stack), block_vertices(mirror(stack)), strict=True):
        reflected = here * [-1, 1, 1]
        assert np.abs(reflected[:, None] - there[None]).sum(-1).min(axis=1) == pytest.approx(0, abs=1e-9)
    assert centers_of_mass(mirror(stack)) == pytest.approx(centers_of_mass(stack) * [-1, 1, 1])
    assert (mirror(mirror(stack)).poses == stack.poses).all()


# Rotations.


@given(st.lists(st.floats(-20, 20), min_size=3, max_size=3), st.sampled_from([1.0, 1e-3, 1e-9, 0.0]))
def test_rotations_are_those_of_scipy(vector: list[float], scale: float) -> None:
    rotation = scale * np.array(vector)
    reference = Rotation.from_rotvec(rotation)
    assert quaternions(rotation) == pytest.approx(reference.as_quat(), abs=1e-15)
    assert rotation_matrices(rotation) == pytest.approx(reference.as_matrix(), abs=1e-14)
    turned = 3 * quaternions(rotation)
    assert rotation_vectors(turned) == pytest.approx(Rotation.from_quat(turned).as_rotvec(), abs=1e-14)
    assert np.linalg.norm(rotation_vectors(turned)) <= np.pi + 1e-9


def test_half_turns_and_no_turn() -> None:
    for axis in np.eye(3):
        half = np.pi * axis
        assert rotation_matrices(half) == pytest.approx(2 * np.outer(axis, axis) - np.eye(3), abs=1e-12)
        assert np.abs(rotation_vectors(quaternions(half))) == pytest.approx(half)
    assert (rotation_matrices(np.zeros((2, 5, 3))) == np.eye(3)).all()
    assert (rotation_vectors(quaternions(np.zeros((2, 5, 3)))) == np.zeros((2, 5, 3))).all()


@given(angles, st.floats(0, 3.1))
def test_tilt_is_the_angle_to_the_vertical(spin: float, lean: float) -> None:
    axis = np.array([np.cos(spin), np.sin(spin), 0])
    poses = np.array([[0, 0, 0, *(lean * axis)], [1, 2, 3, 0, 0, spin]])
    assert tilt(poses) == pytest.approx([lean, 0], abs=1e-7)


def test_blocks_stay_rigid_and_turn_about_their_reference() -> None:
    stack = random_stack(3)
    for shape, pose, corners in zip(stack.shapes, stack.poses, block_vertices(stack), strict=True):
        own = PAPER_CATALOGUE[shape].vertices
        between = np.linalg.norm(own[:, None] - own, axis=-1)
        assert np.linalg.norm(corners[:, None] - corners, axis=-1) == pytest.approx(between)
        assert np.linalg.norm(corners - pose[:3], axis=1) == pytest.approx(np.linalg.norm(own, axis=1))


# IoU.


def masks() -> st.SearchStrategy[NDArray[np.bool_]]:
    return st.lists(st.booleans(), min_size=12, max_size=12).map(lambda b: np.array(b).reshape(3, 4))


@given(masks(), masks())
def test_iou_is_symmetric_between_0_and_1_and_1_for_equals_alone(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> None:
    assert 0 <= iou(a, b) == iou(b, a) <= 1
    assert (iou(a, b) == 1) == bool((a == b).all())
    assert iou(a, a) == 1
    assert iou(a, a & b) == (np.count_nonzero(a & b) / np.count_nonzero(a) if a.any() else 1)
    if a.any():
        assert iou(a, ~a) == 0


@pytest.mark.parametrize("shift", [0, 1, 5, 13, 14, 20])
def test_iou_of_a_shifted_block(shift: int) -> None:
    """Two squares that share a part 1 - s of their width: (1 - s) / (1 + s)."""
    target = silhouette(one(0), PAPER_GRID)
    share = max(0, 1 - shift / 14)
    assert silhouette_iou(one(0, x=shift / 14), target, PAPER_GRID) == pytest.approx(share / (2 - share))


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    "place",
    [(3.5, 3.5, 0.5), (-40, -40, 0.5), (0, 40, 7), (0, -40, 60), (0, 40, 1e6), (0, 40, -9), (9, 9, 9), (9, -9, -9)],
)
def test_a_block_that_left_the_canvas_counts_as_outside_the_target(
    view: View, turned: bool, place: tuple[float, float, float]
) -> None:
    """Wherever it went and however it lies, it is as if it lay beside the target, whole."""
    rotation = (0.0, np.pi / 2, 0.0) if turned else (0.0, 0.0, 0.0)
    target = silhouette(one(0), PAPER_GRID, view)
    both = Stack(np.array([0, 2]), np.array([[0, 0, 0.5, 0, 0, 0], [*place, *rotation]]))
    if view == "side" and abs(place[1]) < 1:
        pytest.skip("not off the canvas in this view")
    alone = np.count_nonzero(silhouette(one(2, z=2, rotation=rotation), PAPER_GRID, view, 64))
    assert silhouette_iou(both, target, PAPER_GRID, view) == pytest.approx(14 * 14 / (14 * 14 + alone), rel=0.04)


def test_a_block_high_above_the_canvas_does_not_reach_into_it() -> None:
    tower = Stack(np.zeros(4, int), np.array([[0, 0, z + 0.5, 0, 0, 0] for z in range(4)]))
    above = [0, 0, 30, 0, np.pi / 2, 0]  # a long rectangle on end
    both = Stack(np.append(tower.shapes, 2), np.vstack([tower.poses, above]))
    assert silhouette_iou(both, silhouette(tower, PAPER_GRID), PAPER_GRID) == pytest.approx(4 / 7, rel=0.02)


def test_iou_with_the_own_silhouette_is_1() -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        poses = np.zeros((4, 6))
        poses[:, 0], poses[:, 2] = rng.uniform(-0.5, 0.5, 4), np.arange(4) * 0.9 + 0.7
        stack = Stack(np.array([0, 1, 3, 0]), poses)
        for view in VIEWS:
            assert silhouette_iou(stack, silhouette(stack, PAPER_GRID, view), PAPER_GRID, view) == 1
