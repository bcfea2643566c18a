"""A training that leads nowhere says so, ends with an exit code that is not 0, and leaves no weights of that kind."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import yaml

from tests.conftest import Cli

TINY = {
    "class_path": "stackgen.models.DDPM",
    "init_args": {"denoiser": {"width": 16, "layers": 1, "heads": 2, "feedforward": 32}, "schedule": {"steps": 10}},
}


@pytest.mark.parametrize("trainer", [{"max_steps": 12}, {"max_steps": 2, "enable_checkpointing": False}])
@pytest.mark.parametrize("callbacks", [[], [{"class_path": "stackgen.training.EMA"}]])
def test_a_training_that_diverges_is_named_and_leaves_no_such_weights(
    trainer: dict[str, object],
    callbacks: list[object],
    cli: Cli,
    towers_dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    options = {**trainer, "callbacks": callbacks, "accelerator": "cpu", "limit_val_batches": 1}
    config = {"model": TINY, "data": {"path": str(towers_dataset), "batch_size": 16}, "trainer": options}
    Path("x.yaml").write_text(yaml.safe_dump(config))
    words = ["fit", "--config", "x.yaml", "--dashboard", "none", "--model.optimizer.warmup", 0]
    answer = cli(*words, "--model.optimizer.learning_rate", 1e30)
    assert answer.code == 2
    last = answer.err.splitlines()[-1]
    assert last.startswith("stackgen fit: the training diverged") and "learning rate" in last
    for path in tmp_path.rglob("*.ckpt"):
        weights = torch.load(path, weights_only=True)["state_dict"].values()
        assert all(torch.isfinite(tensor).all() for tensor in weights)


def test_a_training_that_does_not_diverge_ends_well(
    cli: Cli, towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = {"model": TINY, "data": {"path": str(towers_dataset), "batch_size": 16}, "trainer": {"max_steps": 2}}
    Path("x.yaml").write_text(yaml.safe_dump(config))
    assert cli("fit", "--config", "x.yaml", "--dashboard", "none").code == 0
    assert list(tmp_path.rglob("last.ckpt"))
