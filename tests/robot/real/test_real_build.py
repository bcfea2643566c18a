"""The progress of a build on disk: whole after every block, and only of the build it is of."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.robot.backend import ArmState
from stackgen.robot.planning.arm_model import arm_model
from stackgen.robot.planning.motion import Motion
from stackgen.robot.real.build_progress import FILE, BuildProgress
from stackgen.robot.real.gripper import Gripper
from stackgen.robot.real.program import Controller
from stackgen.robot.real.real_build import RealBuild, confirm, placed_before, prepare, run
from tests.robot.real.arms import TOWER, WORKCELL, plan


class Recorder:
    """An arm that notes what it is told, and what is on disk by then; it may be interrupted."""

    def __init__(self, folder: Path, interrupt_at: int | None = None) -> None:
        self.folder, self.interrupt_at = folder, interrupt_at
        self.moves: list[Motion] = []
        self.seen: list[int] = []
        self.stopped = False

    def move(self, motion: Motion) -> None:
        if len(self.moves) == self.interrupt_at:
            raise KeyboardInterrupt
        self.moves.append(motion)
        self.seen.append(BuildProgress.read(self.folder).placed)

    def open(self, width: float) -> None: ...

    def close(self, force: float) -> None: ...

    def state(self) -> ArmState:
        return ArmState(WORKCELL.home_joints, 0.0)

    def stop(self) -> None:
        self.stopped = True


def job(folder: Path, placed: int = 0) -> RealBuild:
    return prepare(plan(placed), WORKCELL, folder, controller=Controller(), gripper=Gripper(), resume=placed > 0)


def moves_of_first() -> int:
    return sum(isinstance(action, Motion) for action in plan().blocks[0].actions)


def test_what_stands_is_on_disk_before_the_next_block_is_begun(tmp_path: Path) -> None:
    arm, stood = Recorder(tmp_path), list[int]()
    run(job(tmp_path), arm, on_block=stood.append)
    assert stood == [1, 2]
    first = moves_of_first()
    assert arm.seen[:first] == [0] * first and arm.seen[first] == 1
    assert BuildProgress.read(tmp_path).status == "done"


def test_an_interrupted_build_is_stopped_kept_and_gone_on_with(tmp_path: Path) -> None:
    arm = Recorder(tmp_path, interrupt_at=moves_of_first() + 2)
    with pytest.raises(KeyboardInterrupt, match=r"1 of 2 blocks stand.*--resume"):
        run(job(tmp_path), arm)
    assert arm.stopped
    assert (BuildProgress.read(tmp_path).status, placed_before(tmp_path, resume=True)) == ("stopped", 1)
    rest = Recorder(tmp_path)
    progress = run(job(tmp_path, placed=1), rest)
    assert (progress.status, progress.placed) == ("done", 2)
    np.testing.assert_allclose(rest.moves[0].positions[0], WORKCELL.home_joints)
    over = WORKCELL.tip_in_table(_forward(rest.moves[0].end))
    np.testing.assert_allclose(over[:2, 3], plan().blocks[1].waiting.grasp[:2, 3], atol=1e-4)


def _forward(joints: np.ndarray) -> np.ndarray:
    return arm_model(WORKCELL.arm).forward(joints)


def test_progress_survives_the_disk(tmp_path: Path) -> None:
    progress = replace(BuildProgress.of(TOWER, (1, 0), WORKCELL), placed=1, status="stopped", why="a reason")
    progress.write(tmp_path)
    assert BuildProgress.read(tmp_path) == progress
    assert [path.name for path in tmp_path.iterdir()] == [FILE]


def test_only_the_same_build_is_gone_on_with() -> None:
    progress = BuildProgress.of(TOWER, (0, 1), WORKCELL)
    progress.require_same(TOWER, (0, 1), WORKCELL)
    progress.require_same(TOWER, (0, 1), replace(WORKCELL, speeds=replace(WORKCELL.speeds, line=0.1)))  # slower is fine
    moved = TOWER.with_poses(TOWER.poses + [[0.1, 0, 0, 0, 0, 0]])
    with pytest.raises(StackgenError, match="another structure"):
        progress.require_same(moved, (0, 1), WORKCELL)
    with pytest.raises(StackgenError, match="another order"):
        progress.require_same(TOWER, (1, 0), WORKCELL)
    with pytest.raises(StackgenError, match=r"cell\.base is not what it was"):
        progress.require_same(TOWER, (0, 1), replace(WORKCELL, base=replace(WORKCELL.base, yaw=-80.0)))


def test_there_must_be_something_to_go_on_with(tmp_path: Path) -> None:
    assert placed_before(tmp_path, resume=False) == 0
    with pytest.raises(StackgenError, match="there is no build to go on with"):
        placed_before(tmp_path, resume=True)
    replace(BuildProgress.of(TOWER, (0, 1), WORKCELL), placed=2, status="done").write(tmp_path)
    with pytest.raises(StackgenError, match=r"all 2 blocks .* stand already"):
        placed_before(tmp_path, resume=True)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"format": "stackgen.build/1"}', '{"format": "other/1"}'])
def test_a_broken_file_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE).write_text(text)
    with pytest.raises(StackgenError, match=r"is not (the progress of a build|JSON)"):
        BuildProgress.read(tmp_path)


def test_an_impossible_number_of_blocks_is_one_line(tmp_path: Path) -> None:
    BuildProgress.of(TOWER, (0, 1), WORKCELL).write(tmp_path)
    plain = json.loads((tmp_path / FILE).read_text())
    (tmp_path / FILE).write_text(json.dumps({**plain, "placed": 3}))
    with pytest.raises(StackgenError, match=r"is not (the progress of a build|JSON)"):
        BuildProgress.read(tmp_path)


def test_nobody_to_ask_means_no(tmp_path: Path) -> None:
    """Under pytest stdin is no terminal."""
    with pytest.raises(StackgenError, match="run it in a terminal, or say --yes"):
        confirm(job(tmp_path), "127.0.0.1", yes=False)
    confirm(job(tmp_path), "127.0.0.1", yes=True)
