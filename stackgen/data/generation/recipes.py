"""What stands behind one number of a dataset: the stacks of a template, or the answers to a drawing."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import numpy as np

from stackgen.data.dataset import TESTSET, Dataset
from stackgen.data.generation.deconstruction import Settler, deconstruct, surely_falls
from stackgen.data.generation.designs import Design, draw_design, realize
from stackgen.data.generation.drawing.drawings import DESIGN, Drawing, choose, draw, finish
from stackgen.data.generation.drawing.figures import Figure, of_blocks
from stackgen.data.generation.pictures import Pictures
from stackgen.data.generation.settings import GenerateSettings
from stackgen.data.shards import Sample
from stackgen.geometry import iou, silhouette
from stackgen.search.solver import SearchSettings, solve
from stackgen.sim.simulator import Simulator
from stackgen.stack import Stack
from stackgen.vision.masks import bounding_box
from stackgen.world import Mask, World


def samples_of(settings: GenerateSettings, number: int, excluded: frozenset[str], simulator: Simulator) -> list[Sample]:
    """Make all stacks of one number by the recipe of the settings; there may be none.

    Args:
        settings: Settings of the dataset.
        number: Number of the template or drawing; its random stream depends on it and on the seed alone.
        excluded: What to leave out, as :func:`testset_contents` names it.
        simulator: Simulator with the dataset's physics.
    """
    make = drawing_samples if settings.recipe == "drawings" else template_samples
    return make(settings, number, excluded, simulator)


def template_samples(
    settings: GenerateSettings, number: int, excluded: frozenset[str], simulator: Simulator
) -> list[Sample]:
    """Make all stacks of one template; there may be none."""
    rng = _stream(settings, number)
    design = draw_design(rng, settings.world, settings.template)
    if design.key in excluded:
        return []
    start = realize(design, rng, settings.world, settings.template)
    pictures = Pictures(settings.grid)
    samples = []
    for removed, stack in deconstruct(start, _settler(settings, simulator), settings.max_removals):
        if len(stack) > settings.max_blocks:
            continue
        poses = stack.poses.astype(np.float32)
        picture = pictures.front(stack.with_poses(poses))
        key = f"{number:08d}-{'.'.join(f'{b:02d}' for b in removed) or 'whole'}".replace(".", "_")
        meta = {"template": number, "layout": design.key, "removed": list(removed)}
        samples.append(Sample(key, stack.shapes.astype(np.uint8), poses, picture, meta))
    return samples


def drawing_samples(
    settings: GenerateSettings, number: int, excluded: frozenset[str], simulator: Simulator
) -> list[Sample]:
    """Make the answers to one drawing: some of the good layouts that the search finds, drawn evenly; there may be none.

    Good is what fits within `near` of the best, before and after it has settled, and stands with `margin`; or with
    `sure_margin`, if something does.
    """
    rng, how, world = _stream(settings, number), settings.drawings, settings.world
    drawing = _drawing(settings, excluded, rng)
    if drawing is None or fingerprint(drawing.silhouette) in excluded:
        return []
    found = solve(drawing.silhouette, world, how.known, settings=SearchSettings(effort=how.effort, near=how.near))
    best = max((answer.iou for answer in found), default=0.0)
    if best < how.least_fit:
        return []
    good = [answer for answer in found if answer.margin >= how.margin]
    good = [answer for answer in good if answer.margin >= how.sure_margin] or good
    settler, samples = _settler(settings, simulator), []
    for place in rng.permutation(len(good)).tolist():
        settled = settler.settle_rest(settler.at_rest(good[place].stack))
        if settled is None:
            continue
        poses = settled.stack.poses.astype(np.float32)
        stack = Stack(settled.stack.shapes, poses.astype(np.float64), world.catalogue)
        fit = iou(silhouette(stack, world.grid), drawing.silhouette)
        if fit < best - how.near:
            continue
        meta = {"template": number, "kind": drawing.kind, "fit": round(fit, 4), "best": round(best, 4)}
        meta["margin"] = round(good[place].margin, 4)
        shapes = stack.shapes.astype(np.uint8)
        samples.append(Sample(f"{number:08d}-answer_{place}", shapes, poses, drawing.silhouette, meta))
        if len(samples) == how.answers:
            break
    return samples


def _stream(settings: GenerateSettings, number: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(number,)))


def _settler(settings: GenerateSettings, simulator: Simulator) -> Settler:
    return Settler(simulator, settings.accept, settings.settle_twice, settings.certificate)


def _drawing(settings: GenerateSettings, excluded: frozenset[str], rng: np.random.Generator) -> Drawing | None:
    """Draw a silhouette of a random kind; None if it is left out."""
    kind = choose(settings.drawings.kinds, rng)
    figure = (
        _of_design(settings, excluded, rng) if kind == DESIGN else draw(kind, settings.world, settings.drawings, rng)
    )
    return None if figure is None else finish(kind, figure, settings.world, settings.drawings, rng)


def _of_design(settings: GenerateSettings, excluded: frozenset[str], rng: np.random.Generator) -> Figure | None:
    """Draw a random design of which some blocks are taken out, as long as the rest does not surely fall."""
    design = draw_design(rng, settings.world, settings.template)
    if design.key in excluded:
        return None
    stack = realize(design, rng, settings.world, settings.template)
    for _ in range(int(rng.integers(0, settings.max_removals + 1))):
        if len(stack) == 1:
            break
        keep = np.delete(np.arange(len(stack)), int(rng.integers(len(stack))))
        rest = Stack(stack.shapes[keep], stack.poses[keep], stack.catalogue)
        stack = stack if surely_falls(rest) else rest
    return of_blocks(stack)


def fingerprint(silhouette: Mask) -> str:
    """Name a silhouette, wherever it stands in its picture; its mirror image has the same name.

    >>> picture = np.zeros((8, 8), dtype=bool)
    >>> picture[4:, 1:3] = picture[7, 3] = True
    >>> fingerprint(picture) == fingerprint(np.roll(picture[:, ::-1], 1, axis=1))
    True
    """
    cut = silhouette[bounding_box(silhouette)]
    pixels = min(np.packbits(cut).tobytes(), np.packbits(cut[:, ::-1]).tobytes())
    return hashlib.sha256(bytes(f"{cut.shape[1]} ", "ascii") + pixels).hexdigest()


def testset_contents(world: World) -> frozenset[str]:
    """List the designs that `testset-v1` was made from, their mirror images, and the fingerprints of its silhouettes.

    Designs are in the numbers of another catalogue: shapes are the same if name and outline are.
    """
    return _contents_of(TESTSET, world)


@cache
def _contents_of(path: Path, world: World) -> frozenset[str]:
    if not (path / "dataset.json").exists():
        return frozenset()
    testset = Dataset.open(path)
    samples = list(testset.samples("test"))
    silhouettes = {fingerprint(sample.silhouette) for sample in samples}
    if (world.grid.width, world.grid.height) != (testset.world.grid.width, testset.world.grid.height):
        return frozenset(silhouettes)
    shapes = world.catalogue.shapes
    numbers = {i: shapes.index(shape) for i, shape in enumerate(testset.world.catalogue) if shape in shapes}
    designs: set[str] = set()
    for key in {sample.meta["layout"] for sample in samples}:
        rows = Design.from_key(key).rows
        if all(shape in numbers for row in rows for shape, _ in row):
            design = Design(tuple(tuple((numbers[shape], left) for shape, left in row) for row in rows))
            designs |= {design.key, design.mirrored(world).key}
    return frozenset(designs | silhouettes)
