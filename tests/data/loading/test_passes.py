"""Which process visits which samples when: laws of pure functions."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stackgen.data.loading import passes
from stackgen.data.loading.passes import (
    Cursor,
    Deal,
    Piece,
    Topology,
    cut,
    exact_batches,
    number_of_groups,
    shuffled_shards,
    training_groups,
)
from stackgen.errors import StackgenError

Sample = tuple[int, int]
SHARDS = st.lists(st.integers(0, 30), min_size=1, max_size=8)
TOPOLOGIES = st.builds(Topology, st.integers(1, 12), st.integers(1, 4), st.integers(1, 3))


def samples_of(pieces: Iterable[Piece]) -> list[Sample]:
    """(shard, number) of every sample of some pieces."""
    return [(piece.shard, i) for piece in pieces for i in range(piece.start, piece.stop)]


def dealt(counts: list[int], topology: Topology) -> Deal:
    return Deal(tuple(shuffled_shards(counts, np.random.default_rng(0))), topology)


@given(
    sizes=st.lists(st.integers(1, 60), min_size=1, max_size=4),
    batch_size=st.integers(1, 16),
    world=st.integers(1, 4),
    seed=st.integers(0, 99),
)
@settings(max_examples=100, deadline=None)
def test_processes_share_a_training_pass_without_overlap(
    sizes: list[int], batch_size: int, world: int, seed: int
) -> None:
    ends = np.cumsum([0, *sizes])
    buckets = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    groups = training_groups(buckets, batch_size, np.random.default_rng(seed), world)
    ranks = [[group[rank::world] for group in groups] for rank in range(world)]  # as the cached loader takes them
    assert len({len(batches) for batches in ranks}) == 1
    everyone = np.concatenate([batch for batches in ranks for batch in batches] or [np.arange(0)])
    assert len(set(everyone.tolist())) == len(everyone)
    for bucket in buckets:  # only the rest of a last batch is left out
        left_out = len(bucket) - np.isin(bucket, everyone).sum()
        assert left_out < (batch_size if len(bucket) >= batch_size * world else 1) * world
    for together in zip(*ranks, strict=True):
        of = {int(np.searchsorted(ends, i, side="right")) for batch in together for i in batch}
        assert len(of) == 1  # all processes in the same bucket at the same time
        assert len({len(batch) for batch in together}) == 1


@given(count=st.integers(1, 200), batch_size=st.integers(1, 32), world=st.integers(1, 8))
@settings(max_examples=200, deadline=None)
def test_an_exact_pass_visits_everyone_once_in_equally_many_batches(count: int, batch_size: int, world: int) -> None:
    if count < world:
        with pytest.raises(StackgenError):
            exact_batches(count, batch_size, (0, world))
        return
    ranks = [exact_batches(count, batch_size, (rank, world)) for rank in range(world)]
    assert len({len(batches) for batches in ranks}) == 1
    assert all(1 <= len(batch) <= max(batch_size, 2 if world > 1 else 1) for batches in ranks for batch in batches)
    assert sorted(int(i) for batches in ranks for batch in batches for i in batch) == list(range(count))


@given(sizes=st.lists(st.integers(0, 60), max_size=4), topology=TOPOLOGIES)
@settings(max_examples=100, deadline=None)
def test_the_length_of_a_pass_is_known_without_shuffling(sizes: list[int], topology: Topology) -> None:
    groups = training_groups(map(np.arange, sizes), topology.batch_size, np.random.default_rng(0), topology.processes)
    assert number_of_groups(sizes, topology.batch_size, topology.processes) == len(groups)


@given(counts=SHARDS, bounds=st.tuples(st.integers(0, 200), st.integers(0, 200)))
@settings(max_examples=100, deadline=None)
def test_a_cut_is_a_stretch_of_the_row(counts: list[int], bounds: tuple[int, int]) -> None:
    pieces = shuffled_shards(counts, np.random.default_rng(1))
    assert sorted(samples_of(pieces)) == [(i, j) for i, count in enumerate(counts) for j in range(count)]
    start, stop = sorted(bounds)
    assert samples_of(cut(pieces, start, stop)) == samples_of(pieces)[start:stop]


@given(counts=SHARDS, topology=TOPOLOGIES, window=st.integers(1, 40))
@settings(max_examples=200, deadline=None)
def test_processes_share_the_shards_without_overlap_in_equally_many_batches(
    counts: list[int], topology: Topology, window: int
) -> None:
    """Whatever the shards: also if the last one of a process is short, or there are fewer shards than processes."""
    deal = dealt(counts, topology)
    with patch.object(passes, "WINDOW", window):
        read = Counter[Sample]()
        for rank in range(topology.processes):
            batches: list[int] = []
            for number in range(deal.windows):
                those = samples_of(deal.window(rank, number))
                assert len(those) == len(deal.window_batches(number)) * deal.batch_size
                read.update(those)
                batches += deal.window_batches(number)
            assert batches == list(range(deal.steps))
    assert all(count == 1 for count in read.values())
    if sum(counts) >= topology.together:
        assert deal.batch_size == topology.batch_size and sum(counts) - len(read) < topology.together
    else:
        assert sum(counts) - len(read) < topology.processes
    assert deal.steps == len(read) / (deal.batch_size * topology.processes)


@given(steps=st.integers(0, 40), topology=TOPOLOGIES, bounds=st.tuples(st.integers(0, 40), st.integers(0, 40)))
@settings(max_examples=200, deadline=None)
def test_workers_take_turns_and_leave_no_batch_out(steps: int, topology: Topology, bounds: tuple[int, int]) -> None:
    deal = dealt([steps * topology.together], topology)
    whole = [i for worker in range(topology.workers) for i in deal.worker_batches(worker)]
    assert whole == list(range(deal.steps))
    after, until = sorted(bounds)
    for worker in range(topology.workers):
        turns = [step for step in range(after, min(until, deal.steps)) if step % topology.workers == worker]
        own = list(deal.worker_batches(worker))
        assert (
            list(deal.worker_batches(worker, after, until))
            == own[len(deal.worker_batches(worker, 0, after)) :][: len(turns)]
        )
        assert len(deal.worker_batches(worker, after, until)) == len(turns)


@given(counts=SHARDS, topology=TOPOLOGIES, window=st.integers(1, 40), share=st.floats(0, 1))
@settings(max_examples=200, deadline=None)
def test_what_is_unread_is_all_but_the_finished_windows(
    counts: list[int], topology: Topology, window: int, share: float
) -> None:
    deal = dealt(counts, topology)
    done = int(share * deal.steps)
    with patch.object(passes, "WINDOW", window):
        delivered = {i for worker in range(topology.workers) for i in deal.worker_batches(worker, until=done)}
        assert len(delivered) == done
        finished = Counter[Sample]()
        for rank, number in itertools.product(range(topology.processes), range(deal.windows)):
            if set(deal.window_batches(number)) <= delivered:
                finished.update(samples_of(deal.window(rank, number)))
        unread = Counter(samples_of(deal.unread(done)))
    everything = Counter((i, j) for i, count in enumerate(counts) for j in range(count))
    assert finished + unread == everything  # nothing lost, nothing twice
    # At most one window that was begun and not finished for each reader.
    again = done * deal.batch_size * topology.processes - finished.total()
    assert again <= topology.processes * topology.workers * 2 * max(window, deal.batch_size)


def test_a_cursor_survives_a_checkpoint() -> None:
    cursor = Cursor(3, ((Topology(8, 2, 1), 5), (Topology(8, 1, 2), 0)), 7)
    assert Cursor.from_json(cursor.to_json()) == cursor
    assert cursor.moved() == Cursor(3, ((Topology(8, 2, 1), 5), (Topology(8, 1, 2), 1)), 6)
    assert cursor.next_pass() == Cursor.start(4, Topology(8, 1, 2), 7)
