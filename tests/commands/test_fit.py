"""fit, validate and export: every run its own folder, and a killed one goes on."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml

from stackgen.models.optimization import OptimizerConfig, learning_rate_share
from stackgen.models.weights import last_checkpoint
from stackgen.sampling.methods import load_sampler
from tests.conftest import CHILD, Cli, allow_interrupts

CONFIG = """
name: tiny
trainer: {{max_epochs: {epochs}, log_every_n_steps: 1, enable_progress_bar: false, enable_model_summary: false}}
model:
  class_path: stackgen.models.DDPM
  init_args:
    denoiser: {{width: 32, layers: 1, heads: 2, feedforward: 64}}
    optimizer: {{learning_rate: 0.001, warmup: 2}}
data: {{path: {data}, batch_size: 16, test_path: {data}}}
"""


@pytest.fixture
def config(tmp_path: Path, towers_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small model on a small dataset; runs go below the test's own folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "disabled")
    path = tmp_path / "tiny.yaml"
    path.write_text(CONFIG.format(epochs=2, data=towers_dataset))
    return path


def steps(checkpoint: Path) -> int:
    return int(torch.load(checkpoint, weights_only=True, map_location="cpu")["global_step"])


def test_each_run_has_its_own_folder_with_its_configuration(cli: Cli, config: Path) -> None:
    for number in range(2):
        answer = cli("fit", "--config", config, "--data.batch_size", 24)
        assert answer.code == 0, answer.err
        folder = Path(f"runs/tiny/version_{number}")
        saved = yaml.safe_load((folder / "config.yaml").read_text())
        assert saved["data"]["batch_size"] == 24
        assert saved["model"]["init_args"]["denoiser"]["width"] == 32
        with (folder / "metrics.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert any(row["train/loss"] for row in rows) and any(row["validation/loss"] for row in rows)
        assert steps(folder / "checkpoints" / "last.ckpt") == 4


def test_a_run_is_written_down_whatever_its_loggers(cli: Cli, config: Path) -> None:
    for number in range(2):
        answer = cli("fit", "--config", config, "--trainer.logger", "false")
        assert answer.code == 0, answer.err
        folder = Path(f"runs/tiny/version_{number}")
        assert sorted(path.name for path in folder.iterdir()) == ["checkpoints", "config.yaml", "run.json"]
    assert [path.name for path in Path("runs").iterdir()] == ["tiny"]


def test_a_checkpoint_alone_goes_on_with_its_run_s_settings(cli: Cli, config: Path) -> None:
    assert cli("fit", "--config", config, "--trainer.gradient_clip_val", 0.5, "--dashboard", "none").code == 0
    answer = cli("fit", "--ckpt_path", "runs/tiny/version_0/checkpoints/last.ckpt", "--trainer.max_epochs", 3)
    assert answer.code == 0, answer.err
    first, second = (yaml.safe_load(Path(f"runs/tiny/version_{n}/config.yaml").read_text()) for n in (0, 1))
    assert second.pop("ckpt_path") == "runs/tiny/version_0/checkpoints/last.ckpt"
    assert second["trainer"].pop("max_epochs") == 3
    del first["ckpt_path"], first["trainer"]["max_epochs"]
    assert second == first
    assert steps(Path("runs/tiny/version_1/checkpoints/last.ckpt")) == 9


FAST = """
trainer:
  precision: bf16-mixed
  accumulate_grad_batches: 2
  max_epochs: 3
  callbacks: [{{class_path: stackgen.training.Compile, init_args: {{backend: {backend}}}}},
              {{class_path: stackgen.training.EMA}}]
"""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "backend",
    [
        "aot_eager",
        pytest.param(
            "inductor",
            marks=[pytest.mark.slow, pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")],
        ),
    ],
)
def test_half_precision_accumulation_and_compilation_are_settings(backend: str, cli: Cli, config: Path) -> None:
    """48 samples are three batches of 16 and two steps an epoch; schedule and average go by steps."""
    Path("fast.yaml").write_text(FAST.format(backend=backend))
    answer = cli("fit", "--config", config, "--config", "fast.yaml", "--dashboard", "none")
    assert answer.code == 0, answer.err
    checkpoint = torch.load("runs/tiny/version_0/checkpoints/last.ckpt", weights_only=True)
    assert checkpoint["global_step"] == checkpoint["callbacks"]["EMA"]["updates"] == 6
    assert {t.dtype for t in checkpoint["state_dict"].values() if t.is_floating_point()} == {torch.float32}
    with Path("runs/tiny/version_0/metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    course = [learning_rate_share(step, 6, OptimizerConfig(warmup=2)) for step in range(6)]
    rates = [float(row["train/learning_rate"]) / 0.001 for row in rows if row["train/learning_rate"]]
    assert rates == pytest.approx(course, rel=1e-5)
    assert cli("export", "runs/tiny", "--out", "tiny.safetensors").code == 0
    assert load_sampler("tiny.safetensors") is not None


def test_the_saved_configuration_runs_again(cli: Cli, config: Path) -> None:
    assert cli("fit", "--config", config).code == 0
    answer = cli("fit", "--config", "runs/tiny/version_0/config.yaml")
    assert answer.code == 0, answer.err
    first, second = (
        torch.load(last_checkpoint(Path(f"runs/tiny/version_{n}")), weights_only=True)["state_dict"] for n in (0, 1)
    )
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_resuming_goes_on_where_the_run_ended(cli: Cli, config: Path) -> None:
    assert cli("fit", "--config", config).code == 0
    answer = cli("fit", "--config", config, "--ckpt_path", "last", "--trainer.max_epochs", 3)
    assert answer.code == 0, answer.err
    assert steps(Path("runs/tiny/version_0/checkpoints/last.ckpt")) == 6
    assert steps(Path("runs/tiny/version_1/checkpoints/last.ckpt")) == 9
    with Path("runs/tiny/version_1/metrics.csv").open() as file:
        assert {row["epoch"] for row in csv.DictReader(file)} == {"2"}


def test_a_checkpoint_of_another_shape_is_refused_in_one_line(cli: Cli, config: Path) -> None:
    assert cli("fit", "--config", config).code == 0
    wide = ["--model.denoiser.width", 64, "--ckpt_path", "last"]
    answer = cli("fit", "--config", config, *wide)
    assert answer.code == 2
    assert "does not fit the model" in answer.err.splitlines()[-1]


@pytest.mark.parametrize(
    "blow", [*(pytest.param(blow, marks=pytest.mark.slow) for blow in (signal.SIGKILL, signal.SIGINT)), signal.SIGTERM]
)
def test_a_run_that_was_stopped_goes_on(blow: signal.Signals, cli: Cli, config: Path) -> None:
    config.write_text(config.read_text().replace("max_epochs: 2", "max_epochs: 100000"))
    process = subprocess.Popen(
        [sys.executable, "-m", "stackgen", "fit", "--config", str(config)],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        env={**CHILD, "WANDB_MODE": "disabled"},
        preexec_fn=allow_interrupts,
    )
    last = Path("runs/tiny/version_0/checkpoints/last.ckpt")
    while not last.exists():
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(blow)
    _, err = process.communicate(timeout=300)
    if blow is not signal.SIGKILL:
        code, word = (130, "interrupted") if blow is signal.SIGINT else (143, "terminated")
        assert process.returncode == code
        assert err.splitlines()[-1] == f"stackgen fit: {word}; the state is kept: go on with --ckpt_path {last}"
    done = steps(last)
    assert done >= 3
    epochs = done // 3 + 2
    answer = cli("fit", "--config", config, "--ckpt_path", "last", "--trainer.max_epochs", epochs)
    assert answer.code == 0, answer.err
    assert steps(Path("runs/tiny/version_1/checkpoints/last.ckpt")) == 3 * epochs


def test_a_command_that_fails_leaves_no_run_folder(cli: Cli, config: Path) -> None:
    foreign = ["--trainer.callbacks+=stackgen.training.StartFrom", "--trainer.callbacks.weights", "nowhere.ckpt"]
    answer = cli("fit", "--config", config, "--dashboard", "none", *foreign)
    assert answer.code == 2 and "nowhere.ckpt" in answer.err, answer.err
    assert not Path("runs").exists()
    assert cli("fit", "--config", config, "--dashboard", "none").code == 0
    assert cli("fit", "--config", config, "--dashboard", "none", *foreign).code == 2
    assert [path.name for path in Path("runs/tiny").iterdir()] == ["version_0"]


@pytest.mark.slow
def test_nothing_is_left_of_a_run_that_wandb_had_begun(config: Path) -> None:
    """In a process of its own, since wandb writes into a run's folder as a process ends."""
    endless = ["--trainer.max_steps", "-1", "--trainer.max_epochs", "-1", "--trainer.max_time", "00:00:00:05"]
    options = ["fit", "--config", str(config), "--dashboard", "wandb-offline", *endless]
    command = [sys.executable, "-m", "stackgen", *options]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    assert answer.returncode == 2 and "give max_steps or max_epochs" in answer.stderr, answer.stderr
    assert not Path("runs").exists()


def test_validate_finds_the_configuration_beside_the_checkpoint(cli: Cli, config: Path) -> None:
    assert cli("fit", "--config", config).code == 0
    answer = cli("validate", "--ckpt_path", "runs/tiny/version_0/checkpoints/last.ckpt")
    assert answer.code == 0, answer.err
    metrics = json.loads(Path("runs/tiny/validate_0/metrics.json").read_text())
    with Path("runs/tiny/version_0/metrics.csv").open() as file:
        logged = [row["validation/loss"] for row in csv.DictReader(file) if row["validation/loss"]]
    assert metrics["validation/loss"] == pytest.approx(float(logged[-1]), rel=1e-5)


def test_an_exported_checkpoint_samples_as_the_checkpoint_does(cli: Cli, config: Path, tower_image: Path) -> None:
    assert cli("fit", "--config", config).code == 0
    assert cli("export", "runs/tiny", "--out", "tiny.safetensors").code == 0
    assert load_sampler("tiny.safetensors") is not None
    for weights, out in (("tiny.safetensors", "a"), ("runs/tiny", "b")):
        answer = cli("sample", tower_image, "--blocks", "cube=3", "--weights", weights, "--out", out)
        assert answer.code == 0, answer.err
    assert Path("a/stack-1.glb").read_bytes() == Path("b/stack-1.glb").read_bytes()
