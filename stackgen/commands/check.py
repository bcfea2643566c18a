"""stackgen check: which structures of a file stand, which fall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from stackgen.api import judge
from stackgen.commands import Command, Files
from stackgen.commands.tables import add_entries, verdict_table
from stackgen.sim.physics import Physics
from stackgen.sim.verdict import SimulatorChecker
from stackgen.stacks_file import read_stacks, write_stacks


def main(file: Path, out: Path | None = None, physics: Physics = Physics()) -> int:  # noqa: B008 - it is frozen
    """Simulate the structures of a stacks file and say which stand; exit code 1 if any falls.

    Args:
        file: A stacks.json, hand-written ones too.
        out: Write the file again here, with verdicts and settled poses.
        physics: Of the simulation; the cell size is the file's.
    """
    content = read_stacks(file)
    physics = replace(physics, cell_size=content.cell_size)
    checker = SimulatorChecker(physics, content.catalogue)
    judged = replace(
        content,
        entries=tuple(
            replace(judge(checker, entry.stack, content.target, content.grid), comment=entry.comment)
            for entry in content.entries
        ),
        physics=physics.to_json(),
    )
    if out is not None:
        write_stacks(out, judged)
    table = verdict_table("file")
    add_entries(table, file.name, judged.entries)
    Console().print(table)
    return 0 if all(entry.verdict and entry.verdict.stable for entry in judged.entries) else 1


COMMAND = Command(
    "check",
    main,
    """
    stackgen check out/arch/stacks.json
    stackgen check mine.json --out judged.json --physics.friction 0.3
    """,
    files=Files("file", "FILE", "A stacks.json."),
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
