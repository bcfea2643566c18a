"""Fuzzing: seeded inputs of every kind that stackgen reads, and what becomes of them.

Each input is run in a process with a limit of time and memory. An input is right or refused in one line; a traceback,
a hang, the end of the process or a file that is left half written is a defect, and is printed with its seed.

    python -m benchmarks.fuzz --inputs 10000 --seed 0 --out a.json     # typed again, it goes on where it was stopped
    python -m benchmarks.fuzz --add a.json b.json --out sum.json       # runs of several seeds as one
    python -m benchmarks.fuzz --only weights --inputs 1 --seed 1234    # one input again
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.common import argument_parser, plain_table, report, save, start
from benchmarks.fuzz.kinds import KINDS, SLOW, TOWERS, command_line
from benchmarks.fuzz.tally import OUTCOMES, Tally, added
from benchmarks.fuzz.worker import Worker

OFTEN = 50
"""Inputs after which what has been found so far is written."""


def prepare() -> None:
    """Make the valid files that are no part of the repository."""
    from tests.conftest import write_towers

    shutil.rmtree(TOWERS.parent, ignore_errors=True)
    TOWERS.mkdir(parents=True)
    write_towers(TOWERS, {"train": 12, "validation": 4, "test": 4})
    folder = TOWERS.parent / "runs"
    words = ("test", "--weights", "random-placement", "--test_set", TOWERS, "--limit", 2, "--num_samples", 2)
    with contextlib.redirect_stdout(io.StringIO()):
        code = command_line([str(word) for word in (*words, "--runs", folder)])
    if code != 0:
        sys.exit(code)
    for number, path in enumerate(folder.rglob("evaluation-*.json")):
        shutil.copy(path, TOWERS.parent / f"evaluation-{number}.json")


def turns(kinds: Sequence[str], seed: int) -> Iterator[tuple[str, int]]:
    """Give each input's kind and seed: all kinds in turn, the slow ones in every fourth round."""
    for number in itertools.count():
        for kind in kinds:
            if kind not in SLOW or len(kinds) == 1:
                yield kind, seed + number
            elif number % 4 == 0:
                yield kind, seed + number // 4


def run(kinds: Sequence[str], seed: int, inputs: int, out: Path | None) -> Tally:
    """Try inputs; what was found until an interruption is a result, too."""
    name = str(seed) if kinds == list(KINDS) else f"{seed} of {', '.join(kinds)}"
    tally, worker = Tally.begin(out, name), Worker()
    first = tally.inputs[name]
    with contextlib.suppress(KeyboardInterrupt):
        for kind, number in itertools.islice(turns(kinds, seed), first, inputs):
            outcome, text, seconds = worker.give(kind, number)
            tally.inputs[name] += 1
            tally.count(kind, outcome, text, seconds)
            if outcome not in ("ok", "refused"):
                print(f"--- {kind} {number}: {outcome}\n{text[-1200:]}", flush=True)
            if out is not None and tally.inputs.total() % OFTEN == 0:
                save("fuzz", tally.figures(), out)
    return tally


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser("fuzz", __doc__)
    options.add_argument("--inputs", type=int, default=1000, help="number of inputs, shared by the kinds")
    options.add_argument("--seed", type=int, default=0, help="seed of the first input of each kind")
    options.add_argument("--only", nargs="*", choices=KINDS, default=list(KINDS), help="kinds that are tried")
    options.add_argument("--add", nargs="+", type=Path, metavar="FILE", help="results to add up; nothing is tried")
    return options


def main() -> None:
    """Try inputs and print what became of them."""
    options = parser().parse_args()
    if options.add:
        tally = added([Tally.read(path) for path in options.add])
    else:
        prepare()
        tally = run(options.only, options.seed, options.inputs, options.out)
    figures = tally.figures()
    rows = [[kind, *(str(counts[o]) for o in OUTCOMES)] for kind, counts in figures["outcomes"].items()]
    rows.append(["all", *(str(figures["totals"][o]) for o in OUTCOMES)])
    title = f"What became of {figures['inputs']} inputs"
    report("fuzz", figures, [plain_table(title, ["kind", *OUTCOMES], rows)], options.out)
    for line, times in figures["defects"].items():
        print(f"{times} x {line}")


if __name__ == "__main__":
    start(main)
