"""Where training leaves its files: `runs/<name>/version_<n>/{config.yaml, metrics.csv, checkpoints/}`.

What the other verbs find out stands beside it: `runs/<name>/test_<n>/{config.yaml, metrics.json}`.
"""

from __future__ import annotations

import re
from itertools import count
from pathlib import Path

from stackgen.errors import StackgenError

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


def config_of(checkpoint: Path) -> Path | None:
    """The configuration saved beside a run's checkpoints, if the checkpoint still lies there."""
    config = checkpoint.parent.parent / "config.yaml"
    return config if checkpoint.parent.name == "checkpoints" and config.is_file() else None
