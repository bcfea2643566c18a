"""Streaming gives the same batches as memory does."""

from __future__ import annotations

import json
from collections import Counter
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from stackgen.data.arrays import StackArrays
from stackgen.data.datamodule import StackDataModule
from stackgen.data.dataset import Dataset
from stackgen.data.loading.streaming import ExactStream, TrainingStream
from tests.data.loading.batches import TRAIN, place_of, templates

pytestmark = pytest.mark.usefixtures("small_window")


@pytest.mark.parametrize("workers", [0, 2])
def test_an_exact_stream_is_the_split_in_memory(dataset: Path, splits: dict[str, StackArrays], workers: int) -> None:
    data = StackDataModule(dataset, batch_size=10, mode="stream", num_workers=workers, test_path=dataset)
    for loader, split in ((data.val_dataloader(), "validation"), (data.test_dataloader(), "test")):
        batches = list(loader)
        assert len(batches) == len(loader)  # type: ignore[arg-type]
        expected = splits[split].batch(np.arange(len(splits[split])))
        assert all(torch.equal(torch.cat([b[name] for b in batches]), expected[name]) for name in expected)


@pytest.mark.parametrize("batch_size", [1, 4, 7, 50])
def test_ranks_share_an_exact_stream(dataset: Path, splits: dict[str, StackArrays], batch_size: int) -> None:
    streams = [
        ExactStream(Dataset.open(dataset), "validation", batch_size, rank=partial(place_of, rank)) for rank in range(3)
    ]
    cached = StackDataModule(dataset, batch_size=batch_size)
    shares = [[batch["template"].tolist() for batch in stream] for stream in streams]
    assert [len(share) for share in shares] == [len(stream) for stream in streams]
    assert len({len(share) for share in shares}) == 1
    together = [t for share in shares for batch in share for t in batch]
    assert sorted(together) == templates(cached.val_dataloader())


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("world", [1, 3])
def test_an_epoch_visits_everyone_at_most_once_and_leaves_out_less_than_a_step(
    dataset: Path, splits: dict[str, StackArrays], workers: int, world: int
) -> None:
    arrays, batch_size = splits["train"], 5
    place = {t: i for i, t in enumerate(arrays.template.tolist())}
    sign, images = torch.tensor([-1.0, 1, 1, 1, -1, -1]), torch.from_numpy(arrays.images())
    seen, flips = Counter[int](), []
    for rank in range(world):
        stream = TrainingStream(
            Dataset.open(dataset), batch_size, num_workers=workers, mirror=True, rank=partial(place_of, rank, world)
        )
        batches = list(stream)
        assert len(batches) == len(stream) == TRAIN // (batch_size * world)
        seen.update(templates(batches))
        for batch in batches:
            assert len(batch["template"]) == batch_size
            for t, poses, image in zip(batch["template"].tolist(), batch["poses"], batch["silhouette"], strict=True):
                original = torch.from_numpy(arrays.poses[place[t]])
                flipped = not torch.equal(poses, original)
                flips.append(flipped)
                assert torch.equal(poses, original * sign if flipped else original)
                picture = images[place[t]]
                assert torch.equal(image > 0, picture.flip(-1) if flipped else picture)
    assert max(seen.values()) == 1 and TRAIN - len(seen) < batch_size * world
    assert 0.25 < np.mean(flips) < 0.75


def test_the_number_of_workers_changes_the_order_alone(dataset: Path) -> None:
    epochs = [
        [b["template"].tolist() for b in TrainingStream(Dataset.open(dataset), 5, num_workers=n)] for n in (0, 1, 2)
    ]
    assert epochs[0] == epochs[1] != epochs[2]
    assert sorted(epochs[0]) == sorted(epochs[2])


def test_a_stream_depends_on_seed_epoch_and_rank(dataset: Path) -> None:
    def epoch(number: int, seed: int = 0, rank: int = 0) -> list[Any]:
        stream = TrainingStream(
            Dataset.open(dataset),
            8,
            seed=seed,
            mirror=True,
            samples_per_epoch=96,
            epoch=lambda: number,
            rank=lambda: (rank, 2),
        )
        assert len(stream) == 6
        return [(b["template"].tolist(), b["poses"].numpy().tobytes()) for b in stream]

    assert epoch(1) == epoch(1)
    others = [epoch(2), epoch(1, seed=1), epoch(1, rank=1)]
    assert all(epoch(1) != other for other in others)


def test_epochs_of_another_length_are_cut_from_one_row_of_passes(dataset: Path) -> None:
    whole = TrainingStream(Dataset.open(dataset), 16, seed=5)
    cut = TrainingStream(Dataset.open(dataset), 16, seed=5, samples_per_epoch=50)
    assert len(whole) == 4 and len(cut) == 3
    assert templates([b for _ in range(4) for b in cut]) == templates([b for _ in range(3) for b in whole])


def test_buckets_hold_like_with_like_and_no_more_padding_than_they_must(dataset: Path) -> None:
    batches = list(TrainingStream(Dataset.open(dataset), 4, bucket_by_blocks=True))
    assert len(batches) == TRAIN // 4
    for batch in batches:
        assert batch["mask"].any(0).all() and batch["poses"].shape[1] == batch["mask"].shape[1]
    mixed = [len(set(batch["mask"].sum(1).tolist())) - 1 for batch in batches]
    windows = -(-len(batches) // 4)  # of 16 samples
    lengths = 7  # 4 to 10 blocks
    assert sum(mixed) <= windows * (lengths - 1)
    everyone = list(TrainingStream(Dataset.open(dataset), 4))
    assert sorted(templates(batches)) == sorted(templates(everyone))
    assert sum(b["mask"].numel() for b in batches) < 0.8 * sum(b["mask"].numel() for b in everyone)


def test_reading_leaves_the_random_numbers_of_the_model_alone(dataset: Path) -> None:
    torch.manual_seed(0)
    list(TrainingStream(Dataset.open(dataset), 8, mirror=True))
    list(ExactStream(Dataset.open(dataset), "validation", 8))
    after = torch.rand(3)
    torch.manual_seed(0)
    assert torch.equal(after, torch.rand(3))


# Resumed.


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("length", [None, 90])
def test_a_resumed_epoch_goes_on_with_the_next_sample(dataset: Path, workers: int, length: int | None) -> None:
    def stream() -> TrainingStream:
        return TrainingStream(
            Dataset.open(dataset),
            4,
            num_workers=workers,
            bucket_by_blocks=True,
            mirror=True,
            samples_per_epoch=length,
            epoch=lambda: 3,
        )

    def shown(batches: Any) -> list[Any]:
        return [(b["template"].tolist(), b["poses"].numpy().tobytes()) for b in batches]

    whole = shown(stream())
    for stop in (1, 7, len(whole)):
        first, second = stream(), stream()
        begun = shown(islice(first, stop))
        second.load_state_dict(json.loads(json.dumps(first.state_dict())))
        assert len(second) == len(whole) and not second.is_leftover
        assert begun + shown(second) == whole


@pytest.mark.parametrize(("worlds"), [(2, 1), (1, 3), (2, 3, 1)])
def test_on_another_number_of_processes_no_finished_window_is_read_again(
    dataset: Path, worlds: tuple[int, ...]
) -> None:
    state, seen, again = None, Counter[int](), 0
    for turn, world in enumerate(worlds):
        streams = [
            TrainingStream(Dataset.open(dataset), 4, rank=partial(place_of, rank, world), epoch=lambda: 2)
            for rank in range(world)
        ]
        for stream in streams:
            if state is not None:
                stream.load_state_dict(state)
                assert stream.is_leftover
        assert len({len(stream) for stream in streams}) == 1
        stop = 5 if turn < len(worlds) - 1 else None
        lengths = set()
        for stream in streams:
            batches = list(islice(stream, stop))
            lengths.add(len(batches))
            seen.update(templates(batches))
        assert len(lengths) == 1
        again += world * 16  # a window for each reader that may be begun and not finished
        state = streams[0].state_dict()
    assert seen.total() - len(seen) <= again
    assert max(seen.values()) <= len(worlds)
    assert TRAIN - len(seen) < 4 * worlds[-1]
