"""Folders of a dataset: other settings, foreign shards, damaged records and a second command are told apart."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stackgen.data.dataset import Dataset
from stackgen.data.generation.designs import DesignSettings
from stackgen.data.generation.generate import generate, generate_range
from stackgen.data.generation.workshop import MadeShard
from stackgen.errors import StackgenError
from stackgen.sim.checkers import AcceptLimits
from stackgen.sim.physics import Physics
from stackgen.sim.statics.plane import StaticsMargins
from tests.data.generation.making import SMALL, Here, Stored, contents, copy, flip


def test_a_folder_of_other_settings_is_refused_and_left_alone(small: Path) -> None:
    before = contents(small)
    for other in (
        replace(SMALL, seed=6),
        replace(SMALL, stacks=46),
        replace(SMALL, physics=Physics(friction=0.4)),
        replace(SMALL, accept=AcceptLimits(tilt=0.2)),
        replace(SMALL, template=DesignSettings(displacement=0.2)),
    ):
        with pytest.raises(StackgenError, match="other settings") as caught:
            generate(other, small, executor=Stored({}))
        assert "\n" not in str(caught.value)
    assert contents(small) == before


def test_a_folder_of_the_same_settings_from_before_they_were_all_written_down_is_accepted(
    shards: dict[int, MadeShard], tmp_path: Path
) -> None:
    plain = replace(SMALL, certificate=StaticsMargins(enabled=False), settle_twice=False)
    generate(plain, tmp_path, executor=Stored(shards))
    claim = tmp_path / "generate.json"
    before = json.loads(claim.read_text())
    del before["settings"]["certificate"], before["settings"]["revision"]
    claim.write_text(json.dumps(before))
    generate(plain, tmp_path, executor=Stored({}))
    for other in (SMALL, replace(plain, seed=7)):
        with pytest.raises(StackgenError, match="other settings"):
            generate(other, tmp_path, executor=Stored({}))
    claim.write_text("{")
    with pytest.raises(StackgenError, match="other settings"):
        generate(plain, tmp_path, executor=Stored({}))


def test_a_folder_of_unknown_shards_is_refused(small: Path, tmp_path: Path) -> None:
    (tmp_path / "train-000000.tar").write_bytes(next(small.glob("*.tar")).read_bytes())
    with pytest.raises(StackgenError, match=r"no generate\.json"):
        generate(SMALL, tmp_path, executor=Stored({}))
    assert [path.name for path in tmp_path.iterdir()] == ["train-000000.tar"]


def test_damage_since_the_dataset_was_complete_is_named_with_the_way_out(small: Path, tmp_path: Path) -> None:
    out = copy(small, tmp_path / "copy")
    victim, other = (out / entry["file"] for entry in Dataset.open(out).manifest.shards[:2])
    flip(victim, 600)
    before = contents(out)
    line = rf"{victim.name}: missing or damaged .* `stackgen dataset repair {out}`"
    with pytest.raises(StackgenError, match=line) as caught:
        generate(SMALL, out, executor=Stored({}))
    assert "\n" not in str(caught.value) and contents(out) == before
    other.unlink()
    with pytest.raises(StackgenError, match=f"{victim.name} and 1 more"):
        generate(SMALL, out, executor=Stored({}))


@pytest.mark.parametrize(
    "change",
    [
        {"stacks": 0}, {"templates_per_shard": 0}, {"max_blocks": 0}, {"max_removals": -1}, {"draw": 46}, {"draw": -1},
        {"validation": -0.1}, {"test": -0.1}, {"validation": 0.6, "test": 0.6},
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(StackgenError, match="generate: "):
        replace(SMALL, **change)  # type: ignore[arg-type]


def test_settings_that_no_stack_can_meet_end_with_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stackgen.data.generation.generate._HOPELESS", 2)
    with pytest.raises(StackgenError, match="gave no stack"):
        generate(replace(SMALL, max_blocks=3, templates_per_shard=1), tmp_path / "none", executor=Here())


# Hostile and damaged records; two commands in one folder.


@pytest.mark.parametrize("file", ["../outside/train-000000.tar", "/etc/passwd", "train-000001.tar", "x.tar", 5, None])
def test_a_record_that_names_another_file_is_not_believed(
    file: object, small: Path, shards: dict[int, MadeShard], tmp_path: Path
) -> None:
    out = copy(small, tmp_path / "copy")
    (out / "dataset.json").unlink()
    outside = copy(small, tmp_path / "outside")
    victim = next(outside.glob("*.tar"))
    victim = victim.rename(outside / "train-000000.tar")
    entry = {
        "file": file,
        "split": "train",
        "samples": 10**9,
        "sha256": hashlib.sha256(victim.read_bytes()).hexdigest(),
    }
    (out / "progress").mkdir()
    (out / "progress" / "000000.json").write_text(json.dumps(entry))
    before = contents(outside)
    told: list[str] = []
    generate(SMALL, out, executor=Stored(shards), say=told.append)
    assert contents(out) == contents(small) and contents(outside) == before
    assert len(told) == 1


@pytest.mark.parametrize("cut", [0, 100, 2])
def test_a_cut_manifest_costs_no_shard(cut: int, small: Path, tmp_path: Path) -> None:
    out = copy(small, tmp_path / "copy")
    path = out / "dataset.json"
    if cut == 2:
        path.write_text(json.dumps({**json.loads(path.read_text()), "shards": []}))
    else:
        path.write_bytes(path.read_bytes()[:cut])
    before = contents(out)
    for _ in range(2):
        with pytest.raises(StackgenError, match=r"dataset\.json"):
            generate(SMALL, out, executor=Stored({}))
    assert contents(out) == before


def test_files_of_others_in_the_folder_stay(small: Path, tmp_path: Path) -> None:
    out = copy(small, tmp_path / "copy")
    for name in ("backup.tar", "train-notes.tar", ".notes.tmp"):
        (out / name).touch()
    (out / "train-000777.tar").touch()
    generate(SMALL, out, executor=Stored({}))
    assert {"backup.tar", "train-notes.tar", ".notes.tmp"} <= {path.name for path in out.iterdir()}
    assert not (out / "train-000777.tar").exists()


def test_two_commands_do_not_meet_in_one_folder(small: Path, shards: dict[int, MadeShard], tmp_path: Path) -> None:
    out = tmp_path / "both"

    class Meeting(Stored):
        def map(self, task: Any, numbers: Any) -> Any:
            with pytest.raises(StackgenError, match="another command is at work"):
                generate(SMALL, out, executor=Stored(shards))
            with pytest.raises(StackgenError, match="another command is at work"):
                generate_range(SMALL, out, range(2), Stored(shards))
            yield from super().map(task, numbers)

    generate(SMALL, out, executor=Meeting(shards))
    assert contents(out) == contents(small)


def test_jobs_that_make_ranges_share_a_folder(small: Path, shards: dict[int, MadeShard], tmp_path: Path) -> None:
    out = tmp_path / "shared"

    class Meeting(Stored):
        def map(self, task: Any, numbers: Any) -> Any:
            generate_range(SMALL, out, range(2, 4), Stored(shards))
            yield from super().map(task, numbers)

    generate_range(SMALL, out, range(2), Meeting(shards))
    generate(SMALL, out, executor=Stored(shards))
    assert contents(out) == contents(small)


def test_a_record_that_is_true_is_believed(small: Path, shards: dict[int, MadeShard], tmp_path: Path) -> None:
    out = tmp_path / "ranges"
    generate_range(SMALL, out, range(3), Stored(shards))
    generate_range(SMALL, out, range(3), Stored({}))
