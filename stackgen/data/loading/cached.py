"""Batches from a split in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch

from stackgen.data.arrays import Batch, StackArrays, StackTensors
from stackgen.data.loading.epochs import Epochs
from stackgen.data.loading.passes import (
    Cursor,
    Indices,
    Rank,
    exact_batches,
    number_of_groups,
    process_rank,
    training_groups,
)

_CPU = torch.device("cpu")


class CachedLoader(Epochs):
    """Batches gathered from a split in memory.

    In training see :class:`stackgen.data.loading.epochs.Epochs`; a resumed epoch visits exactly the samples that
    the interrupted one had not, also on another number of processes or with another batch size.
    Otherwise every sample comes once, in order.

    Args:
        arrays: The split.
        batch_size: Samples a batch, on each process.
        train: Whether to shuffle, as :func:`stackgen.data.loading.passes.training_groups` does.
        bucket_by_blocks: Whether a batch holds stacks with one number of blocks, their padding trimmed away.
        mirror: Whether to reflect each sample at x = 0 in half of the passes.
        samples_per_epoch: Samples an epoch, over all processes; None for one pass.
        seed: Seed of order and reflections.
        epoch: Gives the epoch's number at its start; by default epochs are counted.
        device: Gives the device that holds split and batches.
        rank: Gives the rank of this process.

    Raises:
        StackgenError: If there are fewer training samples than processes.
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
        device: Callable[[], torch.device] = lambda: _CPU,
        rank: Callable[[], Rank] = process_rank,
    ) -> None:
        super().__init__(batch_size, samples_per_epoch, seed, epoch, rank)
        self.arrays, self.train, self.bucket_by_blocks, self.mirror = arrays, train, bucket_by_blocks, mirror
        self._device = device
        self._tensors: StackTensors | None = None
        lengths = arrays.lengths if bucket_by_blocks else np.zeros(len(arrays), np.int64)
        self._buckets = [np.flatnonzero(lengths == k) for k in np.unique(lengths)]
        if train:
            self._whole_pass()

    def __len__(self) -> int:
        """Count the batches of an epoch on this process: the same on all."""
        return super().__len__() if self.train else len(self._exact())

    def __iter__(self) -> Iterator[Batch]:
        if self.train:
            yield from super().__iter__()
            return
        for indices in self._exact():
            yield self._on_device().batch(torch.from_numpy(indices))

    def _exact(self) -> list[Indices]:
        return exact_batches(len(self.arrays), self.batch_size, self.rank())

    def _steps(self, start: Cursor) -> int:
        sizes = [len(bucket) for bucket in self._unseen(start)]
        return number_of_groups(sizes, start.topology.batch_size, start.topology.processes)

    def _deal(self, cursor: Cursor) -> Iterator[Batch]:
        rank, processes = self.rank()
        flips = np.random.default_rng([self.seed, cursor.number, 1]).random(len(self.arrays)) < 0.5
        groups = self._groups(self._unseen(cursor), cursor, len(cursor.dealt) - 1)
        for group in groups[cursor.step : cursor.step + cursor.left]:
            indices = group[rank::processes]
            longest = int(self.arrays.lengths[indices].max()) if self.bucket_by_blocks else None
            mirrored = torch.from_numpy(flips[indices]) if self.mirror else None
            yield self._on_device().batch(torch.from_numpy(indices), mirrored, longest)

    def _unseen(self, cursor: Cursor) -> list[Indices]:
        """Give the buckets without what was dealt out of the pass under earlier topologies."""
        buckets = self._buckets
        for number, (_, steps) in enumerate(cursor.dealt[:-1]):
            seen = np.zeros(len(self.arrays), bool)
            for group in self._groups(buckets, cursor, number)[:steps]:
                seen[group] = True
            buckets = [bucket[~seen[bucket]] for bucket in buckets]
        return buckets

    def _groups(self, buckets: list[Indices], cursor: Cursor, number: int) -> list[Indices]:
        """Give the steps of the pass under one of its topologies."""
        topology = cursor.dealt[number][0]
        rng = np.random.default_rng([self.seed, cursor.number, 0, *([number] if number else [])])
        return training_groups(buckets, topology.batch_size, rng, topology.processes)

    def _on_device(self) -> StackTensors:
        device = self._device()
        if self._tensors is None or self._tensors.shapes.device != device:
            self._tensors = self.arrays.tensors.to(device)
        return self._tensors
