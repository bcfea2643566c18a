"""The results that lie on this machine: stacks files, pictures, tables and reports below one folder.

A request names an item by an identifier that a listing made; no text of a request becomes a path.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote

from stackgen.errors import StackgenError
from stackgen.io.stacks_file import read_stacks, to_json
from stackgen.io.text import read_json, read_text
from stackgen.studio.markdown import markdown_page
from stackgen.viz.scene import shape_meshes

Kind = Literal["stacks", "picture", "table", "report", "page"]
"""A report is Markdown; a page is HTML, which may hold scripts."""

MOST_ITEMS = 600
_MOST_FOLDERS = 4000
_DEEPEST = 6
_MOST_BYTES = 16_000_000
_MOST_ROWS = 200
_SKIPPED = {"node_modules", "site-packages", "__pycache__", "wandb", "tests"}
_KINDS: dict[str, Kind] = {".png": "picture", ".csv": "table", ".md": "report", ".html": "page"}
_TABLES = {"metrics.json", "build.json", "run.json"}


@dataclass(frozen=True)
class Item:
    """A file of the gallery.

    Args:
        id: Identifier by which it is asked for.
        kind: Kind of its content.
        path: Its place, below the folder of the gallery.
    """

    id: str
    kind: Kind
    path: Path

    def to_json(self) -> dict[str, str]:
        """Plain form, for a listing."""
        return {"id": self.id, "kind": self.kind, "name": self.path.name, "folder": self.path.parent.as_posix()}


class Gallery:
    """What there is below a folder.

    Args:
        root: The folder.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self._items: dict[str, Item] = {}  # by their identifiers

    def items(self) -> list[Item]:
        """Look what there is, the newest folders first."""
        found = list(islice(self._walk(), MOST_ITEMS))
        self._items = {item.id: item for item in found}
        return found

    def content(self, id_: str) -> tuple[Kind, bytes]:
        """Read an item.

        Returns:
            Its kind; and the bytes of a PNG, HTML for a report or a page, or JSON of stacks or of a table's rows.

        Raises:
            StackgenError: If there is no such item, or it cannot be read.
        """
        item = self._items.get(id_) or {item.id: item for item in self.items()}.get(id_)
        if item is None:
            raise StackgenError("there is no such item; list the gallery again")
        path = self.root / item.path
        try:
            if path.stat().st_size > _MOST_BYTES:
                raise StackgenError(f"{item.path} is larger than {_MOST_BYTES // 1_000_000} MB; it is not shown")
            return item.kind, self._read(item, path)
        except StackgenError as error:
            raise StackgenError(str(error).replace(str(path), str(item.path))) from None
        except OSError as error:
            raise StackgenError(f"{item.path} cannot be read: {error.strerror or error}") from None

    def _read(self, item: Item, path: Path) -> bytes:
        if item.kind in ("picture", "page"):
            return path.read_bytes()
        if item.kind == "report":
            return markdown_page(read_text(path), str(item.path), partial(self._address, item.path)).encode()
        if item.kind == "table":
            return json.dumps({"rows": _rows(path)}).encode()
        content = read_stacks(path)
        return json.dumps({"file": to_json(content), "shapes": shape_meshes(content.world.catalogue)}).encode()

    def _address(self, of: Path, name: str) -> str | None:
        """Give the address of what a report names; None for what is not in the gallery."""
        named = os.path.normpath(of.parent / unquote(name.partition("#")[0]))
        found = [item.id for item in self._items.values() if str(item.path) == named]
        return f"/api/gallery/{found[0]}" if found else None

    def _walk(self) -> Iterator[Item]:
        """Walk folder by folder, breadth first; symbolic links are not followed."""
        level, seen = [self.root], 0
        for _ in range(_DEEPEST):
            below: list[Path] = []
            for folder in sorted(level, key=_age, reverse=True):
                seen += 1
                if seen > _MOST_FOLDERS:
                    return
                files, folders = _listed(folder)
                below += folders
                tables = any(file.suffix == ".csv" for file in files)
                for file in files:
                    kind = _kind(file)
                    if kind is not None and (kind != "report" or tables):  # beside no table it is prose
                        path = file.relative_to(self.root)
                        yield Item(hashlib.sha256(os.fsencode(path)).hexdigest()[:16], kind, path)
            level = below


def _listed(folder: Path) -> tuple[list[Path], list[Path]]:
    """List files and folders; nothing hidden, no links, and none of what others keep."""
    files, folders = [], []
    try:
        with os.scandir(folder) as entries:
            for entry in sorted(entries, key=lambda entry: entry.name):
                if entry.name.startswith(".") or entry.is_symlink():
                    continue
                if entry.is_dir():
                    folders += [] if entry.name in _SKIPPED else [Path(entry.path)]
                elif entry.is_file():
                    files.append(Path(entry.path))
    except OSError:
        return [], []
    return files, folders


def _age(folder: Path) -> float:
    try:
        return folder.stat().st_mtime
    except OSError:
        return 0.0


def _kind(file: Path) -> Kind | None:
    if file.name in _TABLES:
        return "table"
    if file.suffix == ".json":
        return "stacks" if file.name == "stacks.json" or file.parent.name == "stacks" else None
    return _KINDS.get(file.suffix)


def _rows(path: Path) -> list[list[str]]:
    """Read a table: a CSV, or the names and values of a JSON."""
    if path.suffix == ".csv":
        rows = list(csv.reader(read_text(path).splitlines()))
        return [row[:20] for row in [*rows[:1], *rows[1:][-_MOST_ROWS:]]]
    content = read_json(path)
    return [["name", "value"], *([name, _short(value)] for name, value in list(_flat(content, ""))[:_MOST_ROWS])]


def _flat(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(inner, f"{name}.{key}" if name else str(key))
    else:
        yield name, value


def _short(value: Any) -> str:
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 120 else f"{text[:117]}..."
