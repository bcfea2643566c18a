"""Training the learned baselines: a fit learns, survives, and samples alike in every form it leaves behind."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from stackgen._lightning import pl
from stackgen.baselines.modules import TranReg, TranVAE
from stackgen.baselines.regression import RegressionConfig
from stackgen.baselines.tran_reg import TranRegNetwork
from stackgen.baselines.tran_vae import TranVAENetwork, VAEConfig
from stackgen.data.arrays import StackArrays
from stackgen.data.datamodule import StackDataModule
from stackgen.errors import StackgenError
from stackgen.models.diffusion.denoiser import Denoiser
from stackgen.models.optimization import OptimizerConfig
from stackgen.models.transformer import TransformerConfig
from stackgen.models.weights import export_checkpoint, last_checkpoint
from stackgen.protocols import StackSampler
from stackgen.sampling.methods import load_predictor, load_sampler
from stackgen.training.callbacks import EMA
from stackgen.world import PAPER_WORLD
from tests.conftest import Cli, TinyWeights
from tests.models.conftest import TINY, TINY_CROSS, trainer_for

pytestmark = pytest.mark.filterwarnings("ignore")

CONFIGS = Path(__file__).parents[2] / "configs"
FAST = OptimizerConfig(learning_rate=3e-3, warmup=2)
METHODS = ["tran-reg", "tran-vae"]


def module_for(method: str, base: TransformerConfig = TINY_CROSS, assignment: Any = "matched") -> TranReg | TranVAE:
    pl.seed_everything(0, verbose=False)
    transformer, regression = replace(base, layers=2), RegressionConfig(assignment, least_std=0.05)
    if method == "tran-reg":
        return TranReg(transformer, regression, FAST)
    return TranVAE(transformer, regression, VAEConfig(1, 4, kl_weight=0.01, kl_warmup=20), FAST)


def data_of(path: Path, **options: Any) -> StackDataModule:
    return StackDataModule(path, **{"batch_size": 8, "bucket_by_blocks": True, "mirror": True, **options})


def poses_of(sampler: StackSampler, arrays: StackArrays) -> np.ndarray:
    scenes = sampler.sample_batch(arrays.images(range(3)), arrays.counts[:3], 2, seed=7)
    return np.concatenate([stack.poses for scene in scenes for stack in scene])


@pytest.fixture
def compact(towers_dataset: Path) -> Path:
    """The towers: what is learned here is that their blocks stand on each other."""
    return towers_dataset


@pytest.fixture
def arrays(compact: Path) -> StackArrays:
    return data_of(compact).split("validation")


@pytest.mark.parametrize("base", [TINY, TINY_CROSS], ids=["paper", "cross"])
@pytest.mark.parametrize("method", METHODS)
def test_a_short_training_learns_to_build_towers(
    method: str, base: TransformerConfig, compact: Path, arrays: StackArrays, tmp_path: Path
) -> None:
    module = module_for(method, base)
    module.optimizer_config = OptimizerConfig(learning_rate=0.01, warmup=5)
    trainer_for(tmp_path, max_steps=120).fit(module, data_of(compact, bucket_by_blocks=base is TINY_CROSS))
    heights = []
    for stacks in module.sampler().sample_batch(arrays.images(), arrays.counts, 2, seed=0):
        for stack in stacks:
            heights += (np.sort(stack.poses[:, 2]) - np.arange(len(stack)) - 0.5).tolist()
    assert np.abs(heights).mean() < 0.15


@pytest.mark.parametrize("method", METHODS)
def test_training_and_validation_repeat(method: str, compact: Path, tmp_path: Path) -> None:
    results = []
    for _ in range(2):
        module = module_for(method)
        trainer_for(tmp_path, max_steps=3).fit(module, data_of(compact))
        results.append(trainer_for(tmp_path).validate(module, data_of(compact), verbose=False)[0])
    assert results[0] == results[1]
    expected = {"validation/loss"} | ({"validation/error", "validation/divergence"} if method == "tran-vae" else set())
    assert set(results[0]) == expected


def test_the_autoencoder_s_loss_is_error_and_weighted_divergence(compact: Path, tmp_path: Path) -> None:
    module = module_for("tran-vae")
    trainer_for(tmp_path, max_steps=3).fit(module, data_of(compact))
    found = trainer_for(tmp_path).validate(module, data_of(compact), verbose=False)[0]
    assert found["validation/loss"] == pytest.approx(
        found["validation/error"] + 0.01 * found["validation/divergence"], rel=1e-5
    )


def test_the_divergence_is_not_taxed_in_the_beginning(compact: Path) -> None:
    module = module_for("tran-vae")
    module.build(PAPER_WORLD)
    batch = next(iter(data_of(compact).train_dataloader()))
    for training, weight in ((True, 0.0), (False, 0.01)):
        module.train(training)
        loss, parts = module._loss(batch, torch.Generator().manual_seed(0))
        assert loss.item() == pytest.approx((parts["error"] + weight * parts["divergence"]).item())


@pytest.mark.parametrize("method", METHODS)
def test_a_resumed_fit_ends_where_the_uninterrupted_one_does(method: str, compact: Path, tmp_path: Path) -> None:
    def fit(name: str, epochs: int, **options: Any) -> Any:
        module = module_for(method)
        module.optimizer_config = replace(FAST, final=1.0)  # else its course would depend on the end
        trainer = trainer_for(tmp_path, max_epochs=epochs, enable_checkpointing=True)
        trainer.fit(module, data_of(compact), **options)
        trainer.save_checkpoint(tmp_path / name)
        return module.model

    whole, _ = fit("whole.ckpt", 2), fit("half.ckpt", 1)
    resumed = fit("resumed.ckpt", 2, ckpt_path=str(tmp_path / "half.ckpt"))
    pairs = zip(resumed.parameters(), whole.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("method", METHODS)
def test_checkpoint_export_and_module_sample_alike(
    method: str, compact: Path, arrays: StackArrays, tmp_path: Path
) -> None:
    module, data = module_for(method), data_of(compact)
    trainer = trainer_for(tmp_path, max_steps=6, callbacks=[EMA(0.9)], enable_checkpointing=True)
    trainer.fit(module, data)
    trainer.save_checkpoint(tmp_path / "run.ckpt")
    card = export_checkpoint(tmp_path / "run.ckpt", tmp_path / "run.safetensors")
    samplers = [module.sampler(), load_sampler(tmp_path / "run.ckpt"), load_sampler(tmp_path / "run.safetensors")]
    first, *others = (poses_of(sampler, arrays) for sampler in samplers)
    assert all((first == other).all() for other in others)
    exported: Any = samplers[2]
    assert card["kind"] == method == exported.card["kind"] and card["dataset"]["name"] == "towers"
    assert exported.world == module.world == PAPER_WORLD
    mean, std = data.pose_statistics()
    assert module.model.mean.numpy() == pytest.approx(mean, abs=1e-6)
    assert module.model.std.numpy() == pytest.approx(np.maximum(std, 0.05), rel=1e-4)
    with pytest.raises(StackgenError, match="not of a block-list predictor"):
        load_predictor(tmp_path / "run.safetensors")


@pytest.mark.parametrize("method", METHODS)
def test_a_card_that_does_not_fit_is_refused(method: str, tmp_path: Path) -> None:
    from stackgen.models.weights import write_weights

    module = module_for(method)
    module.build(PAPER_WORLD)
    path = tmp_path / "x.safetensors"
    write_weights(path, module.model.state_dict(), module.card())
    for part in ("transformer", "regression"):
        card = {**module.card(), "config": {**module.config, part: {"nonsense": 1}}}
        write_weights(path, module.model.state_dict(), card)
        with pytest.raises(StackgenError, match="do not fit together"):
            load_sampler(path)


def test_one_baseline_s_checkpoint_is_not_the_other_s(compact: Path, tmp_path: Path) -> None:
    trainer = trainer_for(tmp_path, max_steps=1, enable_checkpointing=True)
    trainer.fit(module_for("tran-reg"), data_of(compact))
    trainer.save_checkpoint(tmp_path / "reg.ckpt")
    with pytest.raises(StackgenError, match="not one of a TranVAE"):
        trainer_for(tmp_path, max_steps=2).fit(
            module_for("tran-vae"), data_of(compact), ckpt_path=str(tmp_path / "reg.ckpt")
        )


# From the command line.


@pytest.mark.parametrize("method", METHODS)
def test_fit_test_and_sample_from_the_command_line(
    method: str, cli: Cli, compact: Path, tiny: TinyWeights, tower_image: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "disabled")
    options = yaml.safe_load((CONFIGS / "baselines" / f"{method}.yaml").read_text())
    options["model"]["init_args"]["transformer"] |= {"width": 16, "heads": 2, "feedforward": 32}
    options["trainer"] |= {"max_steps": 2, "enable_progress_bar": False, "enable_model_summary": False}
    options["trainer"]["callbacks"][-1]["init_args"]["every_n_train_steps"] = 2
    Path("short.yaml").write_text(yaml.safe_dump(options))
    answer = cli("fit", "--config", "short.yaml", "--data.path", compact)
    assert answer.code == 0, answer.err
    checkpoint = last_checkpoint(Path("runs") / method)
    lists = ["--block_list_weights", tiny.predictor]
    answer = cli("test", "--weights", checkpoint, *lists, "--test_set", compact, "--name", method)
    assert answer.code == 0, answer.err
    rows = json.loads(Path(f"runs/{method}/test_0/metrics.json").read_text())["rows"]
    assert len(rows) == 3  # true list, predicted list, ground truth
    assert cli("export", f"runs/{method}", "--out", "weights.safetensors").code == 0
    given = ["--weights", "weights.safetensors", "--blocks", "cube=3", "--out", "out"]
    answer = cli("sample", tower_image, *given)
    assert answer.code == 0, answer.err
    assert len(json.loads(Path("out/stacks.json").read_text())["stacks"]) == 3


# The configurations.


def settings(folder: str, name: str) -> dict[str, Any]:
    return yaml.safe_load((CONFIGS / folder / f"{name}.yaml").read_text())


def test_the_paper_s_baselines_are_as_large_as_its_denoiser() -> None:
    denoiser = TransformerConfig(**settings("model", "ddpm-paper")["model"]["init_args"]["denoiser"])
    assert denoiser == TransformerConfig()
    for method in METHODS:
        options = settings("baselines", f"{method}-paper")
        assert TransformerConfig(**options["model"]["init_args"]["transformer"]) == denoiser
        assert options["data"] == settings("model", "ddpm-paper")["data"]
        assert options["trainer"]["max_epochs"] == settings("model", "ddpm-paper")["trainer"]["max_epochs"]


def test_only_the_generative_part_differs_at_the_small_size() -> None:
    ours = settings("model", "ddpm-small")
    # Feeding the last estimate back is a part of generating in steps.
    denoiser = replace(TransformerConfig(**ours["model"]["init_args"]["denoiser"]), self_conditioning=False)
    for method in METHODS:
        options = settings("baselines", method)
        given = options["model"]["init_args"]
        assert TransformerConfig(**given["transformer"]) == denoiser
        assert given["regression"]["least_std"] == ours["model"]["init_args"]["diffusion"]["least_std"]
        assert options["data"] == ours["data"] and options["trainer"]["callbacks"] == ours["trainer"]["callbacks"]


def test_the_small_rows_see_as_many_samples() -> None:
    rows = [settings("baselines", method) for method in METHODS] + [settings("model", "ddpm-paper-small")]
    assert len({(row["data"]["batch_size"], row["trainer"]["max_steps"]) for row in rows}) == 1


def test_the_small_paper_recipe_is_the_paper_s_but_for_its_size() -> None:
    small, paper = (settings("model", name)["model"]["init_args"] for name in ("ddpm-paper-small", "ddpm-paper"))
    size = {"width": 128, "heads": 4, "feedforward": 512}
    assert {**paper["denoiser"], **size} == small["denoiser"]
    assert paper["schedule"] == small["schedule"] and paper["diffusion"] == small["diffusion"]
    assert "draws" not in small and "mirror" not in settings("model", "ddpm-paper-small")["data"]


def test_the_small_networks_are_about_as_large() -> None:
    ours = settings("model", "ddpm-small")["model"]["init_args"]["denoiser"]
    size = sum(p.numel() for p in Denoiser(TransformerConfig(**ours), PAPER_WORLD).parameters())
    for method in METHODS:
        given = settings("baselines", method)["model"]["init_args"]
        transformer, regression = TransformerConfig(**given["transformer"]), RegressionConfig(**given["regression"])
        network = (
            TranRegNetwork(transformer, regression, PAPER_WORLD)
            if method == "tran-reg"
            else TranVAENetwork(transformer, regression, VAEConfig(**given["vae"]), PAPER_WORLD)
        )
        assert sum(p.numel() for p in network.parameters()) == pytest.approx(size, rel=0.1)
