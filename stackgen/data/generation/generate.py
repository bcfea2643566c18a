"""The dataset generator: templates in, shards out, on as many processes as there are.

A shard holds all stacks of a fixed range of templates, and each template has its own random stream,
so a shard's bytes depend on the settings and its number alone: not on the number of workers, nor on
whether the run was interrupted. Shards appear under their final name only when complete; a run that
is started again goes on with those that are missing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from stackgen.data.generation.deconstruction import Judge, deconstruct
from stackgen.data.generation.templates import Template, TemplateSettings, draw_template, realize
from stackgen.data.shards import Manifest, Sample, Split, read_shard, write_shard
from stackgen.files import write_atomically
from stackgen.geometry import PAPER_GRID, Grid, silhouette
from stackgen.sim.physics import Physics
from stackgen.sim.verdict import AcceptLimits
from stackgen.sim.world import Simulator
from stackgen.stack import MAX_BLOCKS, PAPER_CATALOGUE, Catalogue, StackgenError

TESTSET = Path(__file__).resolve().parents[2] / "assets" / "testset-v1"
_GOLDEN = 0.6180339887498949
_HOPELESS = 2000  # templates without a stack, after which none is expected


@dataclass(frozen=True)
class GenerateSettings:
    """A dataset, described; `configs/generate/*.yaml` hold these.

    Args:
        name: Of the dataset, kept in its manifest.
        stacks: Stop once this many are stored.
        seed: Same seed, same dataset.
        templates_per_shard: All stacks of so many templates share a shard and a split.
        validation, test: Shares of the templates that go to these splits; 1 - both is for training.
        draw: Keep only so many of the stacks, drawn uniformly; 0 keeps all.
        max_removals: Blocks taken out of a template, at most.
        max_blocks: Stacks of more blocks are not stored, but still deconstructed.
        settle_twice: A stack must stand again when simulated from its settled poses.
        exclude_testset: Leave out every template that `testset-v1` uses, and its mirror image.
        template: How designs are drawn.
        accept: When a settled stack is good enough.
        physics: Of the simulator.
        grid: Design grid and silhouette scale.
        catalogue: The shapes.
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
    settle_twice: bool = False
    exclude_testset: bool = True
    template: TemplateSettings = field(default_factory=TemplateSettings)
    accept: AcceptLimits = field(default_factory=AcceptLimits)
    physics: Physics = field(default_factory=Physics)
    grid: Grid = PAPER_GRID
    catalogue: Catalogue = PAPER_CATALOGUE

    def __post_init__(self) -> None:
        if self.stacks < 1 or self.templates_per_shard < 1 or self.max_blocks < 1 or self.max_removals < 0:
            raise StackgenError(
                "generate: stacks, templates_per_shard and max_blocks must be at least 1, max_removals 0"
            )
        if self.validation < 0 or self.test < 0 or self.validation + self.test > 1:
            raise StackgenError("generate: validation and test are shares of the templates; their sum is at most 1")
        if not 0 <= self.draw <= self.stacks:
            raise StackgenError(f"generate: draw must lie in 0..stacks, got {self.draw}")

    def to_json(self) -> dict[str, Any]:
        """Plain form without what the manifest stores elsewhere."""
        plain = asdict(replace(self, catalogue=PAPER_CATALOGUE))
        for key in ("name", "seed", "grid", "catalogue", "physics", "max_blocks"):
            plain.pop(key)
        return json.loads(json.dumps(plain))

    def split_of(self, shard: int) -> Split:
        """The split of a shard; shares are met evenly along the way (multiples of the golden ratio)."""
        place = shard * _GOLDEN % 1
        if place < self.validation:
            return "validation"
        return "test" if place < self.validation + self.test else "train"


def generate(
    settings: GenerateSettings,
    out: Path,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Manifest:
    """Make a dataset, or finish one that was interrupted.

    Args:
        settings: What to make.
        out: Its folder.
        workers: Processes; by default one per core. The result does not depend on it.
        progress: Called with the number of stacks stored so far.

    Raises:
        StackgenError: If the folder holds something else.
    """
    _claim(out, settings)
    parts = out / "parts" if settings.draw else out  # what is drawn must not overwrite what it is drawn from
    manifest = _finished(out)
    if manifest is None:
        parts.mkdir(exist_ok=True)
        entries = _make_shards(settings, parts, workers or os.cpu_count() or 1, progress or (lambda stored: None))
        if settings.draw:
            entries = [_draw(out, parts, entries, settings)]
        manifest = _manifest(settings, tuple(entries))
        manifest.save(out)
    if settings.draw:
        shutil.rmtree(parts, ignore_errors=True)
    known = {entry["file"] for entry in manifest.shards}
    for path in [*out.glob("*.tar"), *out.glob(".*.tmp")]:  # of shards made ahead, and of killed writers
        if path.name not in known:
            path.unlink()
    return manifest


def testset_layouts(catalogue: Catalogue, grid: Grid) -> set[str]:
    """Layouts of the templates that `testset-v1` was made from, and their mirror images, in the numbers of
    another catalogue: shapes are the same if name and outline are."""
    if not (TESTSET / "dataset.json").exists():
        return set()
    manifest = Manifest.load(TESTSET)
    if (grid.width, grid.height) != (manifest.grid.width, manifest.grid.height):
        return set()
    numbers = {
        i: catalogue.shapes.index(shape) for i, shape in enumerate(manifest.catalogue) if shape in catalogue.shapes
    }
    layouts: set[str] = set()
    for key in {sample.meta["layout"] for sample in manifest.samples(TESTSET, "test")}:
        rows = Template.from_key(key).rows
        if all(shape in numbers for row in rows for shape, _ in row):
            template = Template(tuple(tuple((numbers[shape], left) for shape, left in row) for row in rows))
            layouts |= {template.key, template.mirrored(catalogue, grid).key}
    return layouts


def template_samples(
    settings: GenerateSettings, number: int, excluded: frozenset[str], simulator: Simulator
) -> list[Sample]:
    """All stacks that one template gives, or none."""
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(number,)))
    template = draw_template(rng, settings.template, settings.catalogue, settings.grid)
    if template.key in excluded:
        return []
    start = realize(template, rng, settings.template, settings.catalogue, settings.grid)
    judge = Judge(simulator, settings.accept, settings.settle_twice)
    samples = []
    for removed, stack in deconstruct(start, judge, settings.max_removals):
        if len(stack) > settings.max_blocks:
            continue
        poses = stack.poses.astype(np.float32)
        picture = silhouette(stack.with_poses(poses), "front", settings.grid)
        key = f"{number:08d}-{'.'.join(f'{b:02d}' for b in removed) or 'whole'}".replace(".", "_")
        meta = {"template": number, "layout": template.key, "removed": list(removed)}
        samples.append(Sample(key, stack.shapes.astype(np.uint8), poses, picture, meta))
    return samples


def _make_shards(
    settings: GenerateSettings, out: Path, workers: int, progress: Callable[[int], None]
) -> list[dict[str, Any]]:
    """Write as many shards as it takes, the last one cut to size; returns the entries of those not empty."""
    excluded = (
        frozenset(testset_layouts(settings.catalogue, settings.grid)) if settings.exclude_testset else frozenset()
    )
    entries: list[dict[str, Any]] = []
    stored = 0
    for shard, entry in enumerate(_shards_in_order(settings, out, excluded, workers)):
        stored += entry["samples"]
        progress(min(stored, settings.stacks))
        if entry["samples"]:
            entries.append(entry)
        if stored >= settings.stacks:
            break
        if not stored and shard * settings.templates_per_shard > _HOPELESS:
            raise StackgenError(f"generate: {_HOPELESS} templates gave no stack; relax max_blocks, accept or template")
    entries[-1] = _trim(out, entries[-1], entries[-1]["samples"] - (stored - settings.stacks))
    return entries


def _make_shard(settings: GenerateSettings, out: Path, shard: int, excluded: frozenset[str]) -> dict[str, Any]:
    """Write one shard, unless it is there; returns its manifest entry."""
    path = out / f"{settings.split_of(shard)}-{shard:06d}.tar"
    first = shard * settings.templates_per_shard
    if path.exists():
        return _entry(path)
    with Simulator(settings.physics, settings.catalogue) as simulator:
        samples = [
            sample
            for number in range(first, first + settings.templates_per_shard)
            for sample in template_samples(settings, number, excluded, simulator)
        ]
    return write_shard(path, samples)


def _entry(path: Path) -> dict[str, Any]:
    return write_shard(path, list(read_shard(path)))


def _shards_in_order(
    settings: GenerateSettings, out: Path, excluded: frozenset[str], workers: int
) -> Iterator[dict[str, Any]]:
    """Manifest entries of shard 0, 1, 2, ..., made ahead by a pool of processes."""
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_end_with_parent)
    waiting: dict[int, Future[dict[str, Any]]] = {}
    ahead = 0
    shard = 0
    try:
        while True:
            while len(waiting) < 2 * workers:
                with _without_interrupts():
                    waiting[ahead] = pool.submit(_make_shard, settings, out, ahead, excluded)
                ahead += 1
            while not waiting[shard].done():
                wait([waiting[shard]], timeout=1, return_when=FIRST_COMPLETED)
            yield waiting.pop(shard).result()
            shard += 1
    finally:
        for process in list(getattr(pool, "_processes", {}).values()):
            process.terminate()
        pool.shutdown(wait=False, cancel_futures=True)


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Processes that start here never see Ctrl-C: the parent alone answers it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    """In a worker: end when the parent is gone, even if it was killed; a pool's workers would wait forever."""

    def follow() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _finished(out: Path) -> Manifest | None:
    """The manifest, if all is there that it names."""
    if not (out / "dataset.json").exists():
        return None
    manifest = Manifest.load(out)
    files = {path.name: path for path in out.glob("*.tar")}
    for entry in manifest.shards:
        path = files.get(entry["file"])
        if path is None or hashlib.sha256(path.read_bytes()).hexdigest() != entry["sha256"]:
            return None
    return manifest


def _manifest(settings: GenerateSettings, entries: tuple[dict[str, Any], ...]) -> Manifest:
    return Manifest(
        settings.name,
        settings.seed,
        settings.catalogue,
        settings.grid,
        settings.max_blocks,
        settings.physics.to_json(),
        settings.to_json(),
        entries,
    )


def _claim(out: Path, settings: GenerateSettings) -> None:
    """Make the folder this dataset's own, or see that it already is."""
    mine = json.dumps(_manifest(settings, ()).to_json(), sort_keys=True, indent=1)
    claim = out / "generate.json"
    out.mkdir(parents=True, exist_ok=True)
    if claim.exists():
        if claim.read_text() != mine:
            raise StackgenError(f"{out} holds a dataset made with other settings; choose another folder or delete it")
    elif any(out.glob("*.tar")):
        raise StackgenError(f"{out} holds shards, but no generate.json that says of what; choose another folder")
    else:
        write_atomically(claim, mine.encode())


def _trim(out: Path, entry: dict[str, Any], keep: int) -> dict[str, Any]:
    """Cut a shard to its first samples."""
    if keep >= entry["samples"]:
        return entry
    path = out / entry["file"]
    return write_shard(path, list(read_shard(path))[:keep])


def _draw(out: Path, parts: Path, entries: list[dict[str, Any]], settings: GenerateSettings) -> dict[str, Any]:
    """Keep `settings.draw` stacks of all, drawn uniformly, in one shard."""
    samples = [sample for entry in entries for sample in read_shard(parts / entry["file"])]
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(2**32,)))
    chosen = np.sort(rng.choice(len(samples), settings.draw, replace=False))
    return write_shard(out / entries[0]["file"], [samples[i] for i in chosen])
