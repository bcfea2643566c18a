"""The one way data reaches training: batches from memory, or streamed from shards.

The whole of a paper-sized dataset is 150 MB as arrays, so it is held in memory (on the accelerator,
where there is one) and batches are gathered there; streaming is for what does not fit.
What a batch holds: :meth:`stackgen.data.arrays.StackTensors.batch`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from stackgen._lightning import pl
from stackgen.data.arrays import Batch, StackArrays
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.data.decoding import SkipLog, bytes_per_sample, read_decoded
from stackgen.data.loading.cached import CachedLoader
from stackgen.data.loading.epochs import Epochs
from stackgen.data.manifest import Manifest, Split
from stackgen.errors import StackgenError
from stackgen.world import World

STATISTICS_SHARDS = 8
"""Shards, spread over the split, from which a stream learns the scale of the poses."""


class StackDataModule(pl.LightningDataModule):
    """Training, validation and test data of one dataset, or of several that are joined.

    Args:
        path: Dataset folder or compact `.npz` file; also behind a URL (`s3://`, `https://`, ...) or a command
            (`pipe:ssh host cat data/{file}`). Of a list of them, of one world, all samples are seen alike.
        batch_size: Number of samples in a batch, on each process.
        mode: Source of the batches: `cached` holds the splits in memory, `stream` reads shards as it goes, `auto`
            caches what takes no more than `cache_gb`.
        cache_gb: Memory for the training and validation split together, on each process [GB].
        num_workers: Number of processes that read a stream, beside each training process.
        bucket_by_blocks: Whether a training batch holds stacks with one number of blocks (nearly one, where they are
            streamed), padding trimmed.
        mirror: Whether to reflect training samples at x = 0 half of the time.
        samples_per_epoch: Number of training samples in an epoch, over all processes; by default all that there are.
        eval_batch_size: Batch size of validation and test; by default `batch_size`.
        test_path: Dataset of the test split; by default the frozen `testset-v1`.
        seed: Seed of shuffling and reflections.

    Raises:
        StackgenError: If the options do not fit each other.
    """

    def __init__(
        self,
        path: str | Path | list[str],
        batch_size: int = 256,
        mode: Literal["auto", "cached", "stream"] = "auto",
        cache_gb: float = 2.0,
        num_workers: int = 0,
        bucket_by_blocks: bool = False,
        mirror: bool = False,
        samples_per_epoch: int | None = None,
        eval_batch_size: int | None = None,
        test_path: str | Path | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if batch_size < 1 or (eval_batch_size or 1) < 1 or (samples_per_epoch or 1) < 1:
            raise StackgenError("data: batch_size, eval_batch_size and samples_per_epoch must be at least 1")
        if num_workers < 0 or cache_gb < 0:
            raise StackgenError("data: num_workers and cache_gb must not be negative")
        if mode == "cached" and num_workers:
            raise StackgenError("data: num_workers is for mode stream; cached batches need no worker")
        paths = path if isinstance(path, list) else [path]
        if not paths:
            raise StackgenError("data: path must name at least one dataset")
        self.paths, self.test_path = [str(one) for one in paths], str(test_path or TESTSET)
        self.batch_size, self.eval_batch_size = batch_size, eval_batch_size or batch_size
        self.mode, self.cache_gb, self.num_workers, self.seed = mode, cache_gb, num_workers, seed
        self.bucket_by_blocks, self.mirror, self.samples_per_epoch = bucket_by_blocks, mirror, samples_per_epoch
        self._datasets: dict[str, Dataset] = {}
        self._joined: Dataset | None = None
        self._training: Epochs | None = None
        self._resume: dict[str, Any] | None = None

    @property
    def dataset(self) -> Dataset:
        """The dataset of the training and validation split."""
        if self._joined is None:
            self._joined = Dataset.join([self._open(path) for path in self.paths])
        return self._joined

    @property
    def test_dataset(self) -> Dataset:
        """The dataset of the test split."""
        return self._open(self.test_path)

    @property
    def manifest(self) -> Manifest:
        """The dataset's manifest."""
        return self.dataset.manifest

    @property
    def world(self) -> World:
        """Shapes, grid and longest block list of the dataset."""
        return self.dataset.world

    def pose_statistics(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Compute mean (6,) and standard deviation (6,) of the training poses; when streaming, of a few shards'."""
        if self.is_cached("train"):
            return self.split("train").pose_statistics(self.mirror)
        shards, log = self.dataset.shards("train"), SkipLog()
        parts = []
        for number in np.unique(np.linspace(0, len(shards) - 1, STATISTICS_SHARDS).astype(int)):
            decoded, skipped = read_decoded(shards[number], self.world)
            log.add(skipped)
            parts.append(decoded.stacks)
        arrays = StackArrays.concatenate(parts)
        if not len(arrays):
            raise StackgenError(f"data: none of {len(parts)} training shards of {self.dataset.path} can be read")
        return arrays.pose_statistics(self.mirror)

    def is_cached(self, split: Split) -> bool:
        """Tell whether a split is held in memory; the same on every process and machine."""
        dataset = self._of(split)
        if self.mode == "cached" or dataset.is_compact:
            return True
        if self.mode == "stream":
            return False
        splits: tuple[Split, ...] = ("train", "validation") if split == "train" else (split,)
        samples = sum(map(dataset.manifest.count, splits))
        return samples * bytes_per_sample(dataset.world) <= self.cache_gb * 1e9

    def setup(self, stage: str) -> None:
        """Load what the stage needs."""
        if self.mirror and not all(_is_symmetric(shape.outline) for shape in self.world.catalogue):
            raise StackgenError("data: mirror needs shapes whose outlines are symmetric; set mirror to false")
        if stage == "fit":
            if self.mode == "stream" and self.dataset.is_compact:
                raise StackgenError(
                    f"data: mode stream needs a dataset of shards; {self.dataset.path} is no such folder"
                )
            splits: tuple[Split, ...] = ("train", "validation")
            for split in splits:
                if self.is_cached(split) and split in self.dataset.splits:
                    self.split(split)

    def split(self, name: Split) -> StackArrays:
        """Give a split in memory.

        Raises:
            StackgenError: If the dataset has no such split.
        """
        return self._of(name).split(name)

    def train_dataloader(self) -> Epochs:
        """Make the loader of shuffled batches."""
        options: dict[str, Any] = {
            "bucket_by_blocks": self.bucket_by_blocks,
            "mirror": self.mirror,
            "samples_per_epoch": self.samples_per_epoch,
            "seed": self.seed,
            "epoch": self._epoch(),
            "device": self._device,
        }
        if self.is_cached("train"):
            self._training = CachedLoader(self.split("train"), self.batch_size, train=True, **options)
        else:
            from stackgen.data.loading.streaming import TrainingStream  # webdataset, which a cached run does without

            self._training = TrainingStream(self.dataset, self.batch_size, num_workers=self.num_workers, **options)
        self._training.in_hand = self._in_hand
        if self._resume is not None:
            self._training.load_state_dict(self._resume)
            self._resume = None
        if self._training.is_leftover and self.trainer is not None:
            # The epoch under way has a length of its own: let Lightning ask again for the next one.
            self.trainer.reload_dataloaders_every_n_epochs = 1  # type: ignore[attr-defined]
        return self._training

    def val_dataloader(self) -> Iterable[Batch]:
        """Make a loader of the validation split, once, in order."""
        return self._exact_loader("validation")

    def test_dataloader(self) -> Iterable[Batch]:
        """Make a loader of the test split, once, in order."""
        return self._exact_loader("test")

    def state_dict(self) -> dict[str, Any]:
        """Say where training is, for checkpoints."""
        return {} if self._training is None else {"training": self._training.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Let training continue from there; before Lightning asks how long an epoch is."""
        self._resume = state.get("training")

    def _in_hand(self) -> bool:
        """Tell whether training stopped in the middle of a step, as by Ctrl-C.

        Lightning does not say so itself; these parts of its loop are pinned by a test.
        """
        if self.trainer is None:
            return False
        batches = self.trainer.fit_loop.epoch_loop.batch_progress.current
        return batches.ready > batches.processed  # type: ignore[attr-defined]

    def _exact_loader(self, split: Split) -> Iterable[Batch]:
        if self.is_cached(split):
            return CachedLoader(self.split(split), self.eval_batch_size, train=False, device=self._device)
        from stackgen.data.loading.streaming import ExactStream

        options = {"num_workers": self.num_workers, "device": self._device}
        return ExactStream(self._of(split), split, self.eval_batch_size, **options)  # type: ignore[arg-type]

    def _of(self, split: str) -> Dataset:
        return self.test_dataset if split == "test" else self.dataset

    def _open(self, path: str) -> Dataset:
        if path not in self._datasets:
            self._datasets[path] = Dataset.open(path)
        return self._datasets[path]

    def _epoch(self) -> Callable[[], int] | None:
        trainer = self.trainer
        return None if trainer is None else lambda: int(trainer.current_epoch)

    def _device(self) -> torch.device:
        return self.trainer.strategy.root_device if self.trainer is not None else torch.device("cpu")


def _is_symmetric(outline: Iterable[tuple[float, float]]) -> bool:
    """Tell whether an outline's corners are their own mirror image at x = 0."""
    corners = {(round(x, 6) + 0.0, round(z, 6) + 0.0) for x, z in outline}
    return corners == {(-x + 0.0, z) for x, z in corners}
