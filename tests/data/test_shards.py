"""Shards are read back as written, say the same bytes for the same stacks, and never lie about damage."""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import tarfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import webdataset

from stackgen.data.dataset import Dataset
from stackgen.data.inspection.verify import verify
from stackgen.data.manifest import FORMAT, SPLITS, Manifest, shard_entry
from stackgen.data.resplit import Resplit, resplit
from stackgen.data.shards import MEMBERS, Sample, decode, find_samples, read_shard, write_shard
from stackgen.errors import StackgenError
from stackgen.world import PAPER_CATALOGUE, PAPER_WORLD


def assert_same(a: Sample, b: Sample) -> None:
    assert a.key == b.key and a.meta == b.meta
    for name in ("shapes", "poses", "silhouette"):
        here, there = getattr(a, name), getattr(b, name)
        assert here.dtype == there.dtype and here.shape == there.shape and (here == there).all()


@pytest.fixture
def three(samples: dict[str, list[Sample]], tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    """A shard of three samples, and its entry."""
    path = tmp_path / "train-000007.tar"
    return path, write_shard(path, samples["train-000000.tar"][:3])


def test_a_shard_is_read_back_as_written(dataset: Path, samples: dict[str, list[Sample]]) -> None:
    for name, those in samples.items():
        found = list(read_shard(dataset / name))
        assert len(found) == len(those)
        for here, there in zip(found, those, strict=True):
            assert_same(here, there)
            stack = here.stack(PAPER_CATALOGUE)
            assert stack.shapes.tolist() == there.shapes.tolist() and (stack.poses == there.poses).all()


def test_a_manifest_s_samples_are_those_of_the_split(dataset: Path, samples: dict[str, list[Sample]]) -> None:
    manifest = Dataset.open(dataset).manifest
    for split in SPLITS:
        wanted = [sample for name, those in samples.items() if name.startswith(split) for sample in those]
        found = list(Dataset.open(dataset).samples(split))
        assert [sample.key for sample in found] == [sample.key for sample in wanted]
        assert manifest.count(split) == len(wanted)


def test_equal_stacks_make_equal_bytes(three: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    path, entry = three
    again = tmp_path / "elsewhere" / path.name
    again.parent.mkdir()
    assert write_shard(again, list(read_shard(path))) == entry
    assert again.read_bytes() == path.read_bytes()
    assert entry["file"] == "train-000007.tar" and entry["split"] == "train" and entry["samples"] == 3
    with tarfile.open(path) as tar:
        assert {(m.mtime, m.uid, m.gid, m.uname, m.gname) for m in tar} == {(0, 0, 0, "", "")}


def test_others_read_it_with_webdataset_and_numpy(dataset: Path, samples: dict[str, list[Sample]]) -> None:
    rows = list(webdataset.WebDataset(str(dataset / "validation-000002.tar"), shardshuffle=False))
    for row, sample in zip(rows, samples["validation-000002.tar"], strict=True):
        assert row["__key__"] == sample.key
        poses = np.load(io.BytesIO(row["poses.npy"]))
        assert poses.dtype == np.float32 and (poses == sample.poses).all()
        assert (np.load(io.BytesIO(row["shapes.npy"])) == sample.shapes).all()
        assert (np.unpackbits(np.load(io.BytesIO(row["silhouette.npy"])), axis=1) == sample.silhouette).all()
        assert json.loads(row["meta.json"]) == sample.meta


def test_an_empty_shard_has_no_samples(tmp_path: Path) -> None:
    assert write_shard(tmp_path / "train-000000.tar", [])["samples"] == 0
    assert list(read_shard(tmp_path / "train-000000.tar")) == []


# Damage.


def test_a_shard_cut_off_anywhere_is_damaged(three: tuple[Path, dict[str, Any]]) -> None:
    """Also between two samples, where Python's reader sees nothing wrong."""
    path, _ = three
    content = path.read_bytes()
    used = len(content.rstrip(b"\0"))
    for length in [0, 1, *range(512, used + 512, 512), used]:
        path.write_bytes(content[:length])
        with pytest.raises(StackgenError, match=rf"{path.name} is missing or damaged") as caught:
            list(read_shard(path))
        assert "\n" not in str(caught.value)


def test_a_changed_byte_is_never_overlooked(three: tuple[Path, dict[str, Any]]) -> None:
    """With the manifest's checksum; without it, at least nothing but samples or a StackgenError comes out."""
    path, entry = three
    content, places = path.read_bytes(), np.random.default_rng(0)
    assert len(list(read_shard(path, entry["sha256"]))) == 3
    for place in places.integers(0, len(content.rstrip(b"\0")), 300):
        broken = bytearray(content)
        broken[place] ^= 1 << int(places.integers(8))
        path.write_bytes(broken)
        with pytest.raises(StackgenError, match="checksum"):
            next(read_shard(path, entry["sha256"]))
        try:
            found = list(read_shard(path))
        except StackgenError:
            continue
        assert len(found) == 3
        assert all(sample.poses.shape == (len(sample.shapes), 6) for sample in found)


def test_a_missing_shard_and_a_file_that_is_none_are_named(tmp_path: Path) -> None:
    with pytest.raises(StackgenError, match=r"gone\.tar is missing"):
        list(read_shard(tmp_path / "gone.tar"))
    (tmp_path / "text.tar").write_text("not a tar" * 1000)
    with pytest.raises(StackgenError, match=r"text\.tar"):
        list(read_shard(tmp_path / "text.tar"))


def test_pickles_are_not_read(three: tuple[Path, dict[str, Any]]) -> None:
    sample = next(read_shard(three[0]))
    buffer = io.BytesIO()
    np.save(buffer, np.array([print], dtype=object), allow_pickle=True)
    members = {"shapes.npy": buffer.getvalue(), "poses.npy": b"", "silhouette.npy": b"", "meta.json": b"{}"}
    with pytest.raises(ValueError, match="object"):
        decode({"__key__": sample.key, **members})


# The manifest.


def test_a_manifest_survives_its_file(dataset: Path, tmp_path: Path) -> None:
    manifest = Dataset.open(dataset).manifest
    manifest.save(tmp_path)
    assert Dataset.open(tmp_path).manifest == manifest
    assert (tmp_path / "dataset.json").read_bytes() == (dataset / "dataset.json").read_bytes()
    assert manifest.to_json()["format"] == FORMAT
    assert manifest.to_json()["counts"] == {"train": 71, "validation": 23, "test": 7}


def test_the_manifest_s_hash_names_every_shard_s(dataset: Path) -> None:
    manifest = Dataset.open(dataset).manifest
    changed = json.loads(json.dumps(manifest.to_json()))
    changed["shards"][1]["sha256"] = "0" * 64
    other = Manifest(**{**vars(manifest), "shards": tuple(changed["shards"])})
    assert other.sha256 != manifest.sha256 == Dataset.open(dataset).manifest.sha256


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no dataset at"),
        ("{", "not JSON"),
        ("[]", "not a stackgen.dataset/1 manifest"),
        ('{"format": "other"}', "not a stackgen.dataset/1 manifest"),
        ('{"format": "stackgen.dataset/1"}', "damaged"),
    ],
)
def test_a_folder_without_a_proper_manifest_is_refused(tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "dataset.json").write_text(text)
    with pytest.raises(StackgenError, match=message) as caught:
        Dataset.open(tmp_path)
    assert "\n" not in str(caught.value)


# Shards that others wrote.

FORMATS = {"ustar": tarfile.USTAR_FORMAT, "gnu": tarfile.GNU_FORMAT, "pax": tarfile.PAX_FORMAT}


def packed(files: dict[str, bytes], kind: int = tarfile.USTAR_FORMAT, folder: str | None = None) -> bytes:
    """A tar of some files, after an entry for their folder if that is given."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=kind) as tar:
        if folder is not None:
            entry = tarfile.TarInfo(folder)
            entry.type = tarfile.DIRTYPE
            tar.addfile(entry)
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return buffer.getvalue()


def files_of(path: Path) -> dict[str, bytes]:
    """The files of a tar by name."""
    with tarfile.open(path) as tar:
        return {member.name: file.read() for member in tar if (file := tar.extractfile(member))}


def found_by_webdataset(path: Path) -> list[Sample]:
    """What webdataset makes of a shard; it knows nothing of samples that are none."""
    rows = webdataset.WebDataset(str(path), shardshuffle=False, empty_check=False)
    return [decode(row) for row in rows if {*MEMBERS} & {*row}]


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize(
    "renamed",
    [
        lambda name: name,
        lambda name: f"./{name}",
        lambda name: f"some/folder.v2/{name}",
        lambda name: f"{'long' * 22}/{'longer' * 12}/{name}",
        lambda name: f"bücher-{name}",
        lambda name: name.replace("npy", "NPY"),
    ],
    ids=["plain", "dot", "folder", "long", "umlaut", "capitals"],
)
def test_a_tar_of_another_program_is_read_as_webdataset_reads_it(
    kind: str, renamed: Callable[[str], str], three: tuple[Path, dict[str, Any]]
) -> None:
    path, _ = three
    theirs = {renamed(name): content for name, content in files_of(path).items()}
    some = list(theirs)
    mixed: dict[str, bytes] = {"README.md": b"read me", "__meta__/a.meta.json": b"{}", "nodot": b""}
    for place, name in enumerate(some):
        mixed[name] = theirs[name]
        if place % 4 == 1:
            mixed[f".hidden{place}"] = b""
            mixed[f"{name.split('.poses')[0].split('.POSES')[0]}.note.txt"] = b"?"
    path.write_bytes(packed(mixed, FORMATS[kind], "some"))
    ours, webs = list(read_shard(path)), found_by_webdataset(path)
    assert len(ours) == len(webs) == 3
    for here, there in zip(ours, webs, strict=True):
        assert_same(here, there)
    assert [sample.key for sample in find_samples(path.read_bytes())] == [sample.key for sample in webs]


@pytest.fixture
def holes(samples: dict[str, list[Sample]], tmp_path: Path) -> Path:
    """Ten samples: two lack their shapes, one has them twice, one has a layout that is no text, all have a note."""
    folder = tmp_path / "holes"
    folder.mkdir()
    path = folder / "train-000001.tar"
    write_shard(path, samples["train-000000.tar"][:10])
    content: list[tuple[str, bytes]] = []
    for name, data in files_of(path).items():
        if name in ("0000002.shapes.npy", "0000005.shapes.npy"):
            continue
        if name == "0000003.meta.json":
            data = json.dumps({"template": 3, "layout": []}).encode()
        content += [(name, data)] * (2 if name == "0000007.shapes.npy" else 1)
        content += [(name.replace("meta.json", "note.txt"), b"x")] if name.endswith("meta.json") else []
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for name, data in content:
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    path.write_bytes(buffer.getvalue())
    Manifest("holes", 0, PAPER_WORLD, {}, {}, (shard_entry(path.name, buffer.getvalue(), 10),)).save(folder)
    return folder


def test_broken_samples_are_named_and_skipped_alike_by_all_who_read_a_dataset(
    holes: Path, samples: dict[str, list[Sample]], tmp_path: Path
) -> None:
    left = [sample for i, sample in enumerate(samples["train-000000.tar"][:10]) if i not in (2, 3, 5, 7)]
    faults = ["0000002: no shapes.npy", "0000003: layout []", "0000005: no shapes.npy", "0000007: shapes.npy twice"]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = list(Dataset.open(holes).samples("train"))
        again = resplit(holes, tmp_path / "again", Resplit(0.3, 0.2))
        trained = Dataset.open(holes).split("train")
    for here, there in zip(found, left, strict=True):
        assert_same(here, there)
    lines = [str(warning.message) for warning in said]
    assert all(sum(f"skipped a broken sample of train-000001.tar, {fault}" in line for line in lines) == 3
               for fault in faults)  # fmt: skip
    assert trained.template.tolist() == [sample.meta["template"] for sample in left]
    assert sum(again.counts.values()) == len(left) and not verify(tmp_path / "again")
    copies = [
        sample for split in SPLITS if again.count(split) for sample in Dataset.open(tmp_path / "again").samples(split)
    ]
    for sample in left:
        assert_same(next(copy for copy in copies if copy.key == sample.key), sample)
    assert [problem.detail for problem in verify(holes)] == [f"sample {fault}" for fault in faults]


@pytest.mark.parametrize("press", [gzip.compress, bz2.compress, lzma.compress])
def test_a_compressed_shard_is_named_as_such(press: Callable[[bytes], bytes], holes: Path, tmp_path: Path) -> None:
    path = holes / "train-000001.tar"
    content = press(path.read_bytes())
    path.write_bytes(content)
    Manifest("holes", 0, PAPER_WORLD, {}, {}, (shard_entry(path.name, content, 10),)).save(holes)
    readers: list[Callable[[], object]] = [
        lambda: list(read_shard(path)),
        lambda: list(Dataset.open(holes).samples("train")),
        lambda: Dataset.open(holes).split("train"),
        lambda: resplit(holes, tmp_path / "again", Resplit(0.3, 0.2)),
    ]
    for reader in readers:
        with pytest.raises(
            StackgenError, match=r"train-000001\.tar .* compressed with (gzip|bzip2|xz), and a shard is"
        ):
            reader()
    assert "compressed with" in verify(holes)[0].detail
