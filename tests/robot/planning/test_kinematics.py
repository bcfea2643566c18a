"""Whatever solves the inverse kinematics: it is checked by forward kinematics, on one branch, within the limits."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from ur_analytic_ik import ur5

from stackgen.errors import StackgenError
from stackgen.robot.planning.kinematics import (
    SOLVERS,
    TOLERANCE_M,
    DampedLeastSquares,
    InverseKinematics,
    SolverName,
    Unreachable,
    branch_of,
    residual,
)
from stackgen.robot.planning.staging import TIP_UP
from stackgen.robot.planning.urdf import LINKS, read_chain, self_collision_pairs, ur5_chain, ur5_urdf
from stackgen.robot.workcell import Cell, pose

CELL = Cell()
CHAIN = ur5_chain()
LEAST = {"urdf": 1.0, "closed-form": 1.0, "bullet": 0.9}
"""Share of the poses that a solver finds, at least."""


def flanges(number: int, seed: int = 0) -> list[NDArray[np.float64]]:
    """Poses of the flange over slots and structure, pointing down, turned and leaning a little."""
    random = np.random.default_rng(seed)
    found = []
    for _ in range(number):
        x, y, z = random.uniform([-0.3, -0.2, 0.01], [0.3, 0.25, 0.3])
        found.append(CELL.flange_in_base(pose((x, y, z), random.uniform(-30, 30)) @ TIP_UP))
    return found


def test_the_urdf_s_forward_kinematics_are_the_closed_form_s() -> None:
    """The controller's base frame is the URDF's, turned by half a turn."""
    for joints in np.random.default_rng(1).uniform(-3, 3, (20, 6)):
        turned = np.diag([-1, -1, 1, 1]) @ CHAIN.forward(joints)
        assert np.abs(turned - ur5.forward_kinematics(*joints)).max() < 1e-7


def test_the_jacobian_is_the_derivative_of_the_pose() -> None:
    joints, step = np.array([0.3, -1.2, 1.4, -0.5, -1.3, 0.2]), 1e-6
    here = CHAIN.forward(joints)
    for number, column in enumerate(CHAIN.jacobian(joints).T):
        there = CHAIN.forward(joints + step * np.eye(6)[number])
        turn = (there[:3, :3] @ here[:3, :3].T - np.eye(3)) / step
        assert np.allclose((there[:3, 3] - here[:3, 3]) / step, column[:3], atol=1e-5)
        assert np.allclose([turn[2, 1], turn[0, 2], turn[1, 0]], column[3:], atol=1e-5)


@pytest.fixture(scope="module", params=SOLVERS)
def solver(request: pytest.FixtureRequest) -> tuple[SolverName, InverseKinematics]:
    return request.param, SOLVERS[request.param](CELL.home_joints)


def test_solutions_lead_back_to_their_poses_on_one_branch(solver: tuple[SolverName, InverseKinematics]) -> None:
    name, kinematics = solver
    poses, solved = flanges(30), 0
    for flange in poses:
        try:
            solution = kinematics.solve(flange)
        except Unreachable:
            continue
        solved += 1
        assert max(residual(CHAIN.forward(solution.joints), flange)) <= TOLERANCE_M
        assert branch_of(CHAIN, solution.joints) == branch_of(CHAIN, CELL.home_joints)
        assert ((CHAIN.lower < solution.joints) & (solution.joints < CHAIN.upper)).all()
    assert solved >= LEAST[name] * len(poses)


def test_what_is_out_of_reach_is_refused(solver: tuple[SolverName, InverseKinematics]) -> None:
    far = CELL.flange_in_base(pose((0.0, -0.6, 0.1)) @ TIP_UP)
    with pytest.raises(Unreachable, match=r"cannot reach"):
        solver[1].solve(far)


def test_the_urdf_solver_needs_no_closed_form() -> None:
    alone, helped = DampedLeastSquares(CELL.home_joints, seeds=False), DampedLeastSquares(CELL.home_joints)
    for flange in flanges(8, seed=2):
        assert np.allclose(alone.solve(flange).joints, helped.solve(flange).joints, atol=1e-5)


def test_the_elbow_is_up() -> None:
    kinematics = SOLVERS["urdf"](CELL.home_joints)
    for flange in flanges(10, seed=3):
        frames = CHAIN.frames(kinematics.solve(flange).joints)
        shoulder, elbow, wrist = (frames[i, :3, 3] for i in (1, 2, 3))
        assert elbow[2] > (shoulder[2] + wrist[2]) / 2


def test_near_poses_have_near_joints() -> None:
    kinematics = SOLVERS["closed-form"](CELL.home_joints)
    for flange in flanges(10, seed=4):
        joints = kinematics.solve(flange).joints
        moved = flange @ pose((0.001, 0.0, 0.0))
        assert np.abs(kinematics.solve(moved, joints).joints - joints).max() < 0.02


def test_a_chain_that_is_not_there_is_an_error() -> None:
    with pytest.raises(StackgenError, match=r"no chain leads from base_link to nowhere"):
        read_chain(ur5_urdf(), tip="nowhere")


def test_links_side_by_side_are_no_collision_pair() -> None:
    pairs = {frozenset(pair) for pair in self_collision_pairs()}
    assert not pairs & {frozenset(both) for both in pairwise(LINKS)}
    assert frozenset(("base_link", "palm")) in pairs
