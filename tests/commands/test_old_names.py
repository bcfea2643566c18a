"""What earlier code made goes on to work: its configurations, checkpoints and weights give what they gave then.

tests/assets/before holds a dataset and a run of each model after 4 steps, as written when classes had the names
of OLD_NAMES. `expected.json` is what that code gave: the metrics of `validate`, samples with seed 5 or predicted
block lists for the first scenes, and a fit resumed to 8 steps.
"""

from __future__ import annotations

import csv
import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from numpy.typing import NDArray

from stackgen.commands.old_names import OLD_NAMES, renew
from stackgen.data.arrays import StackArrays
from stackgen.data.dataset import Dataset
from stackgen.geometry import silhouette
from stackgen.io.text import read_json
from stackgen.models.weights import FOLDER
from stackgen.sampling.methods import load_predictor, load_sampler
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD, Mask, World
from tests.conftest import Cli

pytestmark = pytest.mark.filterwarnings("ignore")

BEFORE = Path(__file__).parents[1] / "assets" / "before"
EXPECTED: dict[str, dict[str, Any]] = json.loads((BEFORE / "expected.json").read_text())
RUNS = ["ddpm", "blocklist", "tran-reg", "tran-vae"]
SHIPPED = sorted(path.stem for path in FOLDER.glob("*.safetensors"))


@pytest.fixture
def checkpoint(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The checkpoint of an earlier run, in a folder of the test's own beside the data."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "towers.npz").symlink_to(BEFORE / "towers.npz")
    version = tmp_path / "runs" / name / "version_0"
    version.parent.mkdir(parents=True)
    version.symlink_to(BEFORE / name / "version_0")
    return version.relative_to(tmp_path) / "checkpoints" / "last.ckpt"


@pytest.fixture(scope="module")
def validation() -> StackArrays:
    return Dataset.open(BEFORE / "towers.npz").split("validation")


@pytest.mark.parametrize("path", sorted(set(OLD_NAMES.values())))
def test_what_an_old_name_stands_for_is_there(path: str) -> None:
    module, _, name = path.rpartition(".")
    assert getattr(importlib.import_module(module), name).__name__ == name


def test_a_name_is_renewed_as_a_whole() -> None:
    text = "{class_path: stackgen.baselines.tran_reg.TranReg}, a.stackgen.callbacks.EMA, stackgen.callbacks.EMAs"
    assert renew(text) == "{class_path: stackgen.baselines.TranReg}, a.stackgen.callbacks.EMA, stackgen.callbacks.EMAs"


@pytest.mark.parametrize("name", RUNS)
def test_an_old_checkpoint_validates_as_it_did(cli: Cli, checkpoint: Path, name: str) -> None:
    answer = cli("validate", "--ckpt_path", checkpoint)
    assert answer.code == 0, answer.err
    found = json.loads(Path(f"runs/{name}/validate_0/metrics.json").read_text())
    assert found == pytest.approx(EXPECTED[name]["validation"], rel=1e-5)


@pytest.mark.parametrize("name", RUNS)
def test_an_old_fit_goes_on_to_the_same_weights(cli: Cli, checkpoint: Path, name: str) -> None:
    answer = cli("fit", "--ckpt_path", checkpoint, "--trainer.max_steps", 8)
    assert answer.code == 0, answer.err
    state = torch.load(f"runs/{name}/version_1/checkpoints/last.ckpt", weights_only=True)
    expected = EXPECTED[name]["resumed"]
    for key in ("state_dict", "raw_state_dict"):
        norm = torch.cat([tensor.double().flatten() for tensor in state[key].values()]).norm()
        assert float(norm) == pytest.approx(expected[key], rel=1e-5)
    with Path(f"runs/{name}/version_1/metrics.csv").open() as file:
        losses = [float(row["train/loss"]) for row in csv.DictReader(file) if row["train/loss"]]
    assert losses == pytest.approx(expected["losses"], rel=1e-4)
    saved = yaml.safe_load(Path(f"runs/{name}/version_1/config.yaml").read_text())
    assert saved["model"]["class_path"] in OLD_NAMES.values()  # the names of now


@pytest.mark.parametrize("name", RUNS)
def test_an_old_configuration_is_an_argument(cli: Cli, checkpoint: Path, name: str) -> None:
    config = checkpoint.parents[1] / "config.yaml"
    assert "stackgen.callbacks.EMA" in config.read_text()
    steps = ["--trainer.callbacks", "stackgen.callbacks.EMA", "--trainer.max_steps", 1]
    answer = cli("fit", "--config", config, *steps)
    assert answer.code == 0, answer.err


@pytest.mark.parametrize("name", RUNS)
def test_an_old_checkpoint_samples_what_it_sampled(validation: StackArrays, name: str) -> None:
    assert_same(EXPECTED[name], BEFORE / name, *scenes(validation, [0, 1, 2]), 2)


@pytest.mark.parametrize("name", SHIPPED)
def test_the_shipped_weights_sample_what_they_sampled(validation: StackArrays, name: str) -> None:
    world = World.from_json(read_json(FOLDER / f"{name}.json"))
    asked = scenes(validation, [2]) if world == PAPER_WORLD else box(world)
    assert_same(EXPECTED[f"shipped {name}"], name, *asked, 1)


def scenes(found: StackArrays, numbers: list[int]) -> tuple[Mask, NDArray[np.int64]]:
    """The silhouettes (B, H, W) of some stacks, and their counts (B, S)."""
    return found.images(numbers), found.counts[numbers]


def box(world: World) -> tuple[Mask, NDArray[np.int64]]:
    """The silhouette (1, H, W) of two cubes on two, and their counts (1, S)."""
    poses = np.array([[x, 0, z, 0, 0, 0] for z in (0.5, 1.5) for x in (-0.5, 0.5)])
    stack = Stack(np.zeros(4, np.int64), poses, world.catalogue)
    return silhouette(stack, world.grid)[None], stack.counts[None]


def assert_same(
    expected: dict[str, Any], weights: str | Path, masks: Mask, counts: NDArray[np.int64], number: int
) -> None:
    if "predicted" in expected:
        assert load_predictor(weights).predict(masks, top=3).tolist() == expected["predicted"]
        return
    for drawn, poses in zip(
        load_sampler(weights).sample_batch(masks, counts, number, 5), expected["poses"], strict=True
    ):
        for stack, known in zip(drawn, poses, strict=True):
            assert stack.poses == pytest.approx(np.array(known), abs=1e-4)
