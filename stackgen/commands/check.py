"""stackgen check: which structures of a file stand, and which fall."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from stackgen.api import check
from stackgen.commands.output import tell, wrote
from stackgen.commands.parsing import Command, Files
from stackgen.commands.verdict_table import FALLS, STANDS, verdict_facts, verdict_table, verdict_word
from stackgen.io.stacks_file import StackEntry, read_stacks, write_stacks
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.physics import Physics
from stackgen.sim.statics.fit import describe_misfits


def main(
    file: Path,
    out: Path | None = None,
    explain: bool = False,
    physics: Physics = Physics(),  # noqa: B008 - it is frozen
) -> int:
    """Simulate the structures of a stacks file and say which stand.

    The exit code is 1 if any falls, or has blocks inside each other, in the ground or in the air.

    Args:
        file: File of stacks (stacks.json), made by stackgen or written by hand; `-` is standard input.
        out: File to write the stacks to, with verdicts and settled poses, and with --explain also margins.
        explain: Whether to ask statics, too, and to say why blocks cannot be held.
        physics: Numbers of the simulation; what is not given is as in the file, as far as it describes the blocks.
    """
    content = read_stacks(file)
    physics = Physics.recorded({**(content.physics or {}), "cell_size": content.cell_size}, physics)
    content = replace(content, cell_size=physics.cell_size)
    misfits = [describe_misfits(entry.stack) for entry in content.entries]
    checker = SimulatorChecker(physics)
    entries = tuple(
        replace(check(checker, entry.stack, content.target, content.world.grid), comment=entry.comment)
        for entry in content.entries
    )
    words = [verdict_word(entry, those) for entry, those in zip(entries, misfits, strict=True)]
    tell(verdict_table("file", [(file.name, entries)], words=words))
    if explain:
        entries, statics = _explained(entries, physics)
        tell("", statics)
    for number, those in enumerate(misfits, 1):
        tell(*(f"stack {number}: {misfit.text}" for misfit in those))
    if any(misfits):
        tell("A verdict on blocks that overlap or float is worth little: each engine moves them apart in its own way.")
    facts = [verdict_facts(entry, those) for entry, those in zip(entries, misfits, strict=True)]
    tell(physics=physics.to_json(), stacks=facts)
    if out is not None:
        write_stacks(out, replace(content, entries=entries, physics=physics.to_json()))
        wrote(out)
    return int(any(word != STANDS for word in words))


def _explained(entries: Sequence[StackEntry], physics: Physics) -> tuple[tuple[StackEntry, ...], Table]:
    """Add margins to the entries, and make a table of what statics says of each beside the simulator's verdict."""
    from stackgen.sim.statics.checker import StaticsChecker  # loads a solver that nothing else needs

    checker = StaticsChecker(physics)
    table = Table("stack", "simulator", "statics", "margin", "push", "what cannot be held", box=None, pad_edge=False)
    for column in (table.columns[0], *table.columns[3:5]):
        column.justify = "right"
    explained = []
    for number, entry in enumerate(entries, 1):
        found = checker.answer(entry.stack, with_push=True)
        reasons = checker.reasons(entry.stack, found)
        verdict = entry.verdict and replace(entry.verdict, margin=found.margin)
        explained.append(replace(entry, verdict=verdict))
        table.add_row(
            str(number),
            STANDS if verdict and verdict.stable else FALLS,
            STANDS if found.stable else FALLS,
            f"{math.degrees(found.margin):.1f}°",
            "" if found.push is None else f"{found.push:.0%}",
            escape("; ".join(f"block {i} ({entry.stack.names[i]}): {why}" for i, why in reasons.items())),
        )
    return tuple(explained), table


COMMAND = Command(
    "check",
    main,
    """
    stackgen check out/arch/stacks.json
    stackgen check mine.json --out checked.json --physics.friction 0.3
    stackgen check examples/stacks/cantilever.json --explain
    stackgen check - --json < mine.json
    """,
    files=Files(
        "file", "FILE", "File of stacks (stacks.json), made by stackgen or written by hand; - is standard input."
    ),
    reports=True,
    flags={"explain": "Also ask statics for margins, and why blocks cannot be held."},
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
