"""stackgen check: verdicts, and with --explain margins and reasons."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from stackgen.io.stacks_file import read_stacks
from tests.conftest import Cli, stacks_json


def test_check_explains(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pybullet")
    monkeypatch.setenv("COLUMNS", "200")
    file, checked = tmp_path / "stacks.json", tmp_path / "checked.json"
    file.write_text(json.dumps(stacks_json([("cube", 0, 0.5)], [("cube", 0, 0.5), ("triangle", 0.75, 1.5)])))
    answer = cli("check", file, "--explain", "--out", checked)
    assert answer.code == 1
    assert "26.6°" in answer.out and "50%" in answer.out
    assert "block 1 (triangle): centre of mass 0.25 cells beside its support" in answer.out
    margins = [entry.verdict and entry.verdict.margin for entry in read_stacks(checked).entries]
    assert margins == pytest.approx([math.atan(0.5), 0.0], abs=1e-3)
    assert "statics" not in cli("check", file).out


@pytest.mark.parametrize(
    ("blocks", "word", "reason"),
    [
        ([("cube", 0, 0.5), ("cube", 0, 0.5)], "overlaps", "block 0 (cube) and block 1 (cube) are 1.00 cells inside"),
        ([("cube", 0, 0.5), ("cube", 0, 1.2)], "overlaps", "block 0 (cube) and block 1 (cube) are 0.30 cells inside"),
        ([("cube", 0, -3)], "buried", "block 0 (cube) is 3.50 cells in the ground"),
        ([("cube", 0, 0.8)], "floats", "block 0 (cube) floats 0.30 cells above what is below it"),
    ],
)
def test_what_cannot_be_is_said_and_does_not_pass(
    blocks: list[tuple[str, float, float]], word: str, reason: str, cli: Cli, tmp_path: Path
) -> None:
    file = tmp_path / "stacks.json"
    file.write_text(json.dumps(stacks_json([("cube", 0, 0.5)], blocks)))
    answer = cli("check", file)
    rows = [line.split() for line in answer.out.splitlines()]
    assert rows[1][1:3] == ["1", "stands"] and rows[2][:2] == ["2", word]
    assert answer.code == 1 and f"stack 2: {reason}" in answer.out and "stack 1:" not in answer.out
    first, second = json.loads(cli("check", file, "--json").out)["stacks"]
    assert first["verdict"]["stands"] and first["misfits"] == []
    assert not second["verdict"]["stands"] and second["misfits"][0].startswith(reason)


def test_a_verdict_on_what_overlaps_is_said_to_be_worth_little(cli: Cli, tmp_path: Path) -> None:
    file = tmp_path / "stacks.json"
    for above, said in ((1.5, False), (1.495, False), (1.45, True), (1.55, True)):
        file.write_text(json.dumps(stacks_json([("cube", 0, 0.5), ("cube", 0, above)])))
        answer = cli("check", file)
        assert answer.code == 0 and ("worth little" in answer.out) == said == ("0.05 cells" in answer.out)


def test_a_small_gap_is_said_alone(cli: Cli, tmp_path: Path) -> None:
    file = tmp_path / "stacks.json"
    file.write_text(json.dumps(stacks_json([("cube", 0, 0.7)])))
    answer = cli("check", file)
    assert answer.code == 0 and "block 0 (cube) floats 0.20 cells above what is below it" in answer.out


@pytest.mark.parametrize("size", [0.0005, 0.02, 10.0])
def test_verdicts_do_not_depend_on_the_scale(size: float, cli: Cli, tmp_path: Path) -> None:
    file, out, again = tmp_path / "stacks.json", tmp_path / "out.json", tmp_path / "again.json"
    half = [("cube", -1.5, 0.5), ("cube", -1.5, 1.5), ("rectangle", -1, 2.5), ("cube", -0.5, 3.5)]
    content = stacks_json([("cube", 0, 0.5)], half)
    file.write_text(json.dumps(content))
    assert cli("check", file, "--out", out, "--physics.cell_size", size).code == 1
    found = read_stacks(out)
    assert found.cell_size == size  # what was typed is what the file says
    file.write_text(json.dumps({**content, "cell_size_m": size}))
    assert cli("check", file, "--out", again).code == 1 and again.read_bytes() == out.read_bytes()
    file.write_text(json.dumps(content))
    cli("check", file, "--out", again)
    for entry, other in zip(found.entries, read_stacks(again).entries, strict=True):
        assert entry.verdict and other.verdict
        assert entry.verdict.stable == other.verdict.stable and (entry.verdict.drop == other.verdict.drop).all()
