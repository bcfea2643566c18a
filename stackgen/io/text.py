"""Text files that a person may have written or saved: how they are decoded and parsed, wherever one is read.

Numbers in YAML are those of YAML 1.2, as the command line reads them: `1e-3` is a number, `2026-01-01` is text. What
:func:`to_yaml` writes is read back by any reader of YAML as what it was.
"""

from __future__ import annotations

import codecs
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from stackgen.errors import StackgenError, printable
from stackgen.io.files import read_bytes

_MARKS = {codecs.BOM_UTF16_LE: "UTF-16", codecs.BOM_UTF16_BE: "UTF-16"}
_FLOAT = re.compile(
    r"[-+]?[0-9][0-9_]*(\.[0-9_]*([eE][-+]?[0-9]+)?|[eE][-+]?[0-9]+)|[-+]?\.[0-9][0-9_]*([eE][-+]?[0-9]+)?"
    r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
)


def read_text(path: str | Path) -> str:
    """Read a text file: UTF-8, with or without a byte order mark.

    Raises:
        StackgenError: If it is missing, no file, or text of another encoding; the line names it.
    """
    try:
        return decode_text(read_bytes(path), path)
    except FileNotFoundError:
        raise StackgenError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise StackgenError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def decode_text(content: bytes, path: str | Path) -> str:
    """Decode the bytes of a text file, which errors call `path`.

    Raises:
        StackgenError: If they are not UTF-8.
    """
    for mark, name in _MARKS.items():
        if content.startswith(mark):
            raise StackgenError(f"{path} is text in {name}; save it as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise StackgenError(f"{path} is not text in UTF-8 (line {line}); save it as UTF-8") from None


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file.

    Raises:
        StackgenError: If it cannot be read or is no YAML; the line names it and the place in it.
    """
    return parse_yaml(read_text(path), path)


def parse_yaml(text: str, path: str | Path) -> Any:
    """Parse YAML; errors call it `path`.

    Raises:
        StackgenError: If it is no YAML.
    """
    try:
        content = yaml.load(text, Loader=_Loader)
        _require_finite_size(content)
        return content
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise StackgenError(f"{path} is not YAML{where}: {error.problem or error.context}") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a number with too many digits
        raise StackgenError(f"{path} is not YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise StackgenError(f"{path} is not YAML that is read here: it is nested too deeply") from None


def read_json(path: str | Path) -> Any:
    """Read a JSON file.

    Raises:
        StackgenError: If it cannot be read or is no JSON; the line names it and the place in it.
    """
    return parse_json(read_text(path), path)


def parse_json(text: str, path: str | Path) -> Any:
    """Parse JSON; errors call it `path`.

    Raises:
        StackgenError: If it is no JSON, or has what JSON does not have: NaN, infinities, the same key twice.
    """
    try:
        return json.loads(text, parse_float=_finite, parse_constant=_finite, object_pairs_hook=_without_twins)
    except json.JSONDecodeError as error:
        end = error.pos >= len(text.rstrip()) or error.msg.startswith("Unterminated")
        where = f"line {error.lineno}, column {error.colno}: {error.msg}{'; it seems cut short' if end else ''}"
        raise StackgenError(f"{path} is not JSON at {where}") from None
    except ValueError as error:
        raise StackgenError(f"{path} is not JSON that is read here: {error}") from None
    except RecursionError:
        raise StackgenError(f"{path} is not JSON that is read here: it is nested too deeply") from None


def _finite(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"it holds {digits:.20}; every number must be finite")
    return number


def _without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twin = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"it has the key {twin!r:.60} twice in one object; keep one")
    return found


def to_yaml(content: Any) -> str:
    """Write YAML; text that a reader could take for a number, a date or a truth value is put in quotes."""
    return yaml.dump(content, Dumper=_Dumper, default_flow_style=False, allow_unicode=True, sort_keys=False)


def texts_in(content: Any) -> Iterator[str]:
    """Give every text among the values of plain data."""
    if isinstance(content, str):
        yield content
    for value in content.values() if isinstance(content, dict) else content if isinstance(content, list) else ():
        yield from texts_in(value)


def in_markdown(text: object) -> str:
    """Write text so that a reader of Markdown shows it as it is.

    >>> in_markdown("a|b <b>")
    'a&#124;b &lt;b&gt;'
    """
    special = {"&": "&amp;", "<": "&lt;", ">": "&gt;", "|": "&#124;", "`": "&#96;", "[": "&#91;", "*": "&#42;"}
    return "".join(special.get(c, c) for c in printable(text))


def in_a_plot(text: object) -> str:
    """Write text so that matplotlib draws it as it is, dollar signs too."""
    return printable(text).replace("$", r"\$")


_MOST_VALUES = 200_000
"""Values that a YAML file stands for, with its aliases written out."""


def _require_finite_size(content: Any) -> None:
    """Refuse aliases that stand for more than anybody would write.

    Raises:
        yaml.YAMLError: If they do.
    """
    sizes: dict[int, float] = {}

    def size(value: Any) -> float:
        if not isinstance(value, dict | list):
            return 1
        if id(value) not in sizes:
            sizes[id(value)] = float("inf")  # what holds itself has no end
            inner = [*value.keys(), *value.values()] if isinstance(value, dict) else value
            sizes[id(value)] = 1 + sum(map(size, inner))
        return sizes[id(value)]

    if size(content) > _MOST_VALUES:
        raise yaml.YAMLError(f"its aliases stand for more than {_MOST_VALUES} values")


class _Loader(yaml.SafeLoader):
    """YAML 1.1 as PyYAML reads it, with the numbers of YAML 1.2 and without dates."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merge what `<<` names, as long as it stays a mapping that somebody could have written."""
        super().flatten_mapping(node)
        if len(node.value) > _MOST_VALUES // 20:
            raise yaml.YAMLError("what its `<<` merge is too large")


class _Dumper(yaml.SafeDumper):
    """Writes text in quotes if any version of YAML would not read it as text."""

    def represent_text(self, data: str) -> yaml.ScalarNode:
        """Write text; what is not printable stands in quotes, escaped: YAML takes some of it for the end of a line."""
        plain = all(c.isprintable() or c == "\n" for c in data)
        return self.represent_scalar("tag:yaml.org,2002:str", data, style=None if plain else '"')

    def ignore_aliases(self, data: Any) -> bool:
        """Write everything out, for people."""
        return True


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in those if tag.rpartition(":")[2] not in ("timestamp", "float")]
    for first, those in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _kind in (_Loader, _Dumper):
    # After those that are there: a whole number stays one.
    _kind.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(f"(?:{_FLOAT.pattern})$"), [*"-+.0123456789"])
_Dumper.add_representer(str, _Dumper.represent_text)
