"""What became of inputs, counted: kept in a file, gone on with, and added up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.common import machine
from stackgen.errors import StackgenError
from stackgen.io.text import read_json

OUTCOMES = ("ok", "refused", "more lines", "traceback", "hang", "died", "half-written")


@dataclass
class Tally:
    """What became of inputs.

    Args:
        commit: State of the code that read them.
        inputs: Number of inputs by their run: its first seed, and its kinds if they are not all.
        outcomes: Number of inputs by kind and outcome.
        seconds: Processor time by kind [s].
        defects: What was wrong, and how often.
    """

    commit: str | None
    inputs: Counter[str] = field(default_factory=Counter)
    outcomes: dict[str, Counter[str]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    defects: Counter[str] = field(default_factory=Counter)

    @staticmethod
    def begin(out: Path | None, name: str) -> Tally:
        """Take up a run where a file says that it was stopped, if the code is still the same."""
        tally = Tally(machine()["commit"])
        if out is not None and out.exists():
            before = Tally.read(out)
            if before.commit == tally.commit and list(before.inputs) == [name]:
                return before
        return tally

    @staticmethod
    def read(path: Path) -> Tally:
        """Read what :meth:`figures` gave.

        Raises:
            StackgenError: If the file is of another kind.
        """
        content = read_json(path)
        if not isinstance(content, dict) or content.get("benchmark") != "fuzz":
            raise StackgenError(f"{path} is not a result of the fuzzer")
        figures = content["figures"]
        outcomes = {kind: Counter(counts) for kind, counts in figures["outcomes"].items()}
        counts = Counter(figures["inputs by seed"]), outcomes, figures["seconds"], Counter(figures["defects"])
        return Tally(content["machine"]["commit"], *counts)

    def count(self, kind: str, outcome: str, text: str, seconds: float) -> None:
        """Count one more input."""
        self.outcomes.setdefault(kind, Counter())[outcome] += 1
        self.seconds[kind] = round(self.seconds.get(kind, 0.0) + seconds, 2)
        if outcome not in ("ok", "refused"):
            lines = text.strip().splitlines()[-2 if "bug of stackgen" in text else -1 :]
            self.defects[f"{kind}: {' | '.join(lines)[:200]}"] += 1

    def figures(self) -> dict[str, Any]:
        """Give everything as plain data."""
        totals = {outcome: sum(counts[outcome] for counts in self.outcomes.values()) for outcome in OUTCOMES}
        by_kind = {kind: {outcome: counts[outcome] for outcome in OUTCOMES} for kind, counts in self.outcomes.items()}
        return {
            "inputs": self.inputs.total(),
            "totals": totals,
            "inputs by seed": self.inputs,
            "outcomes": by_kind,
            "seconds": self.seconds,
            "defects": dict(self.defects.most_common()),
        }


def added(tallies: Sequence[Tally]) -> Tally:
    """Add runs up.

    Raises:
        StackgenError: If they are of different code, or of the same run.
    """
    total = Tally(tallies[0].commit)
    for tally in tallies:
        if tally.commit != total.commit or tally.inputs.keys() & total.inputs.keys():
            raise StackgenError("--add takes results of one commit, each of another run")
        total.inputs += tally.inputs
        total.defects += tally.defects
        for kind, counts in tally.outcomes.items():
            total.outcomes[kind] = total.outcomes.get(kind, Counter()) + counts
            total.seconds[kind] = round(total.seconds.get(kind, 0.0) + tally.seconds[kind], 2)
    return total
