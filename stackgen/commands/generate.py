"""stackgen generate: datasets by construction and deconstruction, or of drawings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from stackgen.commands.output import tell
from stackgen.commands.parsing import Command
from stackgen.commands.progress_bar import progress_bar
from stackgen.data.generation.executors import ExecutorName, make_executor
from stackgen.data.generation.generate import generate, generate_range
from stackgen.data.generation.settings import GenerateSettings
from stackgen.data.manifest import SPLITS
from stackgen.errors import StackgenError


def main(
    settings: GenerateSettings,
    out: Path,
    workers: int | None = None,
    executor: ExecutorName = "local",
    shard_range: str | None = None,
) -> None:
    """Make a dataset: random designs settle, then blocks are taken out of them one by one; or the search answers
    drawings, in the recipe `drawings`.

    An interrupted run continues where it stopped when the same command is started again. The result depends on
    the settings alone, not on the number of workers or the executor.

    Args:
        settings: Settings of the dataset.
        out: Folder of the dataset.
        workers: Number of processes; by default one for each core.
        executor: Place where shards are made: `local`, processes of this machine; `ray`, tasks of a Ray cluster.
        shard_range: Range A:B of the shards to make, A to B - 1, for jobs that share the folder; a later run
            without it collects them and makes what is missing.
    """
    shards = None if shard_range is None else _range(shard_range)
    team = make_executor(executor, workers)
    what, total = (f"stacks of {settings.name}", settings.stacks) if shards is None else ("shards", len(shards))
    try:
        with progress_bar(what, total) as (advance, say):
            if shards is not None:
                stacks = generate_range(settings, out, shards, team, progress=advance, say=say)
            else:
                manifest = generate(settings, out, executor=team, progress=advance, say=say)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"finished shards are kept in {out}; the same command continues from there") from None
    if shards is not None:
        line = f"shards {shards.start} to {shards.stop - 1} of {out} are there: {stacks} stacks"
        tell(line, folder=out, shards=[*shards], stacks=stacks)
        return
    counts = {split: manifest.count(split) for split in SPLITS}
    line = f"wrote {out}: {', '.join(f'{n} {split}' for split, n in counts.items())}; sha256 {manifest.sha256[:12]}"
    tell(line, folder=out, stacks=counts, sha256=manifest.sha256)


def _range(text: str) -> range:
    """Read the numbers of A:B.

    >>> _range("10:12")
    range(10, 12)
    """
    match = re.fullmatch(r"(\d{1,9}):(\d{1,9})", text)
    if match is None or int(match[1]) >= int(match[2]):
        raise StackgenError(f"--shard_range {text!r} should read A:B, whole numbers with 0 <= A < B")
    return range(int(match[1]), int(match[2]))


COMMAND = Command(
    "generate",
    main,
    """
    stackgen generate --config configs/generate/paper.yaml --out data/paper
    stackgen generate --config configs/generate/drawings.yaml --out data/drawings
    stackgen generate --name small --stacks 2000 --seed 7 --out data/small --workers 2
    stackgen generate --config configs/generate/paper.yaml --out data/paper --shard_range 0:40
    """,
    settings={"settings": GenerateSettings},
    reports=True,
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
