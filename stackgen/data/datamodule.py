"""The one way data reaches training: batches from memory, or streamed from shards.

The whole of a paper-sized dataset is 150 MB as arrays, so it is held in memory (on the accelerator,
where there is one) and batches are gathered there; streaming is for what does not fit.
What a batch holds: :meth:`stackgen.data.loading.arrays.StackTensors.batch`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from stackgen._lightning import pl
from stackgen.data.loading.arrays import Batch, StackArrays, load_dataset
from stackgen.data.loading.cached import CachedLoader
from stackgen.data.loading.decoding import Frame
from stackgen.data.loading.epochs import Epochs
from stackgen.data.loading.losses import Losses, read_decoded
from stackgen.data.shards import Manifest, Split
from stackgen.data.sources import is_folder, load_manifest, shards_of
from stackgen.errors import StackgenError
from stackgen.world import Catalogue, Grid

__all__ = ["TESTSET", "CachedLoader", "StackDataModule"]

TESTSET = Path(__file__).parents[1] / "assets" / "testset-v1"
"""The frozen test scenes that every method is measured on."""

STATISTICS_SHARDS = 8
"""Shards, spread over the split, from which a stream learns the scale of the poses."""


class StackDataModule(pl.LightningDataModule):
    """Training, validation and test data of one dataset.

    Args:
        path: Dataset folder or compact `.npz` file; also behind a URL (`s3://`, `https://`, ...) or a command
            (`pipe:ssh host cat data/{file}`).
        batch_size: Samples a batch, on each process.
        mode: `cached` holds the splits in memory, filled once; `stream` reads shards as it goes; `auto`
            caches what takes no more than `cache_gb`.
        cache_gb: See `mode`; training and validation split together, on each process [GB].
        num_workers: Reading processes, where data are streamed.
        bucket_by_blocks: Training batches of stacks with one number of blocks (nearly one, where they are
            streamed), padding trimmed.
        mirror: Reflect training samples at x = 0 half of the time.
        samples_per_epoch: Of training, over all processes; by default as many as there are.
        eval_batch_size: Of validation and test; by default `batch_size`.
        test_path: Dataset of the test split; by default the frozen `testset-v1`.
        seed: Of shuffling and reflections.

    Raises:
        StackgenError: If the options do not fit each other.
    """

    def __init__(
        self,
        path: str | Path,
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
        self.path, self.test_path = str(path), str(test_path or TESTSET)
        self.batch_size, self.eval_batch_size = batch_size, eval_batch_size or batch_size
        self.mode, self.cache_gb, self.num_workers, self.seed = mode, cache_gb, num_workers, seed
        self.bucket_by_blocks, self.mirror, self.samples_per_epoch = bucket_by_blocks, mirror, samples_per_epoch
        self.splits: dict[str, StackArrays] = {}
        self._facts: dict[str, dict[str, Any]] = {}  # manifests as plain data, by path
        self._manifests: dict[str, Manifest] = {}
        self._training: Epochs | None = None
        self._resume: dict[str, Any] | None = None

    @property
    def manifest(self) -> dict[str, Any]:
        """The dataset's manifest as plain data."""
        return self._manifest_of(self.path, "train", "validation")

    @property
    def test_manifest(self) -> dict[str, Any]:
        """The manifest of the dataset whose test split is used."""
        return self._manifest_of(self.test_path, "test")

    @property
    def catalogue(self) -> Catalogue:
        """What the shape indices mean."""
        return Catalogue.from_json(self.manifest["catalogue"])

    @property
    def grid(self) -> Grid:
        """The scale of the silhouettes."""
        return Grid(**self.manifest["grid"])

    def pose_statistics(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean (6,) and standard deviation (6,) of the training poses; when streaming, of a few shards'."""
        if self.is_cached("train"):
            return self.split("train").pose_statistics(self.mirror)
        manifest, losses = self._manifest_object(self.path), Losses()
        shards, frame = shards_of(manifest, self.path, "train"), Frame.of(manifest)
        parts = []
        for number in np.unique(np.linspace(0, len(shards) - 1, STATISTICS_SHARDS).astype(int)):
            decoded, lost = read_decoded(shards[number], frame)
            losses.add(lost)
            parts.append(StackArrays.of(decoded, frame))
        arrays = StackArrays.concatenate(parts)
        if not len(arrays):
            raise StackgenError(f"data: none of {len(parts)} training shards of {self.path} can be read")
        return arrays.pose_statistics(self.mirror)

    def is_cached(self, split: Split) -> bool:
        """Whether a split is held in memory; the same on every process and machine."""
        path = self.test_path if split == "test" else self.path
        if self.mode == "cached" or not is_folder(path):
            return True
        if self.mode == "stream":
            return False
        manifest = self._manifest_object(path)
        splits: tuple[Split, ...] = ("train", "validation") if split == "train" else (split,)
        samples = sum(map(manifest.count, splits))
        return samples * Frame.of(manifest).bytes_per_sample <= self.cache_gb * 1e9

    def setup(self, stage: str) -> None:
        """Load what the stage needs."""
        if self.mirror and not all(_is_symmetric(shape.outline) for shape in self.catalogue):
            raise StackgenError("data: mirror needs shapes whose outlines are symmetric; set mirror to false")
        if stage == "fit":
            splits: tuple[Split, ...] = ("train", "validation")
            if self.mode == "stream" and self.is_cached("train"):
                raise StackgenError(f"data: mode stream needs a dataset of shards; {self.path} is no such folder")
            self._load(*(name for name in splits if self.is_cached(name)))

    def split(self, name: str) -> StackArrays:
        """A split in memory.

        Raises:
            StackgenError: If the dataset has no such split.
        """
        if name not in self.splits:
            self._load(name)
        if name not in self.splits:
            raise StackgenError(f"dataset {self.path} has no {name} split")
        return self.splits[name]

    def train_dataloader(self) -> Epochs:
        """Shuffled batches."""
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
            from stackgen.data.loading.streaming import TrainingStream

            self._training = TrainingStream(self.path, self.batch_size, num_workers=self.num_workers, **options)
        self._training.in_hand = self._in_hand
        if self._resume is not None:
            self._training.load_state_dict(self._resume)
            self._resume = None
        if self._training.relaid and self.trainer is not None:
            # The epoch under way has a length of its own: let Lightning ask again for the next one.
            self.trainer.reload_dataloaders_every_n_epochs = 1  # type: ignore[attr-defined]
        return self._training

    def val_dataloader(self) -> Iterable[Batch]:
        """The validation split once, in order."""
        return self._exact_loader(self.path, "validation")

    def test_dataloader(self) -> Iterable[Batch]:
        """The test split once, in order."""
        return self._exact_loader(self.test_path, "test")

    def predict_dataloader(self) -> Iterable[Batch]:
        """The same as for the test."""
        return self.test_dataloader()

    def state_dict(self) -> dict[str, Any]:
        """Where training is, for checkpoints."""
        return {} if self._training is None else {"training": self._training.state_dict()}

    def _in_hand(self) -> bool:
        """Whether training stopped in the middle of a step, as by Ctrl-C."""
        if self.trainer is None:
            return False
        batches = self.trainer.fit_loop.epoch_loop.batch_progress.current
        return batches.ready > batches.processed  # type: ignore[attr-defined]

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Let training go on from there; before Lightning asks how long an epoch is."""
        self._resume = state.get("training")

    def _exact_loader(self, path: str, split: Split) -> Iterable[Batch]:
        if self.is_cached(split):
            return CachedLoader(self.split(split), self.eval_batch_size, train=False, device=self._device)
        from stackgen.data.loading.streaming import ExactStream

        return ExactStream(path, split, self.eval_batch_size, num_workers=self.num_workers, device=self._device)

    def _load(self, *names: str) -> None:
        """Read splits, all that are missing from one file at once."""
        missing = [name for name in names if name not in self.splits]
        ours = [name for name in missing if name != "test"]
        if ours:
            found, self._facts[self.path] = load_dataset(self.path, ours)
            self.splits.update(found)
        if "test" in missing:
            found, self._facts[self.test_path] = load_dataset(self.test_path, ("test",))
            self.splits.update(found)

    def _manifest_of(self, path: str, *splits: str) -> dict[str, Any]:
        if path not in self._facts:
            if is_folder(path):
                self._facts[path] = self._manifest_object(path).to_json()
            else:
                self._load(*splits)
        return self._facts[path]

    def _manifest_object(self, path: str) -> Manifest:
        if path not in self._manifests:
            self._manifests[path] = load_manifest(path)
        return self._manifests[path]

    def _epoch(self) -> Callable[[], int] | None:
        trainer = self.trainer
        return None if trainer is None else lambda: int(trainer.current_epoch)

    def _device(self) -> torch.device:
        return self.trainer.strategy.root_device if self.trainer is not None else torch.device("cpu")


def _is_symmetric(outline: Iterable[tuple[float, float]]) -> bool:
    """Whether an outline's corners are their own mirror image at x = 0."""
    corners = {(round(x, 6) + 0.0, round(z, 6) + 0.0) for x, z in outline}
    return corners == {(-x + 0.0, z) for x, z in corners}
