"""`stackgen build`: one line for what cannot be built, and nothing moves; report, picture and film else."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

import stackgen.robot.build as building
from stackgen.commands.build import COMMAND
from stackgen.commands.parsing import own_sections, parse
from stackgen.io.stacks_file import StackEntry, StacksFile, read_stacks, write_stacks
from stackgen.robot.build_report import BuildReport
from stackgen.robot.planning.arm_model import arm_model
from stackgen.robot.workcell import Workcell
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD
from tests.conftest import Cli


def stack_of(shapes: Sequence[int], poses: Sequence[Sequence[float]]) -> Stack:
    return Stack(np.array(shapes), np.array(poses, dtype=float))


ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "configs" / "robot" / "ur5.yaml"
SKETCH = ROOT / "examples" / "photos" / "sketch-house.jpg"


@pytest.fixture
def stacks(tmp_path: Path) -> Path:
    """A cube that stands, and one that hangs in the air."""
    entries = tuple(StackEntry(stack_of([0], [[0, 0, z, 0, 0, 0]])) for z in (0.5, 2.5))
    write_stacks(tmp_path / "stacks.json", StacksFile(entries, PAPER_WORLD))
    return tmp_path / "stacks.json"


@pytest.fixture
def nothing_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    def moved(*_: Any) -> None:
        raise AssertionError("the arm was started")

    monkeypatch.setattr(building.SimulatedArm, "__init__", moved)
    monkeypatch.delenv("DISPLAY", raising=False)


@pytest.mark.usefixtures("nothing_moves")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["{stacks}", "--stack", 2], "stack 2 cannot be built: block 0 (cube) floats 2.00 cells"),
        (["{stacks}", "--stack", 3], "--stack must lie in 1..2, got 3"),
        (["no.json"], "no.json: no such file"),
        ([], "give a stacks.json, or a picture with --from_image"),
        (["{stacks}", "--from_image", "a.png"], "not both"),
        (["{stacks}", "--which", "1"], "--as, --which, --depth_scale, --focal and --cell_size go with --from_image"),
        (
            ["--from_image", "a.png", "--arm", "ur-rtde", "--host", "h", "--execute", "--yes"],
            "a real arm asks before it moves for a picture",
        ),
        (["{stacks}", "--inventory", "cube=1"], "--inventory, --budget and --cells go with --from_image"),
        (["{stacks}", "--cells", "4"], "--inventory, --budget and --cells go with --from_image"),
        (["--from_image", "a.png", "--cells", "many"], "cells 'many': give auto, a height such as 6"),
        (["--from_image", "{sketch}", "--cells", "4", "--weights", "paper"], "--cells belongs to the search"),
        (["--from_image", "{sketch}", "--weights", "no.ckpt"], "no.ckpt"),
        (["{stacks}", "--execute"], "say --arm ur-rtde"),
        (["{stacks}", "--arm", "ur-rtde", "--execute"], "needs the address of the arm's controller"),
        (["{stacks}", "--arm", "urscript", "--video", "a.gif"], "go with the simulated arm"),
        (["{stacks}", "--staging_sheet", "a.txt"], "a.txt"),
        (["{stacks}", "--video", "a.avi"], "films are written as .mp4 or .gif"),
        (["{stacks}", "--gui"], "there is no display"),
        (["{stacks}", "--noise_mm", -1], "must be at least 0"),
        (["{stacks}", "--cell.jaws.opening", 0.05], "wider than the jaws"),
        (["{stacks}", "--cell.base.position", "[0, 1.5, 0]"], "out of the arm's reach"),
        (["{stacks}", "--cell.staging.length", 0.05], "the staging area is too small"),
        (["{stacks}", "--cell.speeds.line", 0], "line must be positive"),
    ],
)
def test_what_cannot_be_built_is_one_line_and_nothing_moves(
    options: list[object], message: str, cli: Cli, stacks: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    named = [str(o).replace("{stacks}", str(stacks)).replace("{sketch}", str(SKETCH)) for o in options]
    answer = cli("build", *named, "--out", out)
    assert answer.code == 2
    assert message in answer.line
    assert not out.exists()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have a display")
def test_a_display_that_does_not_answer_is_one_line(
    cli: Cli, stacks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bullet would end the whole process."""
    monkeypatch.setenv("DISPLAY", ":4711")
    answer = cli("build", stacks, "--gui", "--out", tmp_path / "out")
    assert answer.code == 2 and "--gui: the display :4711 does not answer" in answer.line
    assert not (tmp_path / "out").exists()


def test_the_shipped_workcell_is_the_default() -> None:
    values = parse(COMMAND.parser(), "build", own_sections("build", ["--config", str(CONFIG)]))
    assert COMMAND.parser().instantiate(values).cell == Workcell()


def test_the_shipped_workcell_names_every_number() -> None:
    plain = yaml.safe_load(CONFIG.read_text())["build"]["cell"]
    default = json.loads(json.dumps(Workcell().to_json()))
    assert plain == default


def test_the_help_fits_on_two_screens_and_names_what_it_leaves_out(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    short, whole = cli("build", "--help").out, cli("build", "--help=all").out
    assert len(short.splitlines()) <= 90
    options = [set(re.findall(r"^  (?:-., )?(--[\w.]+)", text, re.M)) for text in (short, whole)]
    left_out = options[1] - options[0]
    assert options[0] < options[1] and "--video" in options[0] and "--cell.jaws.opening" in left_out
    lens = {"--depth_scale", "--focal", "--cell_size"}
    assert {name.split(".")[0] for name in left_out} == {"--cell", "--controller", "--gripper"} | lens
    names = "--cell.*, --controller.*, --gripper.*, --depth_scale, --focal, --cell_size"
    last = f"`stackgen build --help=all` shows {len(left_out)} more options: {names}"
    assert short.rstrip().endswith(last) and "--help=all" not in whole


@pytest.mark.usefixtures("nothing_moves")
@pytest.mark.parametrize(
    ("module", "options", "extra"),
    [
        ("pinocchio", (), "robot"),
        ("ruckig", (), "robot"),
        ("av", ("--video", "{folder}/a.mp4"), "film"),
        ("rtde_control", ("--arm", "ur-rtde", "--host", "127.0.0.1", "--execute", "--yes"), "ur"),
    ],
)
def test_an_absent_package_is_one_line_and_the_help_needs_none(
    module: str,
    options: Sequence[str],
    extra: str,
    cli: Cli,
    stacks: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arm_model.cache_clear()
    monkeypatch.setitem(sys.modules, module, None)
    assert cli("build", "--help").code == 0
    answer = cli("build", stacks, *(option.format(folder=tmp_path) for option in options), "--out", tmp_path / "out")
    assert answer.code == 2 and f"{module!r}: pip install 'stackgen[{extra}]'" in answer.line


@pytest.mark.slow
def test_a_build_leaves_report_stack_picture_and_film(cli: Cli, stacks: Path, tmp_path: Path) -> None:
    film, out = tmp_path / "films" / "film.gif", tmp_path / "out"
    answer = cli("build", stacks, "--noise_mm", 1, "--noise_deg", 1, "--video", film, "--out", out)
    assert answer.code == 0, answer.err
    assert "built, and stands" in answer.out
    assert sorted(path.name for path in out.iterdir()) == ["build.json", "build.png", "stacks.json"]
    report = json.loads((out / "build.json").read_text())
    assert report["format"] == "stackgen.build/1" and report["success"] and report["unplanned_contacts"] == 0
    assert read_stacks(out / "stacks.json").stacks[0].poses[0, :2] == pytest.approx([0, 0], abs=0.02)
    assert film.read_bytes()[:4] == b"GIF8" and [path.name for path in film.parent.iterdir()] == ["film.gif"]


@pytest.mark.slow
def test_a_picture_whose_blocks_the_arm_knocks_over_is_built_of_fewer(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[int] = []

    def easy(report: BuildReport) -> bool:
        tried.append(len(report.blocks))
        return len(report.blocks) < max(tried)

    monkeypatch.setattr(BuildReport, "success", property(easy))
    options = ("--from_image", ROOT / "examples" / "silhouettes" / "arch.png", "--grasp", "fixed")
    answer = cli("build", *options, "--cell.staging.straighten", "false", "--out", tmp_path / "out")
    said = " ".join((answer.out + answer.err).split())
    assert answer.code == 0 and "fewer, larger blocks are easier to build" in said
    built = json.loads((tmp_path / "out" / "build.json").read_text())
    assert len(built["blocks"]) == tried[-1] < tried[0] == max(tried)
    assert len(read_stacks(tmp_path / "out" / "stacks.json").stacks[0]) == tried[-1]


@pytest.mark.slow
def test_a_picture_that_no_fewer_blocks_make_is_told_as_it_was_built(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(BuildReport, "success", property(lambda _: False))
    cube = np.zeros((80, 80), dtype=np.uint8)
    cube[20:60, 20:60] = 255
    assert cv2.imwrite(str(tmp_path / "cube.png"), cube)
    options = ("--from_image", tmp_path / "cube.png", "--grasp", "fixed", "--inventory", "cube=1")
    answer = cli("build", *options, "--cell.staging.straighten", "false", "--out", tmp_path / "out")
    assert answer.code == 1 and "no stack of at most 0 blocks was found" in " ".join((answer.out + answer.err).split())
    assert len(json.loads((tmp_path / "out" / "build.json").read_text())["blocks"]) == 1


def test_another_arm_builds_by_its_configuration_alone(cli: Cli, stacks: Path, tmp_path: Path) -> None:
    options = ("--config", CONFIG.with_name("panda.yaml"), "--grasp", "fixed", "--cell.staging.straighten", "false")
    refused = cli("build", stacks, *options[:2], "--arm", "urscript", "--out", tmp_path / "real")
    assert refused.code == 2 and "panda.urdf (cell.arm) is another arm" in refused.line
    answer = cli("build", stacks, *options, "--out", tmp_path / "out")
    assert answer.code == 0 and "built, and stands" in answer.out, answer.err
    report = json.loads((tmp_path / "out" / "build.json").read_text())
    assert len(report["torque"]) == 7 and report["cell"]["arm"]["flange"] == "panda_link8"
    assert report["blocks"][0]["ik_distance"] < 1e-3 and report["unplanned_contacts"] == 0  # [mm]


@pytest.mark.usefixtures("nothing_moves")
def test_for_a_real_arm_a_dry_run_leaves_program_and_sheet(cli: Cli, stacks: Path, tmp_path: Path) -> None:
    out, sheet = tmp_path / "out", tmp_path / "sheet.svg"
    answer = cli("build", stacks, "--config", CONFIG, "--arm", "urscript", "--staging_sheet", sheet, "--out", out)
    assert answer.code == 0, answer.err
    assert "dry run: nothing has moved" in answer.out
    assert "def stackgen_build():" in (out / "build.script").read_text() and sheet.read_text().startswith("<?xml")
