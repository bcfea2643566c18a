"""What verbs tell: tables and lines for a person, one JSON object for a program (--json), or nothing (--quiet)."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Literal

from stackgen.errors import StackgenError

Form = Literal["text", "json", "quiet"]
FORMS = {
    "json": "Print one JSON object with what was found, instead of tables and lines.",
    "quiet": "Print nothing but errors; the exit code says it all.",
}
"""The options that choose a form, with their help."""

_WIDE = 1 << 16
"""Width of output that no person looks at: nothing is wrapped or cut [column]."""

_form: ContextVar[Form] = ContextVar("_form", default="text")
_facts: ContextVar[dict[str, Any] | None] = ContextVar("_facts", default=None)


@contextmanager
def telling(form: Form) -> Iterator[None]:
    """Have everything inside told in one form; what is told to a program comes out at the end, if all went well."""
    facts: dict[str, Any] = {}
    before = _form.set(form), _facts.set(facts)
    try:
        yield
        if form == "json":
            sys.stdout.write(json.dumps(_plain(facts), indent=1, allow_nan=False) + "\n")
    finally:
        _form.reset(before[0])
        _facts.reset(before[1])


def chosen(as_json: bool, quiet: bool) -> Form:
    """Name the form that the options ask for.

    Raises:
        StackgenError: If they ask for two.
    """
    if as_json and quiet:
        raise StackgenError("--json prints and --quiet does not: give one of them")
    return "json" if as_json else "quiet" if quiet else "text"


def is_quiet() -> bool:
    """Tell whether nothing is to be seen, not even how far the work is."""
    return _form.get() == "quiet"


def tell(*shown: Any, style: str | None = None, **facts: Any) -> None:
    """Tell what was found.

    Args:
        shown: Tables, texts and lines for a person; brackets are markup in tables alone.
        style: Style of the lines, such as `red`.
        facts: What a program is given; later facts of the same name take the place of earlier ones.
    """
    known = _facts.get()
    if known is not None:
        known.update(facts)
    if _form.get() != "text" or not shown:
        return
    from stackgen.io.terminal import Screen

    console = Screen(width=None if sys.stdout.isatty() else _WIDE)
    for item in shown:
        line = isinstance(item, str)
        console.print(item, style=style, markup=not line, highlight=False, soft_wrap=line)


def wrote(*paths: Path) -> None:
    """Tell which files or folders were written."""
    known = _facts.get() or {}
    tell(*(f"wrote {path}" for path in paths), wrote=[*known.get("wrote", []), *map(str, paths)])


def _plain(value: Any) -> Any:
    """Turn a value into what JSON has; numbers that are not finite become null."""
    if hasattr(value, "tolist"):  # numpy's
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
