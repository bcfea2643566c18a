"""Datasets of stacks: opened, read by training, generated and inspected.

>>> import webdataset as wds
>>> from stackgen.data import Dataset, decode, to_batch
>>> testset = Dataset.open("stackgen/assets/testset-v1")
>>> urls = [shard.path for shard in testset.shards("test")]
>>> batches = wds.WebDataset(urls, shardshuffle=False).map(decode).batched(64, collation_fn=to_batch)
>>> next(iter(batches))["silhouette"].shape
torch.Size([64, 64, 64])
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from stackgen.data.arrays import to_batch
    from stackgen.data.datamodule import StackDataModule
    from stackgen.data.dataset import TESTSET, Dataset
    from stackgen.data.shards import decode

__all__ = ["TESTSET", "Dataset", "StackDataModule", "decode", "to_batch"]

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "arrays": ["to_batch"],
        "datamodule": ["StackDataModule"],
        "dataset": ["TESTSET", "Dataset"],
        "shards": ["decode"],
    },
)
