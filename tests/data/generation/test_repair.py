"""What is damaged is found by its checksum, named, and made again to the same bytes or not at all."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from stackgen.data.dataset import Dataset
from stackgen.data.generation import repair as module
from stackgen.data.generation.generate import generate
from stackgen.data.generation.repair import repair
from stackgen.data.generation.workshop import MadeShard
from stackgen.data.inspection.verify import Problem, verify
from stackgen.data.manifest import shard_number
from stackgen.data.shards import encode_shard, iterate_shard, write_shard
from stackgen.errors import StackgenError
from tests.conftest import Cli
from tests.data.generation.making import SMALL, Here, Stored, contents, copy, flip


@pytest.fixture
def out(small: Path, tmp_path: Path) -> Path:
    """A copy of the small dataset."""
    return copy(small, tmp_path / "copy")


def tars(folder: Path) -> list[Path]:
    return [folder / entry["file"] for entry in Dataset.open(folder).manifest.shards]


def change_manifest(folder: Path, **changes: object) -> None:
    path = folder / "dataset.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def found(folder: Path) -> set[tuple[str, str]]:
    return {(problem.file, problem.fault) for problem in verify(folder)}


# Finding it.


def test_nothing_is_wrong_with_what_was_just_written(small: Path) -> None:
    looked_at: list[int] = []
    assert verify(small, looked_at.append) == []
    assert looked_at == list(range(1, len(tars(small)) + 1))


@pytest.mark.parametrize("place", [0, 130, 512, 700, -1, -5000])
def test_one_bit_is_found_and_named_wherever_it_is(out: Path, place: int) -> None:
    victim = tars(out)[1]
    flip(victim, place)
    kinds = found(out)
    assert kinds == {(victim.name, "altered")} or (place == -1 and kinds == {(victim.name, "truncated")})


def test_what_is_missing_truncated_or_foreign_is_named(out: Path) -> None:
    lost, short, *_ = tars(out)
    lost.unlink()
    short.write_bytes(short.read_bytes()[:-3000])
    (out / "train-009999.tar").write_bytes(b"what is this")
    (out / ".train-000001.tar.0123abcd.tmp").write_bytes(b"half")
    (out / "notes.txt").write_text("mine")
    assert found(out) == {
        (lost.name, "missing"),
        (short.name, "truncated"),
        ("train-009999.tar", "foreign"),
        (".train-000001.tar.0123abcd.tmp", "foreign"),
    }
    detail = next(problem.detail for problem in verify(out) if problem.fault == "truncated")
    assert "stacks can still be read" in detail


def test_a_broken_sample_is_named_even_if_the_checksum_is_right(out: Path) -> None:
    manifest = Dataset.open(out).manifest
    victim = tars(out)[0]
    samples = list(iterate_shard(victim.read_bytes()))
    samples[1].poses[0, 0] = float("nan")
    entry = write_shard(victim, samples)
    replace(manifest, shards=(entry, *manifest.shards[1:])).save(out)
    (problem,) = verify(out)
    assert (problem.file, problem.fault) == (victim.name, "unreadable") and samples[1].key in problem.detail
    assert not problem.breaks_bytes


def test_a_manifest_that_contradicts_itself_is_named(out: Path) -> None:
    manifest = Dataset.open(out).manifest
    first, second, *others = manifest.shards
    change_manifest(out, counts={"train": 1, "validation": 2, "test": 3})
    assert verify(out) == [Problem("dataset.json", "wrong", "its counts are not the sums of its shards'")]
    replace(manifest, shards=({**first, "samples": 1}, second, *others)).save(out)
    assert found(out) == {(first["file"], "wrong")}
    replace(manifest, shards=({**first, "file": "../elsewhere.tar"}, second, *others)).save(out)
    with pytest.raises(StackgenError, match="not a plain file name"):
        verify(out)


def test_stacks_that_are_there_twice_and_templates_on_two_sides_are_named(out: Path) -> None:
    manifest = Dataset.open(out).manifest
    source = tars(out)[0]
    other = "test" if source.name.startswith("train") else "train"
    entry = write_shard(out / f"{other}-000099.tar", list(iterate_shard(source.read_bytes()))[:1])
    replace(manifest, shards=(*manifest.shards, entry)).save(out)
    details = [problem.detail for problem in verify(out) if problem.file == entry["file"]]
    assert any("is in" in detail for detail in details) and any("on two sides" in detail for detail in details)


# Mending it.


def test_lost_shards_are_made_again_byte_for_byte_and_no_others(
    small: Path, out: Path, shards: dict[int, MadeShard]
) -> None:
    first, second, *_, last = tars(out)
    flip(first, 600)
    second.unlink()
    last.write_bytes(last.read_bytes()[:5000])  # it is the one that was cut to size
    told: list[tuple[int, int]] = []
    needed = {shard_number(path.name): shards[shard_number(path.name)] for path in (first, second, last)}
    done = repair(out, Stored(needed), progress=lambda made, of: told.append((made, of)))
    assert sorted(done.identical) == sorted([first.name, second.name, last.name]) and not done.other
    assert contents(out) == contents(small) and verify(out) == [] and told == [(1, 3), (2, 3), (3, 3)]
    assert repair(out, Stored({})).identical == ()


def test_a_repair_simulates_again_what_was_simulated(small: Path, out: Path, here: Here) -> None:
    tars(out)[0].unlink()
    repair(out, here)
    assert contents(out) == contents(small)


def test_a_drawn_dataset_is_repaired_too(shards: dict[int, MadeShard], tmp_path: Path) -> None:
    settings = replace(SMALL, stacks=30, draw=15)
    generate(settings, tmp_path, executor=Stored(shards))
    before = contents(tmp_path)
    flip(tars(tmp_path)[0], 2000)
    repair(tmp_path, Stored(shards))
    assert contents(tmp_path) == before


def other_shards(shards: dict[int, MadeShard]) -> Stored:
    """As another version would make them: the first stack is missing."""
    return Stored(
        {
            number: MadeShard(shard.name, encode_shard(list(iterate_shard(shard.content))[1:]), shard.samples - 1)
            for number, shard in shards.items()
        }
    )


def test_what_cannot_be_made_again_is_left_alone_unless_that_is_asked_for(
    out: Path, shards: dict[int, MadeShard]
) -> None:
    victim, *_ = tars(out)
    flip(victim, 600)
    before, sha256 = contents(out), Dataset.open(out).manifest.sha256
    line = f"{victim.name} cannot be made again byte for byte .*--other_bytes"
    with pytest.raises(StackgenError, match=line) as caught:
        repair(out, other_shards(shards))
    assert "\n" not in str(caught.value) and contents(out) == before
    done = repair(out, other_shards(shards), other_bytes=True)
    assert done.other == (victim.name,) and not done.identical
    manifest = Dataset.open(out).manifest
    assert verify(out) == [] and manifest.sha256 != sha256
    assert manifest.shards[0]["samples"] == shards[shard_number(victim.name)].samples - 1
    assert "made_with" in manifest.shards[0] and "made_with" not in manifest.shards[1]


PACKAGE = SMALL.physics.to_json()["engine"].split()[0]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"physics": {**SMALL.physics.to_json(), "engine": f"{PACKAGE} 1.0"}}, f"made with {PACKAGE} 1.0, here is"),
        ({"settings": {**SMALL.to_json(), "revision": 0}}, "it was made by revision 0 of the generator"),
        ({"settings": {**SMALL.to_json(), "resplit": {}}}, "made by `stackgen dataset split`"),
        ({"settings": {}}, "not made by this version"),
    ],
)
def test_another_version_is_said_before_anything_is_done(out: Path, change: dict[str, object], line: str) -> None:
    change_manifest(out, **change)
    tars(out)[0].unlink()
    before = contents(out)
    with pytest.raises(StackgenError, match=line) as caught:
        repair(out, Stored({}))
    assert "\n" not in str(caught.value) and contents(out) == before


# The command line.


def test_verify_and_repair_from_the_command_line(
    small: Path, out: Path, shards: dict[int, MadeShard], cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "make_executor", lambda *_: Stored(shards))
    monkeypatch.setattr("stackgen.data.generation.executors.make_executor", lambda *_: Stored(shards))
    assert cli("dataset", "verify", out).code == 0
    victim = tars(out)[2]
    flip(victim, 900)
    answer = cli("dataset", "verify", out)
    assert answer.code == 1
    assert victim.name in answer.out and "altered" in answer.out and f"stackgen dataset repair {out}" in answer.out
    answer = cli("dataset", "repair", out)
    assert answer.code == 0 and f"{victim.name} again, byte for byte" in answer.out
    assert cli("dataset", "verify", out).code == 0 and contents(out) == contents(small)
    assert "nothing to repair" in cli("dataset", "repair", out).out
    assert cli("dataset", "verify", out / "nowhere").code == 2
