"""The figures of a dataset are those that counting one by one gives; its card and pictures are there."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from contextlib import chdir
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stackgen.data.arrays import StackArrays
from stackgen.data.card import MARK, dataset_card, write_card
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.data.inspection.contents import (
    Contents,
    counts,
    describe_margins,
    distributions,
    duplicates,
    nearest_silhouettes,
    nearness,
    sample_margins,
)
from stackgen.data.shards import Sample
from stackgen.geometry import iou
from stackgen.protocols import Verdict
from stackgen.sim.physics import Physics
from stackgen.sim.statics.checker import StaticsChecker
from stackgen.stack import Stack
from tests.conftest import Cli

Samples = dict[str, list[Sample]]


@pytest.fixture(scope="module")
def contents(dataset: Path) -> Contents:
    return Contents.load(dataset)


@pytest.fixture(scope="module")
def generated() -> Contents:
    """The frozen test scenes, which the generator made."""
    return Contents.load(TESTSET)


def test_counts_are_those_of_counting(contents: Contents, samples: Samples) -> None:
    everything = [sample for those in samples.values() for sample in those]
    found = counts(contents)
    assert found["split"] == {"train": 71, "validation": 23, "test": 7}
    assert found["templates by split"] == found["split"]
    assert found["blocks by shape"]["triangle"] == sum(int((s.shapes == 3).sum()) for s in everything)
    assert sum(found["stacks by blocks"].values()) == found["stacks by height [cell]"]["4"] == 101
    assert found["stacks by blocks"]["9"] == sum(len(s.shapes) == 9 for s in everything)
    assert found["distinct"]["designs"] == len({s.meta["layout"] for s in everything})
    assert found["distinct"]["block lists"] == len({tuple(np.bincount(s.shapes, minlength=4)) for s in everything})
    assert "stacks by removals" not in found  # these keys do not say


def test_removals_are_read_from_the_keys(generated: Contents) -> None:
    removed = [len(sample.meta["removed"]) for sample in Dataset.open(TESTSET).samples("test")]
    assert generated.depth.tolist() == removed
    assert counts(generated)["stacks by removals"]["2"] == removed.count(2)


def test_a_compact_file_says_the_same(contents: Contents, dataset: Path, tmp_path: Path, cli: Cli) -> None:
    assert cli("dataset", "export", dataset, "--out", tmp_path / "small.npz").code == 0
    compact = Contents.load(tmp_path / "small.npz")
    assert counts(compact) == counts(contents) and compact.manifest.name == "small"
    assert (compact.arrays.poses == contents.arrays.poses).all()


def test_blocks_lie_beside_their_design_by_the_displacement_drawn(contents: Contents) -> None:
    found = distributions(contents)
    assert 0.09 < np.abs(found["x beside the design [cell]"]).max() <= 0.2  # 0.1, more where neighbours made room
    for name in ("y beside the design [cell]", "yaw [degrees]", "tilt [degrees]"):
        assert np.abs(found[name]).max() < 1e-6


# Duplicates.


def test_duplicates_are_found_whatever_the_order_of_blocks(contents: Contents) -> None:
    assert duplicates(contents) == {"stacks": 0, "surplus": 0, "across splits": 0}
    arrays = contents.arrays
    poses, shapes = arrays.poses.copy(), arrays.shapes.copy()
    k = int(arrays.lengths[5])
    for twin in (40, 90):  # one in the same split, one in another
        shapes[twin], poses[twin] = shapes[5], poses[5] + 0.004 * np.sign(poses[5])
        shapes[twin, :k], poses[twin, :k] = shapes[twin, :k][::-1].copy(), poses[twin, :k][::-1].copy()
    shapes[60], poses[60] = shapes[5], poses[5]
    poses[60, 1, 0] += 0.02
    copied = StackArrays(shapes, poses, arrays.silhouettes, arrays.template, arrays.num_shapes)
    twins = Contents(copied, contents.split, contents.depth, contents.manifest)
    assert duplicates(twins) == {"stacks": 3, "surplus": 2, "across splits": 3}
    assert duplicates(twins, same=0.03)["stacks"] == 4
    assert duplicates(twins, same=0.001)["stacks"] == 2  # those two are equal


def test_duplicates_are_those_of_comparing_every_pair(generated: Contents) -> None:
    """At a tolerance at which there are some."""
    same, arrays = 0.2, generated.arrays
    ordered = []
    for i in range(len(arrays)):
        stack = generated.stack(i)
        order = np.lexsort((stack.poses[:, 0], np.floor(stack.poses[:, 2])))
        ordered.append((stack.shapes[order].tolist(), np.floor(stack.poses[order, 2]).tolist(), stack.poses[order]))
    pairs = [
        (a, b)
        for a, b in combinations(range(len(arrays)), 2)
        if ordered[a][:2] == ordered[b][:2] and np.abs(ordered[a][2] - ordered[b][2]).max() <= same
    ]
    found = duplicates(generated, same)
    assert found["stacks"] == len({i for pair in pairs for i in pair}) > 0 == found["across splits"]
    assert found["surplus"] == len({b for _, b in pairs})


# Nearness.


def test_the_nearest_silhouette_is_that_of_trying_all(contents: Contents) -> None:
    train, test = contents.of("train"), contents.of("validation")
    rng = np.random.default_rng(0)
    strange = test.images(slice(0, 3)) & (rng.random((3, 64, 64)) < 0.2)  # far from every training silhouette
    packed = np.concatenate([test.silhouettes, np.packbits(strange.reshape(3, -1), axis=1)])
    best = nearest_silhouettes(train.silhouettes, packed, 64)
    pictures = [picture for image in train.images() for picture in (image, image[:, ::-1])]
    wanted = [max(iou(scene, p) for p in pictures) for scene in (*test.images(), *strange)]
    np.testing.assert_allclose(best, wanted)
    assert best[-3:].max() < 0.5 and (nearest_silhouettes(train.silhouettes, train.silhouettes[:3], 64) == 1).all()


def test_nearness_counts_what_training_holds(contents: Contents, generated: Contents) -> None:
    near = nearness(contents, TESTSET)
    assert near is not None and near["scenes"] == 500 and near["stack in training"] == 0
    assert 0 <= near["design in training"] <= near["layout in training"] < 500
    arrays = generated.arrays
    known = StackArrays.concatenate([arrays.select(slice(0, 120))])
    split = np.zeros(120, np.int64)
    half = nearness(Contents(known, split, generated.depth[:120], generated.manifest), TESTSET)
    assert half is not None and half["stack in training"] == 120 <= half["silhouette in training"]
    assert half["nearest silhouette, IoU"]["largest"] == 1
    assert nearness(Contents(known, split + 1, generated.depth[:120], generated.manifest), TESTSET) is None


def test_margins_are_the_checker_s(contents: Contents) -> None:
    class CountsBlocks:
        physics = Physics()

        def check(self, stack: Stack) -> Verdict:
            """The margin is the number of blocks [degrees]."""
            return Verdict(True, np.zeros(0, bool), np.zeros(0), stack, True, np.radians(len(stack)))

        def check_all(self, stacks: Iterable[Stack]) -> list[Verdict]:
            return [self.check(stack) for stack in stacks]

    margins = sample_margins(contents, CountsBlocks(), 101)
    assert sorted(margins.round(6).tolist()) == sorted(contents.arrays.lengths.tolist())
    assert len(sample_margins(contents, CountsBlocks(), 10, seed=1)) == 10
    assert describe_margins(np.array([0.1, 0.7, 3, 9]))["share below 1 degrees"] == 0.5


# For people.


def test_info_prints_draws_and_writes(dataset: Path, tmp_path: Path, cli: Cli) -> None:
    answer = cli("dataset", "info", dataset, "--out", tmp_path / "out", "--margins", 5, "--samples", 3)
    assert answer.code == 0
    for words in ("101 stacks", "triangle", "have a twin", "of 5 stacks", "testset-v1"):
        assert words in " ".join(answer.out.split())
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["info.json", "info.png", "samples.png"]
    assert json.loads((tmp_path / "out" / "info.json").read_text())["stacks"] == 101
    for name in ("info.png", "samples.png"):
        assert min(Image.open(tmp_path / "out" / name).size) > 300
    assert not (dataset / "README.md").exists()


def test_info_puts_its_figures_into_the_card(towers_dataset: Path, tmp_path: Path, cli: Cli) -> None:
    folder = tmp_path / "towers"
    folder.mkdir()
    for path in towers_dataset.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    assert cli("dataset", "info", folder, "--margins", 0, "--samples", 0).code == 0
    card = (folder / "README.md").read_text()
    assert "## What is in it" in card and "samples.png" not in card and "info.png" in card and "Margins" not in card
    assert cli("dataset", "verify", folder).code == 0


def test_a_card_s_snippet_reads_the_dataset_with_webdataset_and_numpy(dataset: Path, samples: Samples) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", dataset_card(Dataset.open(dataset).manifest), re.DOTALL)
    names: dict[str, np.ndarray] = {}
    with chdir(dataset):
        exec(compile(code, "card", "exec"), names)
    first = samples["train-000000.tar"][0]
    assert (names["poses"] == first.poses).all() and (names["silhouette"] == first.silhouette).all()


def test_a_card_says_how_the_dataset_was_made() -> None:
    text = dataset_card(Dataset.open(TESTSET).manifest)
    for words in (
        "500 stacks",
        "seed 191",
        "Of 4,000 stacks made so, 500 were drawn",
        "| friction | 0.5 |",
        "| test | 500 |",
    ):
        assert words in text


def test_a_readme_that_is_not_ours_is_left_alone(dataset: Path, tmp_path: Path) -> None:
    manifest = Dataset.open(dataset).manifest
    assert write_card(tmp_path, manifest) and write_card(tmp_path, manifest, ["more"])
    assert (tmp_path / "README.md").read_text().startswith(MARK)
    (tmp_path / "README.md").write_text("# mine\n")
    assert not write_card(tmp_path, manifest)
    assert (tmp_path / "README.md").read_text() == "# mine\n"


def test_export_says_how_large_the_file_is(dataset: Path, tmp_path: Path, cli: Cli) -> None:
    answer = cli("dataset", "export", dataset, "--out", tmp_path / "a.npz")
    assert answer.code == 0 and "101 stacks, 0.0 MiB" in answer.out and "more than" not in answer.out


def test_an_export_leaves_out_what_hardly_stands(dataset: Path, tmp_path: Path, cli: Cli) -> None:
    whole, checker = Dataset.open(dataset), StaticsChecker()
    margins = [checker.check(sample.stack(whole.world.catalogue)).margin or 0.0 for sample in whole.samples("train")]
    least = float(np.median(margins))
    answer = cli("dataset", "export", dataset, "--margin", least, "--out", tmp_path / "steady.npz")
    assert answer.code == 0, answer.err
    steady = Dataset.open(tmp_path / "steady.npz")
    expected = whole.split("train").select([i for i, margin in enumerate(margins) if margin >= least])
    assert 0 < len(expected) < len(margins)
    assert (steady.split("train").poses == expected.poses).all()
    assert (steady.split("validation").poses == whole.split("validation").poses).all()
    assert steady.manifest.counts == {**whole.manifest.counts, "train": len(expected)}
    assert steady.manifest.sha256 != whole.manifest.sha256


@pytest.mark.parametrize(("margin", "words"), [(-0.1, "must lie in"), (1.6, "must lie in"), (1.5, "no stack")])
def test_an_export_of_no_steady_stack_is_one_line(
    dataset: Path, tmp_path: Path, cli: Cli, margin: float, words: str
) -> None:
    assert words in cli("dataset", "export", dataset, "--margin", margin, "--out", tmp_path / "a.npz").line
    assert not (tmp_path / "a.npz").exists()


def test_unknown_actions_are_one_line(cli: Cli) -> None:
    assert "did you mean 'verify'" in cli("dataset", "verfy", "x").line
    assert all(f"  {name}" in cli("dataset", "--help").out for name in ("verify", "repair", "info", "split", "export"))
    for name in ("verify", "repair", "info", "split", "export"):
        answer = cli("dataset", name, "--help")
        assert answer.code == 0 and f"example:\n  stackgen dataset {name}" in answer.out
