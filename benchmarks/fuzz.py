"""Fuzzing: seeded inputs of every kind that stackgen reads, and what becomes of them.

Each input is run in a process with a limit of time and memory. An input is right or refused in one line; a traceback,
a hang, the end of the process or a file that is left half written is a defect, and is printed with its seed.

    python -m benchmarks.fuzz --inputs 10000 --seed 0
    python -m benchmarks.fuzz --only weights --inputs 1 --seed 1234    # one input again
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import multiprocessing
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks import fuzzing
from benchmarks.common import ROOT, argument_parser, plain_table, report, start
from stackgen.commands.cli import explain
from stackgen.commands.cli import main as command_line

OUTCOMES = ("ok", "refused", "more lines", "traceback", "hang", "died", "half-written")
SECONDS = 20.0
MEMORY = 6 * 2**30
TOWERS = ROOT / "out" / "fuzz" / "towers"
VERBS = (
    *("sample", "check", "show", "capture", "build", "generate", "test", "predict"),
    *("sweep", "prefer", "report", "export"),
)


def call(function: Callable[[], Any]) -> tuple[str, str]:
    """Call a reader: its errors are those that a user can mend, or defects."""
    try:
        function()
    except Exception as error:  # noqa: BLE001 - any kind is what is looked for
        line = explain(error)
        if line is None:
            return "traceback", "".join(traceback.format_exception(error))[-1500:]
        return ("refused" if line and "\n" not in line else "more lines"), line
    return "ok", ""


def cli(*words: object) -> tuple[str, str]:
    """Run a command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = command_line([str(word) for word in words])
    text = err.getvalue()
    if code in (0, 1):
        return ("traceback" if "Traceback" in text else "ok"), text
    if code != 2 or "Traceback" in text:
        return "traceback", text[-1500:]
    said = ("stackgen:0: UserWarning", "options of ")  # before anything went wrong
    told = [line for line in text.splitlines() if line.strip() and not line.startswith(said)]
    return ("refused" if len(told) == 1 and told[0].isprintable() else "more lines"), text


def parsed_only(verb: str, *words: object) -> tuple[str, str]:
    """Run a verb whose function does nothing: what is tried is its parser, and the settings that it makes."""
    module: Any = importlib.import_module(f"stackgen.commands.{verb}")
    before = module.COMMAND
    module.COMMAND = replace(before, function=_nothing_like(before.function))
    try:
        return cli(verb, *words)
    finally:
        module.COMMAND = before


def _nothing_like(function: Callable[..., Any]) -> Callable[..., None]:
    import functools

    @functools.wraps(function)
    def nothing(*_: Any, **__: Any) -> None:
        return None

    return nothing


def fit_only_built(*words: object) -> tuple[str, str]:
    """Run `fit` up to the point where it trains."""
    from stackgen.commands.fit import StackgenCLI

    before = StackgenCLI._run_subcommand
    StackgenCLI._run_subcommand = lambda self, subcommand: None  # type: ignore[method-assign]
    try:
        return cli("fit", *words, "--dashboard", "none", "--data.path", str(TOWERS))
    finally:
        StackgenCLI._run_subcommand = before  # type: ignore[method-assign]


def _write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def stacks(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A stacks.json, read and sometimes drawn."""
    source = rng.choice(sorted((ROOT / "examples" / "stacks").glob("*.json")))
    path = _write(folder / "s.json", fuzzing.mutated_json(json.loads(source.read_text()), rng))
    if rng.random() < 0.1:
        return cli("show", path, "--out", folder / "out" / "p.png")
    from stackgen.io.stacks_file import read_stacks, to_json

    return call(lambda: to_json(read_stacks(path)))


def configurations(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A YAML file of a verb's options."""
    verbs = {"generate": "generate", "model": "fit", "baselines": "test", "worlds": "generate"}
    paths = [*(ROOT / "configs").rglob("*.yaml")]
    source = rng.choice([path for path in paths if path.parent.name in verbs or path.parent.parent.name in verbs])
    text = source.read_text()
    verb = "fit" if "class_path" in text and "trainer" in text else "generate" if "stacks:" in text else "test"
    path = _write(folder / "c.yaml", fuzzing.mutated_yaml(text, rng))
    if verb == "fit":
        return fit_only_built("--config", path)
    return parsed_only(verb, "--config", path, *(["--out", folder / "out"] if verb == "generate" else []))


def found_configurations(folder: Path, rng: random.Random) -> tuple[str, str]:
    """The config.yaml beside a checkpoint of somebody else."""
    shutil.copytree(fuzzing.BEFORE / rng.choice(["ddpm", "blocklist", "tran-reg", "tran-vae"]), folder / "run")
    config = folder / "run" / "version_0" / "config.yaml"
    config.write_bytes(fuzzing.mutated_yaml(config.read_text(), rng))
    return fit_only_built("--ckpt_path", folder / "run")


def datasets(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A folder of shards: verified, split or read."""
    data = fuzzing.dataset(folder, rng)
    kind = rng.randrange(3)
    if kind == 0:
        return cli("dataset", "verify", data)
    if kind == 1:
        return cli("dataset", "split", data, "--validation", 0.2, "--test", 0.2, "--out", folder / "out")
    from stackgen.data.dataset import Dataset

    return call(lambda: [Dataset.open(data).split(name) for name in Dataset.open(data).splits])


def compact(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A compact dataset."""
    from stackgen.data.dataset import Dataset

    content = (fuzzing.BEFORE / "towers.npz").read_bytes()
    path = _write(folder / "d.npz", fuzzing.mutated_bytes(content, rng))
    return call(lambda: [Dataset.open(path).split(name) for name in Dataset.open(path).splits])


def weights(folder: Path, rng: random.Random) -> tuple[str, str]:
    """Weights and their card."""
    from stackgen.sampling.methods import load_predictor, load_sampler

    network = rng.choice(["ddpm-small", "blocklist-small", "tran-reg"])
    path = fuzzing.weights(folder, rng, ROOT / "stackgen" / "assets" / "weights" / f"{network}.safetensors")
    return call(lambda: (load_predictor if network == "blocklist-small" else load_sampler)(path))


def checkpoints(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A checkpoint of a training."""
    from stackgen.sampling.methods import load_sampler

    content = (fuzzing.BEFORE / "ddpm" / "version_0" / "checkpoints" / "last.ckpt").read_bytes()
    path = _write(folder / "last.ckpt", fuzzing.mutated_bytes(content, rng))
    return call(lambda: load_sampler(path))


def records(folder: Path, rng: random.Random) -> tuple[str, str]:
    """Records of our own: of evaluations, of builds, of generations."""
    from stackgen.data.generation.workshop import Workshop
    from stackgen.evaluation.results import read_evaluation
    from stackgen.robot.real.build_progress import FILE, FORMAT, BuildProgress

    kind = rng.randrange(3)
    if kind == 0:
        kept = sorted((ROOT / "out" / "fuzz").glob("evaluation-*.json"))
        path = _write(folder / "e.json", fuzzing.mutated_json(json.loads(rng.choice(kept).read_text()), rng))
        return call(lambda: read_evaluation(path))
    if kind == 1:
        cell = {"speeds": {"joint": 1.0}}
        progress = BuildProgress(("cube", "cube"), ((0.0,) * 6, (0.0,) * 6), (1, 0), cell, placed=1)
        _write(folder / FILE, fuzzing.mutated_json({"format": FORMAT, **vars(progress)}, rng))
        return call(lambda: BuildProgress.read(folder).describe())
    (folder / "progress").mkdir()
    entry = json.loads((TOWERS / "dataset.json").read_text())["shards"][0]
    _write(folder / "progress" / "000000.json", fuzzing.mutated_json(entry, rng))
    return call(lambda: Workshop(folder).whole(lambda line: None))


def sweeps(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A sweep file, and the journal of a sweep."""
    from stackgen.training.sweeps.coordinator import mend_journal, open_study
    from stackgen.training.sweeps.findings import ranking

    text = (ROOT / "configs" / "sweeps" / "ddpm.yaml").read_text()
    if rng.random() < 0.6:
        return parsed_only("sweep", "--config", _write(folder / "s.yaml", fuzzing.mutated_yaml(text, rng)))
    from stackgen.training.sweeps.file import Metric, Sweep

    parameters: dict[str, dict[str, Any]] = {"x": {"min": 0.0, "max": 1.0}, "y": {"values": [1, 2]}}
    sweep = Sweep(program="x.py", name="s", parameters=parameters, metric=Metric(name="loss"))
    study = open_study(sweep, folder)
    for _ in range(3):
        trial = study.ask()
        trial.suggest_float("x", 0, 1)
        study.tell(trial, 1.0)
    journal = next(folder.rglob("journal*"))
    journal.write_bytes(fuzzing.mutated_bytes(journal.read_bytes(), rng))

    def read() -> None:
        mend_journal(journal)
        ranking(open_study(sweep, folder))

    return call(read)


def option_strings(folder: Path, rng: random.Random) -> tuple[str, str]:
    """Options of a verb with values that make no sense."""
    from stackgen.commands.completion import parsers_of
    from stackgen.commands.hints import options_of

    verb = rng.choice(VERBS)
    parser = parsers_of(verb)
    assert not isinstance(parser, dict)
    known = [option for option in options_of(parser) if option not in ("--help", "-h", "--print_config")]
    return parsed_only(verb, *fuzzing.options(known, rng))


KINDS: dict[str, Callable[[Path, random.Random], tuple[str, str]]] = {
    "stacks": stacks,
    "configurations": configurations,
    "found": found_configurations,
    "datasets": datasets,
    "compact": compact,
    "weights": weights,
    "checkpoints": checkpoints,
    "records": records,
    "sweeps": sweeps,
    "options": option_strings,
}


def one(kind: str, seed: int) -> tuple[str, str]:
    """Try one input in a folder of its own, and look at what it leaves behind."""
    folder = Path(tempfile.mkdtemp(prefix="stackgen-fuzz-"))
    before = os.getcwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            outcome, text = KINDS[kind](folder, random.Random(f"{kind} {seed}"))
        left = [p for p in folder.rglob("*") if p.name.endswith((".tmp", ".unfinished")) or p.name == "pwned"]
        if left or (outcome == "refused" and (folder / "out").exists()):
            return "half-written", f"{left or 'out'}: {text}"
        return outcome, text
    finally:
        os.chdir(before)
        shutil.rmtree(folder, ignore_errors=True)


def _work(pipe: Any) -> None:
    """Try inputs as they come."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY + 8 * 2**30, MEMORY + 8 * 2**30))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    import torch

    torch.set_num_threads(1)
    with contextlib.suppress(EOFError):
        while True:
            kind, seed = pipe.recv()
            try:
                answer = one(kind, seed)
            except BaseException as error:  # noqa: BLE001 - a defect, like any other
                answer = "traceback", "".join(traceback.format_exception(error))[-1500:]
            pipe.send(answer)


class Worker:
    """A process that tries inputs, and is replaced when it hangs or dies."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, there = context.Pipe()
        self.process = context.Process(target=_work, args=(there,), daemon=True)
        self.process.start()
        there.close()
        self.known = set[str]()

    def give(self, kind: str, seed: int) -> tuple[str, str]:
        """Try one input."""
        self.pipe.send((kind, seed))
        limit = SECONDS + (60.0 if kind not in self.known else 0.0)  # the first of a kind loads torch and the rest
        self.known.add(kind)
        if not self.pipe.poll(limit):
            self._end()
            return "hang", f"over {limit:g} s"
        try:
            return self.pipe.recv()
        except (EOFError, OSError):
            self._end()
            return "died", "the process ended"

    def _end(self) -> None:
        self.process.kill()
        self.process.join()
        self._begin()


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


def main() -> None:
    """Try inputs and print what became of them."""
    parser = argument_parser("fuzz", __doc__)
    parser.add_argument("--inputs", type=int, default=1000, help="Number of inputs, shared by the kinds.")
    parser.add_argument("--seed", type=int, default=0, help="Seed of the first input of each kind.")
    parser.add_argument("--only", nargs="*", choices=KINDS, default=list(KINDS), help="Kinds that are tried.")
    options = parser.parse_args()
    prepare()
    worker, counts, defects, begin = Worker(), Counter[tuple[str, str]](), Counter[str](), time.perf_counter()
    for number in range(options.inputs):
        kind = options.only[number % len(options.only)]
        seed = options.seed + number // len(options.only)
        outcome, text = worker.give(kind, seed)
        counts[kind, outcome] += 1
        if outcome not in ("ok", "refused"):
            last = text.strip().splitlines()[-2:] if "bug of stackgen" in text else text.strip().splitlines()[-1:]
            defects[f"{kind}: {' | '.join(last)[:200]}"] += 1
            print(f"--- {kind} {seed}: {outcome}\n{text[-1200:]}", flush=True)
    rows = [[kind, *(str(counts[kind, outcome]) for outcome in OUTCOMES)] for kind in options.only]
    metrics = {
        "inputs": options.inputs,
        "seed": options.seed,
        "seconds": round(time.perf_counter() - begin, 1),
        "outcomes": {kind: {o: counts[kind, o] for o in OUTCOMES} for kind in options.only},
    }
    report("fuzz", metrics, [plain_table("What became of inputs", ["kind", *OUTCOMES], rows)], options.out)
    for line, times in defects.most_common():
        print(f"{times} x {line}")


if __name__ == "__main__":
    start(main)
