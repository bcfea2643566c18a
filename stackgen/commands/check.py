"""stackgen check: which structures of a file stand, which fall."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from stackgen.api import judge
from stackgen.commands.parsing import Command, Files
from stackgen.commands.tables import add_entries, verdict_table
from stackgen.io.stacks_file import StackEntry, read_stacks, write_stacks
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.physics import Physics


def main(
    file: Path,
    out: Path | None = None,
    explain: bool = False,
    physics: Physics = Physics(),  # noqa: B008 - it is frozen
) -> int:
    """Simulate the structures of a stacks file and say which stand; exit code 1 if any falls.

    Args:
        file: A stacks.json, hand-written ones too.
        out: Write the file again here, with verdicts and settled poses; with --explain also with margins.
        explain: Also ask an equilibrium check, and say why blocks cannot be held.
        physics: Of the simulation; friction and whatever else makes the world are the file's unless given.
    """
    content = read_stacks(file)
    physics = replace(Physics.of_world(content.physics, physics), cell_size=content.cell_size)
    checker = SimulatorChecker(physics, content.world.catalogue)
    judged = replace(
        content,
        entries=tuple(
            replace(judge(checker, entry.stack, content.target, content.world.grid), comment=entry.comment)
            for entry in content.entries
        ),
        physics=physics.to_json(),
    )
    table = verdict_table("file")
    add_entries(table, file.name, judged.entries)
    Console().print(table)
    if explain:
        entries, statics = _explained(judged.entries, physics)
        judged = replace(judged, entries=entries)
        Console().print("", statics, sep="\n")
    if out is not None:
        write_stacks(out, judged)
    return 0 if all(entry.verdict and entry.verdict.stable for entry in judged.entries) else 1


def _explained(entries: Sequence[StackEntry], physics: Physics) -> tuple[tuple[StackEntry, ...], Table]:
    """The entries with margins, and what statics says of each beside the simulator's verdict."""
    from stackgen.sim.statics.checker import EquilibriumChecker  # loads a solver that nothing else needs

    checker = EquilibriumChecker(physics)
    table = Table("stack", "simulator", "statics", "margin", "push", "what cannot be held", box=None, pad_edge=False)
    for column in (table.columns[0], *table.columns[3:5]):
        column.justify = "right"
    explained = []
    for number, entry in enumerate(entries, 1):
        found = checker.equilibrium(entry.stack, with_push=True)
        reasons = checker.reasons(entry.stack, found)
        verdict = entry.verdict and replace(entry.verdict, margin=found.margin)
        explained.append(replace(entry, verdict=verdict))
        table.add_row(
            str(number),
            _word(bool(verdict and verdict.stable)),
            _word(found.stable),
            f"{math.degrees(found.margin):.1f}°",
            "" if found.push is None else f"{found.push:.0%}",
            "; ".join(f"block {i} ({entry.stack.names[i]}): {why}" for i, why in reasons.items()),
        )
    return tuple(explained), table


def _word(stands: bool) -> str:
    return "[green]stands[/]" if stands else "[red]falls[/]"


COMMAND = Command(
    "check",
    main,
    """
    stackgen check out/arch/stacks.json
    stackgen check mine.json --out judged.json --physics.friction 0.3
    stackgen check examples/stacks/cantilever.json --explain
    """,
    files=Files("file", "FILE", "A stacks.json."),
    flags={"explain": "Also ask an equilibrium check: margins, and why blocks cannot be held."},
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
