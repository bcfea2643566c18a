"""The dataset generator: designs in, shards out, on as many processes as there are.

A shard holds all stacks of a fixed range of templates, and each template has its own random stream,
so a shard's bytes depend on the settings and its number alone: not on the number of workers, nor on
whether the run was interrupted. A run that is started again makes the shards that are missing.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from functools import cache, partial
from itertools import count
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from stackgen.data.card import write_card
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.data.generation.deconstruction import Settler, deconstruct
from stackgen.data.generation.designs import Design, DesignSettings, draw_design, realize
from stackgen.data.generation.executors import Executor, make_executor
from stackgen.data.generation.pictures import Pictures
from stackgen.data.generation.workshop import PARTS, MadeShard, Workshop, claim, disk_may_be_full, finished, sweep
from stackgen.data.manifest import Manifest, ShardEntry, Split, shard_entry, split_of
from stackgen.data.shards import Sample, encode_shard, read_shard
from stackgen.errors import StackgenError
from stackgen.io.files import held, write_atomically
from stackgen.sim.checkers import AcceptLimits
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Simulator
from stackgen.sim.statics.plane import StaticsMargins
from stackgen.world import MAX_BLOCKS, PAPER_CATALOGUE, PAPER_GRID, Catalogue, Grid, World

REVISION = 1
"""Revision of the generator: raised when equal settings begin to mean other stacks, so that the two are not mixed."""
_HOPELESS = 2000  # templates without a stack, after which none is expected


@dataclass(frozen=True)
class GenerateSettings:
    """The settings of a dataset; `configs/generate/*.yaml` hold these.

    A template is a design that was drawn, displaced and settled; it has a number, and stacks are made from it.

    Args:
        name: Name of the dataset, kept in its manifest.
        stacks: Number of stacks; the generator stops once they are stored.
        seed: Seed; the same one gives the same dataset.
        templates_per_shard: Templates whose stacks share a shard, and so a split.
        validation: Share of the templates that goes to the validation split.
        test: Share of the templates that goes to the test split; the rest is for training.
        draw: Number of stacks that are kept, drawn uniformly from all; 0 keeps all.
        max_removals: Largest number of blocks taken out of a template.
        max_blocks: Largest number of blocks of a stored stack; larger stacks are still deconstructed.
        settle_twice: Whether a settled stack must stand a second time, unless statics is certain that it does.
        exclude_testset: Whether to leave out the designs that `testset-v1` uses, and their mirror images.
        template: How designs are drawn and displaced.
        accept: How far a stack may settle.
        certificate: When statics is certain enough to spare the simulator a stack.
        physics: Physics of the simulator.
        grid: Design grid and scale of the silhouettes.
        catalogue: Shapes of the blocks.
    """

    name: str
    stacks: int
    seed: int = 0
    templates_per_shard: int = 250
    validation: float = 0.02
    test: float = 0.10
    draw: int = 0
    max_removals: int = 4
    max_blocks: int = MAX_BLOCKS
    settle_twice: bool = True
    exclude_testset: bool = True
    template: DesignSettings = field(default_factory=DesignSettings)
    accept: AcceptLimits = field(default_factory=AcceptLimits)
    certificate: StaticsMargins = field(default_factory=StaticsMargins)
    physics: Physics = field(default_factory=Physics)
    grid: Grid = PAPER_GRID
    catalogue: Catalogue = PAPER_CATALOGUE

    def __post_init__(self) -> None:
        if self.stacks < 1 or self.templates_per_shard < 1 or self.max_blocks < 1 or self.max_removals < 0:
            raise StackgenError(
                "generate: stacks, templates_per_shard and max_blocks must be at least 1, max_removals 0"
            )
        if self.seed < 0:
            raise StackgenError(f"generate: seed must be at least 0, got {self.seed}")
        if self.validation < 0 or self.test < 0 or self.validation + self.test > 1:
            raise StackgenError("generate: validation and test are shares of the templates; their sum is at most 1")
        if not 0 <= self.draw <= self.stacks:
            raise StackgenError(f"generate: draw must lie in 0..stacks, got {self.draw}")
        self.grid.require_room()
        self.template.check(self.world)
        thinnest = min(self.catalogue, key=lambda shape: shape.size[2])
        if self.physics.fall_height >= thinnest.size[2]:
            raise StackgenError(
                f"generate: a fall of shape {thinnest.name!r} would go unseen;"
                f" set physics.fall_height to {thinnest.size[2] / 2:g}, half its height"
            )

    def to_json(self) -> dict[str, Any]:
        """Give the plain form without what the manifest stores elsewhere."""
        elsewhere = ("name", "seed", "grid", "catalogue", "physics", "max_blocks")
        own = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in elsewhere}
        plain = {n: asdict(v) if is_dataclass(v) and not isinstance(v, type) else v for n, v in own.items()}
        return {"revision": REVISION, **json.loads(json.dumps(plain))}

    @staticmethod
    def from_manifest(manifest: Manifest) -> GenerateSettings:
        """Give the settings that a dataset was made with.

        Raises:
            StackgenError: If its manifest does not hold them, or holds those of another generator.
        """
        plain = {**_BEFORE, **{key: value for key, value in manifest.settings.items() if key != "revision"}}
        physics = Physics.settings_of(manifest.physics)
        world = {"name": manifest.name, "seed": manifest.seed, **vars(manifest.world)}
        try:
            return _revived(GenerateSettings, {**plain, **world, "physics": physics})
        except (KeyError, TypeError) as error:
            raise StackgenError(
                f"dataset {manifest.name!r} was not made by this version of `stackgen generate`: {error}"
            ) from error

    @property
    def world(self) -> World:
        """The world of its stacks."""
        return World(self.catalogue, self.grid, self.max_blocks)

    def split_of(self, shard: int) -> Split:
        """Choose the split of a shard."""
        return split_of(shard, self.validation, self.test)


_BEFORE = {"certificate": {"enabled": False}}
"""Settings that older manifests do not name, since they did not exist."""


def generate(
    settings: GenerateSettings,
    out: Path,
    *,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
    executor: Executor | None = None,
    say: Callable[[str], None] | None = None,
) -> Manifest:
    """Make a dataset, or finish one that was interrupted.

    Args:
        settings: What to make.
        out: Folder of the dataset.
        workers: Number of processes; by default one per core. The result does not depend on it.
        progress: Called with the number of stacks stored so far.
        executor: Runs the making of the shards; by default on processes of this machine.
        say: Called with a line about each shard that was damaged in an interruption and is made again.

    Raises:
        StackgenError: If the folder holds something else, a shard was damaged since the dataset was
            complete, the disk is full, or workers die again and again.
    """
    with disk_may_be_full(out), _claimed(settings, out):
        manifest = finished(out, settings.draw or settings.stacks)
        if manifest is None:
            workshop = workshop_of(settings, out)
            executor = executor or make_executor("local", workers)
            entries = make_shards(settings, workshop, executor, progress, say)
            if settings.draw:
                entries = [_store(out, draw(workshop.folder, entries, settings))]
            manifest = _manifest(settings, tuple(entries))
            write_card(out, manifest)
            manifest.save(out)
        sweep(out, manifest)
    return manifest


def generate_range(
    settings: GenerateSettings,
    out: Path,
    shards: range,
    executor: Executor | None = None,
    *,
    progress: Callable[[int], None] | None = None,
    say: Callable[[str], None] | None = None,
) -> int:
    """Make some shards of a dataset, for jobs that share its folder; :func:`generate` collects them.

    Args:
        settings: Settings of the whole dataset.
        out: Folder of the dataset.
        shards: Numbers of the shards.
        executor: Runs their making; by default on processes of this machine.
        progress: Called with the number of shards that are there so far.
        say: Called with a line about each shard that was damaged in an interruption and is made again.

    Returns:
        The number of stacks they hold; 0 if the dataset is complete already.
    """
    with disk_may_be_full(out), _claimed(settings, out, shared=True):
        if finished(out, settings.draw or settings.stacks) is not None:
            return 0
        workshop = workshop_of(settings, out)
        known = workshop.whole(say or _ignore, shards)
        missing = [number for number in shards if number not in known]
        made = (executor or make_executor("local")).map(ShardTask.of(settings), missing)
        with contextlib.closing(made):
            for number, shard in made:
                known[number] = workshop.keep(number, shard)
                (progress or _ignore)(len(known))
    return sum(entry["samples"] for entry in known.values())


def testset_designs(world: World) -> frozenset[str]:
    """List the designs that `testset-v1` was made from, and their mirror images, in the numbers of another
    catalogue: shapes are the same if name and outline are."""
    return _designs_of(TESTSET, world)


@cache
def _designs_of(path: Path, world: World) -> frozenset[str]:
    if not (path / "dataset.json").exists():
        return frozenset()
    testset = Dataset.open(path)
    if (world.grid.width, world.grid.height) != (testset.world.grid.width, testset.world.grid.height):
        return frozenset()
    shapes = world.catalogue.shapes
    numbers = {i: shapes.index(shape) for i, shape in enumerate(testset.world.catalogue) if shape in shapes}
    designs: set[str] = set()
    for key in {sample.meta["layout"] for sample in testset.samples("test")}:
        rows = Design.from_key(key).rows
        if all(shape in numbers for row in rows for shape, _ in row):
            design = Design(tuple(tuple((numbers[shape], left) for shape, left in row) for row in rows))
            designs |= {design.key, design.mirrored(world).key}
    return frozenset(designs)


def _revived(kind: type[Any], plain: Mapping[str, Any]) -> Any:
    """Make a dataclass of dataclasses from its plain form; values that are dataclasses already are kept."""
    hints = get_type_hints(kind)
    unknown = set(plain) - {item.name for item in fields(kind)}
    if unknown:
        raise TypeError(f"unknown settings {', '.join(sorted(unknown))}")
    values = {}
    for name, value in plain.items():
        if is_dataclass(hints[name]) and isinstance(value, Mapping):
            value = _revived(hints[name], value)
        values[name] = tuple(value) if isinstance(value, list) else value
    return kind(**values)


def template_samples(
    settings: GenerateSettings, number: int, excluded: frozenset[str], simulator: Simulator
) -> list[Sample]:
    """Make all stacks of one template; there may be none."""
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(number,)))
    design = draw_design(rng, settings.world, settings.template)
    if design.key in excluded:
        return []
    start = realize(design, rng, settings.world, settings.template)
    settler = Settler(simulator, settings.accept, settings.settle_twice, settings.certificate)
    pictures = Pictures(settings.grid)
    samples = []
    for removed, stack in deconstruct(start, settler, settings.max_removals):
        if len(stack) > settings.max_blocks:
            continue
        poses = stack.poses.astype(np.float32)
        picture = pictures.front(stack.with_poses(poses))
        key = f"{number:08d}-{'.'.join(f'{b:02d}' for b in removed) or 'whole'}".replace(".", "_")
        meta = {"template": number, "layout": design.key, "removed": list(removed)}
        samples.append(Sample(key, stack.shapes.astype(np.uint8), poses, picture, meta))
    return samples


@dataclass(frozen=True)
class ShardTask:
    """The task of a worker: make the shard of a number.

    Args:
        settings: Settings of the dataset.
        excluded: Designs to leave out.
    """

    settings: GenerateSettings
    excluded: frozenset[str]

    @staticmethod
    def of(settings: GenerateSettings) -> ShardTask:
        """Make the task of a dataset."""
        return ShardTask(settings, testset_designs(settings.world) if settings.exclude_testset else frozenset())

    def __call__(self, shard: int) -> MadeShard:
        """Make one shard."""
        settings = self.settings
        first = shard * settings.templates_per_shard
        with Simulator(settings.physics) as simulator:
            samples = [
                sample
                for number in range(first, first + settings.templates_per_shard)
                for sample in template_samples(settings, number, self.excluded, simulator)
            ]
        return MadeShard(f"{settings.split_of(shard)}-{shard:06d}.tar", encode_shard(samples), len(samples))


def make_shards(
    settings: GenerateSettings,
    workshop: Workshop,
    executor: Executor,
    progress: Callable[[int], None] | None = None,
    say: Callable[[str], None] | None = None,
) -> list[ShardEntry]:
    """Write as many shards as it takes, the last one cut to size; returns the entries of those not empty."""
    progress, say = progress or _ignore, say or _ignore
    known = workshop.whole(say)
    entries: list[ShardEntry] = []
    stored = 0
    made = executor.map(ShardTask.of(settings), (number for number in count() if number not in known))
    with contextlib.closing(made):
        for shard in count():
            while shard not in known:
                number, new = next(made)
                known[number] = workshop.keep(number, new)
            entry = known[shard]
            stored += entry["samples"]
            progress(min(stored, settings.stacks))
            if entry["samples"]:
                entries.append(entry)
            if stored >= settings.stacks:
                break
            if not stored and shard * settings.templates_per_shard > _HOPELESS:
                raise StackgenError(
                    f"generate: {_HOPELESS} templates gave no stack; relax max_blocks, accept or template"
                )
    entries[-1] = workshop.trim(entries[-1], entries[-1]["samples"] - (stored - settings.stacks))
    return entries


@contextlib.contextmanager
def _claimed(settings: GenerateSettings, out: Path, shared: bool = False) -> Iterator[None]:
    """Have the folder to oneself, or share it with others who make a range of the same shards."""
    out.mkdir(parents=True, exist_ok=True)
    with held(out, shared):
        claim(out, _manifest(settings, ()).to_json(), partial(_are, settings))
        yield


def workshop_of(settings: GenerateSettings, out: Path) -> Workshop:
    """Give the folder where the shards are made: a drawn shard must not overwrite what it is drawn from."""
    folder = out / PARTS if settings.draw else out
    folder.mkdir(exist_ok=True)
    return Workshop(folder)


def _are(settings: GenerateSettings, plain: Any) -> bool:
    """Tell whether a plain manifest without shards has these settings, where defaults stand for what it lacks."""
    try:
        manifest = Manifest.from_json(plain)
        same = manifest.settings.get("revision", REVISION) == REVISION
        return same and manifest.physics == settings.physics.to_json() and settings.from_manifest(manifest) == settings
    except StackgenError:
        return False


def _manifest(settings: GenerateSettings, entries: tuple[ShardEntry, ...]) -> Manifest:
    return Manifest(
        settings.name,
        settings.seed,
        settings.world,
        settings.physics.to_json(),
        settings.to_json(),
        entries,
    )


def draw(folder: Path, entries: list[ShardEntry], settings: GenerateSettings) -> MadeShard:
    """Keep `settings.draw` stacks of all in a folder's shards, drawn uniformly, in one shard."""
    samples = [sample for entry in entries for sample in read_shard(folder / entry["file"], entry["sha256"])]
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(2**32,)))
    chosen = np.sort(rng.choice(len(samples), settings.draw, replace=False))
    return MadeShard(entries[0]["file"], encode_shard(samples[i] for i in chosen), len(chosen))


def _store(folder: Path, shard: MadeShard) -> ShardEntry:
    write_atomically(folder / shard.name, shard.content)
    return shard_entry(shard.name, shard.content, shard.samples)


def _ignore(_: object) -> None:
    """Stand in for a callback that was not given."""
