"""The generator: the same dataset from the same settings, whatever makes it and however often it is cut off."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from stackgen.data.dataset import TESTSET, Dataset
from stackgen.data.generation import recipes
from stackgen.data.generation.designs import Design, DesignSettings
from stackgen.data.generation.generate import generate
from stackgen.data.generation.recipes import fingerprint, template_samples, testset_contents
from stackgen.data.generation.settings import GenerateSettings
from stackgen.data.generation.workshop import MadeShard
from stackgen.data.manifest import SPLITS, Manifest
from stackgen.data.shards import Sample, read_shard
from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.sim.checkers import AcceptLimits
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Simulator
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Catalogue, Grid, Shape, World
from tests.conftest import Cli
from tests.data.generation.making import SMALL, Here, Stored, contents, copy

testset_contents.__test__ = False  # type: ignore[attr-defined]  # a function of the generator, not a test


def samples_of(folder: Path) -> list[Sample]:
    dataset = Dataset.open(folder)
    return [sample for split in dataset.splits for sample in dataset.samples(split)]


@pytest.fixture(scope="module")
def simulator() -> Iterator[Simulator]:
    with Simulator() as simulator:
        yield simulator


# The same bytes.


def test_what_is_lost_is_made_again(small: Path, shards: dict[int, MadeShard], tmp_path: Path) -> None:
    out = copy(small, tmp_path / "copy")
    first, *_, last = sorted(out.glob("*.tar"), key=lambda path: path.name[-10:])
    first.unlink()
    last.unlink()
    (out / "dataset.json").unlink()
    (out / ".train-000001.tar.0123abcd.tmp").write_bytes(b"half")
    generate(SMALL, out, executor=Stored(shards))
    assert contents(out) == contents(small)


def test_the_settings_of_a_manifest_are_those_it_was_made_with(small: Path) -> None:
    assert GenerateSettings.from_manifest(Dataset.open(small).manifest) == SMALL
    template = DesignSettings(top_row_only=("triangle", "cube"))
    other = replace(SMALL, physics=Physics(friction=0.4), template=template, accept=AcceptLimits(tilt=0.2))
    manifest = Manifest(other.name, other.seed, other.world, other.physics.to_json(), other.to_json())
    assert GenerateSettings.from_manifest(manifest) == other
    strange = replace(manifest, settings={**manifest.settings, "sturdy": True})
    with pytest.raises(StackgenError, match=r"not made by this version .*sturdy"):
        GenerateSettings.from_manifest(strange)


def test_a_draw_is_part_of_the_whole_and_drawing_again_changes_nothing(
    small: Path, shards: dict[int, MadeShard], tmp_path: Path
) -> None:
    out = tmp_path / "drawn"
    settings = replace(SMALL, stacks=30, draw=15)
    manifest = generate(settings, out, executor=Stored(shards))
    assert sum(manifest.count(split) for split in SPLITS) == 15 and len(manifest.shards) == 1
    tar = manifest.shards[0]["file"]
    assert sorted(path.name for path in out.iterdir()) == ["README.md", "dataset.json", "generate.json", tar]
    drawn = samples_of(out)
    whole = {sample.key: sample for sample in samples_of(small)}
    order = sorted(whole, key=lambda key: key[:8])  # stable: as the generator wrote them
    places = [order.index(sample.key) for sample in drawn]
    assert places == sorted(set(places))
    assert all((whole[sample.key].poses == sample.poses).all() for sample in drawn)
    before = contents(out)
    generate(settings, out, executor=Stored({}))
    assert contents(out) == before


def test_another_seed_makes_another_dataset(small: Path, simulator: Simulator) -> None:
    number = samples_of(small)[0].meta["template"]
    here, there = (template_samples(replace(SMALL, seed=s), number, frozenset(), simulator) for s in (5, 6))
    assert {s.meta["layout"] for s in here} != {s.meta["layout"] for s in there}


# What is in it.


def test_there_are_exactly_as_many_stacks_as_asked_for(small: Path) -> None:
    manifest = Dataset.open(small).manifest
    assert sum(manifest.count(split) for split in SPLITS) == 45 == len(samples_of(small))
    assert sorted(p.name for p in small.glob("*.tar")) == sorted(shard["file"] for shard in manifest.shards)
    for shard in manifest.shards:
        content = (small / shard["file"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == shard["sha256"]
        assert shard["samples"] == len(list(read_shard(small / shard["file"]))) > 0
        assert shard["file"].startswith(shard["split"] + "-")


def test_no_template_is_in_two_splits(small: Path) -> None:
    dataset = Dataset.open(small)
    templates = [{s.meta["template"] for s in dataset.samples(split)} for split in dataset.splits]
    assert len(templates) >= 2
    assert all(a.isdisjoint(b) for a, b in combinations(templates, 2))


def test_the_splits_have_their_shares_from_early_on() -> None:
    settings = GenerateSettings("x", 1)
    for count in (50, 100, 764, 2000):
        splits = [settings.split_of(shard) for shard in range(count)]
        for split, share in (("train", 0.88), ("validation", 0.02), ("test", 0.10)):
            assert splits.count(split) / count == pytest.approx(share, abs=2 / count + 0.01)  # type: ignore[arg-type]
    assert {GenerateSettings("x", 1, validation=0, test=0).split_of(i) for i in range(50)} == {"train"}
    assert {GenerateSettings("x", 1, validation=0, test=1).split_of(i) for i in range(50)} == {"test"}


def test_samples_are_what_the_format_says(small: Path) -> None:
    found = samples_of(small)
    assert len({sample.key for sample in found}) == 45
    by_template = defaultdict(list)
    for sample in found:
        assert sample.shapes.dtype == np.uint8 and 1 <= len(sample.shapes) <= 10
        assert sample.poses.dtype == np.float32 and sample.poses.shape == (len(sample.shapes), 6)
        assert (sample.silhouette == silhouette(sample.stack(PAPER_CATALOGUE), PAPER_GRID)).all()
        design = Design.from_key(sample.meta["layout"])
        kinds = [shape for row in design.rows for shape, _ in row]
        assert sample.shapes.tolist() == np.delete(kinds, sample.meta["removed"]).tolist()
        assert len(sample.meta["removed"]) <= 4
        by_template[sample.meta["template"]].append(sample)
    for family in by_template.values():
        ways = [tuple(sample.meta["removed"]) for sample in family]
        assert len(set(ways)) == len(ways)


def test_no_stack_is_stored_twice(small: Path) -> None:
    for a, b in combinations(samples_of(small), 2):
        assert a.shapes.tolist() != b.shapes.tolist() or np.abs(a.poses - b.poses).max() > 1e-3


def test_long_lists_are_not_stored_but_still_deconstructed(simulator: Simulator) -> None:
    def ways(max_blocks: int, number: int) -> set[tuple[int, ...]]:
        settings = replace(SMALL, max_blocks=max_blocks)
        return {tuple(s.meta["removed"]) for s in template_samples(settings, number, frozenset(), simulator)}

    number = next(n for n in range(100) if len(ways(10, n)) > 3)
    everything = ways(16, number)
    most = max(map(len, everything))
    total = len(template_samples(replace(SMALL, max_blocks=16), number, frozenset(), simulator)[0].shapes)
    assert ways(total - most, number) == {way for way in everything if len(way) == most}


# The frozen test set stays out.


def test_layouts_of_the_test_set_and_their_mirror_images_are_left_out(small: Path, simulator: Simulator) -> None:
    layouts = testset_contents(PAPER_WORLD)
    frozen = list(Dataset.open(TESTSET).samples("test"))
    for sample in frozen[::25]:
        design = Design.from_key(sample.meta["layout"])
        assert {design.key, design.mirrored(PAPER_WORLD).key, fingerprint(sample.silhouette[:, ::-1])} <= layouts
    assert {s.meta["layout"] for s in samples_of(small)}.isdisjoint(layouts)
    sample = samples_of(small)[0]
    number, key = sample.meta["template"], sample.meta["layout"]
    assert template_samples(SMALL, number, frozenset([key]), simulator) == []
    assert template_samples(SMALL, number, frozenset(["other"]), simulator) != []


def test_a_generator_that_meets_a_test_layout_leaves_it_out(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its own first templates as the test set, a dataset begins after them."""
    frozen = tmp_path / "testset"
    generate(replace(SMALL, stacks=8, draw=8, validation=0, test=1, exclude_testset=False), frozen, executor=Here())
    forbidden = {sample.meta["layout"] for sample in Dataset.open(frozen).samples("test")}
    assert forbidden & {sample.meta["layout"] for sample in samples_of(small)}
    monkeypatch.setattr(recipes, "TESTSET", frozen)
    generate(replace(SMALL, stacks=12), tmp_path / "rest", executor=Here())
    found = {sample.meta["layout"] for sample in samples_of(tmp_path / "rest")}
    assert found and found.isdisjoint(forbidden)


def test_the_test_set_is_left_out_of_catalogues_that_number_shapes_otherwise() -> None:
    def designs(world: World) -> set[str]:
        return {name for name in testset_contents(world) if "@" in name}

    layouts = designs(PAPER_WORLD)
    turned = Catalogue(PAPER_CATALOGUE.shapes[::-1])
    rows = {tuple(tuple((3 - s, left) for s, left in row) for row in Design.from_key(k).rows) for k in layouts}
    assert designs(replace(PAPER_WORLD, catalogue=turned)) == {Design(design).key for design in rows}
    assert designs(replace(PAPER_WORLD, grid=Grid(width=5))) == set()
    shorter = designs(replace(PAPER_WORLD, catalogue=Catalogue(PAPER_CATALOGUE.shapes[:2])))
    assert shorter == {key for key in layouts if "2@" not in key and "3@" not in key}
    longer = Catalogue((*PAPER_CATALOGUE.shapes[:2], Shape.box("long_rectangle", 4), PAPER_CATALOGUE[3]))
    assert designs(replace(PAPER_WORLD, catalogue=longer)) == {key for key in layouts if "2@" not in key}


# The command line.

SMALL_OPTIONS = [
    "--name", "small", "--stacks", 45, "--seed", 5, "--templates_per_shard", 2, "--validation", 0.2, "--test", 0.2,
]  # fmt: skip


def test_jobs_make_ranges_and_a_run_without_one_collects_them(
    small: Path, shards: dict[int, MadeShard], tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stackgen.commands.generate.make_executor", lambda *_: Stored(shards))
    out = ["--out", tmp_path / "small"]
    answer = cli("generate", *SMALL_OPTIONS, *out, "--shard_range", "1:3")
    assert answer.code == 0 and f"{shards[1].samples + shards[2].samples} stacks" in answer.out
    assert sorted(p.name for p in (tmp_path / "small").glob("*.tar")) == sorted(shards[n].name for n in (1, 2))
    assert cli("generate", *SMALL_OPTIONS, *out).code == 0
    assert contents(tmp_path / "small") == contents(small)


@pytest.mark.parametrize("text", ["3", "3:3", "5:2", "-1:2", "a:b", "1:2:3"])
def test_a_range_that_makes_no_sense_is_one_line(text: str, tmp_path: Path, cli: Cli) -> None:
    answer = cli("generate", *SMALL_OPTIONS, "--out", tmp_path / "x", f"--shard_range={text}")
    assert answer.code == 2 and "should read A:B" in answer.line and not (tmp_path / "x").exists()


def test_executors_and_workers_that_do_not_exist_are_one_line(tmp_path: Path, cli: Cli) -> None:
    out = ["--out", tmp_path / "x"]
    assert "ray" in cli("generate", *SMALL_OPTIONS, *out, "--executor", "cloud").line
    assert "at least 1" in cli("generate", *SMALL_OPTIONS, *out, "--workers", 0).line
    assert not (tmp_path / "x").exists()
