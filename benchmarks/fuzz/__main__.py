"""Fuzzing: seeded inputs of every kind that stackgen reads, and what becomes of them.

Each input is run in a process with a limit of time and memory. An input is right or refused in one line; a traceback,
a hang, the end of the process or a file that is left half written is a defect, and is printed with its seed.

    python -m benchmarks.fuzz --inputs 10000 --seed 0
    python -m benchmarks.fuzz --only weights --inputs 1 --seed 1234    # one input again
"""

from __future__ import annotations

import contextlib
import io
import itertools
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence

from benchmarks.common import argument_parser, plain_table, report, start
from benchmarks.fuzz.kinds import KINDS, SLOW, TOWERS, command_line
from benchmarks.fuzz.worker import Worker

OUTCOMES = ("ok", "refused", "more lines", "traceback", "hang", "died", "half-written")


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


def main() -> None:
    """Try inputs and print what became of them."""
    parser = argument_parser("fuzz", __doc__)
    parser.add_argument("--inputs", type=int, default=1000, help="Number of inputs, shared by the kinds.")
    parser.add_argument("--seed", type=int, default=0, help="Seed of the first input of each kind.")
    parser.add_argument("--only", nargs="*", choices=KINDS, default=list(KINDS), help="Kinds that are tried.")
    options = parser.parse_args()
    prepare()
    worker, counts, defects, begin = Worker(), Counter[tuple[str, str]](), Counter[str](), time.perf_counter()
    with contextlib.suppress(KeyboardInterrupt):  # what was tried until then is a result, too
        for kind, seed in itertools.islice(turns(options.only, options.seed), options.inputs):
            outcome, text = worker.give(kind, seed)
            counts[kind, outcome] += 1
            if outcome not in ("ok", "refused"):
                last = text.strip().splitlines()[-2:] if "bug of stackgen" in text else text.strip().splitlines()[-1:]
                defects[f"{kind}: {' | '.join(last)[:200]}"] += 1
                print(f"--- {kind} {seed}: {outcome}\n{text[-1200:]}", flush=True)
    rows = [[kind, *(str(counts[kind, outcome]) for outcome in OUTCOMES)] for kind in options.only]
    metrics = {
        "inputs": counts.total(),
        "seed": options.seed,
        "seconds": round(time.perf_counter() - begin, 1),
        "outcomes": {kind: {o: counts[kind, o] for o in OUTCOMES} for kind in options.only},
        "defects": dict(defects.most_common()),
    }
    report("fuzz", metrics, [plain_table("What became of inputs", ["kind", *OUTCOMES], rows)], options.out)
    for line, times in defects.most_common():
        print(f"{times} x {line}")


if __name__ == "__main__":
    start(main)
