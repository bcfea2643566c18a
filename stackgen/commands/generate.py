"""stackgen generate: datasets, by deconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from stackgen.commands import Command
from stackgen.data.generation.generate import GenerateSettings, generate
from stackgen.data.shards import SPLITS


def main(settings: GenerateSettings, out: Path, workers: int | None = None) -> None:
    """Make a dataset: templates that settle, then blocks taken out of them one by one.

    A run that was interrupted goes on where it stopped when it is started again; the result depends on the
    settings alone, not on the number of workers.

    Args:
        settings: What to make.
        out: Folder of the dataset.
        workers: Processes; by default one for each core.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    screen = Console(stderr=True)
    with Progress(*columns, console=screen, disable=not screen.is_terminal) as progress:
        task = progress.add_task(f"stacks of {settings.name}", total=settings.stacks)
        try:
            manifest = generate(settings, out, workers, progress=lambda stored: progress.update(task, completed=stored))
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"whole shards are kept in {out}: the same command goes on from there") from None
    counts = ", ".join(f"{manifest.count(split)} {split}" for split in SPLITS)
    print(f"wrote {out}: {counts}; sha256 {manifest.sha256[:12]}")


COMMAND = Command(
    "generate",
    main,
    """
    stackgen generate --config configs/generate/paper.yaml --out data/paper
    stackgen generate --name small --stacks 2000 --seed 7 --out data/small --workers 2
    """,
    settings=("settings", GenerateSettings),
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
