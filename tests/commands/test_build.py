"""`stackgen build`: one line for what cannot be built, and nothing moves; report, picture and film else."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import stackgen.robot.build as building
from stackgen.commands.build import COMMAND, _seen
from stackgen.commands.parsing import own_sections, parse
from stackgen.geometry import iou
from stackgen.io.stacks_file import Entry, StacksFile, read_stacks, write_stacks
from stackgen.robot.workcell import Cell
from stackgen.stack import Stack
from stackgen.vision.drawings import read_silhouette
from stackgen.viz.render import save_image
from stackgen.world import PAPER_GRID
from tests.conftest import Cli


def stack_of(shapes: Sequence[int], poses: Sequence[Sequence[float]]) -> Stack:
    return Stack(np.array(shapes), np.array(poses, dtype=float))


ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "configs" / "robot" / "ur5.yaml"


@pytest.fixture
def stacks(tmp_path: Path) -> Path:
    """A cube that stands, and one that hangs in the air."""
    entries = tuple(Entry(stack_of([0], [[0, 0, z, 0, 0, 0]])) for z in (0.5, 2.5))
    write_stacks(tmp_path / "stacks.json", StacksFile(entries))
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
        (["{stacks}", "--stack", 2], "block 0 (cube) would fall"),
        (["{stacks}", "--stack", 3], "--stack must lie in 1..2, got 3"),
        (["no.json"], "no.json: no such file"),
        ([], "give a stacks.json, or a picture with --from_image"),
        (["{stacks}", "--from_image", "a.png"], "not both"),
        (["{stacks}", "--inventory", "cube=1"], "--inventory and --budget go with --from_image"),
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
    answer = cli("build", *(str(o).replace("{stacks}", str(stacks)) for o in options), "--out", out)
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


def test_the_shipped_cell_is_the_default() -> None:
    values = parse(COMMAND.parser(), "build", own_sections("build", ["--config", str(CONFIG)]))
    assert COMMAND.parser().instantiate(values).cell == Cell()


def test_the_shipped_cell_names_every_number() -> None:
    plain = yaml.safe_load(CONFIG.read_text())["build"]["cell"]
    default = json.loads(json.dumps(Cell().to_json()))
    assert plain == default


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


def test_a_clean_picture_and_the_photo_of_an_outline_are_both_seen(tmp_path: Path) -> None:
    clean = _seen(ROOT / "examples" / "silhouettes" / "arch.png", PAPER_GRID)
    assert np.array_equal(clean, read_silhouette(ROOT / "examples" / "silhouettes" / "arch.png"))
    light = np.linspace(150, 235, 400)[None, :] * np.ones((300, 1))  # paper in uneven light
    photo = light.copy()
    photo[60:240, 160:240] = 30
    photo[68:232, 168:232] = light[68:232, 168:232]  # only the outline of a tower is drawn
    file = tmp_path / "photo.png"
    save_image(file, np.repeat(photo.astype(np.uint8)[..., None], 3, axis=2))
    seen = _seen(file, PAPER_GRID)
    rows, columns = np.nonzero(seen)
    assert seen[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1].mean() > 0.9  # filled in


def test_a_depth_frame_is_seen_as_capture_does() -> None:
    seen = _seen(ROOT / "examples" / "photos" / "stack-house-depth.png", PAPER_GRID)
    house = _seen(ROOT / "examples" / "photos" / "sketch-house.jpg", PAPER_GRID)
    assert iou(seen, house) > 0.98  # the same house


@pytest.mark.usefixtures("nothing_moves")
def test_for_a_real_arm_a_dry_run_leaves_program_and_sheet(cli: Cli, stacks: Path, tmp_path: Path) -> None:
    out, sheet = tmp_path / "out", tmp_path / "sheet.svg"
    answer = cli("build", stacks, "--config", CONFIG, "--arm", "urscript", "--staging_sheet", sheet, "--out", out)
    assert answer.code == 0, answer.err
    assert "dry run: nothing has moved" in answer.out
    assert "def stackgen_build():" in (out / "build.script").read_text() and sheet.read_text().startswith("<?xml")
