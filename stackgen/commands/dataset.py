"""stackgen dataset: verify, repair, describe, split and export a dataset."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from stackgen.commands.output import tell, wrote
from stackgen.commands.parsing import Command, Files, epilog
from stackgen.commands.progress_bar import progress_bar
from stackgen.data.arrays import StackArrays
from stackgen.data.card import write_card
from stackgen.data.dataset import TESTSET, Dataset, read_manifest
from stackgen.data.generation.executors import ExecutorName
from stackgen.data.manifest import SPLITS, Manifest
from stackgen.data.resplit import By, Resplit, resplit, split_table
from stackgen.errors import StackgenError
from stackgen.io.files import write_json
from stackgen.protocols import StabilityChecker
from stackgen.stack import Stack

EASY_TO_SEND = 64 * 2**20
"""Largest compact file that is easy to send along [byte]."""


def verify(folder: Path) -> int:
    """Compare every shard with its checksum and read every stack; the exit code is 1 if anything is wrong.

    Args:
        folder: Folder of the dataset.
    """
    from stackgen.data.inspection.verify import verify as find_problems

    manifest = read_manifest(folder)
    with progress_bar("verifying", len(manifest.shards)) as (advance, _):
        problems = find_problems(folder, advance)
    if not problems:
        stacks = sum(manifest.count(split) for split in SPLITS)
        line = f"{folder}: {len(manifest.shards)} shards with {stacks:,} stacks are as they were written"
        tell(line, sound=True, shards=len(manifest.shards), stacks=stacks, problems=[])
        return 0
    table = Table("file", "is", "", box=None, pad_edge=False)
    for problem in problems:
        table.add_row(escape(problem.file), f"[red]{problem.fault}[/]", escape(problem.detail))
    found = [{"file": problem.file, "is": problem.fault, "detail": problem.detail} for problem in problems]
    tell(table, sound=False, problems=found)
    if any(problem.breaks_bytes for problem in problems):
        tell(f"make the lost shards again: stackgen dataset repair {folder}")
    return 1


def repair(
    folder: Path, workers: int | None = None, executor: ExecutorName = "local", other_bytes: bool = False
) -> None:
    """Make missing and damaged shards again, byte for byte; all others are left alone.

    Args:
        folder: Folder of the dataset.
        workers: Number of processes; by default one for each core.
        executor: Place where shards are made: `local`, processes of this machine; `ray`, tasks of a Ray cluster.
        other_bytes: Whether to accept other shards where this version of the simulator cannot make the same;
            dataset.json then gets their checksums.
    """
    from stackgen.data.generation.executors import make_executor
    from stackgen.data.generation.repair import repair as make_again

    with progress_bar("making shards again") as (advance, _):
        done = make_again(folder, make_executor(executor, workers), other_bytes, advance)
    tell(identical=done.identical, other=done.other)
    for name in done.identical:
        tell(f"made {folder / name} again, byte for byte")
    for name in done.other:
        tell(f"made {folder / name} again, with other bytes: dataset.json and the dataset's hash have changed")
    if not done.identical and not done.other:
        tell(f"{folder}: every shard is as it was written; nothing to repair")


def info(folder: Path, out: Path | None = None, margins: int = 500, samples: int = 24, seed: int = 0) -> None:
    """Count, measure and draw what is in a dataset, and how near the frozen test scenes are to it.

    Args:
        folder: Folder of the dataset, or its compact .npz file.
        out: Folder for info.json, info.png and samples.png; by default the dataset's own, whose card then
            gets the numbers too. For a compact file nothing is written without this option.
        margins: Number of stacks whose stability margin statics computes; 0 for none.
        samples: Number of random stacks on the contact sheet; 0 for none.
        seed: Seed of both draws.
    """
    from stackgen.data.inspection.contents import Contents, facts, sample_margins
    from stackgen.data.inspection.plots import draw_facts, draw_samples, paragraphs
    from stackgen.viz.render import save_image

    if margins < 0 or samples < 0 or seed < 0:
        raise StackgenError("dataset info: margins, samples and seed must be at least 0")
    contents = Contents.load(folder)
    held = sample_margins(contents, _statics(contents.manifest), margins, seed) if margins else None
    found = facts(contents, None if folder.resolve() == TESTSET.resolve() else TESTSET, held)
    _print_facts(found)
    place = out or (folder if folder.is_dir() else None)
    if place is None:
        return
    place.mkdir(parents=True, exist_ok=True)
    write_json(place / "info.json", found)
    draw_facts(place / "info.png", contents, found, held)
    written = ["info.json", "info.png"]
    if samples:
        save_image(place / "samples.png", draw_samples(contents, samples, seed))
        written.append("samples.png")
    if out is None and write_card(folder, contents.manifest, paragraphs(found, written[1:])):
        written.append("README.md")
    wrote(*(place / name for name in written))


def split(
    folder: Path,
    validation: float | None = None,
    test: float | None = None,
    by: By = "template",
    seed: int = 0,
    out: Path | None = None,
) -> None:
    """Print how a dataset is split, or write a new dataset with other shares.

    Args:
        folder: Folder of the dataset.
        validation: Share of the validation split in the new dataset; 0 if only the other share is given.
        test: Share of the test split in the new dataset; 0 if only the other share is given.
        by: Stacks that stay in one split: `template`, all that were deconstructed from one template; `layout`, those
            of all templates that are the same design or its mirror image.
        seed: Seed of the choice.
        out: Folder of the new dataset; without it the present split is printed.
    """
    manifest = read_manifest(folder)
    asked = validation is not None or test is not None
    if asked != (out is not None):
        raise StackgenError("dataset split: a new split needs --out and one of --validation and --test")
    if out is not None:
        how = Resplit(validation or 0.0, test or 0.0, by, seed)
        with progress_bar("splitting", len(manifest.shards)) as (advance, _):
            manifest, folder = resplit(folder, out, how, advance), out
    with progress_bar("counting", len(manifest.shards)) as (advance, _):
        rows = split_table(folder, manifest, advance)
    table = Table("split", *next(iter(rows.values())), box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    for name, row in rows.items():
        table.add_row(name, *(f"{number:,}" for number in row.values()))
    tell(table, splits=rows)
    if out is not None:
        tell(f"wrote {out}; sha256 {manifest.sha256[:12]}", wrote=[out], sha256=manifest.sha256)


def export(folder: Path, out: Path, margin: float = 0.0) -> None:
    """Write a whole dataset as one compact file of arrays, for a machine that only trains.

    Args:
        folder: Folder of the dataset.
        out: File to write, ending in .npz; `--data.path` accepts it.
        margin: Least tilt of the ground that a stack for training survives, in any direction [rad]; those that fall
            sooner are left out. Stacks for validation and test stay.
    """
    from stackgen.data.compact import save_npz

    if not 0 <= margin < math.pi / 2:
        raise StackgenError(f"--margin must lie in 0..1.57 rad, got {margin:g}")
    dataset = Dataset.open(folder)
    splits, manifest = {name: dataset.split(name) for name in dataset.splits}, dataset.manifest
    if margin and "train" in splits:
        kept = _steady(splits["train"], manifest, margin)
        splits["train"], manifest = splits["train"].select(kept), _of_the_steady(manifest, kept, margin)
    save_npz(out, splits, manifest)
    size = out.stat().st_size
    large = "" if size <= EASY_TO_SEND else f" (more than the {EASY_TO_SEND / 2**20:g} MiB that are easy to send along)"
    stacks = sum(map(len, splits.values()))
    tell(f"wrote {out}: {stacks:,} stacks, {size / 2**20:.1f} MiB{large}", wrote=[out], stacks=stacks, bytes=size)


def _statics(manifest: Manifest) -> StabilityChecker:
    from stackgen.sim.physics import Physics
    from stackgen.sim.statics.checker import StaticsChecker  # loads a solver that nothing else needs

    return StaticsChecker(Physics.recorded(manifest.physics))


def _steady(stacks: StackArrays, manifest: Manifest, margin: float) -> NDArray[np.intp]:
    """Find the stacks that survive a tilt."""
    checker, kept = _statics(manifest), []
    with progress_bar("stacks", len(stacks)) as (advance, _):
        for i, k in enumerate(stacks.lengths):
            shapes, poses = stacks.shapes[i, :k].astype(np.int64), stacks.poses[i, :k].astype(np.float64)
            stack = Stack(shapes, poses, manifest.world.catalogue)
            if (checker.check(stack).margin or 0.0) >= margin:
                kept.append(i)
            advance(1)
    if not kept:
        raise StackgenError(f"--margin {margin:g}: no stack for training survives that tilt; give a smaller one")
    return np.array(kept)


def _of_the_steady(manifest: Manifest, kept: NDArray[np.intp], margin: float) -> Manifest:
    """Let a manifest say which stacks for training are left of its shards, and why."""
    shards = [shard for shard in manifest.shards if shard["split"] == "train"]
    ends = np.cumsum([shard["samples"] for shard in shards])
    left = np.bincount(np.searchsorted(ends, kept, side="right"), minlength=len(shards)).tolist()
    numbers = dict(zip((shard["file"] for shard in shards), left, strict=True))
    entries = tuple({**shard, "samples": numbers.get(shard["file"], shard["samples"])} for shard in manifest.shards)
    return replace(manifest, shards=entries, settings={**manifest.settings, "least_margin": margin})


def _print_facts(found: Mapping[str, Any]) -> None:
    """Print what `dataset info` found."""
    from stackgen.data.inspection.plots import duplicate_words, margin_words, nearness_words

    tell(Text.assemble((found["name"], "bold"), f": {found['stacks']:,} stacks"), **found)
    for name, tally in found["counts"].items():
        table = Table(escape(name), *tally, box=None, pad_edge=False)
        table.add_row("", *(f"{number:,}" for number in tally.values()))
        tell("", table)
    table = Table("of all blocks", *next(iter(found["distributions"].values())), box=None, pad_edge=False)
    for name, values in found["distributions"].items():
        table.add_row(escape(name), *(f"{value:.4f}" for value in values.values()))
    tell("", table)
    for words in (margin_words(found), duplicate_words(found), *nearness_words(found)):
        if words:
            tell("", words)


_FOLDER = Files("folder", "FOLDER", "Folder of the dataset.")

COMMANDS = {
    "verify": Command("dataset verify", verify, "stackgen dataset verify data/paper", files=_FOLDER, reports=True),
    "repair": Command(
        "dataset repair",
        repair,
        "stackgen dataset repair data/paper\nstackgen dataset repair data/paper --workers 4",
        files=_FOLDER,
        reports=True,
        flags={"other_bytes": "Accept shards with other bytes; dataset.json gets their checksums."},
    ),
    "info": Command(
        "dataset info",
        info,
        "stackgen dataset info data/paper\nstackgen dataset info data/paper.npz --out out/paper --margins 2000",
        files=Files("folder", "FOLDER", "Folder of the dataset, or its compact .npz file."),
        reports=True,
    ),
    "split": Command(
        "dataset split",
        split,
        "stackgen dataset split data/paper\n"
        "stackgen dataset split data/paper --validation 0.05 --test 0.1 --out data/other\n"
        "stackgen dataset split data/paper --validation 0.05 --test 0.1 --by layout --out data/strict",
        files=_FOLDER,
        reports=True,
    ),
    "export": Command(
        "dataset export",
        export,
        "stackgen dataset export data/paper --out data/paper.npz\n"
        "stackgen dataset export data/paper --margin 0.1 --out data/paper-steady.npz",
        files=_FOLDER,
        reports=True,
    ),
}

EXAMPLES = {action: command.example for action, command in COMMANDS.items()}


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run one of the actions."""
    if not argv or argv[0] in ("-h", "--help"):
        print(usage())
        return 0
    action, *rest = argv
    if action not in COMMANDS:
        near = get_close_matches(action, COMMANDS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(COMMANDS)}"
        raise StackgenError(f"unknown action {action!r}: {hint}")
    return COMMANDS[action].run(rest)


def usage() -> str:
    """List the actions, for `stackgen dataset --help`."""
    width = max(map(len, COMMANDS))
    rows = [
        f"  {name:<{width}}  {(command.function.__doc__ or '').partition(chr(10))[0]}"
        for name, command in COMMANDS.items()
    ]
    head = [
        "usage: stackgen dataset ACTION FOLDER ... | stackgen dataset ACTION --help",
        "",
        "Verify, repair, describe, split or export a dataset.",
        "",
    ]
    return "\n".join([*head, *rows, "", epilog("stackgen dataset info data/paper")])
