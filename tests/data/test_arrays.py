"""Shards, arrays and the compact file hold the same stacks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from stackgen.data.arrays import StackArrays, load_dataset, load_npz, save_npz
from stackgen.data.shards import Sample
from stackgen.geometry import mirror, silhouette
from stackgen.stack import Stack, StackgenError

FIELDS = ("shapes", "poses", "silhouettes", "template")


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
        image = silhouette(stack)
        assert np.array_equal(batch["silhouette"][i].numpy() > 0, image[:, ::-1] if flags[i] else image)


def test_the_compact_file_is_read_back_as_written(
    dataset: Path, splits: dict[str, StackArrays], tmp_path: Path
) -> None:
    manifest = load_dataset(dataset)[1]
    save_npz(tmp_path / "small.npz", splits, manifest)
    assert [path.name for path in tmp_path.iterdir()] == ["small.npz"]
    found, again = load_npz(tmp_path / "small.npz")
    assert again == manifest and list(found) == ["train", "validation", "test"]
    assert all(equal(found[name], splits[name]) for name in found)
    only = load_dataset(tmp_path / "small.npz", ("validation",))[0]
    assert list(only) == ["validation"] and equal(only["validation"], splits["validation"])


@pytest.mark.parametrize("damage", ["missing", "text", "truncated", "pickled", "foreign", "wrong dtype"])
def test_a_bad_compact_file_is_one_line(damage: str, splits: dict[str, StackArrays], tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    if damage == "text":
        path.write_text("no arrays here")
    elif damage == "truncated":
        save_npz(path, splits, {})
        path.write_bytes(path.read_bytes()[:1000])
    elif damage == "pickled":
        np.savez(path, shapes=np.array([{}], dtype=object))
    elif damage == "foreign":
        np.savez(path, x=np.zeros(3))
    elif damage == "wrong dtype":
        a = splits["test"]
        np.savez(
            path, shapes=a.shapes, poses=a.poses.astype(np.float64), silhouettes=a.silhouettes,
            template=a.template, split=np.zeros(len(a), np.uint8), manifest=np.array("{}"),
        )  # fmt: skip
    with pytest.raises(StackgenError) as caught:
        load_npz(path)
    assert "\n" not in str(caught.value) and ("x.npz" in str(caught.value) or damage == "wrong dtype")


def test_arrays_that_do_not_fit_are_refused(splits: dict[str, StackArrays]) -> None:
    a = splits["test"]
    gap = a.shapes.copy()
    gap[0, 0] = 255
    for shapes, poses in ((a.shapes[1:], a.poses), (gap, a.poses), (a.shapes, a.poses * np.nan)):
        with pytest.raises(StackgenError):
            StackArrays(shapes, poses, a.silhouettes, a.template)
    with pytest.raises(StackgenError, match="more than 4"):
        StackArrays.from_samples([Sample("k", np.zeros(5, np.uint8), np.zeros((5, 6), np.float32),
                                         np.zeros((64, 64), bool), {"template": 0})], max_blocks=4)  # fmt: skip


def test_pose_statistics_are_those_of_the_real_blocks(splits: dict[str, StackArrays]) -> None:
    arrays = splits["train"]
    blocks = np.concatenate([arrays.poses[i, :k] for i, k in enumerate(arrays.lengths)]).astype(np.float64)
    mean, std = arrays.pose_statistics()
    assert np.allclose(mean, blocks.mean(axis=0), atol=1e-6) and np.allclose(std, blocks.std(axis=0), atol=1e-6)
    mean, std = arrays.pose_statistics(mirror=True)
    assert np.allclose(mean[[0, 4, 5]], 0) and np.isclose(std[0], np.sqrt((blocks[:, 0] ** 2).mean()), atol=1e-6)


def test_arrays_need_neither_webdataset_nor_the_simulator_nor_lightning() -> None:
    code = (
        "import sys, stackgen.data.arrays; "
        "sys.exit(bool({'webdataset', 'pybullet', 'lightning', 'pytorch_lightning'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
