"""Every command line of the README and of docs/ runs, in order and at a small size, in a folder of its own."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest

from tests.conftest import Cli
from tests.test_docs import DOCS, PAGES, ROOT, commands

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

FIRST = ["README.md", "results/table.md", "results/README.md"]
"""Pages that make what others use."""

SMALL = {
    "generate": "--stacks 150 --draw 0 --templates_per_shard 1 --max_removals 1 --validation 0.2 --test 0.2"
    " --workers 1",
    "fit": "--trainer.max_steps 2 --trainer.limit_val_batches 1 --data.batch_size 8 --data.eval_batch_size 8"
    " --trainer.enable_progress_bar false --trainer.enable_model_summary false --data.num_workers 0",
    "validate": "--trainer.limit_val_batches 1 --trainer.enable_progress_bar false",
    "test": "--limit 2 --num_samples 1 --batch_size 2",
    "predict": "--limit 2",
    "prefer": "--scenes 4",
    "report": "--limit 1 --workers 1",
}
"""What is appended to the commands of a verb."""

ELSEWHERE = ("--executor ray", "s3://", "ssh ", "--host", "--realsense", "--trainer.strategy ddp", "stackgen report")
"""Parts of commands that need machines, services or hours that a test has not; other tests see that they parse."""


def lines() -> list[str]:
    """All command lines, in the order in which they can be typed, each once."""
    pages = [ROOT / FIRST[0], *(DOCS / name for name in FIRST[1:])]
    pages += [page for page in PAGES if page not in pages]
    found = dict.fromkeys(line for page in pages for line in commands(page.read_text()))
    return [line for line in found if line.startswith("stackgen ") and not any(part in line for part in ELSEWHERE)]


def is_sweep_that_runs(line: str) -> bool:
    """A sweep trains for hours; tests/training/sweeps has small ones."""
    return line.startswith("stackgen sweep") and "--export_wandb" not in line


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what a user has in a clone, without results."""
    place = tmp_path_factory.mktemp("typed")
    for name in ("configs", "examples", "benchmarks"):
        shutil.copytree(ROOT / name, place / name)
    shutil.copy(ROOT / "examples/silhouettes/bridge.jpg", place / "bridge.png")
    return place


@pytest.mark.parametrize("line", [line for line in lines() if not is_sweep_that_runs(line)])
def test_a_command_line_runs(
    line: str, folder: Path, cli: Cli, no_new_metrics: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("WANDB_MODE", "disabled")
    if "data/ten-million" in line and not Path("data/ten-million").exists():
        shutil.copytree("data/paper", "data/ten-million")
    _, verb, *words = shlex.split(line)
    answer = cli(verb, *words, *shlex.split(SMALL.get(verb, "")))
    assert answer.code in ((0, 1) if verb == "check" else (0,)), f"{line}\n{answer.err}"
