"""A dataset is opened one way, whatever form it has, and webdataset itself reads its shards with stages from here."""

from __future__ import annotations

import io
import json
import tarfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import webdataset as wds

from stackgen._lightning import pl
from stackgen.data import Dataset, StackDataModule, decode, to_batch
from stackgen.data.arrays import StackArrays
from stackgen.data.compact import save_npz
from stackgen.data.dataset import read_manifest
from stackgen.data.shards import Sample, encode_shard
from stackgen.errors import StackgenError
from stackgen.world import PAPER_WORLD


@pytest.fixture
def compact(dataset: Path, splits: dict[str, StackArrays], tmp_path: Path) -> Path:
    """The dataset as one file."""
    save_npz(tmp_path / "small.npz", splits, Dataset.open(dataset).manifest)
    return tmp_path / "small.npz"


def test_a_folder_and_its_compact_file_hold_the_same(dataset: Path, compact: Path) -> None:
    folder, file = Dataset.open(dataset), Dataset.open(compact)
    assert (folder.is_compact, file.is_compact) == (False, True)
    assert folder.manifest == file.manifest and folder.world == file.world == PAPER_WORLD
    assert folder.splits == file.splits == ("train", "validation", "test")
    for split in folder.splits:
        assert np.array_equal(folder.split(split).poses, file.split(split).poses)
        assert folder.split(split) is folder.split(split)  # read once


def test_samples_carry_their_metadata_in_the_order_of_the_shards(
    dataset: Path, samples: dict[str, list[Sample]]
) -> None:
    written = [sample for name, those in samples.items() if name.startswith("train") for sample in those]
    found = list(Dataset.open(dataset).samples("train"))
    assert [sample.meta for sample in found] == [sample.meta for sample in written]
    assert [shard.name for shard in Dataset.open(dataset).shards("train")] == ["train-000000.tar", "train-000001.tar"]


def test_datasets_that_are_joined_hold_all_samples_of_each(dataset: Path, compact: Path, tmp_path: Path) -> None:
    folder = Dataset.open(dataset)
    only = replace(folder.manifest, shards=folder.manifest.shards[:2], settings={"silhouette": "drawing"})
    only.save(tmp_path)
    for shard in only.shards:
        (tmp_path / shard["file"]).write_bytes((dataset / shard["file"]).read_bytes())
    for paths in ([dataset, tmp_path], [tmp_path, dataset], [dataset, compact]):
        parts = [Dataset.open(path) for path in paths]
        data = StackDataModule([str(path) for path in paths], batch_size=4)
        joined = data.dataset
        assert joined.splits == folder.splits and joined.manifest.of_drawings == (tmp_path in paths)
        for split in joined.splits:
            those = [part.split(split) for part in parts if split in part.splits]
            assert np.array_equal(joined.split(split).poses, np.concatenate([arrays.poses for arrays in those]))
            assert joined.manifest.count(split) == sum(map(len, those))
        if compact not in paths:
            names = [shard.name for part in parts for shard in part.shards("train")]
            assert [shard.name for shard in joined.shards("train")] == names
            assert sum(1 for _ in joined.samples("train")) == joined.manifest.count("train")
    assert Dataset.join([folder]) is folder
    wide = replace(folder, manifest=replace(folder.manifest, world=replace(folder.world, max_blocks=12)))
    with pytest.raises(StackgenError, match="of different worlds"):
        Dataset.join([folder, wide])


def test_what_is_not_there_is_one_line(dataset: Path, compact: Path, tmp_path: Path) -> None:
    folder = Dataset.open(dataset)
    only = replace(folder.manifest, shards=folder.manifest.shards[:2])
    only.save(tmp_path)
    for path, name, message in (
        (tmp_path, "validation", "has no validation split"),
        (compact, "nonsense", "has no nonsense split"),
    ):
        with pytest.raises(StackgenError, match=message) as caught:
            Dataset.open(path).split(name)
        assert "\n" not in str(caught.value)
    with pytest.raises(StackgenError, match="is one compact file, not shards"):
        Dataset.open(compact).shards("train")
    with pytest.raises(StackgenError, match="is one compact file, not a folder of shards"):
        read_manifest(compact)


# Webdataset, with the stages that this package exports.


def test_webdataset_makes_the_same_batches_of_the_same_shards(dataset: Path) -> None:
    opened = Dataset.open(dataset)
    urls = [shard.path for shard in opened.shards("train")]
    batches = list(wds.WebDataset(urls, shardshuffle=False).map(decode).batched(16, collation_fn=to_batch))
    whole = opened.split("train")
    for number, batch in enumerate(batches):
        expected = whole.batch(range(16 * number, min(16 * number + 16, len(whole))))
        assert set(batch) == set(expected) and all(torch.equal(batch[name], expected[name]) for name in expected)
    assert sum(len(batch["template"]) for batch in batches) == len(whole)


def test_webdataset_reads_them_through_a_command_shuffled_and_with_workers(dataset: Path) -> None:
    urls = [f"pipe:cat {shard.path}" for shard in Dataset.open(dataset).shards("train")]
    stages = wds.WebDataset(urls, shardshuffle=2, seed=0).map(decode).shuffle(40, seed=0)
    loader = wds.WebLoader(stages.batched(16, collation_fn=to_batch), batch_size=None, num_workers=2)
    templates = [t for batch in loader for t in batch["template"].tolist()]
    assert templates != sorted(templates) and sorted(templates) == list(range(71))


def test_another_world_is_said_to_the_collation(dataset: Path) -> None:
    (url,) = (shard.path for shard in Dataset.open(dataset).shards("test"))
    roomy = partial(to_batch, world=replace(PAPER_WORLD, max_blocks=20))
    batch = next(iter(wds.WebDataset(url, shardshuffle=False).map(decode).batched(4, collation_fn=roomy)))
    assert batch["poses"].shape == (4, 20, 6)
    tight = partial(to_batch, world=replace(PAPER_WORLD, max_blocks=3))
    with pytest.raises(StackgenError, match="more than 3 blocks"):
        next(iter(wds.WebDataset(url, shardshuffle=False).map(decode).batched(4, collation_fn=tight)))


def test_shards_are_the_plain_tars_that_python_writes(samples: dict[str, list[Sample]]) -> None:
    """Equal stacks must stay equal bytes, whatever later versions of webdataset write into headers by default."""
    those, buffer = samples["test-000003.tar"], io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for sample in those:
            packed, kinds = np.packbits(sample.silhouette, axis=1), {"poses": "<f4", "shapes": "u1"}
            arrays = {name: getattr(sample, name).astype(kind) for name, kind in kinds.items()}
            members = {"meta.json": json.dumps(sample.meta, sort_keys=True).encode()}
            for name, array in {**arrays, "silhouette": packed}.items():
                file = io.BytesIO()
                np.save(file, array)
                members[f"{name}.npy"] = file.getvalue()
            for suffix, content in members.items():
                info = tarfile.TarInfo(f"{sample.key}.{suffix}")
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))
    assert encode_shard(those) == buffer.getvalue()


# What the data module reads of Lightning.


class _Asks(pl.LightningModule):
    """Asks the data module during a step and after it whether a batch is in hand."""

    def __init__(self) -> None:
        super().__init__()
        self.weight, self.during, self.after = torch.nn.Parameter(torch.zeros(1)), list[bool](), list[bool]()

    def training_step(self, batch: Any, _: int) -> torch.Tensor:
        self.during.append(self.trainer.datamodule._in_hand())  # type: ignore[attr-defined]
        return self.weight.sum()

    def on_train_batch_end(self, *_: Any) -> None:
        self.after.append(self.trainer.datamodule._in_hand())  # type: ignore[attr-defined]

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_lightning_still_says_whether_a_batch_is_in_hand(dataset: Path) -> None:
    """The data module reads parts of Lightning's loop that are not documented, to resume exactly."""
    module = _Asks()
    trainer = pl.Trainer(
        accelerator="cpu",
        max_steps=3,
        limit_val_batches=0,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(module, StackDataModule(dataset, 8))
    assert module.during == [True] * 3 and module.after == [False] * 3
