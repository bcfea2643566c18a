"""Where training leaves its files: `runs/<name>/version_<n>/{config.yaml, run.json, metrics.csv, checkpoints/}`.

What the other verbs find out stands beside it: `runs/<name>/test_<n>/{config.yaml, run.json, metrics.json}`.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stackgen.data.dataset import Dataset
from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically, write_json
from stackgen.io.provenance import code_version

RUNS = Path("runs")

_FOLDER = "STACKGEN_RUN_FOLDER"  # tells the processes that the first one starts where it writes
_RANKS = ("RANK", "LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "SLURM_PROCID")
"""What launchers number processes or machines by; all are 0, where they are set, for the first process alone."""


def check_run_name(name: str) -> None:
    """Refuse a name of a run that is no plain name of a folder.

    Raises:
        StackgenError: The line says what names are made of.
    """
    if not re.fullmatch(r"\w[\w.+-]*", name):
        raise StackgenError(f"run name {name!r}: use letters, digits, '_', '-', '+' and '.' only")


def new_run(name: str, root: Path = RUNS, kind: str = "version") -> Path:
    """Make and return the next folder of a run; never one that exists, even if two start at once.

    Raises:
        StackgenError: If the name is no plain name of a folder.
    """
    check_run_name(name)
    number = 0
    while True:
        folder = root / name / f"{kind}_{number}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            number += 1


def drop_run_without(worth: str, folder: Path) -> None:
    """Remove the folder of a run that came to nothing, and the folders above it that are then empty.

    Args:
        worth: Pattern of the files that are worth keeping; if there is one, the folder stays.
        folder: Folder of the run.
    """
    if any(folder.glob(worth)):
        return
    if (wandb := sys.modules.get("wandb")) is not None and wandb.run is not None:
        wandb.finish(exit_code=1)  # else it writes into the folder once more at the end
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):  # they hold other runs
        folder.parent.rmdir()
        folder.parent.parent.rmdir()


@contextlib.contextmanager
def dropped_if_failing(worth: str, folder: Path) -> Iterator[None]:
    """See that a block that fails or is stopped leaves no folder without anything that is worth keeping."""
    try:
        yield
    except BaseException:
        drop_run_without(worth, folder)
        raise


def new_shared_run(name: str, root: Path, kind: str, first: bool) -> Path:
    """Like new_run, in a distributed run: the first process makes the folder, the others are told of it.

    Args:
        name: Name of the run.
        root: Folder of all runs.
        kind: Beginning of the folder's name.
        first: Whether this is the first process of the run, as its trainer says.
    """
    if not first:
        return Path(os.environ.get(_FOLDER, root / name))  # on another machine they write nothing
    folder = new_run(name, root, kind)
    os.environ[_FOLDER] = str(folder)
    return folder


def is_first_process() -> bool:
    """Guess whether this is the first process of a distributed run, for messages before there is a trainer to ask."""
    return all(os.environ.get(name, "0") in ("", "0") for name in _RANKS)


def describe_run(folder: Path, config: str, dataset: Dataset | None) -> dict[str, Any]:
    """Write down what makes a run, and return what stands in `run.json`: the code, the command and the data.

    Args:
        folder: Folder of the run.
        config: Configuration, as YAML.
        dataset: Dataset that is read, if there is one.
    """
    facts: dict[str, Any] = {"code": code_version(), "command": ["stackgen", *sys.argv[1:]]}
    if dataset is not None:
        manifest = dataset.manifest
        facts["dataset"] = {"path": dataset.path, "name": manifest.name, "sha256": manifest.sha256}
    write_atomically(folder / "config.yaml", config.encode())
    write_json(folder / "run.json", facts)
    return facts


def config_of(checkpoint: Path) -> Path | None:
    """Find the configuration saved beside a run's checkpoints, if the checkpoint still lies there."""
    config = checkpoint.parent.parent / "config.yaml"
    return config if checkpoint.parent.name == "checkpoints" and config.is_file() else None
