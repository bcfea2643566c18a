"""stackgen generate: datasets, by deconstruction."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from stackgen.commands.parsing import Command
from stackgen.commands.progress_bar import progress_bar
from stackgen.data.generation.executors import ExecutorName, make_executor
from stackgen.data.generation.generate import GenerateSettings, generate, generate_range
from stackgen.data.manifest import SPLITS
from stackgen.errors import StackgenError


def main(
    settings: GenerateSettings,
    out: Path,
    workers: int | None = None,
    executor: ExecutorName = "local",
    shard_range: str | None = None,
) -> None:
    """Make a dataset: templates that settle, then blocks taken out of them one by one.

    A run that was interrupted goes on where it stopped when it is started again; the result depends on the
    settings alone, not on the number of workers nor on the executor.

    Args:
        settings: What to make.
        out: Folder of the dataset.
        workers: Processes; by default one for each core.
        executor: Who makes the shards: processes of this machine, or tasks of a Ray cluster.
        shard_range: A:B, make only the shards A to B - 1, for jobs that share the folder; a run without it
            then collects them and makes what is still missing.
    """
    shards = None if shard_range is None else _range(shard_range)
    what, total = (f"stacks of {settings.name}", settings.stacks) if shards is None else ("shards", len(shards))
    try:
        with progress_bar(what, total) as (advance, say):
            if shards is not None:
                stacks = generate_range(settings, out, shards, make_executor(executor, workers), advance, say)
            else:
                manifest = generate(settings, out, None, advance, make_executor(executor, workers), say)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"whole shards are kept in {out}: the same command goes on from there") from None
    if shards is not None:
        print(f"shards {shards.start} to {shards.stop - 1} of {out} are there: {stacks} stacks")
        return
    counts = ", ".join(f"{manifest.count(split)} {split}" for split in SPLITS)
    print(f"wrote {out}: {counts}; sha256 {manifest.sha256[:12]}")


def _range(text: str) -> range:
    """The numbers of A:B.

    >>> _range("10:12")
    range(10, 12)
    """
    match = re.fullmatch(r"(\d{1,9}):(\d{1,9})", text)
    if match is None or int(match[1]) >= int(match[2]):
        raise StackgenError(f"generate: --shard_range {text!r} should read A:B, whole numbers with 0 <= A < B")
    return range(int(match[1]), int(match[2]))


COMMAND = Command(
    "generate",
    main,
    """
    stackgen generate --config configs/generate/paper.yaml --out data/paper
    stackgen generate --name small --stacks 2000 --seed 7 --out data/small --workers 2
    stackgen generate --config configs/generate/paper.yaml --out data/paper --shard_range 0:40
    """,
    settings={"settings": GenerateSettings},
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
