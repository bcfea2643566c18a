"""Verdicts as a table in the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from stackgen.io.stacks_file import StackEntry
from stackgen.protocols import Verdict
from stackgen.stack import Stack

STANDS, FALLS = "[green]stands[/]", "[red]falls[/]"


def verdict_table(heading: str, sources: Iterable[tuple[str, Sequence[StackEntry]]], most: int | None = None) -> Table:
    """Make a table with one row for each stack.

    Stacks are numbered from 1 and blocks from 0, as in the file and the picture.

    Args:
        heading: Heading of the column that says where a stack came from.
        sources: Where stacks came from, and those stacks with their verdicts.
        most: Largest number of fallen blocks to name for each stack; all by default.
    """
    table = Table(heading, "stack", "verdict", "front IoU", "matches", "what fell", box=None, pad_edge=False)
    for column in (table.columns[1], table.columns[3]):
        column.justify = "right"
    for source, entries in sources:
        for number, entry in enumerate(entries, 1):
            stands = entry.verdict is not None and entry.verdict.stable
            table.add_row(
                escape(source) if number == 1 else "",
                str(number),
                STANDS if stands else FALLS,
                "" if entry.front_iou is None else f"{entry.front_iou:.2f}",
                "" if entry.matches is None else "yes" if entry.matches else "no",
                escape(describe_fall(entry.stack, entry.verdict, most)) if entry.verdict else "",
            )
    return table


def verdict_facts(entry: StackEntry) -> dict[str, Any]:
    """Give what programs are told of a stack: verdict, drops [cell], margin [rad] where it is known, and fit."""
    verdict = entry.verdict
    known = verdict and {
        "stands": verdict.stable,
        "at_rest": verdict.at_rest,
        "fell": np.flatnonzero(verdict.fell),
        "drop": verdict.drop,
        "margin": verdict.margin,
    }
    return {"verdict": known, "front_iou": entry.front_iou, "matches": entry.matches}


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
