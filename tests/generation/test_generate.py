"""The generator: the same dataset from the same settings, whoever makes it and however often it is cut off."""

from __future__ import annotations

import hashlib
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from stackgen.data.generation import generate as module
from stackgen.data.generation.generate import GenerateSettings, generate, template_samples, testset_layouts
from stackgen.data.generation.templates import Template, TemplateSettings
from stackgen.data.shards import SPLITS, Manifest, Sample, read_shard
from stackgen.geometry import PAPER_GRID, Grid, silhouette
from stackgen.sim.physics import Physics
from stackgen.sim.verdict import AcceptLimits
from stackgen.sim.world import Simulator
from stackgen.stack import PAPER_CATALOGUE, Catalogue, Shape, StackgenError
from tests.conftest import CHILD

SMALL = GenerateSettings("small", 45, seed=5, templates_per_shard=2, validation=0.2, test=0.2)

testset_layouts.__test__ = False  # type: ignore[attr-defined]  # a function of the generator, not a test


def contents(folder: Path) -> dict[str, str]:
    """Checksum of every file."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.rglob("*")) if p.is_file()}


def samples_of(folder: Path) -> list[Sample]:
    manifest = Manifest.load(folder)
    return [sample for split in SPLITS for sample in manifest.samples(folder, split)]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset by one worker."""
    folder = tmp_path_factory.mktemp("generate") / "small"
    generate(SMALL, folder, workers=1)
    return folder


@pytest.fixture(scope="module")
def simulator() -> Iterator[Simulator]:
    with Simulator() as simulator:
        yield simulator


# The same bytes.


def test_three_workers_make_what_one_makes(small: Path, tmp_path: Path) -> None:
    stored: list[int] = []
    manifest = generate(SMALL, tmp_path / "again", workers=3, progress=stored.append)
    assert contents(tmp_path / "again") == contents(small)
    assert stored == sorted(stored) and stored[-1] == 45 and len(stored) > 2
    assert manifest == Manifest.load(small)


def test_a_killed_run_goes_on_to_the_same_bytes(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "killed"
    program = (
        "from pathlib import Path; from tests.generation.test_generate import SMALL, generate\n"
        f"if __name__ == '__main__': generate(SMALL, Path({str(out)!r}), workers=1)\n"
    )
    script = tmp_path / "run.py"
    script.write_text(program)
    process = subprocess.Popen([sys.executable, str(script)], env=CHILD, start_new_session=True)
    while not list(out.glob("*.tar")):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (out / "dataset.json").exists() and 1 <= len(list(out.glob("*.tar"))) < len(list(small.glob("*.tar")))
    deadline = time.monotonic() + 20
    while workers_of(process.pid):  # they end on their own when nobody is left to work for
        assert time.monotonic() < deadline
        time.sleep(0.1)
    generate(SMALL, out, workers=2)
    assert contents(out) == contents(small)


def workers_of(session: int) -> list[str]:
    """Worker processes that live in a session."""
    answer = subprocess.run(["ps", "-s", str(session), "-o", "args="], capture_output=True, text=True)
    return [line for line in answer.stdout.splitlines() if "spawn_main" in line]


def test_what_is_lost_is_made_again_and_what_is_done_is_left_alone(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    out.mkdir()
    for path in small.iterdir():
        (out / path.name).write_bytes(path.read_bytes())
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    generate(SMALL, out, workers=1)
    assert {path.name: path.stat().st_mtime_ns for path in out.iterdir()} == before
    first, *_, last = sorted(out.glob("*.tar"), key=lambda path: path.name[-10:])
    first.unlink()
    last.unlink()
    (out / "dataset.json").unlink()
    (out / ".train-000001.tar.0123abcd.tmp").write_bytes(b"half")
    generate(SMALL, out, workers=1)
    assert contents(out) == contents(small)


def test_a_draw_is_part_of_the_whole_and_drawing_again_changes_nothing(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "drawn"
    settings = replace(SMALL, stacks=30, draw=15)
    manifest = generate(settings, out, workers=1)
    assert sum(manifest.count(split) for split in SPLITS) == 15 and len(manifest.shards) == 1
    assert sorted(path.name for path in out.iterdir()) == ["dataset.json", "generate.json", manifest.shards[0]["file"]]
    drawn = samples_of(out)
    whole = {sample.key: sample for sample in samples_of(small)}
    order = sorted(whole, key=lambda key: key[:8])  # stable: as the generator wrote them
    places = [order.index(sample.key) for sample in drawn]
    assert places == sorted(set(places))
    assert all((whole[sample.key].poses == sample.poses).all() for sample in drawn)
    before = contents(out)
    generate(settings, out, workers=1)
    assert contents(out) == before
    (out / "dataset.json").unlink()  # as if cut off between the shard and the manifest
    generate(settings, out, workers=1)
    assert contents(out) == before


def test_another_seed_makes_another_dataset(small: Path, simulator: Simulator) -> None:
    number = samples_of(small)[0].meta["template"]
    here, there = (template_samples(replace(SMALL, seed=s), number, frozenset(), simulator) for s in (5, 6))
    assert {s.meta["layout"] for s in here} != {s.meta["layout"] for s in there}


# What is in it.


def test_there_are_exactly_as_many_stacks_as_asked_for(small: Path) -> None:
    manifest = Manifest.load(small)
    assert sum(manifest.count(split) for split in SPLITS) == 45 == len(samples_of(small))
    assert sorted(p.name for p in small.glob("*.tar")) == sorted(shard["file"] for shard in manifest.shards)
    for shard in manifest.shards:
        content = (small / shard["file"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == shard["sha256"]
        assert shard["samples"] == len(list(read_shard(small / shard["file"]))) > 0
        assert shard["file"].startswith(shard["split"] + "-")


def test_no_template_is_in_two_splits(small: Path) -> None:
    manifest = Manifest.load(small)
    templates = {split: {s.meta["template"] for s in manifest.samples(small, split)} for split in SPLITS}
    assert sum(map(bool, templates.values())) >= 2
    assert all(templates[a].isdisjoint(templates[b]) for a, b in combinations(SPLITS, 2))


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
        assert (sample.silhouette == silhouette(sample.stack(PAPER_CATALOGUE))).all()
        design = Template.from_key(sample.meta["layout"])
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
    layouts = testset_layouts(PAPER_CATALOGUE, PAPER_GRID)
    frozen = list(Manifest.load(module.TESTSET).samples(module.TESTSET, "test"))
    for sample in frozen[::25]:
        design = Template.from_key(sample.meta["layout"])
        assert {design.key, design.mirrored(PAPER_CATALOGUE, PAPER_GRID).key} <= layouts
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
    first = generate(replace(SMALL, stacks=8, draw=8, validation=0, test=1, exclude_testset=False), frozen, workers=1)
    forbidden = {sample.meta["layout"] for sample in first.samples(frozen, "test")}
    assert forbidden & {sample.meta["layout"] for sample in samples_of(small)}
    monkeypatch.setattr(module, "TESTSET", frozen)
    generate(replace(SMALL, stacks=12), tmp_path / "rest", workers=1)
    found = {sample.meta["layout"] for sample in samples_of(tmp_path / "rest")}
    assert found and found.isdisjoint(forbidden)


def test_the_test_set_is_left_out_of_catalogues_that_number_shapes_otherwise() -> None:
    layouts = testset_layouts(PAPER_CATALOGUE, PAPER_GRID)
    turned = Catalogue(PAPER_CATALOGUE.shapes[::-1])
    rows = {tuple(tuple((3 - s, left) for s, left in row) for row in Template.from_key(k).rows) for k in layouts}
    assert testset_layouts(turned, PAPER_GRID) == {Template(design).key for design in rows}
    assert testset_layouts(PAPER_CATALOGUE, Grid(width=5)) == set()
    shorter = testset_layouts(Catalogue(PAPER_CATALOGUE.shapes[:2]), PAPER_GRID)
    assert shorter == {key for key in layouts if "2@" not in key and "3@" not in key}
    longer = Catalogue((*PAPER_CATALOGUE.shapes[:2], Shape.box("long_rectangle", 4), PAPER_CATALOGUE[3]))
    assert testset_layouts(longer, PAPER_GRID) == {key for key in layouts if "2@" not in key}


# Refusals.


def test_a_folder_of_other_settings_is_refused_and_left_alone(small: Path) -> None:
    before = contents(small)
    for other in (
        replace(SMALL, seed=6),
        replace(SMALL, stacks=46),
        replace(SMALL, physics=Physics(friction=0.4)),
        replace(SMALL, accept=AcceptLimits(tilt=0.2)),
        replace(SMALL, template=TemplateSettings(displacement=0.2)),
    ):
        with pytest.raises(StackgenError, match="other settings") as caught:
            generate(other, small, workers=1)
        assert "\n" not in str(caught.value)
    assert contents(small) == before


def test_a_folder_of_unknown_shards_is_refused(small: Path, tmp_path: Path) -> None:
    (tmp_path / "train-000000.tar").write_bytes(next(small.glob("*.tar")).read_bytes())
    with pytest.raises(StackgenError, match=r"no generate\.json"):
        generate(SMALL, tmp_path, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["train-000000.tar"]


def test_a_damaged_shard_is_named_and_not_built_upon(small: Path, tmp_path: Path) -> None:
    for path in small.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    victim = next(tmp_path.glob("*-000001.tar"))
    victim.write_bytes(victim.read_bytes()[: victim.stat().st_size // 2])
    with pytest.raises(StackgenError, match=victim.name):
        generate(SMALL, tmp_path, workers=1)


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
    monkeypatch.setattr(module, "_HOPELESS", 2)
    with pytest.raises(StackgenError, match="gave no stack"):
        generate(replace(SMALL, max_blocks=3, templates_per_shard=1), tmp_path / "none", workers=1)
