"""The kinds of inputs, and how each is given to what reads it."""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import json
import random
import shutil
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.common import ROOT
from benchmarks.fuzz import mutations
from stackgen.commands.cli import explain
from stackgen.commands.cli import main as command_line

TOWERS = ROOT / "out" / "fuzz" / "towers"
WEIGHTS = ROOT / "stackgen" / "assets" / "weights"
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
    path = _write(folder / "s.json", mutations.mutated_json(json.loads(source.read_text()), rng))
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
    path = _write(folder / "c.yaml", mutations.mutated_yaml(text, rng))
    if verb == "fit":
        return fit_only_built("--config", path)
    return parsed_only(verb, "--config", path, *(["--out", folder / "out"] if verb == "generate" else []))


def found_configurations(folder: Path, rng: random.Random) -> tuple[str, str]:
    """The config.yaml beside a checkpoint of somebody else."""
    shutil.copytree(mutations.BEFORE / rng.choice(["ddpm", "blocklist", "tran-reg", "tran-vae"]), folder / "run")
    config = folder / "run" / "version_0" / "config.yaml"
    config.write_bytes(mutations.mutated_yaml(config.read_text(), rng))
    return fit_only_built("--ckpt_path", folder / "run")


def datasets(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A folder of shards: verified, split or read."""
    data = mutations.dataset(folder, rng)
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

    content = (mutations.BEFORE / "towers.npz").read_bytes()
    changed = mutations.mutated_bytes(content, rng) if rng.random() < 0.3 else mutations.mutated_npz(content, rng)
    path = _write(folder / "d.npz", changed)
    return call(lambda: [Dataset.open(path).split(name) for name in Dataset.open(path).splits])


def weights(folder: Path, rng: random.Random) -> tuple[str, str]:
    """Weights and their card."""
    from stackgen.sampling.methods import load_predictor, load_sampler

    network = rng.choice(["ddpm-small", "blocklist-small", "tran-reg"])
    path = mutations.weights(folder, rng, WEIGHTS / f"{network}.safetensors")
    return call(lambda: (load_predictor if network == "blocklist-small" else load_sampler)(path))


def checkpoints(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A checkpoint of a training."""
    from stackgen.sampling.methods import load_predictor, load_sampler

    network = rng.choice(["ddpm", "blocklist", "tran-reg", "tran-vae"])
    content = (mutations.BEFORE / network / "version_0" / "checkpoints" / "last.ckpt").read_bytes()
    change = mutations.mutated_bytes if rng.random() < 0.3 else mutations.mutated_checkpoint
    path = _write(folder / "last.ckpt", change(content, rng))
    return call(lambda: (load_predictor if network == "blocklist" else load_sampler)(path))


def pictures(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A picture or a depth frame, with what a user says of it."""
    from stackgen.vision.reader import read_picture
    from stackgen.world import PAPER_GRID

    path = mutations.picture(folder, rng)
    said: dict[str, Any] = {}
    if rng.random() < 0.3:
        numbers = (None, None, 0.001, 1.0, 1e-9, 1e9)
        said = {name: rng.choice(numbers) for name in ("depth_scale", "focal", "cell_size")}
        said |= {"as_": rng.choice(("drawing", "photo", "depth")), "which": rng.choice((None, 1, 2, 99))}
    return call(lambda: read_picture(path, PAPER_GRID, **said))


LINES = (
    ("check", "FILE"),
    ("check", "FILE", "--explain", "--quiet"),
    ("show", "FILE", "--out", "out/p.png"),
    ("capture", "FILE", "--out", "out/p.png"),
    ("sample", "FILE", "--blocks", "cube=x", "--out", "out"),
    ("build", "FILE", "--cell", "FILE", "--out", "out"),
    ("generate", "--config", "FILE", "--out", "out"),
    ("dataset", "verify", "FILE"),
    ("dataset", "info", "FILE"),
    ("dataset", "repair", "FILE"),
    ("dataset", "split", "FILE", "--validation", "0.5", "--test", "0.1", "--out", "out"),
    ("dataset", "export", "FILE", "--out", "out/d.npz"),
    ("test", "--weights", "FILE", "--limit", "1", "--runs", "out"),
    ("test", "--ckpt_path", "FILE", "--limit", "1", "--runs", "out"),
    ("test", "--config", "FILE", "--limit", "1", "--runs", "out"),
    ("predict", "--weights", "random-placement", "--test_set", "FILE", "--limit", "1", "--runs", "out"),
    ("prefer", "--ckpt_path", "FILE", "--out", "out"),
    ("report", "--config", "FILE", "--out", "out"),
    ("sweep", "--config", "FILE", "--out", "out"),
    ("export", "FILE", "--out", "out/w.safetensors"),
)
"""Command lines whose FILE is of a kind that the verb has no use for."""


def strangers(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A command line with a file of a kind that it has no use for."""
    verb, *words = rng.choice(LINES)
    path = mutations.stranger(folder, rng)
    return cli(verb, *(word.replace("FILE", str(path)) for word in words))


def records(folder: Path, rng: random.Random) -> tuple[str, str]:
    """Records of our own: of evaluations, of builds, of generations."""
    from stackgen.data.generation.workshop import Workshop
    from stackgen.evaluation.results import read_evaluation
    from stackgen.robot.real.build_progress import FILE, FORMAT, BuildProgress

    kind = rng.randrange(3)
    if kind == 0:
        kept = sorted((ROOT / "out" / "fuzz").glob("evaluation-*.json"))
        path = _write(folder / "e.json", mutations.mutated_json(json.loads(rng.choice(kept).read_text()), rng))
        return call(lambda: read_evaluation(path))
    if kind == 1:
        cell = {"speeds": {"joint": 1.0}}
        progress = BuildProgress(("cube", "cube"), ((0.0,) * 6, (0.0,) * 6), (1, 0), cell, placed=1)
        _write(folder / FILE, mutations.mutated_json({"format": FORMAT, **vars(progress)}, rng))
        return call(lambda: BuildProgress.read(folder).describe())
    (folder / "progress").mkdir()
    entry = json.loads((TOWERS / "dataset.json").read_text())["shards"][0]
    _write(folder / "progress" / "000000.json", mutations.mutated_json(entry, rng))
    return call(lambda: Workshop(folder).whole(lambda line: None))


def sweeps(folder: Path, rng: random.Random) -> tuple[str, str]:
    """A sweep file, and the journal of a sweep."""
    from stackgen.training.sweeps.coordinator import mend_journal, open_study
    from stackgen.training.sweeps.findings import ranking

    text = (ROOT / "configs" / "sweeps" / "ddpm.yaml").read_text()
    if rng.random() < 0.6:
        return parsed_only("sweep", "--config", _write(folder / "s.yaml", mutations.mutated_yaml(text, rng)))
    from stackgen.training.sweeps.file import Metric, Sweep

    parameters: dict[str, dict[str, Any]] = {"x": {"min": 0.0, "max": 1.0}, "y": {"values": [1, 2]}}
    sweep = Sweep(program="x.py", name="s", parameters=parameters, metric=Metric(name="loss"))
    study = open_study(sweep, folder)
    for _ in range(3):
        trial = study.ask()
        trial.suggest_float("x", 0, 1)
        study.tell(trial, 1.0)
    journal = next(folder.rglob("journal*"))
    journal.write_bytes(mutations.mutated_bytes(journal.read_bytes(), rng))

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
    return parsed_only(verb, *mutations.options(known, rng))


Kind = Callable[[Path, random.Random], tuple[str, str]]
KINDS: dict[str, Kind] = {
    "pictures": pictures,
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
    "strangers": strangers,
}
SLOW = ("configurations", "found", "options", "strangers")
"""Kinds that make a parser of a verb, which takes a second: they have a quarter of the others' inputs."""
