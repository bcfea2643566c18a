"""Batches read from shards as they are needed, for datasets that do not fit in memory.

Training resamples shards without end, so that no process ever waits for another's last shard;
validation and test pass over every sample once. What cannot be read is skipped, counted and
reported when the epoch ends.
"""

from __future__ import annotations

import multiprocessing
import random
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
import webdataset as wds

from stackgen.data.arrays import Batch, StackArrays
from stackgen.data.datamodule import Place, exact_batches, process_place
from stackgen.data.shards import Manifest, Sample, Split, decode_sample
from stackgen.stack import StackgenError

SHUFFLE_BUFFER = 5000
"""Samples held back for shuffling in each reading process: some 10 MB."""

_HOPELESS = 1000  # errors in a row, after which nothing readable is expected any more


class Skipped:
    """Counts what could not be read, over all reading processes; an error handler of webdataset."""

    def __init__(self) -> None:
        self._count: Any = multiprocessing.Value("q", 0)  # shared memory, also when workers are spawned
        self._in_a_row = 0

    @property
    def count(self) -> int:
        """Errors so far."""
        return int(self._count.value)

    def __call__(self, error: Exception) -> bool:
        """Count one and go on, unless nothing at all can be read."""
        self._in_a_row += 1
        if self._in_a_row > _HOPELESS:
            raise StackgenError(f"no readable sample in {_HOPELESS} attempts; the last error: {error}")
        with self._count.get_lock():
            self._count.value += 1
        return True

    def read_one(self) -> None:
        """Something could be read."""
        self._in_a_row = 0


@dataclass(frozen=True)
class _Decoder:
    """Raw members to a checked sample."""

    max_blocks: int
    num_shapes: int
    image_size: int
    skipped: Skipped

    def __call__(self, raw: dict[str, Any]) -> Sample:
        sample = decode_sample(raw["__key__"], raw)
        k = len(sample.shapes)
        if sample.poses.shape != (k, 6) or not np.isfinite(sample.poses).all():
            raise ValueError(f"sample {sample.key}: {k} shapes do not fit poses {sample.poses.shape}")
        if not 1 <= k <= self.max_blocks or sample.shapes.max() >= self.num_shapes:
            raise ValueError(f"sample {sample.key}: more blocks or shapes than the dataset's manifest says")
        if sample.silhouette.shape != (self.image_size, self.image_size):
            raise ValueError(f"sample {sample.key}: silhouette of {sample.silhouette.shape} pixels")
        self.skipped.read_one()
        return sample

    def collate(self, samples: list[Sample], mirrored: np.ndarray | None = None, trim: bool = False) -> Batch:
        """A batch of samples; `trim` cuts it to the longest of them."""
        arrays = StackArrays.from_samples(samples, self.max_blocks, self.num_shapes)
        flags = None if mirrored is None else torch.from_numpy(mirrored)
        return arrays.tensors.batch(torch.arange(len(samples)), flags, int(arrays.lengths.max()) if trim else None)


@dataclass(frozen=True)
class _Batcher:
    """Samples to batches, each of one bucket; one bucket holds everything if none are asked for."""

    decoder: _Decoder
    batch_size: int
    bucket_by_blocks: bool
    mirror: bool
    seed: int
    rank: int

    def __call__(self, samples: Iterable[Sample]) -> Iterator[Batch]:
        rng = np.random.default_rng([self.seed, _worker_seed(self.rank)])
        buckets: dict[int, list[Sample]] = {}
        for sample in samples:
            bucket = buckets.setdefault(len(sample.shapes) if self.bucket_by_blocks else 0, [])
            bucket.append(sample)
            if len(bucket) == self.batch_size:
                mirrored = rng.random(len(bucket)) < 0.5 if self.mirror else None
                yield self.decoder.collate(bucket, mirrored, trim=self.bucket_by_blocks)
                bucket.clear()


class TrainingStream:
    """Endless resampled shards, cut into epochs.

    Args:
        folder: With `dataset.json` and shards.
        batch_size: Samples a batch, on each process.
        num_workers: Reading processes; 0 reads in this one.
        bucket_by_blocks: Batches of stacks with one number of blocks, padding trimmed.
        mirror: Reflect samples at x = 0 with probability 1/2.
        samples_per_epoch: Over all processes; by default as many as the dataset has.
        seed: With the epoch's number it decides what is read, for a given number of workers.
        epoch: Asked for the epoch's number at its start; by default epochs are counted.
        place: Asked for rank and world size.

    Raises:
        StackgenError: If there are no training shards.
    """

    def __init__(
        self,
        folder: Path,
        batch_size: int,
        *,
        num_workers: int = 0,
        bucket_by_blocks: bool = False,
        mirror: bool = False,
        samples_per_epoch: int | None = None,
        seed: int = 0,
        epoch: Callable[[], int] | None = None,
        place: Callable[[], Place] = process_place,
    ) -> None:
        manifest = Manifest.load(folder)
        self.paths = _paths(manifest, folder, "train")
        self.samples = samples_per_epoch or manifest.count("train")
        self.batch_size, self.num_workers, self.seed = batch_size, num_workers, seed
        self.bucket_by_blocks, self.mirror = bucket_by_blocks, mirror
        self.skipped = Skipped()
        self._decoder = _decoder(manifest, self.skipped)
        self._epoch, self._place, self._passed = epoch, place, 0

    def __len__(self) -> int:
        """Batches an epoch on this process."""
        return max(1, self.samples // (self.batch_size * self._place()[1]))

    def __iter__(self) -> Iterator[Batch]:
        epoch = self._epoch() if self._epoch else self._passed
        self._passed = epoch + 1
        before = self.skipped.count
        dataset = self._pipeline(int(np.random.SeedSequence([self.seed, epoch]).generate_state(1)[0]))
        loader = wds.WebLoader(dataset, batch_size=None, num_workers=self.num_workers)
        for number, batch in enumerate(loader.with_epoch(len(self)), 1):
            if number == len(self):  # the trainer does not ask for more than there are, so say it now
                _report(self.skipped.count - before)
            yield batch

    def _pipeline(self, seed: int) -> wds.DataPipeline:
        rank = self._place()[0]
        return wds.DataPipeline(
            # Each process and worker draws shards of its own, which splits the endless list between them.
            wds.ResampledShards(self.paths, seed=seed, worker_seed=partial(_worker_seed, rank), deterministic=True),
            wds.tarfile_to_samples(handler=self.skipped),
            partial(_shuffled, seed, rank),
            wds.map(self._decoder, handler=self.skipped),
            _Batcher(self._decoder, self.batch_size, self.bucket_by_blocks, self.mirror, seed, rank),
        )


class ExactStream:
    """Every sample of a split once, in order, shared between the processes without overlap.

    Args:
        folder: With `dataset.json` and shards.
        split: Its name.
        batch_size: Samples a batch, on each process.
        place: Asked for rank and world size.

    Raises:
        StackgenError: If there are no shards of that split.
    """

    def __init__(self, folder: Path, split: Split, batch_size: int, place: Callable[[], Place] = process_place) -> None:
        manifest = Manifest.load(folder)
        self.paths = _paths(manifest, folder, split)
        self.count, self.batch_size = manifest.count(split), batch_size
        self.skipped = Skipped()
        self._decoder = _decoder(manifest, self.skipped)
        self._place = place

    def _sizes(self) -> list[int]:
        return [len(indices) for indices in exact_batches(self.count, self.batch_size, self._place())]

    def __len__(self) -> int:
        """Batches on this process: the same on all."""
        return len(self._sizes())

    def __iter__(self) -> Iterator[Batch]:
        rank, world = self._place()
        samples = iter(
            wds.DataPipeline(
                wds.SimpleShardList(self.paths),
                wds.tarfile_to_samples(handler=self.skipped),
                # By sample and not by shard: equal numbers on all processes, whatever the shards.
                lambda raw: islice(raw, rank, None, world),
                wds.map(self._decoder, handler=self.skipped),
            )
        )
        sizes, read = self._sizes(), 0
        for number, size in enumerate(sizes, 1):
            batch = list(islice(samples, size))
            read += len(batch)
            if number == len(sizes):
                _report(sum(sizes) - read)  # a tar cut between two members ends without an error
            if batch:
                yield self._decoder.collate(batch)


def _paths(manifest: Manifest, folder: Path, split: Split) -> list[str]:
    paths = [str(path) for path in manifest.paths(folder, split)]
    if not paths:
        raise StackgenError(f"dataset {folder} has no {split} split")
    return paths


def _decoder(manifest: Manifest, skipped: Skipped) -> _Decoder:
    return _Decoder(manifest.max_blocks, len(manifest.catalogue), manifest.grid.image_size, skipped)


def _worker_seed(rank: int) -> int:
    info = torch.utils.data.get_worker_info()
    return 10_000 * rank + (info.id if info else 0)


def _shuffled(seed: int, rank: int, samples: Iterable[Any]) -> Iterator[Any]:
    """An endless stream out of order: each sample leaves at random from a full buffer."""
    rng = random.Random(seed * 1_000_003 + _worker_seed(rank))
    buffer: list[Any] = []
    for sample in samples:
        buffer.append(sample)
        if len(buffer) >= SHUFFLE_BUFFER:
            i = rng.randrange(len(buffer))
            buffer[i], buffer[-1] = buffer[-1], buffer[i]
            yield buffer.pop()


def _report(skipped: int) -> None:
    if skipped:
        warnings.warn(f"data: {skipped} broken samples or shards were skipped in this epoch", stacklevel=3)
