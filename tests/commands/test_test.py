"""stackgen test: the paper's protocol from a checkpoint, a name, a class or a configuration, old ones too."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from stackgen.commands.asking import from_old_layout, is_old_layout
from stackgen.commands.test import COMMAND
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import evaluate
from stackgen.evaluation.results import read_evaluation
from stackgen.models.weights import CHECKPOINT_KEY, read_weights
from tests.conftest import Cli, TinyWeights

CONFIGS = Path(__file__).parents[2] / "configs"

OLD = """
seed_everything: 0
trainer: {default_root_dir: elsewhere, limit_test_batches: 2, max_steps: -1, logger: null}
model:
  class_path: stackgen.commands.protocol.WeightsUnderTest
  init_args:
    weights:
      class_path: stackgen.baselines.brute_force.BruteForce
      init_args:
        sigma: 0.5
        catalogue:
        - {name: cube, outline: [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], depth: 1.0}
        - {name: rectangle, outline: [[-1, -0.5], [1, -0.5], [1, 0.5], [-1, 0.5]], depth: 1.0}
        - {name: long_rectangle, outline: [[-1.5, -0.5], [1.5, -0.5], [1.5, 0.5], [-1.5, 0.5]], depth: 1.0}
        - {name: triangle, outline: [[-0.5, -0.5], [0.5, -0.5], [0, 0.5]], depth: 1.0}
        grid: {width: 4, height: 4, image_size: 64, pixels_per_cell: 14.0, ground_margin: 4.0}
        max_blocks: 10
    num_samples: 1
    predicted_lists: false
    method: Old
    verify: null
    sampler: {kind: null, steps: null, guide: null}
data: {path: gone, eval_batch_size: 4, test_path: DATA, batch_size: 256}
name: old
dashboard: wandb
ckpt_path: null
"""
"""As `stackgen test` of Lightning's command line saved it."""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Runs go below the test's own folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rows(folder: Path) -> list[dict[str, Any]]:
    content = json.loads((folder / "metrics.json").read_text())
    assert content["format"] == "stackgen.evaluation/2"
    return content["rows"]


def checkpoint(folder: Path, weights: Path) -> Path:
    """A run's folder as `stackgen fit` leaves it, with given weights."""
    tensors, card = read_weights(weights)
    path = folder / "version_0" / "checkpoints" / "last.ckpt"
    path.parent.mkdir(parents=True)
    state = {f"model.{name}": tensor for name, tensor in tensors.items()}
    own = {name: value for name, value in card.items() if name not in ("format", "name", "sha256")}
    torch.save({"state_dict": state, CHECKPOINT_KEY: own, "global_step": 0, "epoch": 0}, path)
    return path


def test_a_checkpoint_leaves_metrics_for_both_lists_and_the_ground_truth(
    cli: Cli, here: Path, tiny: TinyWeights, towers_dataset: Path
) -> None:
    options = ["--test_set", towers_dataset, "--block_list_weights", tiny.predictor, "--num_samples", 2]
    answer = cli("test", "--ckpt_path", checkpoint(here / "runs" / "mine", tiny.sampler), *options)
    assert answer.code == 0, answer.err
    folder = Path("runs/run/test_0")
    found = rows(folder)
    assert [row["block_list"] for row in found] == ["true", "predicted", "true"]
    assert [(row["scenes"], row["samples_per_scene"]) for row in found] == [(12, 2), (12, 2), (12, 1)]
    assert found[2]["metrics"]["stability"]["value"] == 1  # ground truth: towers stand
    assert len(list(folder.glob("scenes-*.csv"))) == 3
    evaluation, question = read_evaluation(folder / "evaluation-predicted.json")
    assert len(evaluation.scenes) == 12 and question["sampler"]["weights"] == found[0]["weights_sha256"]
    run = json.loads((folder / "run.json").read_text())
    assert run["dataset"]["path"] == str(towers_dataset) and len(run["dataset"]["sha256"]) == 64


def test_the_saved_configuration_runs_again_and_gives_the_same(
    cli: Cli, here: Path, tiny: TinyWeights, towers_dataset: Path
) -> None:
    network = checkpoint(here / "cnn", tiny.predictor).parents[2]
    options = ["--weights", tiny.sampler, "--num_samples", 1, "--limit", 5, "--test_set", towers_dataset]
    first = cli("test", "--ckpt_path", network, *options, "--sampler.steps", 4, "--name", "mine", "--runs", "out")
    assert first.code == 0, first.err
    second = cli("test", "--config", "out/mine/test_0/config.yaml")
    assert second.code == 0, second.err
    a, b = (rows(Path(f"out/mine/test_{number}")) for number in (0, 1))
    assert a == b and a[0]["scenes"] == 5 and a[0]["sampler"]["steps"] == 4
    saved = yaml.safe_load(Path("out/mine/test_0/config.yaml").read_text())
    assert saved["ckpt_path"] == str(network) and saved["weights"] == str(tiny.sampler)


def test_a_configuration_of_before_is_understood(cli: Cli, here: Path, towers_dataset: Path) -> None:
    Path("old.yaml").write_text(OLD.replace("DATA", str(towers_dataset)))
    answer = cli("test", "--config", "old.yaml")
    assert answer.code == 0, answer.err
    row = rows(Path("elsewhere/old/test_0"))[0]
    assert row["method"] == "Old" and row["sampler"]["sigma"] == 0.5
    assert (row["scenes"], row["samples_per_scene"]) == (8, 1)
    section = yaml.safe_dump({"test": yaml.safe_load(Path("old.yaml").read_text())})
    Path("section.yaml").write_text(section)
    assert cli("test", "--config", "section.yaml", "--name", "again", "--limit", "1").code == 0
    assert rows(Path("elsewhere/again/test_0"))[0]["scenes"] == 1


def test_only_old_configurations_are_translated() -> None:
    old = yaml.safe_load(OLD)
    assert is_old_layout(old) and not is_old_layout({"weights": "default"}) and not is_old_layout({"model": "x.DDPM"})
    plain = from_old_layout(old)
    known = {action.dest for action in COMMAND.parser()._actions}
    assert set(plain) <= known and plain["limit"] == 8 and plain["weights"]["init_args"]["world"]["max_blocks"] == 10
    assert from_old_layout({"model": "stackgen.commands.test.WeightsUnderTest", "name": "x"}) == {"name": "x"}


def test_the_frozen_test_set_is_asked_in_batches_of_64(cli: Cli) -> None:
    answer = cli("test", "--config", CONFIGS / "baselines" / "brute-force.yaml", "--print_config")
    printed = yaml.safe_load(answer.out)
    assert printed["test_set"] is None and printed["batch_size"] == 64 and printed["method"] == "Brute-Force"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--limit", "0"], "--limit must be at least 1"),
        (["--workers", "0"], "--workers must be at least 1"),
        (["--num_samples", "0"], "num_samples and batch_size must be at least 1"),
        (["--ckpt_path", "nowhere.ckpt"], "no weights at nowhere.ckpt"),
        (["--sampler.steps", "4", "--weights", "greedy-random"], "greedy-random is no diffusion model"),
        (["--wieghts", "x"], "did you mean --weights?"),
    ],
)
def test_mistakes_are_one_line_and_leave_no_run(arguments: list[str], line: str, cli: Cli, here: Path) -> None:
    answer = cli("test", *arguments)
    assert answer.code == 2 and line in answer.line
    assert not Path("runs").exists()


def test_text_for_weights_is_refused_in_one_line(cli: Cli, here: Path) -> None:
    Path("bad.ckpt").write_text("class_path: os.system")
    answer = cli("test", "--weights", "bad.ckpt")
    assert answer.code == 2 and "bad.ckpt holds no weights" in answer.line


@pytest.mark.parametrize(("struck", "kept"), [(0, False), (1, True)])
def test_a_stopped_test_keeps_what_is_done_and_says_where(
    struck: int, kept: bool, cli: Cli, here: Path, towers_dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = iter(range(9))

    def evaluated(*arguments: Any) -> Any:
        if next(calls) == struck:
            os.kill(os.getpid(), signal.SIGTERM)
        return evaluate(*arguments)

    monkeypatch.setattr("stackgen.commands.test.evaluate", evaluated)
    answer = cli("test", "--weights", "random-placement", "--test_set", towers_dataset, "--predicted_lists", "false")
    assert answer.code == 143 and "terminated" in answer.err and "the same command begins again" in answer.err
    assert ("are kept in runs/run/test_0" in answer.err) is kept is Path("runs/run/test_0").exists()


def test_a_test_that_fails_leaves_no_run_folder(
    cli: Cli, here: Path, towers_dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object) -> None:
        raise StackgenError("no")

    monkeypatch.setattr("stackgen.commands.test.evaluate", failing)
    assert cli("test", "--weights", "random-placement", "--test_set", towers_dataset).code == 2
    assert not Path("runs").exists()


def test_options_of_training_are_refused(cli: Cli, here: Path) -> None:
    answer = cli("test", "--data.path", "x")
    assert answer.code == 2 and "--data.path" in answer.err
