"""stackgen report: made once, then read; gone on with, and wrong settings in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from stackgen.commands import report
from stackgen.evaluation.protocol import Evaluation
from stackgen.evaluation.report import plan
from stackgen.evaluation.report.rows import check_rows
from stackgen.evaluation.results import PREDICTED_LIST, TRUE_LIST
from tests.conftest import Cli

CONFIG = Path(__file__).parents[2] / "configs" / "report.yaml"


@pytest.fixture
def small(towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """A report of the towers: random placement and the truth, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    rows = [
        {"name": "Random", "model": {"weights": "random-placement"}},
        {"name": "Truth", "model": {"weights": "ground-truth"}},
    ]
    settings = {"rows": rows, "test_set": str(towers_dataset), "num_samples": 2, "ceiling": None}
    (tmp_path / "report.yaml").write_text(yaml.safe_dump({"report": settings}))

    def command(*more: str) -> list[str]:
        return ["report", "--config", "report.yaml", "--workers", "1", "--out", "out", *more]

    return command


def test_a_report_is_made_once_and_then_read(
    small: Callable[..., list[str]], cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = cli(*small())
    assert first.code == 0, first.err
    assert "Random, CNN's list: to be run" in first.out
    written = {path.name for path in Path("out").iterdir()}
    assert {"table.md", "table.csv", "table.json", "chart-iou.png", "sheet-random.png", "sheet-truth.png"} <= written
    rows = json.loads(Path("out/table.json").read_text())["rows"]
    assert [(row["method"], row["block_list"]) for row in rows] == [
        ("Random", TRUE_LIST), ("Random", PREDICTED_LIST), ("Truth", TRUE_LIST),
    ]  # fmt: skip
    assert rows[2]["figures"]["all"]["metrics"]["stability"]["value"] == 1
    before = Path("out/table.md").read_bytes()
    monkeypatch.setattr(report, "answer", refuse)
    again = cli(*small())
    assert again.code == 0, again.err
    assert "to be run" not in again.out and Path("out/table.md").read_bytes() == before


def refuse(*arguments: object) -> Evaluation:
    raise AssertionError("nothing is to be run")


def test_an_interrupted_report_goes_on(
    small: Callable[..., list[str]], cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, str]] = []
    whole = report.answer

    def interrupted(task: Any, *rest: Any) -> Evaluation:
        asked.append((task.row.name, task.block_list))
        if len(asked) == 2:
            raise KeyboardInterrupt
        return whole(task, *rest)

    monkeypatch.setattr(report, "answer", interrupted)
    stopped = cli(*small())
    assert stopped.code == 130 and "1 of 3 are done and kept" in stopped.err
    assert not Path("out").exists()
    assert cli(*small()).code == 0
    assert asked == [("Random", TRUE_LIST), *[("Random", PREDICTED_LIST)] * 2, ("Truth", TRUE_LIST)]


def test_what_stackgen_test_found_is_not_run_again(
    small: Callable[..., list[str]], cli: Cli, towers_dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["--model.weights", "random-placement", "--model.num_samples", "2", "--data.test_path", towers_dataset]
    tested = cli("test", *options, "--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")
    assert tested.code == 0, tested.err
    asked: list[str] = []
    whole = report.answer

    def counted(task: Any, *rest: Any) -> Evaluation:
        asked.append(task.row.name)
        return whole(task, *rest)

    monkeypatch.setattr(report, "answer", counted)
    made = cli(*small())
    assert made.code == 0, made.err
    assert asked == ["Truth"] and "kept in runs/run/test_0/evaluation-predicted.json" in made.out


def test_a_row_without_weights_is_read_from_its_record(small: Callable[..., list[str]], cli: Cli) -> None:
    content = yaml.safe_load(Path("report.yaml").read_text())
    row = content["report"]["rows"][0]
    row["recorded"] = "records/random.json"
    Path("report.yaml").write_text(yaml.safe_dump(content))
    assert cli(*small()).code == 0
    assert Path("records/random.json").exists()
    row["model"]["weights"] = "too-large.safetensors"
    Path("report.yaml").write_text(yaml.safe_dump(content))
    answer = cli(*small("--seed", "1"))
    assert answer.code == 0, answer.err
    assert "Random: recorded in records/random.json (no weights at too-large.safetensors)" in answer.out
    text = Path("out/table.md").read_text()
    assert "| Random † | true |" in text and "seed 0, not 1" in text
    Path("records/random.json").unlink()
    gone = cli(*small())
    assert gone.code == 2 and "no weights at too-large.safetensors, and no record at records/random.json" in gone.line


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--limit", "0"], "limit must be at least 1"),
        (["--limit", "3", "--out", "docs/results"], "another folder"),
        (["--workers", "0"], "workers must be at least 1"),
        (["--rows", "[]"], "no rows"),
        (["--rows", '[{"name": "a", "model": {"weights": "nowhere"}}]'], "row 'a': no weights called nowhere"),
        (["--rows", '[{"name": "a", "model": {"weights": "random-placement", "seed": 3}}]'], "for all rows alike"),
        (["--rows", '[{"name": "a", "model": {"weights": "random-placement", "wings": 2}}]'], "wings"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], line: str, small: Callable[..., list[str]], cli: Cli) -> None:
    answer = cli(*small(*arguments))
    assert answer.code == 2 and line in answer.line


def test_the_shipped_configuration_names_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every row's weights are here, or its record is; each of the paper's methods has a row."""
    monkeypatch.chdir(CONFIG.parents[1])
    parser = report.COMMAND.parser()
    content = yaml.safe_load(CONFIG.read_text())["report"]
    values = parser.instantiate(parser.parse_args([f"--config={yaml.safe_dump(content)}"]))
    check_rows(values.rows)
    for row in values.rows:
        if not row.is_ground_truth and not (row.recorded and row.recorded.is_file()):
            assert plan.under_test(row, plan.ReportSettings(rows=[row])).method == row.name
