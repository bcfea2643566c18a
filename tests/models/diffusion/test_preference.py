"""Fine-tuning on verdicts: pairs are what they say, the network comes to prefer what stands, a fit resumes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from stackgen._lightning import pl
from stackgen.data.arrays import StackArrays
from stackgen.data.datamodule import StackDataModule
from stackgen.data.preferences import Preferences, prefer
from stackgen.errors import StackgenError
from stackgen.models.diffusion.preference import VerdictTuning
from stackgen.models.diffusion.sampler import DiffusionSampler
from stackgen.models.optimization import OptimizerConfig
from stackgen.protocols import StabilityChecker, Verdict
from stackgen.sampling.methods import load_sampler
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD, Mask
from tests.conftest import Cli, TinyWeights
from tests.models.conftest import TINY_CROSS, trainer_for

pytestmark = pytest.mark.filterwarnings("ignore")


class EveryThirdFails:
    """Knows the truth of each scene, and gives it; every third sample comes one cell too high."""

    world = PAPER_WORLD
    settings: Mapping[str, Any] = {}
    card: Mapping[str, Any] = {}

    def __init__(self, stacks: StackArrays) -> None:
        self.truths = {stacks.images([i]).tobytes(): i for i in range(len(stacks))}
        self.stacks = stacks

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """(B, num_samples) stacks."""
        return [[self._sample(mask, n) for n in range(num_samples)] for mask in silhouettes]

    def _sample(self, mask: Mask, number: int) -> Stack:
        row = self.truths[mask[None].tobytes()]
        k = self.stacks.lengths[row]
        order = np.argsort(self.stacks.shapes[row, :k], kind="stable")
        lifted = np.array([0, 0, float(number % 3 == 2), 0, 0, 0])
        return Stack(self.stacks.shapes[row, order], self.stacks.poses[row, order] + lifted)


class OnTheGround(StabilityChecker):
    """Stable is what touches the ground."""

    physics = Physics()

    def check(self, stack: Stack) -> Verdict:
        """Give the verdict on one stack."""
        stable = bool(stack.poses[:, 2].min() < 0.9)
        return Verdict(stable, np.full(len(stack), not stable), np.zeros(len(stack)), stack)


@pytest.fixture(scope="module")
def pairs(arrays: StackArrays) -> Preferences:
    return prefer(EveryThirdFails(arrays), OnTheGround(), arrays, num_samples=3, iou=0.9)


def test_each_failure_is_paired_with_a_success_of_its_scene(arrays: StackArrays, pairs: Preferences) -> None:
    assert len(pairs) == len(arrays)  # one of three samples of each scene
    real = pairs.better.shapes != 255
    lifted = (pairs.worse.poses - pairs.better.poses)[..., 2]
    assert lifted[real] == pytest.approx(1.0) and (lifted[~real] == 0).all()
    for row in range(len(pairs)):  # the stacks and the picture are of one scene
        scene = np.flatnonzero((arrays.silhouettes == pairs.better.silhouettes[row]).all(axis=1))[0]
        assert (np.sort(arrays.shapes[scene]) == pairs.better.shapes[row]).all()


def test_a_drawing_is_matched_as_well_as_its_own_stack_matches_it(arrays: StackArrays) -> None:
    taller = np.roll(arrays.images(), -7, axis=1) | arrays.images()  # by half a cell, which no stack of these can be
    drawings = replace(arrays, silhouettes=np.packbits(taller.reshape(len(taller), -1), axis=1))
    pairs = prefer(EveryThirdFails(drawings), OnTheGround(), drawings, num_samples=3, iou=0.95)
    assert len(pairs) == len(drawings)  # the lifted ones alone have failed


def test_pairs_come_back_from_a_file(pairs: Preferences, tmp_path: Path) -> None:
    pairs.save(tmp_path / "pairs.npz")
    again = Preferences.load(tmp_path / "pairs.npz")
    for side in ("better", "worse"):
        for name in ("shapes", "poses", "silhouettes", "template"):
            assert np.array_equal(getattr(getattr(again, side), name), getattr(getattr(pairs, side), name))
    assert [path.name for path in tmp_path.iterdir()] == ["pairs.npz"]


def test_no_failure_no_pairs(arrays: StackArrays) -> None:
    with pytest.raises(StackgenError, match="nothing to learn"):
        prefer(EveryThirdFails(arrays), OnTheGround(), arrays, num_samples=2)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 nonsense", None])
def test_a_foreign_file_is_named_in_one_line(content: bytes | None, compact: Path, tmp_path: Path) -> None:
    path = compact if content is None else tmp_path / "x.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(StackgenError, match=r"^[^\n]*is not a file of preferences: make one with `stackgen prefer`$"):
        Preferences.load(path)


def module_for(path: Path, **options: Any) -> VerdictTuning:
    pl.seed_everything(0, verbose=False)
    return VerdictTuning(
        str(path),
        denoiser=TINY_CROSS,
        optimizer=OptimizerConfig(learning_rate=3e-3, warmup=1),
        **{"pairs": 16, **options},
    )


def data_of(compact: Path) -> StackDataModule:
    return StackDataModule(compact, batch_size=8, bucket_by_blocks=True, mirror=True)


def test_the_network_comes_to_prefer_what_stands(pairs: Preferences, compact: Path, tmp_path: Path) -> None:
    pairs.save(tmp_path / "pairs.npz")
    module = module_for(tmp_path / "pairs.npz", beta=100.0)
    seen: list[tuple[float, float]] = []

    class Watch(pl.Callback):
        def on_train_batch_end(self, trainer: pl.Trainer, *rest: Any) -> None:
            logged = trainer.callback_metrics
            seen.append((float(logged["train/preference_loss"]), float(logged["train/preferred"])))

    trainer_for(tmp_path, max_steps=60, callbacks=[Watch()]).fit(module, data_of(compact))
    losses, preferred = np.array(seen).T
    assert losses[0] == pytest.approx(np.log(2), abs=1e-5)  # it begins as its own reference
    assert losses[-10:].mean() < 0.6 and preferred[-10:].mean() > 0.8


def test_a_resumed_fit_is_the_undisturbed_one(pairs: Preferences, compact: Path, tmp_path: Path) -> None:
    """The network is measured against what it was at the beginning, also after a resume."""
    pairs.save(tmp_path / "pairs.npz")

    class SaveOnTheWay(pl.Callback):
        def on_train_batch_end(self, trainer: pl.Trainer, *rest: Any) -> None:
            if trainer.global_step == 3:
                trainer.save_checkpoint(tmp_path / "half.ckpt")

    whole, resumed = module_for(tmp_path / "pairs.npz"), module_for(tmp_path / "pairs.npz")
    trainer_for(tmp_path, max_steps=6, callbacks=[SaveOnTheWay()]).fit(whole, data_of(compact))
    trainer_for(tmp_path, max_steps=6).fit(resumed, data_of(compact), ckpt_path=str(tmp_path / "half.ckpt"))
    for name, tensor in whole.model.state_dict().items():
        assert torch.equal(tensor, resumed.model.state_dict()[name]), name


def test_its_checkpoints_are_those_of_a_ddpm(pairs: Preferences, compact: Path, tmp_path: Path) -> None:
    pairs.save(tmp_path / "pairs.npz")
    trainer = trainer_for(tmp_path, max_steps=1)
    trainer.fit(module_for(tmp_path / "pairs.npz"), data_of(compact))
    trainer.save_checkpoint(tmp_path / "x.ckpt")
    assert isinstance(load_sampler(tmp_path / "x.ckpt"), DiffusionSampler)


def test_prefer_writes_pairs_of_a_model_s_own_failures(
    cli: Cli, tiny: TinyWeights, towers_dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "verdicts.npz"
    command = ("prefer", "--data", towers_dataset, "--weights", tiny.sampler, "--scenes", 4, "--workers", 1)
    answer = cli(*command, "--num_samples", 1, "--out", out)
    assert answer.code == 0, answer.err
    assert len(Preferences.load(out)) == 4  # an untrained network gets nothing right
    assert cli(*command, "--out", tmp_path / "verdicts.txt").line.endswith("not verdicts.txt")
