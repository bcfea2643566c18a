"""Shards, arrays and the compact file hold the same stacks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from stackgen.data.arrays import Buffers, StackArrays
from stackgen.data.compact import load_npz, save_npz
from stackgen.data.dataset import Dataset
from stackgen.data.decoding import decode_shard
from stackgen.data.shards import Sample, encode_shard, read_shard
from stackgen.errors import StackgenError
from stackgen.geometry import mirror, silhouette
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, World

FIELDS = ("shapes", "poses", "silhouettes", "template")
BEYOND = np.array([1, 4], np.uint8)  # the second is no shape of the paper's catalogue


def equal(a: StackArrays, b: StackArrays) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in FIELDS)


def test_arrays_hold_what_was_written_to_the_shards(
    samples: dict[str, list[Sample]], splits: dict[str, StackArrays]
) -> None:
    written = [s for name, those in samples.items() if name.startswith("train") for s in those]
    arrays = splits["train"]
    assert len(arrays) == len(written)
    images = arrays.images()
    for i, sample in enumerate(written):
        k = len(sample.shapes)
        assert arrays.lengths[i] == k
        assert np.array_equal(arrays.shapes[i, :k], sample.shapes) and (arrays.shapes[i, k:] == 255).all()
        assert np.array_equal(arrays.poses[i, :k], sample.poses) and not arrays.poses[i, k:].any()
        assert np.array_equal(images[i], sample.silhouette)
        assert arrays.template[i] == sample.meta["template"]
        assert arrays.counts[i].tolist() == [list(sample.shapes).count(s) for s in range(4)]


def test_a_batch_is_what_a_loop_over_its_samples_gives(splits: dict[str, StackArrays]) -> None:
    arrays, chosen = splits["train"], [5, 3, 3, 40]
    batch = arrays.batch(chosen)
    kinds = {name: tensor.dtype for name, tensor in batch.items()}
    i64, f32 = torch.int64, torch.float32
    assert kinds == {
        "shapes": i64, "poses": f32, "mask": torch.bool, "silhouette": f32, "counts": i64, "template": i64
    }  # fmt: skip
    for row, i in enumerate(chosen):
        k = int(arrays.lengths[i])
        assert batch["shapes"][row].tolist() == arrays.shapes[i, :k].tolist() + [-1] * (10 - k)
        assert batch["mask"][row].tolist() == [True] * k + [False] * (10 - k)
        assert np.array_equal(batch["poses"][row], arrays.poses[i])
        assert np.array_equal(batch["silhouette"][row].numpy(), arrays.images([i])[0].astype(np.float32))
        assert batch["counts"][row].tolist() == arrays.counts[i].tolist()
        assert batch["template"][row] == arrays.template[i]


def test_a_mirrored_sample_is_the_mirrored_stack_and_its_silhouette(splits: dict[str, StackArrays]) -> None:
    arrays = splits["train"]
    everyone = torch.arange(len(arrays))
    flags = everyone % 2 == 1
    batch = arrays.tensors.batch(everyone, flags)
    for i in range(len(arrays)):
        mask = batch["mask"][i]
        got = Stack(batch["shapes"][i][mask].numpy(), batch["poses"][i][mask].numpy())
        stack = Stack(arrays.shapes[i][mask], arrays.poses[i][mask])
        expected = mirror(stack) if flags[i] else stack
        assert np.array_equal(got.shapes, expected.shapes) and np.array_equal(got.poses, expected.poses)
        image = silhouette(stack, PAPER_GRID)
        assert np.array_equal(batch["silhouette"][i].numpy() > 0, image[:, ::-1] if flags[i] else image)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_batch_on_the_accelerator_is_the_one_on_the_cpu(splits: dict[str, StackArrays]) -> None:
    arrays, everyone = splits["train"], torch.arange(71)
    here = arrays.tensors.batch(everyone, everyone % 3 == 0, 8)
    there = arrays.tensors.to("cuda").batch(everyone, everyone % 3 == 0, 8)
    assert all(there[name].is_cuda and torch.equal(here[name], there[name].cpu()) for name in here)


def test_a_batch_that_is_held_is_not_written_over(splits: dict[str, StackArrays]) -> None:
    """Memory of pictures is used again, but only that of batches that nobody holds."""
    arrays = splits["train"]
    rng = np.random.default_rng(0)
    chosen = [rng.integers(len(arrays), size=size) for size in rng.integers(1, 60, size=30)]
    held = [arrays.batch(indices)["silhouette"][1:] for indices in chosen]  # a view holds on to it too
    for indices, images in zip(chosen, held, strict=True):
        assert np.array_equal(images.numpy() > 0, arrays.images(indices)[1:])


def test_memory_is_used_again_once_it_is_free() -> None:
    buffers = Buffers(most=2)
    first = buffers.take(100)
    place = first.data_ptr()
    second = buffers.take(100)
    assert second.data_ptr() != place
    del first
    third = buffers.take(40)
    assert third.data_ptr() == place and len(third) == 40
    del second, third
    assert len(buffers.take(200)) == 200  # those that are too small are let go


def test_a_shard_decoded_at_once_is_the_same_as_sample_by_sample(
    samples: dict[str, list[Sample]], splits: dict[str, StackArrays], dataset: Path
) -> None:
    decoded = decode_shard((dataset / "validation-000002.tar").read_bytes(), PAPER_WORLD)
    assert not decoded.broken and decoded.positions.tolist() == list(range(23))
    whole = decoded.stacks
    assert equal(whole, StackArrays.from_samples(read_shard(dataset / "validation-000002.tar"), PAPER_WORLD))
    assert equal(whole, splits["validation"])


def test_whatever_bytes_a_shard_holds_samples_come_out_or_faults(samples: dict[str, list[Sample]]) -> None:
    content = encode_shard(samples["train-000000.tar"][:3])
    rng = np.random.default_rng(0)
    used = len(content.rstrip(b"\0"))
    for _ in range(300):
        broken = bytearray(content)
        for place in rng.integers(0, used, rng.integers(1, 4)):
            broken[place] = rng.integers(256)
        for cut in (used, int(rng.integers(used))):
            decoded = decode_shard(bytes(broken[:cut]), PAPER_WORLD)
            assert np.isfinite(decoded.stacks.poses).all() and len(decoded.positions) == len(decoded.stacks)


@pytest.mark.parametrize(
    ("sample", "fault"),
    [
        (Sample("k", np.zeros(11, np.uint8), np.zeros((11, 6), np.float32), np.zeros((64, 64), bool), {"template": 0}),
         "k: shapes of size (11,), not of 1 to 10 blocks"),
        (Sample("k", np.zeros(2, np.uint8), np.zeros((3, 6), np.float32), np.zeros((64, 64), bool), {"template": 0}),
         "k: poses of size (3, 6) for 2 blocks"),
        (Sample("k", np.zeros(2, np.uint8), np.zeros((2, 6), np.float32), np.zeros((8, 8), bool), {"template": 0}),
         "k: a packed silhouette of size (8, 1), not of 64 pixels square"),
        (Sample("k", np.zeros(2, np.uint8), np.zeros((2, 6), np.float32), np.zeros((64, 64), bool), {}),
         "k: no template"),
        (Sample("k", np.zeros(2, np.uint8), np.zeros((2, 6), np.float32), np.zeros((64, 64), bool), {"template": "x"}),
         "k: template 'x'"),
        (Sample("k", BEYOND, np.zeros((2, 6), np.float32), np.zeros((64, 64), bool), {"template": 0}),
         "k: poses that are not finite, or shapes beyond the catalogue"),
    ],
)  # fmt: skip
def test_a_broken_sample_is_named_and_costs_no_other(
    sample: Sample, fault: str, samples: dict[str, list[Sample]]
) -> None:
    good = samples["train-000000.tar"][:2]
    decoded = decode_shard(encode_shard([good[0], sample, good[1]]), PAPER_WORLD)
    assert decoded.broken == (fault,)
    assert decoded.positions.tolist() == [0, 2]
    assert decoded.stacks.template.tolist() == [s.meta["template"] for s in good]


def test_the_compact_file_is_read_back_as_written(
    dataset: Path, splits: dict[str, StackArrays], tmp_path: Path
) -> None:
    manifest = Dataset.open(dataset).manifest
    save_npz(tmp_path / "small.npz", splits, manifest)
    assert [path.name for path in tmp_path.iterdir()] == ["small.npz"]
    found, again = load_npz(str(tmp_path / "small.npz"))
    assert again == manifest and list(found) == ["train", "validation", "test"]
    assert all(equal(found[name], splits[name]) for name in found)
    compact = Dataset.open(tmp_path / "small.npz")
    assert compact.is_compact and compact.splits == ("train", "validation", "test")
    assert equal(compact.split("validation"), splits["validation"]) and compact.world == manifest.world


@pytest.mark.parametrize("damage", ["missing", "text", "truncated", "pickled", "foreign", "wrong dtype"])
def test_a_bad_compact_file_is_one_line(
    damage: str, dataset: Path, splits: dict[str, StackArrays], tmp_path: Path
) -> None:
    path = tmp_path / "x.npz"
    if damage == "text":
        path.write_text("no arrays here")
    elif damage == "truncated":
        save_npz(path, splits, Dataset.open(dataset).manifest)
        path.write_bytes(path.read_bytes()[:1000])
    elif damage == "pickled":
        np.savez(path, shapes=np.array([{}], dtype=object))
    elif damage == "foreign":
        np.savez(path, x=np.zeros(3))
    elif damage == "wrong dtype":
        a = splits["test"]
        np.savez(
            path, shapes=a.shapes, poses=a.poses.astype(np.float64), silhouettes=a.silhouettes,
            template=a.template, split=np.zeros(len(a), np.uint8),
            manifest=np.array(json.dumps(Dataset.open(dataset).manifest.to_json())),
        )  # fmt: skip
    with pytest.raises(StackgenError) as caught:
        Dataset.open(path)
    assert "\n" not in str(caught.value) and ("x.npz" in str(caught.value) or damage == "wrong dtype")


def test_arrays_that_do_not_fit_are_refused(splits: dict[str, StackArrays]) -> None:
    a = splits["test"]
    gap = a.shapes.copy()
    gap[0, 0] = 255
    for shapes, poses in ((a.shapes[1:], a.poses), (gap, a.poses), (a.shapes, a.poses * np.nan)):
        with pytest.raises(StackgenError):
            StackArrays(shapes, poses, a.silhouettes, a.template, 4)
    sample = Sample("k", np.zeros(5, np.uint8), np.zeros((5, 6), np.float32), np.zeros((64, 64), bool), {"template": 0})
    with pytest.raises(StackgenError, match="more than 4"):
        StackArrays.from_samples([sample], World(PAPER_CATALOGUE, PAPER_GRID, 4))


def test_pose_statistics_are_those_of_the_real_blocks(splits: dict[str, StackArrays]) -> None:
    arrays = splits["train"]
    blocks = np.concatenate([arrays.poses[i, :k] for i, k in enumerate(arrays.lengths)]).astype(np.float64)
    mean, std = arrays.pose_statistics()
    assert np.allclose(mean, blocks.mean(axis=0), atol=1e-6) and np.allclose(std, blocks.std(axis=0), atol=1e-6)
    mean, std = arrays.pose_statistics(mirror=True)
    assert np.allclose(mean[[0, 4, 5]], 0) and np.isclose(std[0], np.sqrt((blocks[:, 0] ** 2).mean()), atol=1e-6)
