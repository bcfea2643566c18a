"""Training the diffusion model: what a fit leaves behind samples alike in every form, and a killed fit goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from stackgen._lightning import pl
from stackgen.data.arrays import StackArrays
from stackgen.data.datamodule import StackDataModule
from stackgen.errors import StackgenError
from stackgen.models.diffusion.module import DDPM
from stackgen.models.diffusion.network import DiffusionConfig
from stackgen.models.diffusion.schedules import ScheduleConfig
from stackgen.models.optimization import OptimizerConfig
from stackgen.models.transformer import TransformerConfig
from stackgen.models.weights import export_checkpoint
from stackgen.protocols import StackSampler
from stackgen.sampling.methods import load_sampler
from stackgen.training.callbacks import EMA, RAW_WEIGHTS
from stackgen.world import PAPER_WORLD
from tests.conftest import CHILD
from tests.models.conftest import TINY, TINY_CROSS, trainer_for

pytestmark = pytest.mark.filterwarnings("ignore")

FAST = OptimizerConfig(learning_rate=3e-3, warmup=2)


def module_for(denoiser: TransformerConfig = TINY_CROSS, **options: Any) -> DDPM:
    pl.seed_everything(0, verbose=False)
    return DDPM(denoiser, ScheduleConfig(), DiffusionConfig(prediction="v"), FAST, **options)


def data_of(path: Path, **options: Any) -> StackDataModule:
    return StackDataModule(path, **{"batch_size": 8, "bucket_by_blocks": True, "mirror": True, **options})


def poses_of(sampler: StackSampler, arrays: StackArrays) -> np.ndarray:
    scenes = sampler.sample_batch(arrays.images(range(3)), arrays.counts[:3], 2, seed=7)
    return np.concatenate([stack.poses for scene in scenes for stack in scene])


@pytest.mark.parametrize("denoiser", [TINY, TINY_CROSS], ids=["paper", "cross"])
def test_training_lowers_the_loss(denoiser: TransformerConfig, compact: Path, tmp_path: Path) -> None:
    module, data = module_for(denoiser, draws=4), data_of(compact)
    trainer = trainer_for(tmp_path, max_steps=1)
    trainer.fit(module, data)
    before = trainer.validate(module, data, verbose=False)[0]["validation/loss"]
    trainer_for(tmp_path, max_steps=80).fit(module, data)
    after = trainer_for(tmp_path).validate(module, data, verbose=False)[0]["validation/loss"]
    assert after < 0.85 * before


def test_validation_says_the_same_every_time(compact: Path, tmp_path: Path) -> None:
    module, data = module_for(), data_of(compact)
    trainer_for(tmp_path, max_steps=2).fit(module, data)
    first, second = (trainer_for(tmp_path).validate(module, data, verbose=False)[0] for _ in range(2))
    assert first == second
    assert {f"validation/loss_t{q}of4" for q in range(1, 5)} & set(first)


def test_poses_are_normalised_by_the_training_data_s_statistics(compact: Path, tmp_path: Path) -> None:
    """Also where averages of the weights are kept: statistics are no average of themselves and a beginning."""
    module, data = module_for(), data_of(compact)
    trainer_for(tmp_path, max_steps=2, callbacks=[EMA(0.99, warmup=False)]).fit(module, data)
    mean, std = data.pose_statistics()
    assert module.model.mean.numpy() == pytest.approx(mean, abs=1e-6)
    assert module.model.std.numpy() == pytest.approx(np.maximum(std, 1e-6), rel=1e-4)


def test_checkpoint_export_and_module_sample_alike(compact: Path, arrays: StackArrays, tmp_path: Path) -> None:
    module, data = module_for(), data_of(compact)
    trainer = trainer_for(tmp_path, max_steps=6, callbacks=[EMA(0.9)], enable_checkpointing=True)
    trainer.fit(module, data)
    trainer.save_checkpoint(tmp_path / "run.ckpt")
    card = export_checkpoint(tmp_path / "run.ckpt", tmp_path / "run.safetensors", {"stability": 0.5})
    samplers = [module.sampler(), load_sampler(tmp_path / "run.ckpt"), load_sampler(tmp_path / "run.safetensors")]
    first, *others = (poses_of(sampler, arrays) for sampler in samplers)
    assert all((first == other).all() for other in others)
    exported: Any = samplers[2]
    assert exported.card["metrics"] == {"stability": 0.5} and exported.card["trained"]["steps"] == 6
    assert exported.card["dataset"]["name"] == "small" == card["dataset"]["name"]
    assert exported.world == module.world == PAPER_WORLD


def test_a_checkpoint_samples_with_the_average(compact: Path, arrays: StackArrays, tmp_path: Path) -> None:
    module = module_for()
    trainer = trainer_for(tmp_path, max_steps=6, callbacks=[EMA(0.9)], enable_checkpointing=True)
    trainer.fit(module, data_of(compact))
    trainer.save_checkpoint(tmp_path / "run.ckpt")
    content = torch.load(tmp_path / "run.ckpt", weights_only=True)
    average = poses_of(load_sampler(tmp_path / "run.ckpt"), arrays)
    content["state_dict"] = {**content["state_dict"], **content[RAW_WEIGHTS]}
    torch.save(content, tmp_path / "raw.ckpt")
    assert (poses_of(load_sampler(tmp_path / "raw.ckpt"), arrays) != average).any()


def test_sampling_in_the_middle_of_a_training_leaves_it_training(compact: Path, tmp_path: Path) -> None:
    module = module_for()
    trainer_for(tmp_path, max_steps=1).fit(module, data_of(compact))
    module.train()
    module.sampler()
    assert module.model.training
    module.eval()
    module.sampler()
    assert not module.model.training


def test_the_world_comes_from_the_data(tmp_path: Path, compact: Path) -> None:
    module, data = module_for(), data_of(compact)
    assert not hasattr(module, "model") and module.dataset is None
    trainer_for(tmp_path, max_steps=1).fit(module, data)
    card = module.card()
    assert card["kind"] == "ddpm" and card["max_blocks"] == 10
    assert card["catalogue"] == data.world.catalogue.to_json() and card["grid"] == vars(data.world.grid)
    assert len(card["dataset"]["sha256"]) == 64 and card["dataset"]["physics"] == {"engine": "none"}


@pytest.mark.parametrize("content", [{}, {"stackgen": {"kind": "blocklist"}}, {"stackgen": 3}])
def test_a_foreign_checkpoint_is_one_line(content: dict[str, Any]) -> None:
    with pytest.raises(StackgenError, match="not one of a DDPM"):
        module_for().on_load_checkpoint(content)


# Cut off and resumed.


class Cut(pl.Callback):
    """Ends the fit the hard way, right after a checkpoint was written."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_end(self, trainer: pl.Trainer, *rest: Any) -> None:
        if trainer.global_step == self.step:
            raise RuntimeError("cut")


def fit(
    compact: Path, folder: Path, callbacks: tuple[pl.Callback, ...] = (), resume: Path | None = None, steps: int = 14
) -> DDPM:
    """Some epochs of four batches, with everything that has a state."""
    module = module_for(draws=2)
    checkpoints = pl.callbacks.ModelCheckpoint(folder, every_n_train_steps=3, save_last=True)
    callbacks = (EMA(0.9), checkpoints, *callbacks)
    trainer = trainer_for(folder, max_steps=steps, callbacks=list(callbacks), enable_checkpointing=True)
    trainer.fit(module, data_of(compact), ckpt_path=resume)
    return module


def test_a_resumed_fit_is_the_uninterrupted_one(compact: Path, tmp_path: Path) -> None:
    """In the middle of an epoch: weights, averages, course of the learning rate, batches and noise, all go on."""
    whole = fit(compact, tmp_path / "whole")
    with pytest.raises(RuntimeError, match="cut"):
        fit(compact, tmp_path / "cut", (Cut(7),))
    assert torch.load(tmp_path / "cut" / "last.ckpt", weights_only=True)["global_step"] == 6
    torch.rand(5)
    resumed = fit(compact, tmp_path / "cut", resume=tmp_path / "cut" / "last.ckpt")
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, resumed.state_dict()[name]), name


def test_the_noise_of_a_step_is_its_own(compact: Path, tmp_path: Path) -> None:
    module = module_for()
    trainer_for(tmp_path, max_steps=1).fit(module, data_of(compact))

    def noise(index: int) -> float:
        return float(torch.rand(1, generator=module.generator_of_step(index, torch.device("cpu"))))

    assert noise(3) == noise(3) != noise(4)
    first = noise(3)
    torch.manual_seed(1)
    assert noise(3) != first


@pytest.mark.slow
def test_a_killed_fit_goes_on_to_the_same_weights(compact: Path, tmp_path: Path) -> None:
    steps = 400
    whole = fit(compact, tmp_path / "whole", steps=steps)
    script = tmp_path / "run.py"
    script.write_text(
        f"import torch; torch.set_num_threads({torch.get_num_threads()})  # others round otherwise\n"
        "from pathlib import Path; from tests.models.diffusion.test_module import fit\n"
        f"fit(Path({str(compact)!r}), Path({str(tmp_path / 'killed')!r}), steps={steps})\n"
    )
    process = subprocess.Popen([sys.executable, str(script)], env=CHILD)
    last = tmp_path / "killed" / "last.ckpt"
    while not last.exists():
        assert process.poll() is None
        time.sleep(0.01)
    time.sleep(0.5)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert 0 < torch.load(last, weights_only=True)["global_step"] < steps
    resumed = fit(compact, tmp_path / "killed", resume=last, steps=steps)
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, resumed.state_dict()[name]), name
