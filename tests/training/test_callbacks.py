"""Averaged weights, sample quality and throughput under a real trainer."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from stackgen._lightning import pl
from stackgen.data.arrays import Batch, StackArrays
from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.protocols import StabilityChecker, Verdict
from stackgen.sim.physics import Physics
from stackgen.stack import Stack, shapes_of
from stackgen.training.callbacks import EMA, RAW_WEIGHTS, Compile, SampleQuality, StepMetrics, Throughput
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Mask

pytestmark = pytest.mark.filterwarnings("ignore")


class Module(pl.LightningModule):
    """One weight that goes up by 1 with each step, and what there was to see of it."""

    running: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(2))
        self.register_buffer("running", torch.zeros(1))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))
        self.validated: list[float] = []
        self.tested: list[float] = []
        self.trained: list[float] = []

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        self.trained.append(float(self.weight[0]))
        self.running += 1
        self.count += 1
        return -self.weight.sum()

    def validation_step(self, batch: Any, batch_idx: int) -> None:
        self.validated.append(float(self.weight[0]))

    def test_step(self, batch: Any, batch_idx: int) -> None:
        self.tested.append(float(self.weight[0]))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=1.0)


def trainer_for(folder: Path, callbacks: list[pl.Callback], **options: Any) -> pl.Trainer:
    settings = {
        "max_epochs": 1, "accelerator": "cpu", "logger": False, "enable_progress_bar": False,
        "enable_model_summary": False, "enable_checkpointing": False, "num_sanity_val_steps": 0,
    }  # fmt: skip
    return pl.Trainer(default_root_dir=folder, callbacks=callbacks, **{**settings, **options})


def loader(those: list[Batch]) -> DataLoader[Any]:
    return DataLoader(cast(Any, those), batch_size=None)


def batches(count: int) -> DataLoader[Any]:
    return loader([{"mask": torch.ones(3)} for _ in range(count)])


def averages(weights: list[float], decay: float, warmup: bool) -> list[float]:
    """The average after each update, as a loop, starting at weight 0."""
    found, average = [], 0.0
    for t, weight in enumerate(weights):
        d = min(decay, (1 + t) / (10 + t)) if warmup else decay
        average = d * average + (1 - d) * weight
        found.append(average)
    return found


@pytest.mark.parametrize("warmup", [False, True])
def test_the_average_is_its_closed_form_and_stays_in_the_module(tmp_path: Path, warmup: bool) -> None:
    steps, decay, module = 12, 0.8, Module()
    trainer_for(tmp_path, [EMA(decay, warmup)]).fit(module, batches(steps))
    expected = averages([float(t) for t in range(1, steps + 1)], decay, warmup)[-1]
    if not warmup:  # of weights 1, 2, ..., n: n - (1 - d^n) d / (1 - d)
        assert expected == pytest.approx(steps - (1 - decay**steps) * decay / (1 - decay))
    assert module.trained == list(range(steps))  # training never saw the average
    assert module.weight.tolist() == pytest.approx([expected, expected], rel=1e-5)
    assert float(module.running) == pytest.approx(expected, rel=1e-5)  # buffers of numbers are averaged too
    assert int(module.count) == steps  # counters are not


def test_validation_and_test_see_the_average_and_training_goes_on_with_its_own(tmp_path: Path) -> None:
    module = Module()
    trainer = trainer_for(tmp_path, [EMA(0.5, warmup=False)], max_epochs=3)
    trainer.fit(module, batches(4), batches(1))
    expected = averages([float(t) for t in range(1, 13)], 0.5, warmup=False)
    assert module.validated == pytest.approx([expected[3], expected[7], expected[11]], rel=1e-5)
    assert module.trained == list(range(12))
    trainer.test(module, batches(1), verbose=False)
    assert module.tested == pytest.approx([expected[-1]], rel=1e-5)


def test_accumulated_gradients_are_one_update(tmp_path: Path) -> None:
    ema, module = EMA(0.5, warmup=False), Module()
    trainer_for(tmp_path, [ema], accumulate_grad_batches=4).fit(module, batches(8))
    assert ema.updates == 2


class Layer(torch.nn.Linear):
    """Code of ours: torch.compile leaves PyTorch's own layers to those who call them."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x).tanh()


class Layered(Module):
    """A part to be compiled."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = Layer(2, 2)

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        return self.layer(self.weight).square().sum()

    def validation_step(self, batch: Any, batch_idx: int) -> None:
        self.compiled_before = frames()
        self.layer(self.weight.repeat(5, 1))
        self.compiled_after = frames()


def frames() -> int:
    """Pieces of code that torch.compile has taken up in this process."""
    return torch._dynamo.utils.counters["frames"]["ok"]


def test_compiled_parts_train_as_they_would_and_keep_their_names(tmp_path: Path) -> None:
    found, ways = [], list[list[pl.Callback]]([[], [Compile(["layer"], backend="eager")]])
    for callbacks in ways:
        torch.manual_seed(0)
        module, before = Layered(), frames()
        trainer_for(tmp_path, callbacks).fit(module, batches(4), batches(1))
        found.append((module.state_dict(), frames() - before))
        assert module.compiled_before == module.compiled_after  # validation runs as written
    (plain, none), (compiled, some) = found
    assert none == 0 < some
    assert list(plain) == list(compiled)
    assert all(torch.equal(plain[name], compiled[name]) for name in plain)


def test_a_part_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(StackgenError, match=r"Layered has no part 'model.denoiser'; try layer"):
        trainer_for(tmp_path, [Compile()]).fit(Layered(), batches(1))


def test_checkpoints_hold_the_average_and_a_resumed_fit_is_the_uninterrupted_one(tmp_path: Path) -> None:
    whole, first, second = Module(), Module(), Module()
    trainer_for(tmp_path, [EMA(0.9)], max_epochs=4).fit(whole, batches(5), batches(1))
    checkpoint = pl.callbacks.ModelCheckpoint(tmp_path, save_last=True)
    trainer_for(tmp_path, [EMA(0.9), checkpoint], max_epochs=2, enable_checkpointing=True).fit(
        first, batches(5), batches(1)
    )
    content = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert torch.equal(content["state_dict"]["weight"], first.weight.detach())
    assert content[RAW_WEIGHTS]["weight"].tolist() == [10, 10]
    trainer_for(tmp_path, [EMA(0.9)], max_epochs=4).fit(
        second, batches(5), batches(1), ckpt_path=tmp_path / "last.ckpt"
    )
    assert second.trained == list(range(10, 20))
    assert torch.equal(second.weight, whole.weight) and torch.equal(second.running, whole.running)
    tested = Module()
    trainer_for(tmp_path, [EMA(0.9)]).test(tested, batches(1), ckpt_path=tmp_path / "last.ckpt", verbose=False)
    assert tested.tested == [float(first.weight[0])]


def test_a_checkpoint_saved_during_validation_is_the_same(tmp_path: Path) -> None:
    class Saver(pl.Callback):
        def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            trainer.save_checkpoint(tmp_path / "inside.ckpt")

    module = Module()
    checkpoint = pl.callbacks.ModelCheckpoint(tmp_path, save_last=True)
    trainer_for(tmp_path, [EMA(0.9), Saver(), checkpoint], enable_checkpointing=True).fit(
        module, batches(5), batches(1)
    )
    inside, after = (torch.load(tmp_path / name, weights_only=True) for name in ("inside.ckpt", "last.ckpt"))
    for key in ("state_dict", RAW_WEIGHTS):
        assert all(torch.equal(inside[key][name], after[key][name]) for name in after[key])


def test_an_impossible_decay_is_one_line() -> None:
    with pytest.raises(StackgenError, match=r"decay must lie in \[0, 1\)"):
        EMA(1.0)


class Row:
    """A sampler that puts the blocks side by side, the first sample of each scene in the air."""

    world, settings, card = PAPER_WORLD, dict[str, Any](), dict[str, Any]()

    def __init__(self) -> None:
        self.asked: list[tuple[int, int, int]] = []

    def sample_batch(self, silhouettes: Mask, counts: np.ndarray, num_samples: int, seed: int) -> list[list[Stack]]:
        self.asked.append((len(silhouettes), num_samples, seed))
        stacks = []
        for c in counts:
            shapes = shapes_of(c)
            poses = np.zeros((len(shapes), 6))
            poses[:, 0], poses[:, 2] = np.arange(len(shapes)), 0.5
            stacks.append([Stack(shapes, poses + np.array([0, 0, j == 0, 0, 0, 0])) for j in range(num_samples)])
        return stacks


class Floor(StabilityChecker):
    """A checker by which everything above the ground falls."""

    physics = Physics()

    def check(self, stack: Stack) -> Verdict:
        fell = stack.poses[:, 2] > 1
        return Verdict(not fell.any(), fell, fell.astype(float), stack)


class Sampling(Module):
    """A module that has a sampler."""

    def __init__(self) -> None:
        super().__init__()
        self.row = Row()

    def sampler(self) -> Row:
        return self.row


def one_cube_scenes(count: int) -> StackArrays:
    poses = np.zeros((count, 10, 6), np.float32)
    poses[:, 0, 2] = 0.5
    shapes = np.full((count, 10), 255, np.uint8)
    shapes[:, 0] = 0
    image = np.packbits(silhouette(Stack(np.array([0]), np.array([[0, 0, 0.5, 0, 0, 0]])), PAPER_GRID))
    return StackArrays(shapes, poses, np.tile(image, (count, 1)), np.arange(count), len(PAPER_CATALOGUE))


def scene_batches(arrays: StackArrays, size: int) -> DataLoader[Any]:
    return loader([arrays.batch(i) for i in np.array_split(np.arange(len(arrays)), size)])


@pytest.mark.parametrize("checker", [Floor(), None])
def test_sample_quality_is_logged_every_n_epochs_with_the_same_noise(tmp_path: Path, checker: Floor | None) -> None:
    module = Sampling()
    quality = SampleQuality(every_n_epochs=2, num_scenes=5, num_samples=2, checker=checker)
    trainer = trainer_for(tmp_path, [quality], max_epochs=4, num_sanity_val_steps=1)
    trainer.fit(module, batches(2), scene_batches(one_cube_scenes(8), 3))
    assert [asked[:2] for asked in module.row.asked] == [(5, 2), (5, 2)]  # of epochs 2 and 4
    assert len({asked[2] for asked in module.row.asked}) == 1
    logged = {n.partition("/")[2]: float(v) for n, v in trainer.callback_metrics.items() if n.startswith("sample/")}
    assert logged.pop("stacks_per_second") > 0
    assert logged["diversity"] == 1  # on the ground and a layer up
    if checker is None:
        assert set(logged) == {"diversity", "front_iou_before_physics"}
    else:
        assert logged["stability"] == logged["front_iou"] == logged["avg_iou"] == logged["valid_diversity"] == 0.5
        assert logged["iou_given_stable"] == 1


def test_throughput_counts_the_samples_of_training(tmp_path: Path) -> None:
    trainer = trainer_for(tmp_path, [Throughput(every_n_steps=4)])
    trainer.fit(Module(), batches(9))
    assert float(trainer.callback_metrics["train/samples_per_second"]) > 3


def test_the_norm_is_that_of_all_gradients_before_they_are_clipped(tmp_path: Path) -> None:
    trainer = trainer_for(tmp_path, [StepMetrics(every_n_steps=1)], gradient_clip_val=0.1)
    trainer.fit(Module(), batches(3))
    metrics = trainer.callback_metrics
    assert float(metrics["train/gradient_norm"]) == pytest.approx(2**0.5)  # of a loss -(w1 + w2)
    assert float(metrics["train/learning_rate"]) == 1.0
    with pytest.raises(StackgenError, match="at least 1"):
        StepMetrics(0)
