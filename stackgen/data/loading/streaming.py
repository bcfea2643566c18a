"""Batches read from shards as they are needed, for datasets that do not fit in memory.

Both streams are webdataset pipelines: shards split over the workers, opened, decoded, shuffled and batched, and
loaded by a `WebLoader`. Stages of our own stand where webdataset's cannot keep what is promised here:

- which process reads what follows from the manifest (:class:`stackgen.data.loading.passes.Deal`), not from counting
  shards: every process has equally many steps, and a resumed run continues at the next sample;
- `fetch` compares the checksum of a whole shard before a byte of it is used; what cannot be read is skipped, named
  and counted, and in training other samples take its place;
- `decode` decodes a whole shard at once, many times as fast as webdataset's expander, which goes member by member;
- what a worker hands over is packed, 800 bytes a stack, and becomes a batch in the process that trains.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, groupby
from typing import Any

import numpy as np
import torch
import webdataset as wds
from numpy.typing import NDArray

from stackgen.data.arrays import Batch, Buffers, StackArrays, StackTensors
from stackgen.data.dataset import Dataset
from stackgen.data.decoding import Decoded, SkipLog, Skipped, read_decoded
from stackgen.data.loading.epochs import Epochs
from stackgen.data.loading.passes import Cursor, Deal, Piece, Rank, exact_batches, process_rank, shuffled_shards
from stackgen.data.sources import Shard
from stackgen.errors import StackgenError
from stackgen.world import World

HOPELESS = 20
"""Shards in a row that cannot be read, after which nothing readable is expected any more."""

_CPU = torch.device("cpu")

Item = dict[str, Any]
"""What travels from stage to stage, as in all of webdataset."""


@dataclass(frozen=True)
class Packet:
    """What a reading process hands over.

    Args:
        stacks: The stacks of a batch; None if this only brings news.
        mirrored: (B,) bool, which to reflect at x = 0.
        skipped: What could not be read since the last packet.
        error: Why no more will come.
    """

    stacks: StackArrays | None = None
    mirrored: NDArray[np.bool_] | None = None
    skipped: tuple[Skipped, ...] = ()
    error: str | None = None


class TrainingStream(Epochs):
    """Training batches from shards; see :class:`stackgen.data.loading.epochs.Epochs`.

    A pass visits every sample at most once, over all processes. Resumed under the same topology an epoch
    continues with the next sample; under another one, whole windows of about 8 shards are what is not
    read again.

    Args:
        dataset: A dataset of shards, wherever it lies.
        batch_size: Samples a batch, on each process.
        num_workers: Reading processes; 0 reads in this one.
        bucket_by_blocks: Whether a batch holds stacks with nearly one number of blocks, their padding trimmed away.
        mirror: Whether to reflect samples at x = 0 with probability 1/2.
        samples_per_epoch: Samples an epoch, over all processes; None for one pass.
        seed: Seed that with the epoch's number and the topology decides what is read.
        epoch: Gives the epoch's number at its start; by default epochs are counted.
        device: Gives the device that the batches are for.
        rank: Gives the rank of this process.

    Raises:
        StackgenError: If there are no training shards, or fewer samples than processes.
    """

    def __init__(
        self,
        dataset: Dataset,
        batch_size: int,
        *,
        num_workers: int = 0,
        bucket_by_blocks: bool = False,
        mirror: bool = False,
        samples_per_epoch: int | None = None,
        seed: int = 0,
        epoch: Callable[[], int] | None = None,
        device: Callable[[], torch.device] = lambda: _CPU,
        rank: Callable[[], Rank] = process_rank,
    ) -> None:
        super().__init__(batch_size, samples_per_epoch, seed, epoch, rank, max(1, num_workers))
        self.num_workers, self.bucket_by_blocks, self.mirror = num_workers, bucket_by_blocks, mirror
        self.shards, self.world = dataset.shards("train"), dataset.world
        number, processes = rank()
        self._unpacker, self._log = _Unpacker(device), SkipLog(f"(process {number})" if processes > 1 else "")
        self._whole_pass()

    def _steps(self, start: Cursor) -> int:
        return self._dealt(start).steps

    def _deal(self, cursor: Cursor) -> Iterator[Batch]:
        until = min(cursor.step + cursor.left, self._steps(cursor))
        stages = _TrainingStages(self, self._dealt(cursor), cursor, until)
        packets = _packets(stages.pipeline(), self.num_workers, self._log)
        for step, packet in enumerate(packets, cursor.step + 1):
            if step == until:  # the trainer does not ask for more than there are: now or never
                packets.close()
                if step == cursor.step + cursor.left:
                    self._log.report(f"epoch {self._passed - 1}")
            yield self._unpacker.batch(packet, trim=self.bucket_by_blocks)

    def _dealt(self, cursor: Cursor) -> Deal:
        """Deal out what earlier topologies left of a pass under the present one."""
        rng = np.random.default_rng([self.seed, cursor.number, 0])
        pieces = tuple(shuffled_shards([shard.samples for shard in self.shards], rng))
        for topology, steps in cursor.dealt[:-1]:
            pieces = Deal(pieces, topology).unread(steps)
        return Deal(pieces, cursor.topology)


class ExactStream:
    """Every readable sample of a split once, in order, shared between the processes without overlap.

    Every process reads all shards and keeps its share of the samples. So all know what could not be
    read, and have the same number of batches nevertheless.

    Args:
        dataset: A dataset of shards, wherever it lies.
        split: Name of the split.
        batch_size: Samples a batch, on each process; a last batch that makes up for losses may have two more.
        num_workers: Reading processes; 0 reads in this one, more than one are no faster.
        device: Gives the device that the batches are for.
        rank: Gives the rank of this process.

    Raises:
        StackgenError: If there are no shards of that split.
    """

    def __init__(
        self,
        dataset: Dataset,
        split: str,
        batch_size: int,
        *,
        num_workers: int = 0,
        device: Callable[[], torch.device] = lambda: _CPU,
        rank: Callable[[], Rank] = process_rank,
    ) -> None:
        self.shards, self.world = dataset.shards(split), dataset.world
        self.batch_size, self.num_workers, self.rank = batch_size, min(num_workers, 1), rank
        self._unpacker, self._log = _Unpacker(device), SkipLog()
        self._what = f"the {split} split"

    def __len__(self) -> int:
        """Count the batches on this process if everything can be read: the same on all."""
        return len(exact_batches(sum(shard.samples for shard in self.shards), self.batch_size, self.rank()))

    def __iter__(self) -> Iterator[Batch]:
        log = self._log if self.rank()[0] == 0 else None  # all processes meet the same
        stages = _ExactStages(self.shards, self.world, self.batch_size, self.rank())
        last: Packet | None = None
        for packet in chain(_packets(stages.pipeline(), self.num_workers, log), [None]):
            if packet is None and log is not None:
                log.report(self._what)
            if last is not None:
                yield self._unpacker.batch(last)
            last = packet


class _Stages:
    """Stages that open and decode shards, and remember what could not be read.

    Args:
        shards: Shards of the split.
        world: World of the dataset.
    """

    def __init__(self, shards: Sequence[Shard], world: World) -> None:
        self.shards, self.world = shards, world
        self._skipped: list[Skipped] = []
        self._in_vain = 0  # shards in a row without a readable sample

    def fetch_and_decode(self, items: Iterable[Item]) -> Iterator[Item]:
        """Add the `stacks` of its `piece` to each item; neighbours that are of one shard share its reading.

        Raises:
            StackgenError: If none of many shards in a row had a readable sample.
        """
        for number, those in groupby(items, key=lambda item: item["piece"].shard):
            decoded = self._decoded(number)
            for item in those:
                first, last = np.searchsorted(decoded.positions, (item["piece"].start, item["piece"].stop))
                yield {**item, "stacks": decoded.stacks.select(slice(first, last))}

    def _decoded(self, number: int) -> Decoded:
        decoded, skipped = read_decoded(self.shards[number], self.world)
        self._skipped += skipped
        self._in_vain = 0 if len(decoded.stacks) or not skipped else self._in_vain + 1
        if self._in_vain == HOPELESS:
            raise StackgenError(f"data: {HOPELESS} shards in a row cannot be read; the last one: {skipped[-1].what}")
        return decoded

    def news(self) -> tuple[Skipped, ...]:
        """Say what was skipped since this was last asked."""
        skipped, self._skipped = tuple(self._skipped), []
        return skipped

    def last_words(self, packets: Iterable[Packet]) -> Iterator[Packet]:
        """Turn an error into a last packet: torch would make a traceback of it."""
        try:
            yield from packets
        except StackgenError as error:
            yield Packet(skipped=self.news(), error=str(error))


class _TrainingStages(_Stages):
    """One process's batches of a stretch of a pass."""

    def __init__(self, stream: TrainingStream, deal: Deal, cursor: Cursor, until: int) -> None:
        super().__init__(stream.shards, stream.world)
        self.deal, self.after, self.until, self.rank = deal, cursor.step, until, stream.rank()[0]
        self.seeds = [stream.seed, cursor.number, len(cursor.dealt)]
        self.bucket_by_blocks, self.mirror = stream.bucket_by_blocks, stream.mirror

    def pipeline(self) -> wds.DataPipeline:
        """Put the stages together."""
        return wds.DataPipeline(
            self.turns,
            wds.split_by_worker,
            self.pieces,
            self.fetch_and_decode,
            self.windows,
            self.batches,
            self.last_words,
        )

    def turns(self) -> Iterator[Item]:
        """List what each worker contributes, in the order in which the loader asks them.

        The share of this process was dealt before: `split_by_node` asks torch for the rank, and a worker that was
        spawned does not know it.
        """
        workers = self.deal.topology.workers
        for worker in range(workers):
            yield {"numbers": self.deal.worker_batches((worker + self.after) % workers, self.after, self.until)}

    def pieces(self, turns: Iterable[Item]) -> Iterator[Item]:
        """List the pieces of shards that a worker reads, window by window."""
        per_window = self.deal.batches_per_window
        for turn in turns:
            numbers = turn["numbers"]
            for window in range(numbers.start // per_window, -(-numbers.stop // per_window) if len(numbers) else 0):
                for piece in self.deal.window(self.rank, window):
                    yield {"numbers": numbers, "window": window, "piece": piece}

    def windows(self, items: Iterable[Item]) -> Iterator[Item]:
        """Put the pieces of each window together and shuffle them into `groups`, the batches of the window."""
        for window, those in groupby(items, key=lambda item: item["window"]):
            parts = list(those)
            stacks = self._readable([part["stacks"] for part in parts], parts[-1]["piece"].shard)
            rng = np.random.default_rng([*self.seeds, window, 1 + self.rank])
            wanted = len(self.deal.window_batches(window)) * self.deal.batch_size
            order = rng.permutation(len(stacks))
            if len(order) < wanted:  # others of the window in the place of those that could not be read
                order = np.concatenate([order, rng.integers(len(stacks), size=wanted - len(order))])
            order = order[:wanted]
            if self.bucket_by_blocks:
                order = order[np.argsort(stacks.lengths[order], kind="stable")]
            groups = np.split(order, range(self.deal.batch_size, wanted, self.deal.batch_size))
            # All processes take short and long stacks in the same order, so that none waits for another.
            turn = np.random.default_rng([*self.seeds, window, 0]).permutation(len(groups))
            flips = rng.random(len(stacks)) < 0.5
            yield {**parts[0], "stacks": stacks, "groups": [groups[i] for i in turn], "flips": flips}

    def batches(self, windows: Iterable[Item]) -> Iterator[Packet]:
        """Hand over those batches of a window that this worker contributes."""
        for item in windows:
            for number, group in zip(self.deal.window_batches(item["window"]), item["groups"], strict=True):
                if number in item["numbers"]:
                    flips = item["flips"][group] if self.mirror else None
                    yield Packet(item["stacks"].select(group), flips, self.news())

    def _readable(self, parts: list[StackArrays], after: int) -> StackArrays:
        """Put some parts together; if they are empty, take the next shard that has any sample."""
        stacks, count = StackArrays.concatenate(parts), len(self.shards)
        for i in range(1, count + 1):
            if len(stacks):
                return stacks
            stacks = self._decoded((after + i) % count).stacks
        if not len(stacks):
            raise StackgenError("data: there is no readable sample in any shard; the lines above name the damage")
        return stacks


class _ExactStages(_Stages):
    """One process's batches of an exact pass."""

    def __init__(self, shards: Sequence[Shard], world: World, batch_size: int, rank: Rank) -> None:
        super().__init__(shards, world)
        self.rank, self.processes = rank
        count = sum(shard.samples for shard in shards)
        # (processes, batches) samples that each process has had after each batch, if everything can be read
        dealt = [exact_batches(count, batch_size, (number, self.processes)) for number in range(self.processes)]
        self.planned = np.stack([np.cumsum([len(batch) for batch in batches]) for batches in dealt])

    def pipeline(self) -> wds.DataPipeline:
        """Put the stages together."""
        return wds.DataPipeline(self.pieces, self.fetch_and_decode, self.batches, self.last_words)

    def pieces(self) -> Iterator[Item]:
        """List all shards, whole."""
        return ({"piece": Piece(number, 0, shard.samples)} for number, shard in enumerate(self.shards))

    def batches(self, items: Iterable[Item]) -> Iterator[Packet]:
        """Keep this process's share of the samples, and hand it over in batches."""
        seen, held, taken, number = 0, [], 0, 0
        for item in items:
            held.append(item["stacks"].select(slice((self.rank - seen) % self.processes, None, self.processes)))
            seen += len(item["stacks"])
            while number + 1 < self.planned.shape[1] and self._all_have_more(number, seen):
                size = int(self.planned[self.rank, number]) - taken
                rest = StackArrays.concatenate(held)
                held, taken, number = [rest.select(slice(size, None))], taken + size, number + 1
                yield Packet(rest.select(slice(size)), skipped=self.news())
        if seen < self.processes:
            raise StackgenError(f"data: {seen} readable samples cannot be shared by {self.processes} processes")
        yield Packet(StackArrays.concatenate(held), skipped=self.news())

    def _all_have_more(self, number: int, seen: int) -> bool:
        """Tell whether every process can have its batch of this number, and something for another one."""
        shares = [len(range(rank, seen, self.processes)) for rank in range(self.processes)]
        return all(share > planned for share, planned in zip(shares, self.planned[:, number], strict=True))


class _Unpacker:
    """Packets to batches on a device."""

    def __init__(self, device: Callable[[], torch.device]) -> None:
        self._device, self._buffers = device, Buffers()

    def batch(self, packet: Packet, trim: bool = False) -> Batch:
        assert packet.stacks is not None
        tensors = StackTensors.of(packet.stacks, self._buffers).to(self._device())
        mirrored = None if packet.mirrored is None else torch.from_numpy(packet.mirrored)
        longest = int(packet.stacks.lengths.max()) if trim else None
        return tensors.batch(torch.arange(len(packet.stacks)), mirrored, longest)


def _packets(pipeline: wds.DataPipeline, workers: int, log: SkipLog | None) -> Generator[Packet, None, None]:
    """Read packets here or by workers that take turns; what was skipped is counted, errors are raised."""
    own = torch.Generator()  # else the loader draws from the stream of numbers that the model draws from
    for packet in wds.WebLoader(pipeline, batch_size=None, num_workers=workers, generator=own):
        if log is not None:
            log.add(packet.skipped)
        if packet.error is not None:
            raise StackgenError(packet.error)
        if packet.stacks is not None:
            yield packet
