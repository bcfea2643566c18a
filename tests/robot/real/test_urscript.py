"""The program: poses in the controller's base, balanced blocks of text, within the limits, for both kinds of jaws."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from stackgen.data.card import dataset_card
from stackgen.data.manifest import Manifest
from stackgen.errors import StackgenError
from stackgen.evaluation.results import write_csv
from stackgen.robot.planning.motion import Close, Motion, Open, joint_motion
from stackgen.robot.real.gripper import Gripper
from stackgen.robot.real.program import Controller, controller_move, controller_pose, tool_offset
from stackgen.robot.real.staging_sheet import write_staging_sheet
from stackgen.robot.real.urscript import urscript
from stackgen.stack import Stack
from stackgen.viz.gltf import glb_bytes
from stackgen.viz.page import html_page
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, Catalogue, World
from tests.robot.real import standin
from tests.robot.real.arms import WORKCELL, plan

NUMBERS = r"\[([^\]]*)\]"


def program(**gripper: object) -> str:
    return urscript(plan(), WORKCELL, Controller(), Gripper(**gripper))  # type: ignore[arg-type]


def motions() -> list[Motion]:
    found = [action for step in plan().blocks for action in step.actions if isinstance(action, Motion)]
    return [*found, *([plan().homing] if plan().homing else [])]  # type: ignore[list-item]


def test_the_controllers_base_is_the_urdfs_turned_by_half_a_turn() -> None:
    """Against the arm's published Denavit-Hartenberg table, which is written in the controller's base."""
    random, tool = np.random.default_rng(0), np.array(tool_offset(WORKCELL))
    for joints in random.uniform(-np.pi, np.pi, (20, 6)):
        ours = standin.matrix(controller_pose(joints, WORKCELL))
        np.testing.assert_allclose(ours, standin.forward(joints, tool), atol=1e-7)


def test_every_motion_is_a_line_that_leads_to_its_end() -> None:
    lines = [line for line in program().splitlines() if re.match(r"  move[jl]\(.*#", line)]
    assert len(lines) == len(motions())
    for line, motion in zip(lines, motions(), strict=True):
        assert line.strip().startswith("movej(get_inverse_kin(p[" if motion.kind == "joint" else "movel(p[")
        pose = np.array([float(word) for word in re.findall(NUMBERS, line)[0].split(",")])
        wanted = controller_pose(motion.end, WORKCELL)
        np.testing.assert_allclose(standin.matrix(pose), standin.matrix(wanted), atol=2e-6)
        speed = float(re.findall(r" v=([\d.]+)", line)[0])
        assert (
            0 < speed <= (np.radians(WORKCELL.speeds.joint) if motion.kind == "joint" else WORKCELL.speeds.line) + 1e-3
        )


def test_every_block_is_taken_let_go_and_named() -> None:
    text = program()
    actions = [action for step in plan().blocks for action in step.actions]
    assert len(re.findall(r"^  jaws_close\(\d+\)$", text, re.M)) == sum(isinstance(a, Close) for a in actions)
    assert len(re.findall(r"^  jaws_open\(\d+\)$", text, re.M)) == sum(isinstance(a, Open) for a in actions)
    assert len(re.findall(r"^  jaws_must_hold\(\)$", text, re.M)) == len(plan().blocks)
    assert "Block 0 (cube): from slot 1" in text and "Block 1 (triangle): from slot 2" in text


@pytest.mark.parametrize("kind", ["robotiq", "digital"])
def test_every_block_of_text_is_ended_and_nothing_is_left_to_fill_in(kind: str) -> None:
    text = program(kind=kind)
    code = [line.strip() for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]
    opened = sum(bool(re.match(r"(def|if|while) ?.*:$", line)) for line in code)
    assert opened == sum(line == "end" for line in code) > 5
    assert code[0] == "def stackgen_build():" and code[-1] == "end"
    assert "@" not in text
    assert ("socket_open" in text) == (kind == "robotiq")


def test_a_digital_output_has_the_level_that_was_asked_for() -> None:
    text = program(kind="digital", output=3, closed=False)
    opens = text[text.index("def jaws_open") : text.index("def jaws_close")]
    closes = text[text.index("def jaws_close") :]
    assert "set_standard_digital_out(3, True)" in opens
    assert "set_standard_digital_out(3, False)" in closes


def test_a_motion_out_of_the_workspace_is_refused_by_block_and_place() -> None:
    high = (0.55, 0.40, 0.12)
    low_ceiling = replace(WORKCELL, workspace=replace(WORKCELL.workspace, high=high))
    with pytest.raises(StackgenError, match=r"block 0 \(cube\): .* outside cell.workspace"):
        urscript(plan(), low_ceiling, Controller(), Gripper())


def test_a_motion_that_is_too_fast_is_refused() -> None:
    motion = joint_motion("transit", WORKCELL.home_joints, WORKCELL.home_joints + 0.3, WORKCELL.speeds)
    assert motion is not None
    slow = replace(WORKCELL, speeds=replace(WORKCELL.speeds, joint=10.0))
    with pytest.raises(StackgenError, match="transit would be too fast"):
        controller_move(motion, slow)
    assert controller_move(motion, WORKCELL).speed <= np.radians(WORKCELL.speeds.joint)


HOSTILE = 'x$\\frac{"];</script><b>|[red]&#movej(p)'
"""A name that is one printable word, and code in more than one language."""

EVIL = Catalogue(tuple(replace(shape, name=f"{HOSTILE}{i}") for i, shape in enumerate(PAPER_CATALOGUE)))


def test_a_block_s_name_is_only_ever_a_comment_of_the_program() -> None:
    named = replace(plan(), stack=Stack(plan().stack.shapes, plan().stack.poses, EVIL))
    text = urscript(named, WORKCELL, Controller(), Gripper())

    def code(program: str) -> list[str]:
        return [line.partition("#")[0].rstrip() for line in program.splitlines()]

    assert code(text) == code(program()) and HOSTILE in text


@pytest.mark.parametrize("host", ['x", 1, "jaws")\n movej([0])', "a b", "@PORT@", "\x1b[2J", "a" * 300])
def test_an_address_that_could_be_code_is_refused(host: str) -> None:
    for kind in (Controller, Gripper):
        with pytest.raises(StackgenError, match="host must be") as refused:
            kind(host=host)
        assert str(refused.value).isprintable()


def test_no_number_of_the_program_is_nan() -> None:
    with pytest.raises(StackgenError, match="finite"):
        Controller(center_of_gravity=(0.0, float("nan"), 0.0))


@pytest.mark.parametrize("suffix", [".svg", ".pdf"])
def test_a_name_is_text_on_the_staging_sheet(suffix: str, tmp_path: Path) -> None:
    stack = Stack(plan().stack.shapes, plan().stack.poses, EVIL)
    write_staging_sheet(tmp_path / f"a{suffix}", stack, order=(0, 1), workcell=WORKCELL, cell_size=0.05)
    content = (tmp_path / f"a{suffix}").read_bytes()
    assert b"<b>" not in content and b"</script>" not in content
    if suffix == ".svg":
        ElementTree.fromstring(content)


def test_a_name_is_text_in_pages_models_cards_and_tables(tmp_path: Path) -> None:
    stack = Stack(plan().stack.shapes, plan().stack.poses, EVIL)
    page = html_page([stack], title=HOSTILE)
    assert page.count("</script>") == html_page([plan().stack]).count("</script>") and "<b>" not in page
    glb = glb_bytes(stack)
    size = int.from_bytes(glb[12:16], "little")
    assert json.loads(glb[20 : 20 + size])["nodes"][0]["name"] == f"0 {HOSTILE}0"
    world = World(EVIL, PAPER_GRID, 10)
    manifest = Manifest(f"a\n# b {HOSTILE}", 0, world, {"engine": "<b>|"}, {})
    card = dataset_card(manifest)
    assert "<b>" not in card and "\n# b" not in card and "</script>" not in card
    write_csv(tmp_path / "a.csv", [{"method": '=HYPERLINK("x")', "value": -0.5}])
    assert list(csv.reader((tmp_path / "a.csv").open()))[1] == ['\'=HYPERLINK("x")', "-0.5"]
