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
