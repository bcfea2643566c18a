"""stackgen report: made once, then read; continued, and wrong settings in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from stackgen.commands import report
from stackgen.data.dataset import Dataset
from stackgen.evaluation.protocol import Request
from stackgen.evaluation.report.rows import ReportSettings, check_rows
from stackgen.evaluation.report.tasks import tasks_of
from stackgen.evaluation.results import PREDICTED_LIST, TRUE_LIST, Evaluation
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
    settings = {"rows": rows, "test_set": str(towers_dataset), "num_samples": 2, "diversity_limit": None}
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
    assert rows[2]["metrics"]["all"]["stability"]["value"] == 1
    before = Path("out/table.md").read_bytes()
    monkeypatch.setattr(report, "evaluate", refuse)
    again = cli(*small())
    assert again.code == 0, again.err
    assert "to be run" not in again.out and Path("out/table.md").read_bytes() == before


def refuse(*arguments: object) -> Evaluation:
    raise AssertionError("nothing is to be run")


def test_an_interrupted_report_goes_on(
    small: Callable[..., list[str]], cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, str]] = []
    whole = report.evaluate

    def interrupted(request: Request, *rest: Any) -> Evaluation:
        asked.append((request.method, request.block_list))
        if len(asked) == 2:
            raise KeyboardInterrupt
        return whole(request, *rest)

    monkeypatch.setattr(report, "evaluate", interrupted)
    stopped = cli(*small())
    assert stopped.code == 130 and "1 of 3 are done and kept" in stopped.err
    assert not Path("out").exists()
    assert cli(*small()).code == 0
    assert asked == [("Random", TRUE_LIST), *[("Random", PREDICTED_LIST)] * 2, ("Truth", TRUE_LIST)]


def test_what_stackgen_test_found_is_not_run_again(
    small: Callable[..., list[str]], cli: Cli, towers_dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tested = cli("test", "--weights", "random-placement", "--num_samples", "2", "--test_set", towers_dataset)
    assert tested.code == 0, tested.err
    monkeypatch.setattr(report, "evaluate", refuse)
    made = cli(*small())
    assert made.code == 0, made.err
    assert "kept in runs/run/test_0/evaluation-ground-truth.json" in made.out
    assert "kept in runs/run/test_0/evaluation-predicted.json" in made.out


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--limit", "0"], "must be at least 1"),
        (["--workers", "0"], "must be at least 1"),
        (["--rows", "[]"], "no rows"),
        (["--rows", '[{"name": "a", "model": {"weights": "nowhere"}}]'], "row 'a': no weights called nowhere"),
        (["--rows", '[{"name": "a", "model": {"weights": "random-placement", "seed": 3}}]'], "seed"),
        (["--rows", '[{"name": "a", "model": {"weights": "random-placement", "wings": 2}}]'], "wings"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], line: str, small: Callable[..., list[str]], cli: Cli) -> None:
    answer = cli(*small(*arguments))
    assert answer.code == 2 and line in answer.line


def test_the_shipped_rows_are_the_default_and_name_what_there_is() -> None:
    """Every row's weights are here; each of the paper's methods has a row; the configuration is the package's own."""
    assert CONFIG.resolve() == report.ROWS.resolve()
    parser = report.COMMAND.parser()
    content = yaml.safe_load(CONFIG.read_text())["report"]
    values = parser.instantiate(parser.parse_args([f"--config={yaml.safe_dump(content)}"]))
    check_rows(values.rows)
    manifest = Dataset.open(values.test_set).manifest
    tasks = tasks_of(ReportSettings(rows=values.rows), manifest, 500, physics={}, facts={})
    assert [task.place[0] for task in tasks if task.request.block_list == TRUE_LIST] == [
        row.name for row in values.rows
    ]
    assert {row.paper for row in values.rows} >= {"Brute Force", "Greedy", "Tran-Reg", "Tran-VAE", "StackGen"}
    assert report.main.__defaults__ is not None and Path("out/report") in report.main.__defaults__
