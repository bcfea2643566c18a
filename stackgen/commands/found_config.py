"""Configurations that were found beside a checkpoint, not typed: what is taken from them.

A run's folder may come from anybody. So its configuration may name stackgen's own code and local data, but no other
code, no command, no URL and no folder to write to. `--config FILE` trusts the same file, and takes everything in it.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from stackgen.data.sources import is_remote
from stackgen.errors import StackgenError, printable

_OURS = ("baselines", "models", "training")
_KNOWN = (
    "stackgen.sim.checkers.SimulatorChecker",
    *(f"lightning.pytorch.callbacks.{name}" for name in ("EarlyStopping", "LearningRateMonitor", "ModelCheckpoint")),
)
_FREE_TEXT = ("name", "path", "test_path", "weights", "preferences", "parts", "monitor")
"""Options that are names or files to read; every other text is a choice among words."""
_WORD = re.compile(r"[\w:+-]*")
_ROOT = ("trainer", "default_root_dir")


def taken_from(content: Any, path: Path, typed: Collection[str], sections: Collection[str]) -> dict[str, Any]:
    """Take the options of a configuration that was found.

    Args:
        content: What stands in it.
        path: File, for messages.
        typed: Options that the user typed, such as `data.path`; they are not taken.
        sections: Sections that are taken, as far as they are there.

    Returns:
        The options, which name nothing foreign.

    Raises:
        StackgenError: If they name foreign classes, commands, places afar or folders to write to.
    """
    groups = content if isinstance(content, dict) else {}
    parts = [groups.get("model"), groups.get("data", {}), groups.get("trainer", {})]
    if not all(isinstance(part, dict) for part in parts):
        raise StackgenError(f"{path} is no configuration of a run; name one with --config")
    taken = {name: _without(value, typed, name) for name, value in groups.items() if name in sections}
    for place, value in _leaves(taken):
        reason = _foreign(place, value, path)
        if reason:
            raise StackgenError(
                f"{path} was found beside the checkpoint, and its {'.'.join(map(str, place))} {reason},"
                f" '{printable(value)[:80]}': add --config {path} if you trust it, or type another"
                f" --{'.'.join(map(str, place[:2]))}"
            )
    return taken


def described(taken: Mapping[str, Any], path: Path) -> str:
    """Say in a line what was taken from where."""
    data = (taken.get("data") or {}).get("path")
    facts = [f"model {taken['model'].get('class_path')}", *([f"data {data}"] if data else [])]
    return printable(f"options of {path} are taken: {', '.join(facts)}")


def _without(value: Any, typed: Collection[str], name: str) -> Any:
    """Leave out what was typed."""
    if not isinstance(value, dict):
        return value
    named = {f"{name}.{key}": (key, inner) for key, inner in value.items()}
    return {key: _without(inner, typed, full) for full, (key, inner) in named.items() if full not in typed}


def _leaves(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Go through all keys and plain values, with the keys that lead to them."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, (*place, key))
    elif isinstance(value, list):
        for inner in value:
            yield from _leaves(inner, place)
    else:
        yield place, value


def _foreign(place: tuple[Any, ...], value: Any, path: Path) -> str | None:
    """Say what is foreign about a value; None if nothing is."""
    key = place[-1] if place else ""
    if not all(isinstance(name, str) and name.isidentifier() and name != "dict_kwargs" for name in place):
        return "is no option of stackgen's"
    if not isinstance(value, str):
        return None
    if key == "class_path":
        return None if value in known_classes() else "names a class that is not stackgen's"
    if place == _ROOT:
        return None if _is_own_root(Path(value), path) else "is a folder to write to"
    if key in _FREE_TEXT:
        return "is a command or a place behind a URL" if is_remote(value) or "${" in value else None
    if not _WORD.fullmatch(value) or Path(value).is_file():  # the parser takes files and classes for groups of options
        return "names a file, a class or a folder"
    return None


def known_classes() -> frozenset[str]:
    """Name the public classes that a configuration may name."""
    import importlib

    public = {part: importlib.import_module(f"stackgen.{part}").__all__ for part in _OURS}
    return frozenset((*_KNOWN, *(f"stackgen.{part}.{name}" for part, names in public.items() for name in names)))


def _is_own_root(folder: Path, path: Path) -> bool:
    """Tell whether the folder of all runs is the one that the run lies in, or one below the current folder."""
    inside = not folder.is_absolute() and ".." not in folder.parts
    return inside or folder.resolve() == path.resolve().parent.parent.parent
