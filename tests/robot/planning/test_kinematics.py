"""Every solution meets its pose, on one branch, within the limits, for whatever arm a URDF describes."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.robot.planning.arm_model import ArmModel, arm_model
from stackgen.robot.planning.clearance import load_arm
from stackgen.robot.planning.kinematics import (
    SOLVERS,
    TOLERANCE,
    ClosedForm,
    InverseKinematics,
    Iterative,
    SolverName,
    Unreachable,
    branch_of,
    residual,
)
from stackgen.robot.planning.motion import Motion
from stackgen.robot.planning.plan import plan_build
from stackgen.robot.planning.staging import TIP_UP
from stackgen.robot.planning.urdf import arm_file, chain_links, chain_urdf, self_collision_pairs
from stackgen.robot.workcell import ArmDescription, Base, Staging, Workcell, pose
from stackgen.sim.bullet_engine import bullet
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from tests.robot.real import standin

WORKCELL = Workcell()
UR5 = WORKCELL.arm
ARM = arm_model(UR5)
ROBOTS = "package://example-robot-data/robots"
UR10 = Workcell(
    arm=replace(UR5, urdf=f"{ROBOTS}/ur_description/urdf/ur10_robot.urdf"), base=Base(position=(0.0, 0.6, 0.0))
)
PANDA = Workcell(
    arm=ArmDescription(
        f"{ROBOTS}/panda_description/urdf/panda.urdf",
        f"{ROBOTS}/panda_description/srdf/panda.srdf",
        base="panda_link0",
        flange="panda_link8",
    ),
    base=Base(position=(0.0, 0.55, 0.0)),
    home=(0, -30, 0, -120, 0, 90, 45),
)


def flanges(number: int, seed: int = 0, workcell: Workcell = WORKCELL) -> list[NDArray[np.float64]]:
    """Poses of the flange over slots and structure, pointing down and turned a little."""
    random = np.random.default_rng(seed)
    found = []
    for _ in range(number):
        x, y, z = random.uniform([-0.3, -0.2, 0.01], [0.3, 0.2, 0.3])
        found.append(workcell.flange_in_base(pose((x, y, z), random.uniform(-30, 30)) @ TIP_UP))
    return found


def test_the_urdf_s_forward_kinematics_are_those_of_the_published_table() -> None:
    """The controller's base frame is the URDF's, turned by half a turn."""
    for joints in np.random.default_rng(1).uniform(-3, 3, (20, 6)):
        turned = np.diag([-1, -1, 1, 1]) @ ARM.forward(joints)
        assert np.abs(turned - standin.forward(joints, np.zeros(6))).max() < 1e-7


@pytest.mark.parametrize("workcell", [WORKCELL, PANDA])
def test_the_jacobian_is_the_derivative_of_the_pose(workcell: Workcell) -> None:
    arm, joints, step = arm_model(workcell.arm), workcell.home_joints + 0.1, 1e-6
    here = arm.forward(joints)
    for number, column in enumerate(arm.jacobian(joints).T):
        there = arm.forward(joints + step * np.eye(len(arm))[number])
        turn = (there[:3, :3] @ here[:3, :3].T - np.eye(3)) / step
        assert np.allclose((there[:3, 3] - here[:3, 3]) / step, column[:3], atol=1e-5)
        assert np.allclose([turn[2, 1], turn[0, 2], turn[1, 0]], column[3:], atol=1e-5)


@pytest.fixture(scope="module", params=SOLVERS)
def solver(request: pytest.FixtureRequest) -> tuple[SolverName, InverseKinematics]:
    return request.param, SOLVERS[request.param](ARM, WORKCELL.home_joints)


def check(solver: InverseKinematics, poses: list[NDArray[np.float64]]) -> None:
    """Every pose is met, within the limits, on the branch of home."""
    arm = solver.arm
    for flange in poses:
        solution = solver.solve(flange)
        assert max(residual(arm.forward(solution.joints), flange)) <= TOLERANCE
        assert branch_of(arm, solution.joints) == branch_of(arm, solver.home)
        assert ((arm.lower < solution.joints) & (solution.joints < arm.upper)).all()


def test_every_pose_over_the_table_is_solved_on_one_branch(solver: tuple[SolverName, InverseKinematics]) -> None:
    check(solver[1], flanges(100))


@pytest.mark.parametrize("workcell", [UR10, PANDA])
def test_another_arm_s_urdf_is_solved(workcell: Workcell) -> None:
    check(Iterative(arm_model(workcell.arm), workcell.home_joints), flanges(50, seed=5, workcell=workcell))


def test_both_solvers_agree() -> None:
    for workcell in (WORKCELL, UR10):
        both = [kind(arm_model(workcell.arm), workcell.home_joints) for kind in (Iterative, ClosedForm)]
        for flange in flanges(20, seed=2, workcell=workcell):
            one, other = (kinematics.solve(flange).joints for kinematics in both)
            assert np.allclose(one, other, atol=1e-6)


def test_an_arm_of_seven_joints_has_no_closed_form_and_its_home_seven_angles() -> None:
    arm = arm_model(PANDA.arm)
    with pytest.raises(StackgenError, match="no closed form; use --solver urdf"):
        ClosedForm(arm, PANDA.home_joints)
    with pytest.raises(StackgenError, match=r"cell\.home: the arm has 7 joints, got 6 angles"):
        Iterative(arm, WORKCELL.home_joints)


def test_another_arm_places_a_block_where_it_is_to_be() -> None:
    """The whole of a plan: slots, motions, clearances; only the numbers of the workcell are others."""
    workcell = replace(UR10, staging=Staging(straighten=False))
    cube = Stack(np.array([0]), np.array([[0.5, 0, 0.5, 0, 0, 0.1]]))
    (step,) = plan_build(cube, [0], workcell, Physics()).blocks
    placed = [action for action in step.actions if isinstance(action, Motion) and action.name == "lower"][-1]
    tip = workcell.tip_in_table(arm_model(workcell.arm).forward(placed.end))
    frame = tip @ np.linalg.inv(step.waiting.grasp) @ step.waiting.frame
    assert np.allclose(frame[:3, 3] - step.goal[:3, 3], [0, 0, workcell.workspace.drop], atol=1e-6)
    assert step.clearance.distance > workcell.workspace.clearance and step.distance < 1e-6


def test_what_is_out_of_reach_is_refused(solver: tuple[SolverName, InverseKinematics]) -> None:
    far = WORKCELL.flange_in_base(pose((0.0, -0.6, 0.1)) @ TIP_UP)
    with pytest.raises(Unreachable, match=r"cannot reach"):
        solver[1].solve(far)


def test_the_elbow_is_up() -> None:
    kinematics = Iterative(ARM, WORKCELL.home_joints)
    for flange in flanges(10, seed=3):
        shoulder, elbow, wrist = ARM.joint_frames(kinematics.solve(flange).joints)[[1, 2, 3], :3, 3]
        assert elbow[2] > (shoulder[2] + wrist[2]) / 2


def test_near_poses_have_near_joints(solver: tuple[SolverName, InverseKinematics]) -> None:
    for flange in flanges(10, seed=4):
        joints = solver[1].solve(flange).joints
        moved = flange @ pose((0.001, 0.0, 0.0))
        assert np.abs(solver[1].solve(moved, joints).joints - joints).max() < 0.02


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"flange": "nowhere"}, "no chain leads from base_link to nowhere"),
        ({"base": "base", "flange": "base_link"}, "no chain leads from base to base_link"),
        ({"urdf": "no/such.urdf"}, r"no/such\.urdf does not exist"),
        ({"urdf": f"{ROBOTS}/no.urdf"}, r"no\.urdf does not exist"),
        ({"flange": "base"}, "must be revolute"),
    ],
)
def test_a_chain_that_is_not_there_is_an_error(changed: dict[str, str], message: str) -> None:
    with pytest.raises(StackgenError, match=message):
        ArmModel(replace(UR5, **changed))


@pytest.mark.parametrize(
    ("pattern", "written", "message"),
    [
        ("(?s).*", "a photo", "is no URDF"),
        ('<link name="upper_arm_link">', '<link name="other">', "the chain has no link upper_arm_link"),
        ("package://", "package://nowhere/", "the mesh package://nowhere/.* is not there"),
        ('parent link="base_link"', 'parent link="tool0"', "no chain leads from base_link to tool0"),
        ('rpy="[^"]*" xyz="[^"]*"', 'xyz="a b c"', "cannot be read: .* valid URDF"),
    ],
)
def test_what_is_no_urdf_is_an_error(tmp_path: Path, pattern: str, written: str, message: str) -> None:
    (tmp_path / "arm.urdf").write_text(re.sub(pattern, written, arm_file(UR5.urdf).read_text()))
    with pytest.raises(StackgenError, match=message):
        ArmModel(replace(UR5, urdf=str(tmp_path / "arm.urdf")))


def test_what_bullet_cannot_load_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(re.sub("<mesh [^>]*/>", "<blob/>", arm_file(UR5.urdf).read_text()))
    client = bullet.connect(bullet.DIRECT)
    with pytest.raises(StackgenError, match="cannot be read"):
        load_arm(replace(WORKCELL, arm=replace(UR5, urdf=str(tmp_path / "arm.urdf"))), client, visual=False)
    bullet.disconnect(client)


def test_what_is_no_srdf_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "arm.srdf").write_text("a photo")
    with pytest.raises(StackgenError, match="is no SRDF"):
        self_collision_pairs(replace(UR5, srdf=str(tmp_path / "arm.srdf")))


@pytest.mark.parametrize("pattern", ['type="revolute"', "<limit [^>]*/>"])
def test_a_joint_without_limits_turns_by_two_turns(tmp_path: Path, pattern: str) -> None:
    text = re.sub(pattern, 'type="continuous"' if "type" in pattern else "", arm_file(UR5.urdf).read_text())
    (tmp_path / "arm.urdf").write_text(text)
    arm = ArmModel(replace(UR5, urdf=str(tmp_path / "arm.urdf")))
    assert np.allclose([arm.lower, arm.upper], [[-2 * np.pi] * 6, [2 * np.pi] * 6])


@pytest.mark.parametrize("workcell", [WORKCELL, UR10, PANDA])
def test_every_mesh_of_an_arm_is_found(workcell: Workcell) -> None:
    meshes = [mesh.get("filename", "") for mesh in chain_urdf(workcell.arm).iter("mesh")]
    assert meshes and all(Path(mesh).is_file() for mesh in meshes)


@pytest.mark.parametrize("arm", [UR5, replace(UR5, srdf=""), PANDA.arm])
def test_links_side_by_side_are_no_collision_pair(arm: ArmDescription) -> None:
    pairs = {frozenset(pair) for pair in self_collision_pairs(arm)}
    assert not pairs & {frozenset(both) for both in pairwise(chain_links(arm))}
    assert frozenset((arm.base, "palm")) in pairs


@pytest.mark.parametrize("module", ["pinocchio", "eaik.IK_HP"])
def test_an_absent_package_is_one_line(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(StackgenError, match=r"pip install 'stackgen\[robot\]'"):
        ClosedForm(ArmModel(UR5), WORKCELL.home_joints)


def test_an_absent_description_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stackgen.robot.planning.urdf._PACKAGE", "not-installed")
    with pytest.raises(StackgenError, match=r"needs the package 'not-installed': pip install 'stackgen\[robot\]'"):
        arm_file("package://not-installed/robots/ur.urdf")
