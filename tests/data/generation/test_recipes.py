"""The recipe of drawings: good answers only, drawn evenly, the same whatever makes them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stackgen.data.card import dataset_card
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.data.generation import recipes
from stackgen.data.generation.drawing.drawings import DESIGN, Drawing, DrawingSettings
from stackgen.data.generation.executors import make_executor
from stackgen.data.generation.generate import ShardTask, generate
from stackgen.data.generation.recipes import drawing_samples, fingerprint, samples_of, testset_contents
from stackgen.data.generation.repair import repair
from stackgen.data.generation.settings import GenerateSettings
from stackgen.data.inspection.contents import Contents, facts
from stackgen.data.inspection.plots import draw_samples
from stackgen.data.inspection.verify import verify
from stackgen.data.manifest import SPLITS, Manifest
from stackgen.data.resplit import Resplit, resplit
from stackgen.errors import StackgenError
from stackgen.geometry import iou, silhouette
from stackgen.search.solver import SearchSettings, solve
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.simulator import Simulator
from stackgen.stack import layout
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Mask
from tests.data.generation.making import Here, contents

testset_contents.__test__ = False  # type: ignore[attr-defined]  # a function of the generator, not a test

DRAWN = GenerateSettings(
    "drawn",
    24,
    seed=3,
    recipe="drawings",
    templates_per_shard=3,
    validation=0.3,
    test=0.2,
    drawings=DrawingSettings(effort=0.02, known=4, answers=3),
)


@pytest.fixture(scope="module")
def simulator() -> Iterator[Simulator]:
    with Simulator() as simulator:
        yield simulator


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dataset of drawings, made in one process; not to be written to."""
    folder = tmp_path_factory.mktemp("generate") / "drawn"
    generate(DRAWN, folder, executor=Here())
    return folder


@pytest.mark.slow
def test_any_number_of_workers_makes_the_same_bytes(drawn: Path, tmp_path: Path) -> None:
    generate(DRAWN, tmp_path / "two", executor=make_executor("local", 2))
    assert contents(tmp_path / "two") == contents(drawn)


def test_the_manifest_holds_all_settings_and_says_what_the_silhouettes_are(drawn: Path) -> None:
    manifest = Dataset.open(drawn).manifest
    assert manifest.of_drawings and GenerateSettings.from_manifest(manifest) == DRAWN
    paper = GenerateSettings("paper", 5)
    other = Manifest("paper", 0, paper.world, paper.physics.to_json(), paper.to_json())
    assert not other.of_drawings and not {"recipe", "drawings", "silhouette"} & set(other.settings)


def test_answers_stand_and_fit_within_two_points_of_the_best(drawn: Path) -> None:
    dataset, checker = Dataset.open(drawn), SimulatorChecker()
    samples = [sample for split in dataset.splits for sample in dataset.samples(split)]
    assert len(samples) == 24
    for sample in samples:
        stack = sample.stack(PAPER_CATALOGUE)
        found = solve(sample.silhouette, PAPER_WORLD, 4, settings=SearchSettings(effort=0.02))
        fit = iou(silhouette(stack, PAPER_GRID), sample.silhouette)
        assert fit >= max(answer.iou for answer in found) - DRAWN.drawings.near - 1e-6
        assert layout(stack, PAPER_GRID) in {answer.layout for answer in found}
        assert sample.meta["margin"] >= DRAWN.drawings.margin and checker.check(stack).stable
    families = Counter(sample.meta["template"] for sample in samples)
    assert 1 < max(families.values()) <= 3
    assert len({(s.meta["template"], layout(s.stack(PAPER_CATALOGUE), PAPER_GRID)) for s in samples}) == 24


def test_good_answers_are_drawn_evenly(simulator: Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a slab of two rows, three cells wide, every good layout comes up about as often."""
    mask = np.zeros((64, 64), dtype=bool)
    mask[60 - 28 : 60, 11:53] = True
    monkeypatch.setattr(recipes, "_drawing", lambda *_: Drawing("boxes", mask))
    settings = replace(DRAWN, drawings=DrawingSettings(effort=0.05, known=4, answers=1))
    times = Counter(
        layout(sample.stack(PAPER_CATALOGUE), PAPER_GRID)
        for number in range(80)
        for sample in drawing_samples(settings, number, frozenset(), simulator)
    )
    assert sum(times.values()) == 80 and len(times) >= 3
    assert max(times.values()) < 80 / len(times) * 2 and min(times.values()) > 80 / len(times) / 2.5


def test_answers_that_hardly_stand_are_left_out_where_others_stand_surely(simulator: Simulator) -> None:
    drawings = DrawingSettings(kinds={DESIGN: 1}, effort=0.02, known=8, answers=8)
    mixed = 0
    for number in range(12):
        known = [
            [
                sample.meta["margin"]
                for sample in drawing_samples(
                    replace(DRAWN, drawings=replace(drawings, sure_margin=sure)), number, frozenset(), simulator
                )
            ]
            for sure in (0.0, 0.2)
        ]
        sure = [margin for margin in known[0] if margin >= 0.2]
        assert sorted(known[1]) == sorted(sure or known[0])
        mixed += 0 < len(sure) < len(known[0])
    assert mixed


def test_silhouettes_and_designs_of_the_test_set_are_left_out(
    simulator: Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    excluded = testset_contents(PAPER_WORLD)
    scene = next(Dataset.open(TESTSET).samples("test"))
    for mask in (scene.silhouette, scene.silhouette[:, ::-1]):
        monkeypatch.setattr(recipes, "_drawing", lambda *_, mask=mask: Drawing("rows", mask))
        assert drawing_samples(DRAWN, 0, excluded, simulator) == []
        assert drawing_samples(DRAWN, 0, frozenset(), simulator)
    monkeypatch.undo()
    designs = replace(DRAWN, drawings=replace(DRAWN.drawings, kinds={DESIGN: 1.0}))
    number, found = next((n, s) for n in range(20) if (s := samples_of(designs, n, excluded, simulator)))
    assert fingerprint(found[0].silhouette) not in excluded
    monkeypatch.setattr(recipes, "draw_design", lambda *_: recipes.Design.from_key(scene.meta["layout"]))
    assert samples_of(designs, number, excluded, simulator) == []


def test_a_silhouette_has_one_name_wherever_it_stands() -> None:
    def figure(left: int) -> Mask:
        mask = np.zeros((64, 64), dtype=bool)
        mask[40:60, left : left + 14] = mask[50:60, left : left + 28] = True
        return mask

    assert len({fingerprint(figure(left)) for left in (3, 20, 30)} | {fingerprint(figure(9)[:, ::-1])}) == 1
    assert fingerprint(figure(3)) != fingerprint(figure(3).T)


def test_drawings_that_blocks_cannot_make_are_left_out(simulator: Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    mask = np.zeros((64, 64), dtype=bool)
    mask[4:60, 31:33] = True  # a pole
    monkeypatch.setattr(recipes, "_drawing", lambda *_: Drawing("boxes", mask))
    assert drawing_samples(DRAWN, 0, frozenset(), simulator) == []


def test_a_dataset_of_drawings_is_verified_described_split_and_repaired(drawn: Path, tmp_path: Path) -> None:
    assert verify(drawn) == []
    loaded = Contents.load(drawn)
    found = facts(loaded, TESTSET)
    assert found["stacks"] == 24 and found["testset"]["silhouette in training"] == 0
    assert draw_samples(loaded, 4).ndim == 3
    card = dataset_card(loaded.manifest)
    assert "the drawing that it answers" in card and "counted in drawings" in card and "deconstruction" not in card
    again = resplit(drawn, tmp_path / "again", Resplit(0.5, 0))
    assert again.of_drawings and sum(again.count(split) for split in SPLITS) == 24 and verify(tmp_path / "again") == []
    with pytest.raises(StackgenError, match="only be split by template"):
        resplit(drawn, tmp_path / "layouts", Resplit(0.5, 0, by="layout"))


def test_a_lost_shard_of_drawings_is_made_again(drawn: Path, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    generate(DRAWN, out, executor=Here())
    before = contents(out)
    shard = sorted(out.glob("*.tar"))[0]
    shard.unlink()
    assert repair(out, Here()).identical == (shard.name,) and contents(out) == before


def test_settings_of_drawings_belong_to_their_recipe() -> None:
    with pytest.raises(StackgenError, match="set recipe to drawings"):
        replace(DRAWN, recipe="deconstruction")
    assert ShardTask.of(replace(DRAWN, exclude_testset=False)).excluded == frozenset()
