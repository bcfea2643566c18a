"""Batches read from shards as they are needed, for datasets that do not fit in memory.

Reading processes fetch shards, compare their checksums, decode and shuffle; what they hand over is
packed, 800 bytes a stack, and becomes a batch in the process that trains. What cannot be read is
skipped, named, counted and reported when the epoch ends (:mod:`stackgen.data.loading.losses`); in training
others take its place, so that every process has as many batches as it would have had.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from stackgen.data.loading.arrays import Batch, StackArrays, StackTensors
from stackgen.data.loading.buffers import Buffers
from stackgen.data.loading.decoding import Decoded, Frame
from stackgen.data.loading.epochs import Epochs
from stackgen.data.loading.losses import Loss, Losses, read_decoded
from stackgen.data.loading.order import Cursor, Deal, Piece, Place, exact_batches, process_place, shuffled_shards
from stackgen.data.shards import Split
from stackgen.data.sources import Shard, load_manifest, shards_of
from stackgen.errors import StackgenError

HOPELESS = 20
"""Shards in a row that cannot be read, after which nothing readable is expected any more."""

_CPU = torch.device("cpu")


@dataclass(frozen=True)
class Packet:
    """What a reading process hands over.

    Args:
        arrays: The stacks of a batch; None if this only brings news.
        mirrored: (B,) bool, which to reflect at x = 0.
        losses: What could not be read since the last packet.
        error: Why no more will come.
    """

    arrays: StackArrays | None = None
    mirrored: NDArray[np.bool_] | None = None
    losses: tuple[Loss, ...] = ()
    error: str | None = None


class ShardReader:
    """Decoded shards of a split, by number; remembers the last one, which two neighbouring windows share.

    Args:
        shards: Of the split.
        frame: Of the dataset.
    """

    def __init__(self, shards: Sequence[Shard], frame: Frame) -> None:
        self.shards, self.frame = shards, frame
        self._last: tuple[int, Decoded] | None = None
        self._losses: list[Loss] = []
        self._in_vain = 0  # shards in a row without a readable sample

    def read(self, number: int) -> Decoded:
        """The readable samples of a shard.

        Raises:
            StackgenError: If none of many shards in a row had any.
        """
        if self._last is None or self._last[0] != number:
            decoded, losses = read_decoded(self.shards[number], self.frame)
            self._losses += losses
            self._last = number, decoded
            self._in_vain = 0 if len(decoded.positions) or not losses else self._in_vain + 1
            if self._in_vain == HOPELESS:
                raise StackgenError(f"data: {HOPELESS} shards in a row cannot be read; the last one: {losses[-1].what}")
        return self._last[1]

    def samples(self, piece: Piece) -> StackArrays:
        """The readable samples of a piece."""
        decoded = self.read(piece.shard)
        first, last = np.searchsorted(decoded.positions, (piece.start, piece.stop))
        return StackArrays.of(decoded, self.frame).select(slice(first, last))

    def news(self) -> tuple[Loss, ...]:
        """What was lost since this was last asked."""
        losses, self._losses = tuple(self._losses), []
        return losses


class TrainingStream(Epochs):
    """Training batches from shards; see :class:`stackgen.data.loading.epochs.Epochs`.

    A pass visits every sample at most once, over all processes: which shard is read by whom follows
    from the manifest alone (:class:`stackgen.data.loading.order.Deal`). Resumed under the same layout an epoch
    goes on with the next sample; under another one, whole windows of about 8 shards are what is not
    read again.

    Args:
        path: Of the dataset, wherever it lies.
        batch_size: Samples a batch, on each process.
        num_workers: Reading processes; 0 reads in this one.
        bucket_by_blocks: Batches of stacks with nearly one number of blocks, their padding trimmed away.
        mirror: Reflect samples at x = 0 with probability 1/2.
        samples_per_epoch: Over all processes; None for one pass.
        seed: With the epoch's number and the layout it decides what is read.
        epoch: Asked for the epoch's number at its start; by default epochs are counted.
        device: Asked for the device that the batches are for.
        place: Asked for rank and world size.

    Raises:
        StackgenError: If there are no training shards, or fewer samples than processes.
    """

    def __init__(
        self,
        path: str | Path,
        batch_size: int,
        *,
        num_workers: int = 0,
        bucket_by_blocks: bool = False,
        mirror: bool = False,
        samples_per_epoch: int | None = None,
        seed: int = 0,
        epoch: Callable[[], int] | None = None,
        device: Callable[[], torch.device] = lambda: _CPU,
        place: Callable[[], Place] = process_place,
    ) -> None:
        super().__init__(batch_size, samples_per_epoch, seed, epoch, place, max(1, num_workers))
        self.num_workers, self.bucket_by_blocks, self.mirror = num_workers, bucket_by_blocks, mirror
        self.frame, self.shards = _open(path, "train")
        self._unpacker, self._losses = _Unpacker(device), _losses_of(place())
        self._whole_pass()

    def _steps(self, start: Cursor) -> int:
        return self._dealt(start).steps

    def _deal(self, cursor: Cursor) -> Iterator[Batch]:
        until = min(cursor.step + cursor.left, self._steps(cursor))
        reader = _TrainingReader(self, self._dealt(cursor), cursor, until, self.place()[0])
        packets = _packets(reader, self.num_workers, self._losses)
        for step, packet in enumerate(packets, cursor.step + 1):
            if step == until:  # the trainer does not ask for more than there are: now or never
                packets.close()
                if step == cursor.step + cursor.left:
                    self._losses.report(f"epoch {self._passed - 1}")
            yield self._unpacker.batch(packet, trim=self.bucket_by_blocks)

    def _dealt(self, cursor: Cursor) -> Deal:
        """What is left of a pass under earlier layouts, dealt out under the present one."""
        rng = np.random.default_rng([self.seed, cursor.number, 0])
        pieces = tuple(shuffled_shards([shard.samples for shard in self.shards], rng))
        for layout, steps in cursor.dealt[:-1]:
            pieces = Deal(pieces, layout).unread(steps)
        return Deal(pieces, cursor.layout)


class _TrainingReader(IterableDataset):
    """One worker's batches of a stretch of a pass."""

    def __init__(self, stream: TrainingStream, deal: Deal, cursor: Cursor, until: int, rank: int) -> None:
        self.deal, self.after, self.until, self.rank = deal, cursor.step, until, rank
        self.seeds = [stream.seed, cursor.number, len(cursor.dealt)]
        self.bucket_by_blocks, self.mirror = stream.bucket_by_blocks, stream.mirror
        self.reader = ShardReader(stream.shards, stream.frame)

    def __iter__(self) -> Iterator[Packet]:
        info = get_worker_info()
        worker = ((info.id if info else 0) + self.after) % self.deal.layout.workers
        batches = self.deal.worker_batches(worker, self.after, self.until)
        per_window = self.deal.batches_per_window
        for window in range(batches.start // per_window, -(-batches.stop // per_window) if len(batches) else 0):
            samples, groups, flips = self._window(window)
            first = self.deal.window_batches(window).start
            for number in self.deal.window_batches(window):
                if number in batches:
                    group = groups[number - first]
                    yield Packet(samples.select(group), flips[group] if self.mirror else None, self.reader.news())

    def _window(self, window: int) -> tuple[StackArrays, list[NDArray[np.int64]], NDArray[np.bool_]]:
        """The samples of a window, which of them are each batch, and which are mirrored."""
        samples = self._readable(self.deal.window(self.rank, window))
        rng = np.random.default_rng([*self.seeds, window, 1 + self.rank])
        wanted = len(self.deal.window_batches(window)) * self.deal.batch_size
        order = rng.permutation(len(samples))
        if len(order) < wanted:  # others of the window in the place of those that could not be read
            order = np.concatenate([order, rng.integers(len(samples), size=wanted - len(order))])
        order = order[:wanted]
        if self.bucket_by_blocks:
            order = order[np.argsort(samples.lengths[order], kind="stable")]
        groups = np.split(order, range(self.deal.batch_size, wanted, self.deal.batch_size))
        # All processes take short and long stacks in the same order, so that none waits for another.
        turn = np.random.default_rng([*self.seeds, window, 0]).permutation(len(groups))
        return samples, [groups[i] for i in turn], rng.random(len(samples)) < 0.5

    def _readable(self, pieces: list[Piece]) -> StackArrays:
        """The samples of some pieces, or if none is readable those of the next shard that has any."""
        samples = StackArrays.concatenate([self.reader.samples(piece) for piece in pieces])
        after, count = pieces[-1].shard, len(self.reader.shards)
        for i in range(1, count + 1):
            if len(samples):
                break
            samples = StackArrays.of(self.reader.read((after + i) % count), self.reader.frame)
        if not len(samples):
            raise StackgenError("data: there is no readable sample in any shard; the lines above name the damage")
        return samples


class ExactStream:
    """Every readable sample of a split once, in order, shared between the processes without overlap.

    Every process reads all shards and keeps its share of the samples. So all know what could not be
    read, and have the same number of batches nevertheless.

    Args:
        path: Of the dataset, wherever it lies.
        split: Its name.
        batch_size: Samples a batch, on each process; a last batch that makes up for losses may have two more.
        num_workers: 0 reads in this process; more are no faster than the one that keeps the order.
        device: Asked for the device that the batches are for.
        place: Asked for rank and world size.

    Raises:
        StackgenError: If there are no shards of that split.
    """

    def __init__(
        self,
        path: str | Path,
        split: Split,
        batch_size: int,
        *,
        num_workers: int = 0,
        device: Callable[[], torch.device] = lambda: _CPU,
        place: Callable[[], Place] = process_place,
    ) -> None:
        self.frame, self.shards = _open(path, split)
        self.batch_size, self.num_workers, self.place = batch_size, min(num_workers, 1), place
        self._unpacker, self._losses = _Unpacker(device), Losses()
        self._what = f"the {split} split"

    def __len__(self) -> int:
        """Batches on this process if everything can be read: the same on all."""
        count = sum(shard.samples for shard in self.shards)
        return len(exact_batches(count, self.batch_size, self.place()))

    def __iter__(self) -> Iterator[Batch]:
        losses = self._losses if self.place()[0] == 0 else None  # all processes meet the same
        packets = _packets(
            _ExactReader(self.shards, self.frame, self.batch_size, self.place()), self.num_workers, losses
        )
        last: Packet | None = None
        for packet in chain(packets, [None]):
            if packet is None and losses is not None:
                losses.report(self._what)
            if last is not None:
                yield self._unpacker.batch(last)
            last = packet


class _ExactReader(IterableDataset):
    """One process's batches of an exact pass."""

    def __init__(self, shards: Sequence[Shard], frame: Frame, batch_size: int, place: Place) -> None:
        self.reader = ShardReader(shards, frame)
        self.rank, self.world = place
        count = sum(shard.samples for shard in shards)
        # (ranks, batches) samples that each process has had after each batch, if everything can be read
        self.planned = np.stack(
            [
                np.cumsum([len(batch) for batch in exact_batches(count, batch_size, (rank, self.world))])
                for rank in range(self.world)
            ]
        )

    def __iter__(self) -> Iterator[Packet]:
        seen, held, taken, number = 0, [], 0, 0
        for shard in range(len(self.reader.shards)):
            samples = StackArrays.of(self.reader.read(shard), self.reader.frame)
            held.append(samples.select(slice((self.rank - seen) % self.world, None, self.world)))
            seen += len(samples)
            while number + 1 < self.planned.shape[1] and self._all_have_more(number, seen):
                size = int(self.planned[self.rank, number]) - taken
                rest = StackArrays.concatenate(held)
                held, taken, number = [rest.select(slice(size, None))], taken + size, number + 1
                yield Packet(rest.select(slice(size)), losses=self.reader.news())
        if seen < self.world:
            raise StackgenError(f"data: {seen} readable samples cannot be shared by {self.world} processes")
        yield Packet(StackArrays.concatenate(held), losses=self.reader.news())

    def _all_have_more(self, number: int, seen: int) -> bool:
        """Whether every process can have its batch of this number, and something for another one."""
        shares = [len(range(rank, seen, self.world)) for rank in range(self.world)]
        return all(share > planned for share, planned in zip(shares, self.planned[:, number], strict=True))


class _Unpacker:
    """Packets to batches on a device."""

    def __init__(self, device: Callable[[], torch.device]) -> None:
        self._device, self._buffers = device, Buffers()

    def batch(self, packet: Packet, trim: bool = False) -> Batch:
        assert packet.arrays is not None
        tensors = StackTensors.of(packet.arrays, self._buffers).to(self._device())
        mirrored = None if packet.mirrored is None else torch.from_numpy(packet.mirrored)
        longest = int(packet.arrays.lengths.max()) if trim else None
        return tensors.batch(torch.arange(len(packet.arrays)), mirrored, longest)


def _packets(reader: IterableDataset, workers: int, losses: Losses | None) -> Generator[Packet, None, None]:
    """What a reader hands over, read here or by workers that take turns; losses are counted, errors raised."""
    own = torch.Generator()  # else the loader draws from the stream of numbers that the model draws from
    loader = DataLoader(_Messages(reader), batch_size=None, num_workers=workers, collate_fn=_unchanged, generator=own)
    for packet in loader:
        if losses is not None:
            losses.add(packet.losses)
        if packet.error is not None:
            raise StackgenError(packet.error)
        if packet.arrays is not None:
            yield packet


class _Messages(IterableDataset):
    """A reader whose errors arrive as one line: torch would send a traceback in their place."""

    def __init__(self, reader: Any) -> None:
        self.reader = reader

    def __iter__(self) -> Iterator[Packet]:
        try:
            yield from self.reader
        except StackgenError as error:
            yield Packet(losses=self.reader.reader.news(), error=str(error))


def _unchanged(packet: Any) -> Any:
    return packet


def _open(path: str | Path, split: Split) -> tuple[Frame, list[Shard]]:
    manifest = load_manifest(path)
    shards = shards_of(manifest, path, split)
    if not shards:
        raise StackgenError(f"dataset {path} has no {split} split")
    return Frame.of(manifest), shards


def _losses_of(place: Place) -> Losses:
    return Losses(f"(process {place[0]})" if place[1] > 1 else "")
