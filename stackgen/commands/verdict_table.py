"""Verdicts as a table in the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from stackgen.io.stacks_file import StackEntry
from stackgen.protocols import Verdict
from stackgen.sim.statics.fit import Misfit
from stackgen.stack import Stack

STANDS, FALLS = "[green]stands[/]", "[red]falls[/]"


def verdict_table(
    heading: str,
    sources: Iterable[tuple[str, Sequence[StackEntry]]],
    most: int | None = None,
    words: Sequence[str] | None = None,
) -> Table:
    """Make a table with one row for each stack.

    Stacks are numbered from 1 and blocks from 0, as in the file and the picture.

    Args:
        heading: Heading of the column that says where a stack came from.
        sources: Where stacks came from, and those stacks with their verdicts.
        most: Largest number of fallen blocks to name for each stack; all by default.
        words: What is said of each stack of a source; that it stands or falls by default.
    """
    table = Table(heading, "stack", "verdict", "front IoU", "matches", "what fell", box=None, pad_edge=False)
    for column in (table.columns[1], table.columns[3]):
        column.justify = "right"
    for source, entries in sources:
        for number, entry in enumerate(entries, 1):
            table.add_row(
                escape(source) if number == 1 else "",
                str(number),
                words[number - 1] if words else verdict_word(entry),
                "" if entry.front_iou is None else f"{entry.front_iou:.2f}",
                "" if entry.matches is None else "yes" if entry.matches else "no",
                escape(describe_fall(entry.stack, entry.verdict, most)) if entry.verdict else "",
            )
    return table


def verdict_word(entry: StackEntry, misfits: Sequence[Misfit] = ()) -> str:
    """Say in a word, in its colour, what becomes of a stack; of one that no blocks can form, why that is."""
    if entry.verdict is None or not entry.verdict.stable:
        return FALLS
    return next((f"[red]{misfit.kind}[/]" for misfit in misfits if misfit.impossible), STANDS)


def verdict_facts(entry: StackEntry, misfits: Sequence[Misfit] = ()) -> dict[str, Any]:
    """Give what programs are told of a stack: verdict, drops [cell], margin [rad] where it is known, and misfits."""
    verdict = entry.verdict
    known = verdict and {
        "stands": verdict_word(entry, misfits) == STANDS,
        "at_rest": verdict.at_rest,
        "fell": np.flatnonzero(verdict.fell),
        "drop": verdict.drop,
        "margin": verdict.margin,
    }
    texts = [misfit.text for misfit in misfits]
    return {"verdict": known, "front_iou": entry.front_iou, "matches": entry.matches, "misfits": texts}


def describe_fall(stack: Stack, verdict: Verdict, most: int | None = None) -> str:
    """Name the blocks that fell and how far, the furthest first; empty where none did.

    >>> stack = Stack(np.array([0, 3]), np.array([[0, 0, 2.5, 0, 0, 0], [2, 0, 3.5, 0, 0, 0]]))
    >>> verdict = Verdict(False, np.array([True, True]), np.array([2.0, 3.0]), stack)
    >>> describe_fall(stack, verdict)
    'block 1 (triangle) 3.0 cells, block 0 (cube) 2.0 cells'
    >>> describe_fall(stack, verdict, most=1)
    'block 1 (triangle) 3.0 cells, 1 more'
    """
    fallen = np.flatnonzero(verdict.fell)
    order = fallen[np.argsort(-verdict.drop[fallen], kind="stable")]
    parts = [f"block {i} ({stack.names[i]}) {verdict.drop[i]:.1f} cells" for i in order]
    rest = parts[most:] if most is not None else []
    return ", ".join([*parts[:most], *([f"{len(rest)} more"] if rest else [])])
