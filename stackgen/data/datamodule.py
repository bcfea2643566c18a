"""The one way data reaches training: batches from memory, or streamed from shards.

The whole of a paper-sized dataset is 150 MB as arrays, so by default it is held in memory (on the
accelerator, where there is one) and batches are gathered there; streaming is for what does not fit.
What a batch holds: :meth:`stackgen.data.arrays.StackTensors.batch`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from stackgen._lightning import pl
from stackgen.data.arrays import Batch, StackArrays, StackTensors, load_dataset
from stackgen.data.shards import Manifest, Split
from stackgen.geometry import Grid
from stackgen.stack import Catalogue, StackgenError

TESTSET = Path(__file__).parents[1] / "assets" / "testset-v1"
"""The frozen test scenes that every method is measured on."""

Indices = NDArray[np.int64]
Place = tuple[int, int]


def process_place() -> Place:
    """(rank, world size) of this process; (0, 1) outside distributed training."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


def training_batches(
    buckets: Iterable[Indices], batch_size: int, rng: np.random.Generator, place: Place = (0, 1)
) -> list[Indices]:
    """One pass over the samples in random order, each batch from one bucket.

    All processes get the same number of batches, without overlap, and at any time batches of the
    same bucket, so that none waits for another's longer stacks. What is left of a bucket after its
    last whole batch waits for another pass, which leaves out others; a bucket smaller than one batch
    is one batch.

    Args:
        buckets: Indices of the samples of each bucket.
        batch_size: Of each process.
        rng: In the same state on every process.
        place: Rank and world size.
    """
    rank, world = place
    together = batch_size * world
    groups: list[Indices] = []
    for bucket in buckets:
        order = rng.permutation(bucket)
        whole = len(order) // together * together or len(order) // world * world
        groups += [order[start : min(start + together, whole)] for start in range(0, whole, together)]
    return [groups[i][rank::world] for i in rng.permutation(len(groups))]


def exact_batches(count: int, batch_size: int, place: Place = (0, 1)) -> list[Indices]:
    """Every sample once, in order: equal numbers of batches on all processes, without overlap.

    Raises:
        StackgenError: If there are fewer samples than processes.
    """
    rank, world = place
    if count < world:
        raise StackgenError(f"{count} samples cannot be shared by {world} processes; use fewer")
    share = np.arange(rank, count, world)
    # As many as the longest share needs, but none empty: batches of one may so become batches of two.
    batches = min(math.ceil(math.ceil(count / world) / batch_size), count // world)
    return np.array_split(share, batches)


class CachedLoader:
    """Batches gathered from a split in memory; what they are depends on seed and epoch alone.

    Training: an epoch is one pass, or the next `samples_per_epoch` of an endless row of passes.
    Otherwise every sample once, in order.

    Args:
        arrays: The split.
        batch_size: Samples a batch, on each process.
        train: Shuffle, as :func:`training_batches` does.
        bucket_by_blocks: Batches of stacks with one number of blocks, their padding trimmed away.
        mirror: Reflect each sample at x = 0 in half of the passes.
        samples_per_epoch: Over all processes; None for one pass.
        seed: Of order and reflections.
        epoch: Asked for the epoch's number at its start; by default epochs are counted.
        device: Asked for the device that holds split and batches.
        place: Asked for rank and world size.
    """

    def __init__(
        self,
        arrays: StackArrays,
        batch_size: int,
        *,
        train: bool,
        bucket_by_blocks: bool = False,
        mirror: bool = False,
        samples_per_epoch: int | None = None,
        seed: int = 0,
        epoch: Callable[[], int] | None = None,
        device: Callable[[], torch.device] = lambda: torch.device("cpu"),
        place: Callable[[], Place] = process_place,
    ) -> None:
        self.arrays, self.batch_size, self.train = arrays, batch_size, train
        self.bucket_by_blocks, self.mirror, self.samples_per_epoch = bucket_by_blocks, mirror, samples_per_epoch
        self.seed, self.place = seed, place
        self._epoch, self._device = epoch, device
        self._tensors: StackTensors | None = None
        self._passed = 0  # epochs begun
        self._position = {"epoch": -1, "batches": 0}  # where the last iteration is
        self._resume: dict[str, int] | None = None
        lengths = arrays.lengths if bucket_by_blocks else np.zeros(len(arrays), np.int64)
        self._buckets = [np.flatnonzero(lengths == k) for k in np.unique(lengths)]
        if train and not len(self._pass(0)):
            raise StackgenError(f"{len(arrays)} training samples are too few for {place()[1]} processes")

    def __len__(self) -> int:
        """Batches an epoch on this process."""
        if not self.train:
            return len(exact_batches(len(self.arrays), self.batch_size, self.place()))
        if self.samples_per_epoch is not None:
            return max(1, self.samples_per_epoch // (self.batch_size * self.place()[1]))
        return len(self._pass(0))

    def __iter__(self) -> Iterator[Batch]:
        epoch = self._epoch() if self._epoch else self._passed
        self._passed = epoch + 1
        # After a resume in the middle of an epoch, go on where it was left.
        done = self._resume["batches"] if self._resume and self._resume["epoch"] == epoch else 0
        self._resume = None
        tensors = self._on_device()
        batches = self._training(epoch, done) if self.train else self._exact(done)
        for batches_done, (indices, mirrored) in enumerate(batches, done + 1):
            self._position = {"epoch": epoch, "batches": batches_done}
            longest = int(self.arrays.lengths[indices].max()) if self.bucket_by_blocks else None
            flags = None if mirrored is None else torch.from_numpy(mirrored)
            yield tensors.batch(torch.from_numpy(indices), flags, longest)

    def state_dict(self) -> dict[str, int]:
        """Where the epoch is; Lightning keeps it in its checkpoints."""
        return dict(self._position)

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Let the next iteration, if of the same epoch, go on from there."""
        self._resume = {"epoch": int(state["epoch"]), "batches": int(state["batches"])}

    def _exact(self, done: int) -> Iterator[tuple[Indices, None]]:
        for indices in exact_batches(len(self.arrays), self.batch_size, self.place())[done:]:
            yield indices, None

    def _training(self, epoch: int, done: int) -> Iterator[tuple[Indices, NDArray[np.bool_] | None]]:
        """The epoch's stretch of the endless row of passes."""
        length, a_pass = len(self), len(self._pass(0))
        number, batches = -1, []
        for i in range(epoch * length + done, (epoch + 1) * length):
            if i // a_pass != number:
                number = i // a_pass
                batches = self._pass(number)
                flips = np.random.default_rng([self.seed, number, 1]).random(len(self.arrays)) < 0.5
            indices = batches[i % a_pass]
            yield indices, flips[indices] if self.mirror else None

    def _pass(self, number: int) -> list[Indices]:
        rng = np.random.default_rng([self.seed, number, 0])
        return training_batches(self._buckets, self.batch_size, rng, self.place())

    def _on_device(self) -> StackTensors:
        device = self._device()
        if self._tensors is None or self._tensors.shapes.device != device:
            self._tensors = self.arrays.tensors.to(device)
        return self._tensors


class StackDataModule(pl.LightningDataModule):
    """Training, validation and test data of one dataset.

    Args:
        path: Dataset folder or compact `.npz` file.
        batch_size: Samples a batch, on each process.
        mode: `cached` holds the splits in memory; `stream` reads shards as it goes.
        num_workers: Reading processes, in mode `stream` (training).
        bucket_by_blocks: Training batches of stacks with one number of blocks, padding trimmed.
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
        mode: Literal["cached", "stream"] = "cached",
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
        if mode == "cached" and num_workers:
            raise StackgenError("data: num_workers is for mode stream; cached batches need no worker")
        self.path, self.test_path = Path(path), Path(test_path or TESTSET)
        self.batch_size, self.eval_batch_size = batch_size, eval_batch_size or batch_size
        self.mode, self.num_workers, self.seed = mode, num_workers, seed
        self.bucket_by_blocks, self.mirror, self.samples_per_epoch = bucket_by_blocks, mirror, samples_per_epoch
        self.splits: dict[str, StackArrays] = {}
        self._manifest: dict[str, Any] | None = None

    @property
    def manifest(self) -> dict[str, Any]:
        """The dataset's manifest as plain data."""
        if self._manifest is None:
            if self.path.is_dir():
                self._manifest = Manifest.load(self.path).to_json()
            else:
                self._load("train", "validation")
        assert self._manifest is not None
        return self._manifest

    @property
    def catalogue(self) -> Catalogue:
        """What the shape indices mean."""
        return Catalogue.from_json(self.manifest["catalogue"])

    @property
    def grid(self) -> Grid:
        """The scale of the silhouettes."""
        return Grid(**self.manifest["grid"])

    def pose_statistics(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean (6,) and standard deviation (6,) of the training poses; when streaming, of the first shard's."""
        if self.mode == "cached":
            arrays = self.split("train")
        else:
            paths = Manifest.load(self.path).paths(self.path, "train")[:1]
            arrays = StackArrays.from_shards(paths, self.manifest["max_blocks"], len(self.catalogue))
        return arrays.pose_statistics(self.mirror)

    def setup(self, stage: str) -> None:
        """Load what the stage needs."""
        if self.mirror and not all(_is_symmetric(shape.outline) for shape in self.catalogue):
            raise StackgenError("data: mirror needs shapes whose outlines are symmetric; set mirror to false")
        if self.mode == "cached" and stage == "fit":
            self._load("train", "validation")

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

    def train_dataloader(self) -> Iterable[Batch]:
        """Shuffled batches."""
        if self.mode == "stream":
            from stackgen.data.streaming import TrainingStream

            return TrainingStream(
                self.path,
                self.batch_size,
                num_workers=self.num_workers,
                bucket_by_blocks=self.bucket_by_blocks,
                mirror=self.mirror,
                samples_per_epoch=self.samples_per_epoch,
                seed=self.seed,
                epoch=self._epoch(),
            )
        return CachedLoader(
            self.split("train"),
            self.batch_size,
            train=True,
            bucket_by_blocks=self.bucket_by_blocks,
            mirror=self.mirror,
            samples_per_epoch=self.samples_per_epoch,
            seed=self.seed,
            epoch=self._epoch(),
            device=self._device,
        )

    def val_dataloader(self) -> Iterable[Batch]:
        """The validation split once, in order."""
        return self._exact_loader(self.path, "validation")

    def test_dataloader(self) -> Iterable[Batch]:
        """The test split once, in order."""
        return self._exact_loader(self.test_path, "test")

    def predict_dataloader(self) -> Iterable[Batch]:
        """The same as for the test."""
        return self.test_dataloader()

    def _exact_loader(self, path: Path, split: Split) -> Iterable[Batch]:
        if self.mode == "stream" and path.is_dir():
            from stackgen.data.streaming import ExactStream

            return ExactStream(path, split, self.eval_batch_size)
        return CachedLoader(self.split(split), self.eval_batch_size, train=False, device=self._device)

    def _load(self, *names: str) -> None:
        """Read splits, all that are missing from one file at once."""
        missing = [name for name in names if name not in self.splits]
        ours = [name for name in missing if name != "test"]
        if ours:
            found, self._manifest = load_dataset(self.path, ours)
            self.splits.update(found)
        if "test" in missing:
            self.splits.update(load_dataset(self.test_path, ("test",))[0])

    def _epoch(self) -> Callable[[], int] | None:
        trainer = self.trainer
        return None if trainer is None else lambda: int(trainer.current_epoch)

    def _device(self) -> torch.device:
        return self.trainer.strategy.root_device if self.trainer is not None else torch.device("cpu")


def _is_symmetric(outline: Iterable[tuple[float, float]]) -> bool:
    """Whether an outline's corners are their own mirror image at x = 0."""
    corners = {(round(x, 6) + 0.0, round(z, 6) + 0.0) for x, z in outline}
    return corners == {(-x + 0.0, z) for x, z in corners}
