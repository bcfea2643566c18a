"""A build over real sockets, by the unmodified client, against the stand-in."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.robot.planning.motion import Motion, joint_motion
from stackgen.robot.real.build_progress import BuildProgress
from stackgen.robot.real.gripper import Gripper
from stackgen.robot.real.program import Controller, controller_move, controller_pose
from stackgen.robot.real.real_build import RealBuild, carry_out, prepare, send
from stackgen.robot.real.ur_arm import UrArm
from tests.robot.real.arms import TOWER, WORKCELL, plan, stand_in

pytest.importorskip("rtde_control", reason="needs stackgen[ur]")
pytest.importorskip("rtde_receive", reason="needs stackgen[ur]")

NEARLY_HOME = tuple(np.array(WORKCELL.home) + 0.5)


def job(folder: Path, resume: bool = False, **gripper: Any) -> RealBuild:
    placed = BuildProgress.read(folder).placed if resume else 0
    return prepare(plan(placed), WORKCELL, folder, controller=Controller(), gripper=Gripper(**gripper), resume=resume)


def motions() -> list[Motion]:
    found = [action for step in plan().blocks for action in step.actions if isinstance(action, Motion)]
    return [*found, *([plan().homing] if plan().homing else [])]  # type: ignore[list-item]


def test_a_build_goes_where_it_was_planned_and_takes_every_block(tmp_path: Path) -> None:
    stood: list[int] = []
    with stand_in(tmp_path, "--grasps", "1") as controller:
        progress = carry_out(job(tmp_path), controller.host, stood.append)
        moved, jaws = controller.events("movej", "movel"), controller.events("jaws")
        halts = controller.events("halt")
    assert progress.status == "done" and stood == [1, 2]
    assert BuildProgress.read(tmp_path) == progress
    assert len(moved) == len(motions())
    for event, motion in zip(moved, motions(), strict=True):
        assert event["event"] == {"joint": "movej", "line": "movel"}[motion.kind]
        np.testing.assert_allclose(event["pose"][:3], controller_pose(motion.end, WORKCELL)[:3], atol=1e-6)
        np.testing.assert_allclose(event["joints"], motion.end, atol=1e-4)
    assert [order["POS"] == 255 for order in jaws] == [False, True, False] * 2
    assert [halt["why"] for halt in halts] == ["asked to"]


def test_a_digital_output_takes_every_block(tmp_path: Path) -> None:
    with stand_in(tmp_path) as controller:
        carry_out(job(tmp_path, kind="digital", output=2, seconds=0.01), controller.host)
        switched = controller.events("output")
    assert [(event["number"], event["level"]) for event in switched] == [(2, False), (2, True), (2, False)] * 2


def test_a_protective_stop_is_kept_and_the_build_goes_on_with_the_next_block(tmp_path: Path) -> None:
    in_second = 2 + sum(isinstance(action, Motion) for action in plan().blocks[0].actions)
    with stand_in(tmp_path, "--grasps", "1", "--stop_at", str(in_second)) as controller:
        with pytest.raises(StackgenError, match=r"protective stop; 1 of 2 blocks stand \(0\).*slot 2.*--resume"):
            carry_out(job(tmp_path), controller.host)
        assert len(controller.events("movej", "movel")) == in_second
        stopped = BuildProgress.read(tmp_path)
        assert (stopped.status, stopped.placed, stopped.next) == ("stopped", 1, 1)
        with pytest.raises(StackgenError, match="safety mode PROTECTIVE_STOP"):
            carry_out(job(tmp_path, resume=True), controller.host)
    with stand_in(tmp_path, "--grasps", "1") as controller:
        controller.log.write_text("")
        progress = carry_out(job(tmp_path, resume=True), controller.host)
        first = controller.events("movej", "movel")[0]
    assert (progress.status, progress.placed) == ("done", 2)
    away = plan().blocks[1].waiting.grasp[:2, 3]
    tip = WORKCELL.base.table_from_base @ np.diag([-1.0, -1, 1, 1]) @ [*first["pose"][:3], 1]
    np.testing.assert_allclose(tip[:2], away, atol=1e-4)


def test_a_controller_that_vanishes_is_one_line_and_the_build_is_kept(tmp_path: Path) -> None:
    with stand_in(tmp_path, "--grasps", "1", "--drop_at", "3") as controller:
        begin = time.monotonic()
        with pytest.raises(StackgenError, match=r"lost the connection to 127.*0 of 2 blocks stand; next is block 0"):
            carry_out(job(tmp_path), controller.host)
        assert time.monotonic() - begin < 30
    assert BuildProgress.read(tmp_path).status == "stopped"


def test_jaws_that_close_on_nothing_stop_the_build_before_the_arm_lifts(tmp_path: Path) -> None:
    with stand_in(tmp_path, "--grasps", "0") as controller:
        with pytest.raises(StackgenError, match="the jaws closed on nothing"):
            carry_out(job(tmp_path), controller.host)
        names = [motion.name for motion in motions()]
        assert len(controller.events("movej", "movel")) == names.index("lift")


@pytest.mark.parametrize(
    ("options", "joints", "line"),
    [
        (["--local"], WORKCELL.home, "local mode: switch it to remote control"),
        (["--mode", "POWER_OFF"], WORKCELL.home, "mode POWER_OFF: switch it on"),
        (["--program"], WORKCELL.home, "has a program going"),
        ([], (0.0, *WORKCELL.home[1:]), r"not at its home position \(joint 1 is 16 degrees away\)"),
    ],
)
def test_an_arm_that_is_not_ready_is_one_line_and_does_not_move(
    tmp_path: Path, options: list[str], joints: tuple[float, ...], line: str
) -> None:
    with stand_in(tmp_path, *options, joints=joints) as controller:
        with pytest.raises(StackgenError, match=line):
            carry_out(job(tmp_path), controller.host)
        assert controller.events() == []


def test_an_arm_before_remote_control_was_invented_needs_none(tmp_path: Path) -> None:
    with (
        stand_in(tmp_path, "--version", "3.15", "--local") as controller,
        UrArm(controller.host, WORKCELL, Controller(), Gripper()) as arm,
    ):
        assert arm.state().stopped is None


def test_a_controller_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(StackgenError, match=r"no UR controller answers at 127\.0\.0\.1:29999"):
        carry_out(job(tmp_path), "127.0.0.1")
    assert not (tmp_path / "progress.json").exists()


def test_a_motion_that_starts_elsewhere_is_refused(tmp_path: Path) -> None:
    elsewhere = joint_motion("transit", WORKCELL.home_joints + 0.2, WORKCELL.home_joints + 0.4, WORKCELL.speeds)
    assert elsewhere is not None
    with stand_in(tmp_path) as controller:
        line = pytest.raises(StackgenError, match=r"11\.5 degrees from where its next motion")
        with UrArm(controller.host, WORKCELL, Controller(), Gripper()) as arm, line:
            arm.move(elsewhere)
        assert controller.events("movej", "movel") == []


def test_a_controller_that_is_not_heard_from_stops_the_arm(tmp_path: Path) -> None:
    motion = joint_motion("transit", WORKCELL.home_joints, WORKCELL.home_joints + 0.2, WORKCELL.speeds)
    assert motion is not None
    with (
        stand_in(tmp_path, "--motion", "60") as controller,
        UrArm(controller.host, WORKCELL, Controller(), Gripper()) as arm,
    ):
        assert arm._start(controller_move(motion, WORKCELL))
        time.sleep(3)  # as if this process hung
        assert [halt["why"] for halt in controller.events("halt")] == ["watchdog"]
        with pytest.raises(StackgenError, match="stopped or paused at the controller"):
            arm.move(motion)
        assert np.abs(arm.state().joints - WORKCELL.home_joints).max() < 0.02


def test_another_tool_than_the_cells_is_noticed(tmp_path: Path) -> None:
    """Another arm has its finger tips elsewhere; here the tolerance is too tight for the right arm."""
    with stand_in(tmp_path) as controller:
        with pytest.raises(StackgenError, match=r"is it the arm of cell\.arm"):
            UrArm(controller.host, WORKCELL, Controller(agreement=1e-15), Gripper())
        assert controller.events("movej", "movel") == []


def test_a_program_is_sent_as_it_was_reviewed(tmp_path: Path) -> None:
    build = job(tmp_path)
    assert build.plan.stack is TOWER
    with stand_in(tmp_path) as controller:
        send(build, controller.host)
        time.sleep(0.3)
        sent = controller.events("script")
    assert [event["text"] for event in sent] == [(tmp_path / "build.script").read_text()]
