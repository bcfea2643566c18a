"""Every file in configs/ means something: its verb understands it, and what it describes can be built."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from jsonargparse import ArgumentParser
from lightning.pytorch import Callback, LightningModule
from torch import nn

from stackgen.commands.cli import VERBS
from stackgen.commands.generate import COMMAND as GENERATE
from stackgen.commands.parsing import own_sections, parse
from stackgen.data.datamodule import StackDataModule
from stackgen.data.generation.settings import GenerateSettings
from stackgen.models.block_list.module import BlockListCNN
from stackgen.models.diffusion.module import DDPM
from stackgen.models.weights import last_checkpoint
from stackgen.sampling.methods import load_sampler
from stackgen.world import PAPER_WORLD
from tests.conftest import Cli

CONFIGS = Path(__file__).parents[1] / "configs"
QUICK = CONFIGS / "quick.yaml"
OVERLAY, TRIAL = CONFIGS / "warm-start.yaml", CONFIGS / "trial.yaml"  # no configurations of their own
ALL = sorted(path for path in CONFIGS.rglob("*.yaml") if path not in (OVERLAY, TRIAL))
WORLDS = CONFIGS / "worlds"
VERB_OF_FOLDER = {"generate": "generate", "model": "fit", "baselines": "fit", "sweeps": "sweep"}

Load = Callable[[Path], dict[str, Any]]


def verbs(path: Path) -> list[str]:
    """Whose options a file holds: of each verb that has a section in it, or else those of its folder's verb."""
    content = yaml.safe_load(path.read_text())
    sections = [verb for verb in VERBS if isinstance(content.get(verb), dict)]
    if sections or WORLDS not in path.parents:
        return sections or [VERB_OF_FOLDER[folder] for folder in (path.parent.name,) if folder in VERB_OF_FOLDER]
    return ["generate" if path.stem == "generate" else "fit"]


def name_of(path: Path) -> str:
    """What a configuration's dataset or run is called, so that it is found."""
    if WORLDS not in path.parents:
        return path.stem
    world = path.parent.name
    return world if path.stem == "generate" else f"{world}-{path.stem}"


def of(verb: str) -> list[Any]:
    return [pytest.param(path, id=name_of(path)) for path in ALL if verb in verbs(path)]


def settings_of(path: Path) -> GenerateSettings:
    """What a configuration of `generate` describes."""
    parser = GENERATE.parser()
    values = parse(parser, "generate", own_sections("generate", ["--config", str(path), "--out", "x"]))
    values = parser.instantiate(values)
    return GenerateSettings(**{name: values[name] for name in GenerateSettings.__dataclass_fields__})


@pytest.fixture
def fit_options(cli: Cli) -> Load:
    """All options of `fit` as a configuration sets them, defaults filled in."""

    def load(path: Path) -> dict[str, Any]:
        answer = cli("fit", "--config", path, "--data.path", "x", "--print_config")
        assert answer.code == 0, answer.err
        return yaml.safe_load(io.StringIO(answer.out))

    return load


def build(
    options: dict[str, Any], world: GenerateSettings | None = None
) -> tuple[Any, StackDataModule, list[Callback]]:
    """Training module with its network, data module and callbacks; in the paper's world by default."""
    parser = ArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(LightningModule, "model")
    parser.add_class_arguments(StackDataModule, "data")
    parser.add_argument("--callbacks", type=list[Callback])
    chosen = {"model": options["model"], "data": options["data"], "callbacks": options["trainer"]["callbacks"]}
    made = parser.instantiate_classes(parser.parse_object(chosen))
    made.model.build(PAPER_WORLD if world is None else world.world)
    return made.model, made.data, made.callbacks


def test_no_file_is_without_a_verb() -> None:
    assert [path.name for path in ALL if not verbs(path)] == []


def test_a_warm_start_is_laid_over_a_model(cli: Cli) -> None:
    base = CONFIGS / "model" / "ddpm-small.yaml"
    answer = cli("fit", "--config", base, "--config", OVERLAY, "--data.path", "x", "--print_config")
    printed = yaml.safe_load(answer.out)
    kinds = [callback["class_path"].rpartition(".")[2] for callback in printed["trainer"]["callbacks"]]
    assert answer.code == 0 and kinds == ["StartFrom", "EMA", "ModelCheckpoint"]
    assert printed["model"]["init_args"]["denoiser"]["ordered"] is True


@pytest.mark.parametrize("path", of("generate"))
def test_a_dataset_s_settings_are_made(path: Path) -> None:
    settings = settings_of(path)
    assert settings.name == name_of(path)
    assert settings.exclude_testset == (settings.name != "testset-v1" and WORLDS not in path.parents)


@pytest.mark.parametrize("path", of("fit"))
def test_a_model_is_built_and_learns_from_a_batch(path: Path, fit_options: Load) -> None:
    options = fit_options(path)
    assert options["name"] == name_of(path)  # where its run is looked for
    world = settings_of(path.with_name("generate.yaml")) if WORLDS in path.parents else GenerateSettings("paper", 1)
    module, _, callbacks = build(options, world)
    assert callbacks
    counts = torch.eye(len(world.catalogue), dtype=torch.long)[[0, 1]]
    counts[:, -1] += torch.tensor([1, 2])  # a cube and a triangle, a rectangle and two
    last = len(world.catalogue) - 1
    batch = {
        "shapes": torch.tensor([[0, last, -1], [1, last, last]]),
        "poses": torch.randn(2, 3, 6),
        "mask": torch.tensor([[True, True, False], [True, True, True]]),
        "silhouette": torch.ones(2, world.grid.image_size, world.grid.image_size),
        "counts": counts,
    }
    loss_of(module, batch).backward()
    assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in module.parameters())


def loss_of(module: Any, batch: dict[str, torch.Tensor]) -> torch.Tensor:
    """The training loss of a batch; finite."""
    if isinstance(module, DDPM):
        loss = module.model.loss(batch, module.draws)[0].mean()
    elif isinstance(module, BlockListCNN):
        loss = module._loss(module.model.features(batch["silhouette"]), batch["counts"])
    else:
        loss = module.training_step(batch, 0)
    assert loss.isfinite()
    return loss


def test_the_paper_s_denoiser_is_the_paper_s(fit_options: Load) -> None:
    module, _, _ = build(fit_options(CONFIGS / "model" / "ddpm-paper.yaml"))
    model = module.model
    layer = nn.TransformerEncoderLayer(512, 8, 2048, device="meta")
    assert size(model.denoiser.layers) == 6 * size(layer)
    assert {block.attention.heads for block in model.denoiser.layers} == {8}
    assert model.denoiser.encode(torch.zeros(1, 64, 64)).shape == (1, 16, 512)
    assert size(model.denoiser.head) == 512 * 6 + 6
    assert size(model) == 20_105_222
    assert module.world.max_blocks == 10
    assert model.config.prediction == "epsilon" and model.config.clip is None
    beta = model.schedule.beta
    assert model.schedule.steps == 50
    assert beta[1].item() == pytest.approx(1e-4) and beta[50].item() == pytest.approx(0.189)
    assert (beta[2:] - beta[1:-1]).std().item() == pytest.approx(0, abs=1e-12)


def test_the_paper_s_classifier_is_the_paper_s(fit_options: Load) -> None:
    module, _, _ = build(fit_options(CONFIGS / "model" / "blocklist-paper.yaml"))
    assert isinstance(module, BlockListCNN)
    network = module.model
    assert len(network.layers) == 30
    assert network.stem(torch.zeros(1, 1, 64, 64)).shape == (1, 10, 64, 64)
    assert network.out.out_features == 1000  # 14 over 4 multisets of at most ten, less the empty one


def test_quick_has_stacks_for_every_split() -> None:
    """A template gives five stacks or so; even at ten, each split gets a shard before there are enough."""
    settings = GenerateSettings(**yaml.safe_load(QUICK.read_text())["generate"])
    shards = settings.stacks // (10 * settings.templates_per_shard)
    assert {settings.split_of(shard) for shard in range(shards)} == {"train", "validation", "test"}


def test_quick_trains_and_its_run_holds_weights(
    cli: Cli, towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "disabled")
    monkeypatch.chdir(tmp_path)
    content = yaml.safe_load(QUICK.read_text())
    options = content["fit"]
    options["data"]["path"] = str(towers_dataset)
    options["trainer"] |= {"max_steps": 2, "enable_progress_bar": False, "enable_model_summary": False}
    for callback in options["trainer"]["callbacks"]:
        if "every_n_train_steps" in callback["init_args"]:
            callback["init_args"]["every_n_train_steps"] = 2
    shorter = tmp_path / "shorter.yaml"
    shorter.write_text(yaml.safe_dump(content))
    answer = cli("fit", "--config", shorter)
    assert answer.code == 0, answer.err
    sampler = load_sampler(last_checkpoint(Path("runs/quick")))
    (stacks,) = sampler.sample_batch(np.ones((1, 64, 64), bool), np.array([[2, 0, 0, 0]]), 1, 0)
    assert stacks[0].names == ["cube", "cube"]


def size(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())
