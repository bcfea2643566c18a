"""Overlaps, burial and gaps are what geometry says, and what linear programs say of blocks in any pose."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from stackgen.geometry import rotation_matrices
from stackgen.sim.statics.fit import describe_misfits, overlaps_and_gaps
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE

CUBE, TRIANGLE = 0, 3


def stack_of(*blocks: tuple[int, float, float, float]) -> Stack:
    """Blocks as shape, x, z and turn about y [rad]."""
    poses = [[x, 0, z, 0, turn, 0] for _, x, z, turn in blocks]
    return Stack(np.array([shape for shape, *_ in blocks]), np.array(poses, float))


@pytest.mark.parametrize(
    ("stack", "overlap", "buried", "gap"),
    [
        (stack_of((CUBE, 0, 0.5, 0), (CUBE, 0, 0.5, 0)), 1, [0, 0], [0, 0]),
        (stack_of((CUBE, 0, 0.5, 0), (CUBE, 0, 1.2, 0)), 0.3, [0, 0], [0, 0]),
        (stack_of((CUBE, 0, -3, 0)), 0, [3.5], [0]),
        (stack_of((CUBE, 0, 0.5, 0), (CUBE, 0, 1.5, 0)), 0, [0, 0], [0, 0]),
        (stack_of((CUBE, 0, 0.5, 0), (CUBE, 1, 0.5, 0)), 0, [0, 0], [0, 0]),
        (stack_of((CUBE, 0, 0.5, 0), (CUBE, 1, 3.5, 0)), 0, [0, 0], [0, 3]),  # beside it, not above
        (stack_of((CUBE, 0, 0.5, 0), (CUBE, 0.5, 3.5, 0)), 0, [0, 0], [0, 2]),
        (stack_of((CUBE, 0, 0.5, 0), (CUBE, 0, 3, np.pi / 4)), 0, [0, 0], [0, 2 - np.sqrt(0.5)]),
        (stack_of((TRIANGLE, 0, 0.5, 0), (CUBE, 0.25 + 0.5, 2, 0)), 0, [0, 0], [0, 1]),  # onto the slope's middle
    ],
)
def test_plain_cases(stack: Stack, overlap: float, buried: list[float], gap: list[float]) -> None:
    fit = overlaps_and_gaps(stack)
    assert fit.overlap.max() == pytest.approx(overlap) and (fit.overlap == fit.overlap.T).all()
    assert fit.buried == pytest.approx(buried) and fit.gap == pytest.approx(gap)


def corners(stack: Stack, block: int) -> np.ndarray:
    turn = rotation_matrices(stack.poses[block : block + 1, 3:])[0]
    return PAPER_CATALOGUE[stack.shapes[block]].vertices @ turn.T + stack.poses[block, :3]


def fall_by_a_linear_program(below: np.ndarray, above: np.ndarray) -> float:
    """The least fall after which the bodies share a point; infinite if there is none."""
    m, n = len(below), len(above)
    equal = np.zeros((5, m + n + 1))
    equal[:3, :m], equal[:3, m : m + n], equal[2, -1] = below.T, -above.T, 1
    equal[3, :m] = equal[4, m : m + n] = 1
    found = linprog(np.eye(m + n + 1)[-1], A_eq=equal, b_eq=[0, 0, 0, 1, 1])
    return found.x[-1] if found.status == 0 else np.inf


@pytest.mark.parametrize("seed", range(60))
def test_blocks_in_any_pose_fall_as_far_as_a_linear_program_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1, 1, (2, 3)) + [[0, 0, 1.5], [0, 0, 3.5]]
    stack = Stack(rng.integers(0, 4, 2), np.concatenate([places, rng.uniform(-2, 2, (2, 3))], axis=1))
    below, above = corners(stack, 0), corners(stack, 1)
    fit = overlaps_and_gaps(stack)
    expected = min(fall_by_a_linear_program(below, above), max(above[:, 2].min(), 0))
    assert fit.gap[1] == pytest.approx(expected, abs=1e-6)
    depth = fit.overlap[0, 1]
    assert (depth > 0) == (fall_by_a_linear_program(below, above) == pytest.approx(0, abs=1e-9))
    for turn in rng.normal(size=(20, 3)):  # moved apart by less than the depth, they still overlap
        moved = stack.poses.copy()
        moved[1, :3] += 0.99 * depth * turn / np.linalg.norm(turn)
        assert (overlaps_and_gaps(stack.with_poses(moved)).overlap[0, 1] > 0) == (depth > 0) or depth == 0


def test_misfits_name_blocks_and_say_which_no_structure_can_have() -> None:
    found = describe_misfits(stack_of((CUBE, 0, 0.5, 0), (CUBE, 0, 1.3, 0), (CUBE, 3, 0.1, 0), (CUBE, 5, 2, 0)))
    assert [misfit.text for misfit in found] == [
        "block 0 (cube) and block 1 (cube) are 0.20 cells inside each other",
        "block 2 (cube) is 0.40 cells in the ground",
        "block 3 (cube) floats 1.50 cells above what is below it",
    ]
    assert [(misfit.kind, misfit.impossible) for misfit in found] == [
        ("overlaps", False),
        ("buried", True),
        ("floats", True),
    ]
    assert not describe_misfits(stack_of((CUBE, 0, 0.5, 0), (CUBE, 0.05, 1.492, 0)))
