"""stackgen capture: silhouettes and overlays are written, bad input is one line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from stackgen.commands.cli import main
from stackgen.geometry import iou
from stackgen.viz.render import save_image
from tests.vision.conftest import CASTLE, HOUSE, PHOTOS, ROOT, camera_that_is_not_there, read_silhouette, truth


def test_the_command_writes_what_sample_takes_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "castle.png"
    assert main(["capture", "--depth", str(PHOTOS / "stack-castle-depth.png"), "--out", str(out)]) == 0
    assert "read as a depth frame" in capsys.readouterr().out
    assert iou(read_silhouette(out), truth(CASTLE)) >= 0.9
    assert (tmp_path / "castle-overlay.png").stat().st_size > 1000


def test_a_simulated_capture_tells_its_iou(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(ROOT / "examples" / "stacks" / "arch.json")
    assert main(["capture", "--simulate", file, "--elevation", "12", "--out", str(tmp_path / "a.png")]) == 0
    assert float(capsys.readouterr().out.split("truth: ")[1]) >= 0.9


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "give one of IMAGE, --depth"),
        (["--depth", "no.png"], "no.png: no such file"),
        (["--depth", "zero.npy"], "zero.npy: the frame has no depth"),
        (["--depth", "words.npy"], "words.npy: cannot be read"),
        (["--depth", "empty.png"], "empty.png: is an empty file"),
        (["--depth", "wall.npy"], "nothing stands in front of the background"),
        (["wall.npy", "--as", "photo", "--color", "a.png"], "--color belongs to a depth frame"),
        (["--depth", "wall.npy", "--depth_scale", "0"], "--depth_scale must be positive"),
        (["--depth", "wall.npy", "--cell_size", "-1"], "--cell_size must be positive"),
        (["page.eps.png"], "page.eps.png: is not an image that can be read"),
        (["."], ".: is a folder"),
        (["cut.png"], "cut.png: cannot be read"),
        (["--depth", "wall.npy", "--focal", "0"], "wall.npy: the focal length must be positive"),
        (["--realsense", "--seed", "-1"], "--seed must be at least 0"),
        (["--realsense"], "RealSense"),
        (["--sketch", "no.jpg", "--realsense"], "give one of"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pyrealsense2", camera_that_is_not_there())
    np.save("zero.npy", np.zeros((120, 160)))
    np.save("wall.npy", np.ones((120, 160)))
    np.save("words.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    Path("empty.png").touch()
    Path("page.eps.png").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\nshowpage\n")
    Path("cut.png").write_bytes((ROOT / "examples" / "silhouettes" / "arch.png").read_bytes()[:300])
    assert main(["capture", "--out", "out.png", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not Path("out.png").exists()


def test_a_stack_number_that_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = ROOT / "examples" / "stacks" / "arch.json"
    number = len(json.loads(file.read_text())["stacks"]) + 1
    arguments = ["capture", "--simulate", str(file), "--stack", str(number), "--out", str(tmp_path / "a.png")]
    assert main(arguments) == 2
    assert "--stack must lie in 1.." in capsys.readouterr().err


def test_the_command_writes_silhouette_and_overlay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "house.png"
    save_image(tmp_path / "truth.png", truth(HOUSE))
    photo = str(PHOTOS / "sketch-house.jpg")
    assert main(["capture", photo, "--as", "photo", "--truth", str(tmp_path / "truth.png"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "block list by the heuristic: cube=2" in said
    assert float(said.split("truth: ")[1]) >= 0.95
    assert iou(read_silhouette(out), truth(HOUSE)) >= 0.95
    assert (tmp_path / "house-overlay.png").exists()


def test_with_the_size_of_a_cell_a_structure_keeps_its_scale(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, frame = tmp_path / "castle.png", str(PHOTOS / "stack-castle-depth.png")
    for size, cells in (("0.05", 4), ("0.067", 3)):
        assert main(["capture", "--depth", frame, "--cell_size", size, "--freehand", "--out", str(out)]) == 0
        rows = np.flatnonzero(read_mask(out).any(axis=1))
        assert len(rows) == pytest.approx(14 * cells, abs=3)
    assert main(["capture", "--depth", frame, "--cell_size", "0.03", "--out", str(out)]) == 2
    assert "leave out --cell_size" in capsys.readouterr().err


def test_of_two_drawings_one_is_captured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = tmp_path / "two.png"
    page = np.full((600, 800), 240, dtype=np.uint8)
    cv2.rectangle(page, (100, 100), (250, 300), 40, 6)
    cv2.rectangle(page, (500, 300), (700, 400), 40, 6)
    save_image(photo, np.repeat(page[..., None], 3, axis=2))
    assert main(["capture", str(photo), "--out", str(tmp_path / "a.png")]) == 2
    assert "2 drawings are in it" in capsys.readouterr().err
    assert main(["capture", str(photo), "--which", "2", "--out", str(tmp_path / "a.png")]) == 0
    assert read_mask(tmp_path / "a.png").any(axis=0).sum() > read_mask(tmp_path / "a.png").any(axis=1).sum()


def read_mask(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path)) > 0
