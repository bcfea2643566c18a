"""What Lightning, torch and wandb refuse is one line; each run has a folder of its own, whatever launched it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from stackgen.commands.cli import explain
from stackgen.training.runs import is_first_process
from tests.conftest import CHILD, Cli

TINY = {
    "name": "tiny",
    "model": {
        "class_path": "stackgen.models.DDPM",
        "init_args": {"denoiser": {"width": 16, "layers": 1, "heads": 2, "feedforward": 32}, "schedule": {"steps": 10}},
    },
    "trainer": {"max_steps": 2, "limit_val_batches": 1, "log_every_n_steps": 1, "accelerator": "cpu"},
}
NOISE = {"enable_progress_bar": False, "enable_model_summary": False}


@pytest.fixture
def tiny(towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A configuration of a training that takes a second."""
    monkeypatch.chdir(tmp_path)
    data = {"path": str(towers_dataset), "batch_size": 16}
    trainer = {**TINY["trainer"], **NOISE}  # type: ignore[dict-item]
    Path("tiny.yaml").write_text(yaml.safe_dump({**TINY, "trainer": trainer, "data": data}))
    return Path("tiny.yaml")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("options", "word"),
    [
        ("--trainer.max_steps -1 --trainer.max_time 00:00:00:05", "give max_steps or max_epochs"),
        (
            "--trainer.callbacks+=EarlyStopping --trainer.callbacks.monitor typo",
            "no metric is called 'typo'; there are",
        ),
        (
            "--trainer.callbacks+=ModelCheckpoint --trainer.callbacks.monitor typo --trainer.max_steps 9",
            "validation/loss",
        ),
        ("--model.denoiser.width 97 --model.denoiser.heads 4", "multiple of heads (4), got 97"),
        ("--model.denoiser.width 0", "width must"),
        ("--model.denoiser.heads 0", "heads must"),
        ("--model.optimizer.learning_rate -1", "learning_rate must lie in"),
        ("--model.optimizer.final 2", "final must lie in 0..1"),
        ("--trainer.strategy nonsense", "nonsense"),
        ("--trainer.num_nodes 0", "num_nodes"),
        ("--trainer.val_check_interval 1000", "val_check_interval"),
        ("--trainer.check_val_every_n_epoch 0", "check_val_every_n_epoch must be at least 1"),
        ("--trainer.accumulate_grad_batches 0", "accumulate_grad_batches must be at least 1"),
        ("--trainer.limit_val_batches 7.5", "limit_val_batches"),
        ("--trainer.max_time tomorrow", "tomorrow"),
        ("--seed_everything -1", "-1 is not in bounds"),
    ],
)
def test_a_refusal_of_a_library_is_one_line(options: str, word: str, cli: Cli, tiny: Path) -> None:
    answer = cli("fit", "--config", tiny, "--dashboard", "none", *options.split())
    assert answer.code == 2, answer.err
    last = answer.err.splitlines()[-1]
    assert last.startswith("stackgen fit: ") and word in last and "bug" not in last
    assert not Path("runs").exists()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("metric", ["validation/loss", "train/loss", "train/gradient_norm"])
def test_metrics_that_are_logged_can_be_monitored(metric: str, cli: Cli, tiny: Path) -> None:
    best = ["--trainer.callbacks+=ModelCheckpoint", "--trainer.callbacks.monitor", metric]
    answer = cli("fit", "--config", tiny, "--dashboard", "none", *best)
    assert answer.code == 0, answer.err


def test_a_mistake_of_ours_is_still_a_bug() -> None:
    for wrong in (lambda: [][0], lambda: int("x"), lambda: {"y": 1}["x"], lambda: None + 1):  # type: ignore[operator]
        with pytest.raises(Exception) as caught:  # noqa: PT011
            wrong()
        assert explain(caught.value) is None


LAUNCHERS = [
    {"SLURM_JOB_ID": "5", "SLURM_PROCID": "3", "SLURM_LOCALID": "3", "SLURM_NTASKS": "4"},
    {"LOCAL_RANK": "1", "RANK": "1"},
    {"LOCAL_RANK": "0", "NODE_RANK": "", "GROUP_RANK": "first"},
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("left", LAUNCHERS)
def test_every_run_has_a_folder_whatever_a_launcher_left_behind(
    left: dict[str, str], cli: Cli, tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in left.items():
        monkeypatch.setenv(name, value)
    is_first_process()  # a guess for messages, which no variable can break
    for number in range(2):
        answer = cli("fit", "--config", tiny, "--dashboard", "none", "--seed_everything", number)
        assert answer.code == 0, answer.err
        folder = Path(f"runs/tiny/version_{number}")
        assert yaml.safe_load((folder / "config.yaml").read_text())["seed_everything"] == number
        assert (folder / "metrics.csv").stat().st_size and (folder / "checkpoints/last.ckpt").exists()


@pytest.mark.slow
def test_a_wandb_that_refuses_the_key_leaves_the_curves_here(tiny: Path) -> None:
    # A process of its own: wandb keeps what it was told when it was first used in one.
    environment = {**CHILD, "WANDB_API_KEY": "abc", "WANDB_BASE_URL": "http://127.0.0.1:9", "WANDB_MODE": "online"}
    command = [sys.executable, "-m", "stackgen", "fit", "--config", str(tiny)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "`wandb sync`" in line]
    assert "wandb: " in line
    assert list(Path("runs/tiny/version_0/wandb").glob("offline-run-*"))
