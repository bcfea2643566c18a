"""A new split has the same stacks, its shares, and keeps together what belongs together."""

from __future__ import annotations

import hashlib
from collections import Counter
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from stackgen.data import resplit as module
from stackgen.data.dataset import Dataset
from stackgen.data.generation.designs import Design
from stackgen.data.inspection.verify import verify
from stackgen.data.manifest import SPLITS, Manifest
from stackgen.data.resplit import By, Resplit, resplit, split_table
from stackgen.data.shards import Sample, write_shard
from stackgen.errors import StackgenError
from tests.conftest import Cli


@pytest.fixture
def families(dataset: Path, samples: dict[str, list[Sample]], tmp_path: Path) -> Path:
    """40 templates with three stacks each, every other one the mirror image of the one before."""
    manifest = Dataset.open(dataset).manifest
    designs = []
    for sample in samples["train-000000.tar"][:20]:
        design = Design.from_key(sample.meta["layout"])
        designs += [design.key, design.mirrored(manifest.world).key]
    made = [
        Sample(f"{t:08d}-{i:02d}", s.shapes, s.poses, s.silhouette, {"template": t, "layout": key, "removed": []})
        for t, key in enumerate(designs)
        for i, s in enumerate(samples["train-000001.tar"][:3])
    ]
    folder = tmp_path / "families"
    folder.mkdir()
    shards = tuple(write_shard(folder / f"train-{n:06d}.tar", made[30 * n : 30 * n + 30]) for n in range(4))
    Manifest(**{**vars(manifest), "shards": shards}).save(folder)
    return folder


def sides(folder: Path, what: str) -> dict[str, set[object]]:
    dataset = Dataset.open(folder)
    return {split: {s.meta[what] for s in dataset.samples(split)} for split in dataset.splits}


def keys(folder: Path) -> Counter[str]:
    dataset = Dataset.open(folder)
    return Counter(sample.key for split in dataset.splits for sample in dataset.samples(split))


@pytest.mark.parametrize("by", ["template", "layout"])
def test_the_same_stacks_in_other_shares_and_families_stay_together(families: Path, tmp_path: Path, by: By) -> None:
    out = tmp_path / "other"
    manifest = resplit(families, out, Resplit(0.1, 0.3, by))
    assert manifest == Dataset.open(out).manifest and keys(out) == keys(families)
    assert verify(out) == []
    templates = sides(out, "template")
    assert all(templates[a].isdisjoint(templates[b]) for a, b in combinations(SPLITS, 2))
    assert [len(templates[split]) for split in SPLITS] == pytest.approx([24, 4, 12], abs=2)
    assert manifest.settings["resplit"] == {
        "validation": 0.1, "test": 0.3, "by": by, "seed": 0, "source": Dataset.open(families).manifest.sha256
    }  # fmt: skip
    twins = split_table(out, manifest)["train"]["designs in another split too"]
    assert twins == 0 if by == "layout" else twins > 0


def test_equal_settings_equal_bytes_other_seed_other_sides(families: Path, tmp_path: Path) -> None:
    def content(name: str, seed: int) -> list[str]:
        resplit(families, tmp_path / name, Resplit(0.2, 0.2, seed=seed))
        return [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted((tmp_path / name).iterdir())]

    assert content("a", 0) == content("b", 0) != content("c", 1)


def test_a_new_dataset_appears_when_it_is_complete(
    families: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "other"
    before = {path.name: path.read_bytes() for path in families.iterdir()}
    with monkeypatch.context() as patch:
        patch.setattr(module, "write_card", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            resplit(families, out, Resplit(0.1, 0.1))
    assert [path.name for path in tmp_path.iterdir()] == ["families"]
    (tmp_path / ".other.unfinished").mkdir()  # as a kill leaves it
    (tmp_path / ".other.unfinished" / "train-000077.tar").write_bytes(b"half")
    resplit(families, out, Resplit(0.1, 0.1))
    assert verify(out) == [] and {path.name: path.read_bytes() for path in families.iterdir()} == before
    with pytest.raises(StackgenError, match="is there already"):
        resplit(families, out, Resplit(0.1, 0.1))


def test_what_does_not_say_its_layout_cannot_be_split_by_it(towers_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(StackgenError, match="can only be split by template"):
        resplit(towers_dataset, tmp_path / "x", Resplit(0.1, 0.1, "layout"))
    assert not list(tmp_path.iterdir())
    table = split_table(towers_dataset, Dataset.open(towers_dataset).manifest)
    assert [row["templates"] for row in table.values()] == [48, 12, 12]
    assert {row["designs"] for row in table.values()} == {0}


@pytest.mark.parametrize("shares", [(-0.1, 0), (0, -0.1), (0.6, 0.6)])
def test_shares_that_make_no_sense_are_refused(shares: tuple[float, float]) -> None:
    with pytest.raises(StackgenError, match="sum is at most 1"):
        Resplit(*shares)


def test_splitting_from_the_command_line(families: Path, tmp_path: Path, cli: Cli) -> None:
    answer = cli("dataset", "split", families)
    assert answer.code == 0 and "120" in answer.out and "40" in answer.out
    out = tmp_path / "other"
    answer = cli("dataset", "split", families, "--validation", 0.1, "--test", 0.2, "--by", "layout", "--out", out)
    assert answer.code == 0 and f"wrote {out}" in answer.out
    assert keys(out) == keys(families)
    for arguments in (["--out", tmp_path / "y"], ["--test", 0.2]):
        answer = cli("dataset", "split", families, *arguments)
        assert answer.code == 2 and "--out and one of --validation and --test" in answer.line


def test_two_splits_into_one_folder_leave_one_whole_dataset(
    families: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, write, nested = tmp_path / "new", module._write, iter([True])

    def meeting(*arguments: Any) -> Any:
        if next(nested, False):
            resplit(families, out, Resplit(0.1, 0.1))
        return write(*arguments)

    monkeypatch.setattr(module, "_write", meeting)
    with pytest.raises(StackgenError, match="is there already"):
        resplit(families, out, Resplit(0.3, 0.3))
    assert verify(out) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["families", "new"]


def test_what_a_killed_split_left_is_removed_and_no_link_is_followed(families: Path, tmp_path: Path) -> None:
    (tmp_path / ".new.0123abcd.unfinished").mkdir()
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "file").touch()
    (tmp_path / ".new.01234567.unfinished").symlink_to(tmp_path / "precious")
    (tmp_path / ".new.unfinished").symlink_to(tmp_path / "precious")
    resplit(families, tmp_path / "new", Resplit(0.1, 0.1))
    assert verify(tmp_path / "new") == [] and (tmp_path / "precious" / "file").exists()
    assert not (tmp_path / ".new.0123abcd.unfinished").exists()
