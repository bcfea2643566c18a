"""The same command twice gives the same losses to the last bit, and so does one that was resumed in the middle."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from stackgen.data.dataset import Dataset
from stackgen.models.diffusion.module import DDPM
from tests.conftest import Cli

CONFIG = """
name: twice
seed_everything: 7
trainer:
  max_steps: 12
  log_every_n_steps: 1
  gradient_clip_val: 1.0
  enable_progress_bar: false
  enable_model_summary: false
  callbacks:
    - {{class_path: stackgen.training.EMA, init_args: {{decay: 0.9}}}}
    - class_path: lightning.pytorch.callbacks.ModelCheckpoint
      init_args: {{every_n_train_steps: 4, save_top_k: -1, save_last: true, filename: "{{step}}"}}
model:
  class_path: stackgen.models.DDPM
  init_args:
    denoiser: {{width: 32, layers: 1, heads: 2, feedforward: 64, conditioning: cross, memory_layers: 1,
               mask_padding: true, ordered: true, self_conditioning: true}}
    diffusion: {{prediction: v, clip: 3.0}}
    optimizer: {{learning_rate: 0.01, warmup: 2}}
    draws: 2
data: {{path: {data}, batch_size: 5, mirror: true, bucket_by_blocks: true}}
"""


@pytest.fixture
def config(tmp_path: Path, towers_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A training with everything that is random: noise, order, reflections, self-conditioning."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "twice.yaml"
    path.write_text(CONFIG.format(data=towers_dataset))
    return path


def curve(version: int) -> dict[tuple[str, str], str]:
    """Every figure of a run by step and name, as written; but for what a clock says."""
    with Path(f"runs/twice/version_{version}/metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    named = {(row["step"], name): value for row in rows for name, value in row.items() if value}
    return {key: value for key, value in named.items() if "per_second" not in key[1] and key[1] != "step"}


def state(version: int) -> dict[str, Any]:
    path = Path(f"runs/twice/version_{version}/checkpoints/last.ckpt")
    return torch.load(path, weights_only=True)


def same(one: Any, other: Any) -> bool:
    """Equal to the last bit, however nested."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


@pytest.mark.filterwarnings("ignore")
def test_a_training_is_repeated_and_resumed_to_the_last_bit(cli: Cli, config: Path) -> None:
    fit = ["fit", "--config", config, "--dashboard", "none"]
    for _ in range(2):
        torch.rand(3)  # what went before does not matter
        answer = cli(*fit)
        assert answer.code == 0, answer.err
    first = curve(0)
    assert len([key for key in first if key[1] == "train/loss"]) == 12
    assert curve(1) == first
    middle = next(Path("runs/twice/version_0/checkpoints").glob("*step=8*.ckpt"))
    assert torch.load(middle, weights_only=True)["global_step"] == 8
    answer = cli(*fit, "--ckpt_path", middle)
    assert answer.code == 0, answer.err
    resumed = curve(2)
    assert {key for key in resumed if key[1] == "train/loss"} == {(str(s), "train/loss") for s in range(8, 12)}
    assert resumed.items() <= first.items()
    for key in ("state_dict", "raw_state_dict", "optimizer_states", "lr_schedulers", "StackDataModule"):
        assert same(state(2)[key], state(0)[key]) and same(state(1)[key], state(0)[key]), key


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("step", [3, 6])  # the first of an epoch, and one in its middle
def test_what_ctrl_c_stopped_in_the_middle_of_a_step_goes_on_as_if_it_had_not(
    step: int, cli: Cli, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = ["fit", "--config", config, "--dashboard", "none"]
    config.write_text(config.read_text().replace("save_last: true", "save_last: true, save_on_exception: true"))
    assert cli(*fit).code == 0
    training_step = DDPM.training_step

    def interrupted(self: DDPM, batch: dict[str, torch.Tensor], index: int) -> torch.Tensor:
        if self.trainer.global_step == step:
            raise KeyboardInterrupt
        return training_step(self, batch, index)

    with monkeypatch.context() as patch:
        patch.setattr(DDPM, "training_step", interrupted)
        assert cli(*fit).code == 130
    assert state(1)["global_step"] == step
    answer = cli(*fit, "--ckpt_path", "runs/twice/version_1/checkpoints/last.ckpt")
    assert answer.code == 0, answer.err
    for key in ("global_step", "state_dict", "raw_state_dict", "optimizer_states", "StackDataModule"):
        assert same(state(2)[key], state(0)[key]), key


@pytest.mark.filterwarnings("ignore")
def test_another_seed_is_another_training(cli: Cli, config: Path) -> None:
    short = ["--trainer.max_steps", 1, "--dashboard", "none"]
    assert cli("fit", "--config", config, *short).code == 0
    assert cli("fit", "--config", config, *short, "--seed_everything", 8).code == 0
    assert curve(0)["0", "train/loss"] != curve(1)["0", "train/loss"]


@pytest.mark.filterwarnings("ignore")
def test_a_run_says_what_made_it(cli: Cli, config: Path, towers_dataset: Path) -> None:
    import json

    assert cli("fit", "--config", config, "--trainer.max_steps", 1, "--dashboard", "none").code == 0
    folder = Path("runs/twice/version_0")
    facts = json.loads((folder / "run.json").read_text())
    assert facts["code"].startswith("0.")
    assert facts["dataset"]["sha256"] == Dataset.open(towers_dataset).manifest.sha256
    assert yaml.safe_load((folder / "config.yaml").read_text())["model"]["init_args"]["draws"] == 2
