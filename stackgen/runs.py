"""Where training leaves its files: `runs/<name>/version_<n>/{config.yaml, metrics.csv, checkpoints/}`.

What the other verbs find out stands beside it: `runs/<name>/test_<n>/{config.yaml, metrics.json}`.
"""

from __future__ import annotations

import re
import subprocess
from importlib.metadata import version
from itertools import count
from pathlib import Path

from stackgen.stack import StackgenError

RUNS = Path("runs")


def new_run(name: str, root: Path = RUNS, kind: str = "version") -> Path:
    """Make and return the next folder of a run; never one that exists, even if two start at once.

    Raises:
        StackgenError: If the name is no plain name of a folder.
    """
    if not re.fullmatch(r"\w[\w.+-]*", name):
        raise StackgenError(f"run name {name!r}: use letters, digits, '_', '-', '+' and '.' only")
    for number in count():
        folder = root / name / f"{kind}_{number}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise AssertionError("count() ends never")


def code_version() -> str:
    """The package's version, and the commit where it runs from a git checkout (`+` where that was changed since).

    >>> code_version().split()[0]
    '0.1.0'
    """
    package = version("stackgen")
    try:
        git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty=+", "--exclude=*"]
        commit = subprocess.run(git, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return package
    return f"{package} {commit}"


def last_checkpoint(folder: Path) -> Path:
    """The newest `last.ckpt` of a run (all its versions) or of one version.

    Raises:
        StackgenError: If there is none.
    """
    found = [*folder.glob("checkpoints/last.ckpt"), *folder.glob("version_*/checkpoints/last.ckpt")]
    if not found:
        raise StackgenError(f"no checkpoint in {folder}: there is no version_*/checkpoints/last.ckpt in it")
    return max(found, key=lambda path: path.stat().st_mtime)


def resolve_weights(name: str | Path) -> str:
    """The last checkpoint where the name is a run's folder; else the name as it is."""
    return str(last_checkpoint(Path(name))) if Path(name).is_dir() else str(name)


def config_of(checkpoint: Path) -> Path | None:
    """The configuration saved beside a run's checkpoints, if the checkpoint still lies there."""
    config = checkpoint.parent.parent / "config.yaml"
    return config if checkpoint.parent.name == "checkpoints" and config.is_file() else None
