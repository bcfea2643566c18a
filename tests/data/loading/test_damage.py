"""What cannot be read is named, counted and skipped, in a stream as in memory."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from stackgen.data.datamodule import StackDataModule
from stackgen.data.dataset import Dataset
from stackgen.data.loading import streaming
from stackgen.data.loading.streaming import ExactStream, TrainingStream
from stackgen.data.shards import Sample, write_shard
from stackgen.errors import StackgenError
from tests.data.loading.batches import TRAIN, VALIDATION, place_of, templates

pytestmark = pytest.mark.usefixtures("small_window")


@contextmanager
def said() -> Iterator[list[str]]:
    """The lines of the data module while this runs."""
    lines: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        yield lines
    lines += [str(w.message) for w in caught if str(w.message).startswith("data")]
    assert not any("\n" in line for line in lines)


def copy_of(dataset: Path, folder: Path, **shards: list[Sample]) -> Path:
    """The dataset with other samples in some shards, as if it had been written so; `train_000001` names a shard."""
    shutil.copytree(dataset, folder)
    manifest = Dataset.open(folder).manifest
    entries = {entry["file"]: entry for entry in manifest.shards}
    for name, samples in shards.items():
        file = name.replace("_", "-") + ".tar"
        entries[file] = write_shard(folder / file, samples)
    replace(manifest, shards=tuple(entries.values())).save(folder)
    return folder


@pytest.fixture
def damaged(dataset: Path, tmp_path: Path) -> Path:
    """The dataset with a training shard cut short, and one bit of a pose changed in the validation shard."""
    folder = tmp_path / "damaged"
    shutil.copytree(dataset, folder)
    content = (folder / "train-000000.tar").read_bytes()
    (folder / "train-000000.tar").write_bytes(content[: len(content) // 2])
    flipped = bytearray((folder / "validation-000002.tar").read_bytes())
    flipped[flipped.index(b"\x93NUMPY") + 140] ^= 1
    (folder / "validation-000002.tar").write_bytes(flipped)
    return folder


@pytest.fixture
def faulty(dataset: Path, samples: dict[str, list[Sample]], tmp_path: Path) -> Path:
    """The dataset with a broken sample in a training shard and two in the validation shard, checksums being right."""
    train, validation = list(samples["train-000001.tar"]), list(samples["validation-000002.tar"])
    train[4] = replace(train[4], poses=np.full_like(train[4].poses, np.nan))
    validation[0] = replace(validation[0], shapes=validation[0].shapes + 200)
    validation[9] = replace(validation[9], silhouette=np.zeros((32, 32), bool))
    return copy_of(dataset, tmp_path / "faulty", train_000001=train, validation_000002=validation)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_damaged_shard_is_named_and_counted_and_takes_no_batch_away(damaged: Path, workers: int) -> None:
    data = StackDataModule(damaged, batch_size=8, mode="stream", num_workers=workers)
    with said() as lines:
        batches = list(data.train_dataloader())
    assert len(batches) == TRAIN // 8 and all(len(batch["template"]) == 8 for batch in batches)
    assert set(templates(batches)) <= set(range(41, 71))  # not one from the shard whose checksum is wrong
    assert len(lines) == 2
    assert "train-000000.tar is damaged: cut short or altered, its checksum is not the one" in lines[0]
    assert lines[1] == "data: samples skipped in epoch 0: 41"


def test_damage_is_reported_in_every_epoch_and_named_in_the_first(damaged: Path) -> None:
    stream = TrainingStream(Dataset.open(damaged), 8)
    with said() as lines:
        for _ in range(3):
            list(stream)
    assert "train-000000.tar is damaged" in lines[0]
    assert lines[1:] == [f"data: samples skipped in epoch {number}: 41" for number in range(3)]


def test_one_flipped_bit_costs_the_shard_and_leaves_nothing_to_validate(damaged: Path) -> None:
    with said() as lines, pytest.raises(StackgenError, match="0 readable samples cannot be shared by 1 processes"):
        list(StackDataModule(damaged, mode="stream").val_dataloader())
    assert len(lines) == 1 and "validation-000002.tar is damaged" in lines[0]


@pytest.mark.parametrize("workers", [0, 1])
def test_broken_samples_are_skipped_named_and_counted(faulty: Path, workers: int) -> None:
    data = StackDataModule(faulty, batch_size=8, mode="stream", num_workers=workers)
    with said() as lines:
        training = list(data.train_dataloader())
        validation = list(data.val_dataloader())
    assert len(training) == TRAIN // 8 and all(torch.isfinite(batch["poses"]).all() for batch in training)
    assert 45 not in templates(training)
    assert templates(validation) == [t for t in range(71, 94) if t not in (71, 80)]
    assert lines == [
        "data: skipped a broken sample of train-000001.tar, 0000045: "
        "poses that are not finite, or shapes beyond the catalogue",
        "data: samples skipped in epoch 0: 1",
        "data: skipped a broken sample of validation-000002.tar, 0000080: "
        "a packed silhouette of size (32, 4), not of 64 pixels square",
        "data: skipped a broken sample of validation-000002.tar, 0000071: "
        "poses that are not finite, or shapes beyond the catalogue",
        "data: samples skipped in the validation split: 2",
    ]


def test_memory_skips_and_names_the_same_samples(faulty: Path) -> None:
    with said() as lines:
        found = Dataset.open(faulty)
        train, validation = found.split("train"), found.split("validation")
    assert train.template.tolist() == [t for t in range(71) if t != 45]
    assert validation.template.tolist() == [t for t in range(71, 94) if t not in (71, 80)]
    assert len(lines) == 5
    assert lines[1] == f"data: samples skipped in the train split of {faulty}: 1"
    assert lines[-1] == f"data: samples skipped in the validation split of {faulty}: 2"


def test_memory_refuses_a_damaged_shard(damaged: Path) -> None:
    for split, file in (("train", r"train-000000\.tar"), ("validation", r"validation-000002\.tar")):
        with pytest.raises(StackgenError, match=rf"{file} is damaged.*`stackgen dataset repair`") as caught:
            Dataset.open(damaged).split(split)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("lost", [{4}, {0, 1, 2}, {22}, {20, 21, 22}, set(range(1, 20)), set(range(5, 23))])
@pytest.mark.parametrize("batch_size", [1, 3, 8])
def test_losses_leave_processes_with_equally_many_validation_batches(
    dataset: Path, samples: dict[str, list[Sample]], tmp_path: Path, lost: set[int], batch_size: int
) -> None:
    those = list(samples["validation-000002.tar"])
    for i in lost:
        those[i] = replace(those[i], poses=those[i].poses * np.nan)
    folder = copy_of(dataset, tmp_path / "lossy", validation_000002=those)
    with said() as lines:
        shares = [
            [
                b["template"].tolist()
                for b in ExactStream(Dataset.open(folder), "validation", batch_size, rank=partial(place_of, rank))
            ]
            for rank in range(3)
        ]
    assert len({len(share) for share in shares}) == 1
    assert all(1 <= len(batch) <= batch_size + 2 for share in shares for batch in share)
    together = sorted(t for share in shares for batch in share for t in batch)
    assert together == [71 + i for i in range(VALIDATION) if i not in lost]
    assert lines[-1] == f"data: samples skipped in the validation split: {len(lost)}"  # by one of the three
    assert sum("samples skipped in" in line for line in lines) == 1


@pytest.mark.parametrize("workers", [0, 2])
def test_a_dataset_without_a_readable_sample_is_an_error_and_not_an_endless_wait(
    dataset: Path, tmp_path: Path, workers: int
) -> None:
    folder = tmp_path / "empty"
    shutil.copytree(dataset, folder)
    for path in folder.glob("train-*.tar"):
        path.write_bytes(b"nothing")
    with said() as lines, pytest.raises(StackgenError, match="no readable sample in any shard") as caught:
        list(TrainingStream(Dataset.open(folder), 8, num_workers=workers))
    assert "\n" not in str(caught.value)
    assert sum("is damaged" in line for line in lines) == 2


def test_after_many_unreadable_shards_in_a_row_it_gives_up(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = copy_of(dataset, tmp_path / "gone")
    (folder / "train-000000.tar").unlink()
    (folder / "train-000001.tar").unlink()
    monkeypatch.setattr(streaming, "HOPELESS", 2)
    with said(), pytest.raises(StackgenError, match=r"2 shards in a row cannot be read; .*there is no file"):
        list(TrainingStream(Dataset.open(folder), 8))


def test_a_shard_that_holds_fewer_samples_than_the_manifest_says_is_reported(
    dataset: Path, samples: dict[str, list[Sample]], tmp_path: Path
) -> None:
    folder = copy_of(dataset, tmp_path / "short", validation_000002=samples["validation-000002.tar"][:20])
    manifest = Dataset.open(folder).manifest
    entries = [{**entry, "samples": 23} if entry["split"] == "validation" else entry for entry in manifest.shards]
    replace(manifest, shards=tuple(entries)).save(folder)
    with said() as lines:
        assert len(templates(ExactStream(Dataset.open(folder), "validation", 8))) == 20
    assert lines[-1] == "data: samples skipped in the validation split: 3"
    with said() as lines:
        assert len(Dataset.open(folder).split("validation")) == 20
    assert lines == [
        "data: validation-000002.tar lacks 3 of the samples that dataset.json says it has",
        f"data: samples skipped in the validation split of {folder}: 3",
    ]


def test_a_shard_that_holds_more_samples_than_the_manifest_says_is_refused(dataset: Path, tmp_path: Path) -> None:
    folder = copy_of(dataset, tmp_path / "long")
    manifest = Dataset.open(folder).manifest
    replace(manifest, shards=tuple({**entry, "samples": 20} for entry in manifest.shards)).save(folder)
    with pytest.raises(StackgenError, match=r"validation-000002\.tar holds more samples than dataset\.json says"):
        Dataset.open(folder).split("validation")
