"""How every method degrades on silhouettes that the generator cannot have made.

Scenes of testset-v1, evenly spread, each disturbed in several ways and asked for as `stackgen sample --one_shot` asks:
with the CNN's block list, the silhouette shifted to the grid's cells. `search` chooses blocks itself and shifts
nothing; `together` is what `stackgen sample` delivers. Front IoU is with the disturbed silhouette. Intervals are 95 %,
clustered by scene. Each row is printed and written when it is there.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from benchmarks.common import argument_parser, machine, percent, plain_table, report, start
from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.io.files import write_json
from stackgen.protocols import StabilityChecker, StackSampler
from stackgen.sampling.alignment import AlignedSampler, aligned
from stackgen.search.sampler import NAME, side_by_side
from stackgen.stack import Stack
from stackgen.world import PAPER_GRID, PAPER_WORLD, Mask, World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stackgen.evaluation.protocol import Scene
    from stackgen.protocols import BlockListPredictor

METRICS = ("stability", "front_iou", "iou_given_stable")
TOGETHER = "together"
DRAWINGS = Path("examples/silhouettes")

Disturb = Callable[[Mask, np.random.Generator], Mask]
"""Function that disturbs a picture with PAD pixels added on every side."""

PAD = 32
"""Room in which a disturbed structure may move before it is framed again [pixel]."""


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    names = ["brute-force", "greedy-random", "default"]
    options.add_argument(
        "--weights", nargs="+", default=names, help="methods: names (`together` too), files of weights, run folders"
    )
    options.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), help="kinds of silhouettes")
    options.add_argument("--scenes", type=int, default=50, help="scenes, evenly spread over the test set")
    options.add_argument("--num_samples", type=int, default=3, help="samples of each scene")
    options.add_argument("--verified", action="store_true", help="add verified sampling with the last weights")
    options.add_argument("--draws", type=int, default=64, help="stacks that verified sampling may draw for a scene")
    options.add_argument("--seed", type=int, default=0, help="seed of disturbances and noise")
    options.add_argument(
        "--add_to", type=Path, metavar="FILE.json", help="earlier result, the rest of whose rows is kept"
    )
    return options


def disturbed(mask: Mask, disturb: Disturb, rng: np.random.Generator, centre: bool) -> Mask | None:
    """The mask (H, W), disturbed, on the ground line; None if it does not fit into the picture any more.

    Args:
        mask: Silhouette to disturb.
        disturb: Function that disturbs it.
        rng: Source of what is random in that.
        centre: Move it to the middle where it would be cut off.
    """
    found = disturb(np.pad(mask, PAD), rng)
    rows, columns = np.flatnonzero(found.any(axis=1)), np.flatnonzero(found.any(axis=0))
    if not len(rows):
        return None
    found = np.roll(found, FOOT - 1 - rows[-1], axis=0)
    outside = columns[0] < PAD or columns[-1] >= PAD + mask.shape[1]
    if outside and centre:
        found = np.roll(found, round((found.shape[1] - 1 - columns[0] - columns[-1]) / 2), axis=1)
    inside = found[PAD:-PAD, PAD:-PAD]
    return inside if inside.sum() == found.sum() else None


FOOT = round(PAD + PAPER_GRID.image_size - PAPER_GRID.ground_margin)
"""The ground line, below this row of a padded picture."""


def shifted(cells: float) -> Disturb:
    """Moved sideways, to the side that has more room."""

    def disturb(mask: Mask, rng: np.random.Generator) -> Mask:
        columns = np.flatnonzero(mask.any(axis=0))
        side = 1 if columns[0] < mask.shape[1] - 1 - columns[-1] else -1
        return np.roll(mask, side * round(cells * PAPER_GRID.pixels_per_cell), axis=1)

    return disturb


def warped(matrix: Callable[[float], NDArray[np.float64]], amount: float, sides: tuple[int, ...] = (-1, 1)) -> Disturb:
    """Linearly, about the middle of the ground line, to either side."""

    def disturb(mask: Mask, rng: np.random.Generator) -> Mask:
        inverse = np.linalg.inv(matrix(rng.choice(sides) * amount))  # in (row, column)
        foot = np.array([FOOT, mask.shape[1] / 2]) - 0.5
        return ndimage.affine_transform(mask.astype(float), inverse, foot - inverse @ foot, order=1) >= 0.5

    return disturb


def rotation(degrees: float) -> NDArray[np.float64]:
    """(2, 2) in (row, column)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s], [-s, c]])


def shear(degrees: float) -> NDArray[np.float64]:
    """(2, 2) in (row, column): upright edges lean, level ones stay."""
    return np.array([[1.0, 0.0], [np.tan(np.radians(degrees)), 1.0]])


def scaling(percent: float) -> NDArray[np.float64]:
    """(2, 2) to this size."""
    return np.eye(2) * percent / 100


def rough(mask: Mask, rng: np.random.Generator) -> Mask:
    """Change 30 % of the pixels on either side of an edge; remove specks."""
    edge = ndimage.binary_dilation(mask) & ~ndimage.binary_erosion(mask)
    noisy = mask ^ (edge & (rng.random(mask.shape) < 0.3))
    labels, _ = ndimage.label(noisy)
    return labels == np.bincount(labels[noisy]).argmax() if noisy.any() else mask


def drawn_by_hand(mask: Mask, rng: np.random.Generator) -> Mask:
    """Edges that waver by a pixel or two over the length of a block, as a hand draws them."""
    offsets = [ndimage.gaussian_filter(rng.normal(size=mask.shape), 5.0) for _ in range(2)]
    places = [
        place + 1.5 * offset / offset.std() for place, offset in zip(np.indices(mask.shape), offsets, strict=True)
    ]
    return ndimage.map_coordinates(mask.astype(float), places, order=1) >= 0.5


DISTURBANCES: dict[str, Disturb] = {
    "as it is": lambda mask, rng: mask,
    "shifted by 1/4 cell": shifted(0.25),
    "shifted by 1/2 cell": shifted(0.5),
    "turned by 2 degrees": warped(rotation, 2.0),
    "turned by 5 degrees": warped(rotation, 5.0),
    "slanted by 5 degrees": warped(shear, 5.0),
    "slanted by 10 degrees": warped(shear, 10.0),
    "scaled to 90 %": warped(scaling, 90.0, sides=(1,)),
    "rough edges": rough,
    "drawn by hand": drawn_by_hand,
}
HALF_CELLS, EXAMPLES = "half-cell steps", "drawings"
KINDS = (*DISTURBANCES, HALF_CELLS, EXAMPLES)


def half_cell_steps(truth: Stack, checker: StabilityChecker, rng: np.random.Generator) -> Stack | None:
    """The stack with all above some level moved by half a cell, if there is such a one that stands."""
    levels = np.unique(np.round(truth.poses[:, 2] - 0.5).astype(int))
    for level in rng.permutation(levels[levels > 0]):
        for side in rng.permutation([-0.5, 0.5]):
            poses = truth.poses.copy()
            poses[np.round(poses[:, 2] - 0.5) >= level, 0] += side
            verdict = checker.check(truth.with_poses(poses))
            cut_off = silhouette(verdict.settled, PAPER_GRID)[:, [0, -1]].any()
            if verdict.stable and verdict.at_rest and not cut_off:
                return verdict.settled
    return None


def scenes_of_kind(kind: str, scenes: Sequence[Scene], checker: StabilityChecker, seed: int) -> list[Scene]:
    """What is asked for: fewer scenes where a disturbance has no sense, or what it leaves does not fit the picture."""
    from dataclasses import replace

    from stackgen.evaluation.protocol import Scene
    from stackgen.vision.reader import read_silhouette

    if kind == EXAMPLES:
        files = sorted(DRAWINGS.iterdir())
        unknown = np.zeros_like(scenes[0].counts)
        return [Scene(file.stem, read_silhouette(file, PAPER_GRID), unknown) for file in files]
    found = []
    for number, scene in enumerate(scenes):
        rng = np.random.default_rng([seed, KINDS.index(kind), number])
        if kind == HALF_CELLS:
            moved = half_cell_steps(scene.truth, checker, rng) if scene.truth else None
            if moved is not None:
                found.append(Scene(scene.name, silhouette(moved, PAPER_GRID), scene.counts, moved))
        else:
            mask = disturbed(scene.silhouette, DISTURBANCES[kind], rng, centre=not kind.startswith("shifted"))
            found += [] if mask is None else [replace(scene, silhouette=mask, truth=None)]
    return found


class AlignedPredictor:
    """A BlockListPredictor that shows another each structure on the cells of its grid."""

    def __init__(self, predictor: BlockListPredictor) -> None:
        self.predictor = predictor

    @property
    def world(self) -> World:
        """The world of the other predictor."""
        return self.predictor.world

    @property
    def card(self) -> Mapping[str, Any]:
        """The card of the other predictor."""
        return self.predictor.card

    def predict(self, silhouettes: Mask, top: int = 1, limit: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """See BlockListPredictor."""
        shown = [aligned(mask, self.world.grid)[0] for mask in silhouettes]
        return self.predictor.predict(np.stack(shown), top, limit)


@dataclass(frozen=True)
class WithOwnLists:
    """A StackSampler that chooses the blocks itself; where it finds nothing, those that were given lie on the ground.

    Args:
        ask: Gives the best stacks for a silhouette (H, W), at most so many, by seed.
    """

    ask: Callable[[Mask, int, int], Sequence[Stack]]
    world: World = PAPER_WORLD
    settings: Mapping[str, Any] = field(default_factory=dict)
    card: Mapping[str, Any] = field(default_factory=dict)

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """See StackSampler; the best stack again where there are too few."""
        scenes = []
        for mask, block_list in zip(silhouettes, counts, strict=True):
            try:
                stacks = list(self.ask(mask, num_samples, seed))
            except StackgenError:
                stacks = []
            stacks = stacks or [side_by_side(block_list, self.world)]
            scenes.append([stacks[i % len(stacks)] for i in range(num_samples)])
        return scenes


def searched(silhouette: Mask, number: int, seed: int) -> list[Stack]:
    """What the search finds; the seed changes nothing."""
    from stackgen.search.solver import solve

    return [answer.stack for answer in solve(silhouette, PAPER_WORLD, number)]


def together(silhouette: Mask, number: int, seed: int) -> Sequence[Stack]:
    """What `stackgen sample` delivers."""
    from stackgen.api import best
    from stackgen.vision.reader import Reading

    overlay = np.zeros((*silhouette.shape, 3), np.uint8)
    return best(Reading(silhouette, "drawing", 1.0, overlay, exact=silhouette), number, seed).stacks


OWN_LISTS = {NAME: WithOwnLists(searched), TOGETHER: WithOwnLists(together)}


def methods_of(options: argparse.Namespace, checker: StabilityChecker) -> dict[str, StackSampler]:
    """The methods to ask, by name."""
    from stackgen.sampling.methods import load_sampler
    from stackgen.sampling.verified import Budget, VerifiedSampler

    methods: dict[str, StackSampler] = {}
    title = ""
    for name in options.weights:
        if name in OWN_LISTS:
            methods[name] = OWN_LISTS[name]
            continue
        sampler = load_sampler(name)
        title = str(sampler.card.get("name", name))
        methods[title] = AlignedSampler(sampler)
    if options.verified and title:
        methods[f"{title}, verified"] = VerifiedSampler(methods[title], checker, Budget(options.draws))
    return methods


def main() -> None:
    """Disturb the silhouettes, ask the methods, check their stacks."""
    options = parser().parse_args()
    if min(options.scenes, options.num_samples) < 1:
        raise StackgenError("--scenes and --num_samples must be at least 1")
    from stackgen.data.dataset import TESTSET
    from stackgen.evaluation.protocol import Request, evaluate, load_scenes
    from stackgen.sampling.methods import load_predictor
    from stackgen.sim.checkers import SimulatorChecker

    everything, dataset = load_scenes(TESTSET)
    number = min(options.scenes, len(everything))
    scenes = [everything[i] for i in np.linspace(0, len(everything) - 1, number).round().astype(int)]
    checker, predictor = SimulatorChecker(until_fall=True), AlignedPredictor(load_predictor("default"))
    methods = methods_of(options, checker)
    metrics: dict[str, Any] = {
        "test_set": dataset.manifest.sha256,
        "samples_per_scene": options.num_samples,
        "seed": options.seed,
        "physics": checker.physics.to_json(),
    }
    metrics["rows"] = rows = kept(options.add_to, options.kinds, methods, metrics) if options.add_to else []
    facts = {"commit": machine()["commit"]}
    for kind in options.kinds:
        asked = scenes_of_kind(kind, scenes, checker, options.seed)
        for name, sampler in methods.items():
            request = Request(
                name, sampler.world, sampler, predictor, num_samples=options.num_samples, seed=options.seed
            )
            found = evaluate(request, asked, checker)
            estimates = {metric: found.estimate(metric) for metric in METRICS}
            row = {"silhouettes": kind, "scenes": len(asked), "method": name, **facts}
            row |= {metric: value and value.to_json() for metric, value in estimates.items()}
            print(f"{kind}, {name}: " + ", ".join(f"{m} {percent(row[m])}" for m in METRICS), flush=True)
            rows.append(row)
            rows.sort(key=lambda row: KINDS.index(row["silhouettes"]))  # stable: methods stay in order
            if options.out is not None:
                options.out.parent.mkdir(parents=True, exist_ok=True)
                write_json(options.out, metrics)
    report("out_of_distribution", metrics, [table(rows, metric) for metric in METRICS[:2]], options.out)


def kept(
    path: Path, kinds: Sequence[str], methods: Mapping[str, StackSampler], conditions: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """The rows of an earlier result that are not measured again, each with the commit it was measured at.

    Raises:
        StackgenError: If it was measured under other conditions.
    """
    content = json.loads(path.read_text())
    found = content["figures"]
    if any(found[name] != value for name, value in conditions.items()):
        raise StackgenError(f"{path} holds another test set, seed, number of samples or physics")
    return [
        {"commit": content["machine"]["commit"], **row}
        for row in found["rows"]
        if row["silhouettes"] not in kinds or row["method"] not in methods
    ]


def table(rows: Sequence[Mapping[str, Any]], metric: str) -> Any:
    """One metric: silhouettes down, methods across."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines: dict[str, list[str]] = {}
    for row in rows:
        lines.setdefault(f"{row['silhouettes']} ({row['scenes']})", []).append(percent(row[metric]))
    title = f"{metric.replace('_', ' ')}, percent"
    return plain_table(title, ("silhouettes (scenes)", *methods), [[name, *line] for name, line in lines.items()])


if __name__ == "__main__":
    start(main)
