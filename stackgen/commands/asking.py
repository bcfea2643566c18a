"""What the verbs that ask methods share (`test`, `predict`, `report`): their arguments, methods and run folders.

`test` and `predict` were verbs of Lightning's command line once; their configurations of that time are translated here.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from stackgen.commands.parsing import CONFIG_FLAGS, option_values, own_sections
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import BATCH, Scene, load_scenes
from stackgen.evaluation.requests import Loaded, Method, load_method, require_one_world
from stackgen.io.text import parse_yaml, read_text, to_yaml
from stackgen.names import DEFAULT
from stackgen.training.runs import describe_run, new_run

_OLD_MODEL = "WeightsUnderTest"


def arguments_of(verb: str, argv: Sequence[str]) -> list[str]:
    """Complete the arguments of a verb: sections of configuration files, old layouts, classes of the user's own.

    Raises:
        StackgenError: If a file of weights holds text.
    """
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for a class_path of the user's own
    arguments = own_sections(verb, argv)
    for _, value in option_values(arguments, ("--weights",)):
        _require_binary(Path(value))
    for index, value in option_values(arguments, CONFIG_FLAGS):
        content = _content(value)
        if content is not None and is_old_layout(content):
            flag, equals, _ = arguments[index].partition("=")
            text = to_yaml(from_old_layout(content))
            arguments[index] = f"{flag}={text}" if equals and flag in CONFIG_FLAGS else text
    return arguments


def _content(value: str) -> dict[str, Any] | None:
    """Read a configuration, given as a file or as its text; None if the parser is to say what is wrong with it."""
    try:
        content = parse_yaml(read_text(value) if value.endswith((".yaml", ".yml")) else value, value)
    except StackgenError:
        return None
    return content if isinstance(content, dict) else None


def is_old_layout(content: Mapping[str, Any]) -> bool:
    """Tell whether a configuration is of the time when the options were those of a LightningModule."""
    model = content.get("model")
    name = model.get("class_path") if isinstance(model, dict) else model
    return str(name).rpartition(".")[2] == _OLD_MODEL


def from_old_layout(content: Mapping[str, Any]) -> dict[str, Any]:
    """Translate an old configuration, written by hand or saved in a run's folder, into plain options.

    >>> from_old_layout({"name": "x", "model": {"class_path": "m.WeightsUnderTest", "init_args": {"seed": 3}}})
    {'name': 'x', 'seed': 3}
    """
    model, data, trainer = (content.get(part) or {} for part in ("model", "data", "trainer"))
    options = dict(model.get("init_args") or {}) if isinstance(model, dict) else {}
    if isinstance(options.get("sampler"), dict):  # settings that are null, some of which there are no more
        options["sampler"] = {name: value for name, value in options["sampler"].items() if value is not None}
    weights = options.get("weights")
    if isinstance(weights, dict) and "catalogue" in (weights.get("init_args") or {}):
        inner = dict(weights["init_args"])
        world = {part: inner.pop(part) for part in ("catalogue", "grid", "max_blocks") if part in inner}
        options["weights"] = {**weights, "init_args": {**inner, "world": world}}
    batches = trainer.get("limit_test_batches") or trainer.get("limit_predict_batches")
    size = data.get("eval_batch_size") or BATCH
    options = {
        "name": content.get("name"),
        "ckpt_path": content.get("ckpt_path"),
        "runs": trainer.get("default_root_dir"),
        "test_set": data.get("test_path"),
        "batch_size": size if size != BATCH else None,
        "limit": batches * size if isinstance(batches, int) else None,
        **options,
    }
    return {name: value for name, value in options.items() if value is not None}


def _require_binary(path: Path) -> None:
    """Say in one line if a file of weights holds text: the parser would take it for the description of a sampler."""
    starts = {".ckpt": (b"PK", 0), ".safetensors": (b"{", 8)}
    if path.suffix not in starts or not path.is_file():
        return
    mark, at = starts[path.suffix]
    with path.open("rb") as file:
        if not file.read(at + len(mark)).endswith(mark):
            raise StackgenError(f"{path} holds no weights of stackgen, or is damaged")


def with_checkpoint(method: Method, ckpt_path: Path | None) -> Method:
    """Put a checkpoint in the place of the weights that it holds: those of a sampler, or of a block-list network.

    Raises:
        StackgenError: If there is no such checkpoint, or other weights were given too.
    """
    if ckpt_path is None:
        return method
    from stackgen.sampling.methods import role_of

    part = "block_list_weights" if role_of(ckpt_path) == "predictor" else "weights"
    if getattr(method, part) != DEFAULT:
        raise StackgenError(f"--ckpt_path and --{part} both name weights of the same kind: give one of them")
    return replace(method, **{part: str(ckpt_path)})  # type: ignore[arg-type]


def load_both(
    method: Method, ckpt_path: Path | None, test_set: str | None, limit: int | None, split: str = "test"
) -> tuple[Loaded, list[Scene], Dataset]:
    """Load a method, and the scenes that it is asked about, from a dataset of the same world.

    Raises:
        StackgenError: If one of them is not there, or they do not fit each other.
    """
    if limit is not None and limit < 1:
        raise StackgenError(f"--limit must be at least 1, got {limit}")
    loaded = load_method(with_checkpoint(method, ckpt_path))
    scenes, dataset = load_scenes(test_set or TESTSET, split)
    require_one_world(loaded, dataset.world, dataset.manifest.name)
    return loaded, scenes[:limit], dataset


def open_run(name: str, runs: Path, verb: str, config: str, dataset: Dataset) -> Path:
    """Make the folder of a run, and write down what makes it: its options, the code, the data and the command.

    Raises:
        StackgenError: If the folder cannot be made.
    """
    folder = new_run(name, runs, verb)
    describe_run(folder, config, dataset)
    return folder
