"""Streaming gives the same batches as memory does, and says what it could not read."""

from __future__ import annotations

import shutil
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from stackgen.data import streaming
from stackgen.data.arrays import StackArrays
from stackgen.data.datamodule import StackDataModule
from stackgen.data.streaming import ExactStream, TrainingStream
from stackgen.stack import StackgenError


def _place(rank: int) -> tuple[int, int]:
    return rank, 3


@pytest.fixture(autouse=True)
def small_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shuffle buffer to suit the data."""
    monkeypatch.setattr(streaming, "SHUFFLE_BUFFER", 20)


@pytest.fixture
def broken(dataset: Path, tmp_path: Path) -> Path:
    """The dataset with one training shard cut short, one validation shard too, and a damaged sample."""
    folder = tmp_path / "broken"
    shutil.copytree(dataset, folder)
    for name in ("train-000000.tar", "validation-000002.tar"):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])
    return folder


def test_an_exact_stream_is_the_split_in_memory(dataset: Path, splits: dict[str, StackArrays]) -> None:
    data = StackDataModule(dataset, batch_size=10, mode="stream", test_path=dataset)
    for loader, split in ((data.val_dataloader(), "validation"), (data.test_dataloader(), "test")):
        batches = list(loader)
        assert len(batches) == len(loader)  # type: ignore[arg-type]
        expected = splits[split].batch(np.arange(len(splits[split])))
        assert all(torch.equal(torch.cat([b[name] for b in batches]), expected[name]) for name in expected)


def test_ranks_share_an_exact_stream(dataset: Path, splits: dict[str, StackArrays]) -> None:
    streams = [ExactStream(dataset, "validation", 4, partial(_place, rank)) for rank in range(3)]
    shares = [[t for b in stream for t in b["template"].tolist()] for stream in streams]
    assert len({len(stream) for stream in streams}) == 1
    assert sorted(t for share in shares for t in share) == splits["validation"].template.tolist()


@pytest.mark.parametrize("workers", [0, 2])
def test_training_batches_hold_samples_of_the_split(
    dataset: Path, splits: dict[str, StackArrays], workers: int
) -> None:
    stream = TrainingStream(dataset, 8, num_workers=workers, bucket_by_blocks=True, mirror=True)
    batches = list(stream)
    assert len(batches) == len(stream) == 71 // 8
    arrays = splits["train"]
    place = {t: i for i, t in enumerate(arrays.template.tolist())}
    for batch in batches:
        k = batch["poses"].shape[1]
        assert batch["mask"].all() and len(batch["poses"]) == 8
        for t, poses in zip(batch["template"].tolist(), batch["poses"], strict=True):
            original = torch.from_numpy(arrays.poses[place[t]][:k])
            assert torch.equal(poses.abs(), original.abs())


def test_a_stream_depends_on_seed_epoch_and_rank(dataset: Path) -> None:
    def epoch(number: int, seed: int = 0, rank: int = 0) -> list[Any]:
        stream = TrainingStream(
            dataset, 8, seed=seed, mirror=True, samples_per_epoch=96, epoch=lambda: number, place=lambda: (rank, 2)
        )
        assert len(stream) == 6
        return [(b["template"].tolist(), b["poses"].numpy().tobytes()) for b in stream]

    assert epoch(1) == epoch(1)
    others = [epoch(2), epoch(1, seed=1), epoch(1, rank=1)]
    assert all(epoch(1) != other for other in others)


@pytest.mark.parametrize("workers", [0, 1])
def test_what_cannot_be_read_is_counted_and_reported(broken: Path, workers: int) -> None:
    data = StackDataModule(broken, batch_size=8, mode="stream", num_workers=workers, samples_per_epoch=400)
    with pytest.warns(UserWarning, match=r"data: [1-9]\d* broken samples or shards were skipped"):
        batches = list(data.train_dataloader())
    assert len(batches) == 50 and all(torch.isfinite(batch["poses"]).all() for batch in batches)


def test_a_short_validation_shard_is_reported_with_the_number_of_samples_lost(broken: Path) -> None:
    loader = StackDataModule(broken, batch_size=8, mode="stream").val_dataloader()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read = sum(len(batch["template"]) for batch in loader)
    assert 0 < read < 23
    assert [str(w.message) for w in caught if "skipped" in str(w.message)] == [
        f"data: {23 - read} broken samples or shards were skipped in this epoch"
    ]


def test_a_dataset_without_a_readable_sample_is_an_error_and_not_an_endless_wait(broken: Path) -> None:
    for path in broken.glob("train-*.tar"):
        path.write_bytes(b"nothing")
    with pytest.raises(StackgenError, match="no readable sample"):
        next(iter(TrainingStream(broken, 8)))


def test_memory_refuses_a_broken_shard(broken: Path) -> None:
    with pytest.raises(StackgenError, match=r"train-000000\.tar"):
        StackDataModule(broken).setup("fit")
