"""One HTML page that shows stacks in 3-D: the studio's own, with stacks in it instead of a server behind it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from html import escape
from importlib.resources import files
from pathlib import Path

from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.viz.scene import scene

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'unsafe-inline'; style-src \
'unsafe-inline'; img-src data: blob:">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
<script type="application/json" id="stacks">{data}</script>
<script type="module">
{script}</script>
</body>
</html>
"""
_FRAME = "width: 100%; height: 420px; border: 1px solid #d5d9e1; border-radius: 8px"


def write_html(
    path: str | Path, stacks: Sequence[Stack], verdicts: Sequence[Verdict | None] | None = None, title: str = "Stacks"
) -> None:
    """Write one page that shows the stacks in 3-D: turn, zoom, choose a stack, let it settle.

    The page asks for nothing from outside and runs in any browser with WebGL.

    Args:
        path: File to write.
        stacks: Stacks to choose from, all of one catalogue.
        verdicts: Verdict on each stack, or None where there is none; it shows where the blocks ended and which fell.
        title: Title of the page.

    Raises:
        StackgenError: If it cannot be written.
    """
    write_atomically(path, html_page(stacks, verdicts, title).encode())


def html_page(stacks: Sequence[Stack], verdicts: Sequence[Verdict | None] | None = None, title: str = "Stacks") -> str:
    """Make the content of :func:`write_html`'s file."""
    known = verdicts or [None] * len(stacks)
    if not stacks or len(known) != len(stacks) or any(s.catalogue != stacks[0].catalogue for s in stacks):
        raise StackgenError("a page needs at least one stack, all of one catalogue, and as many verdicts as stacks")
    data = {"title": title, **scene(stacks, known)}
    safe = json.dumps(data, allow_nan=False).replace("<", "\\u003c")  # nothing in it can end the script
    return _PAGE.format(title=escape(title), style=_asset("studio.css"), data=safe, script=_asset("studio.js"))


@cache
def _asset(name: str) -> str:
    return files("stackgen").joinpath("assets/studio", name).read_text(encoding="utf-8")


def notebook_html(
    stacks: Sequence[Stack], verdicts: Sequence[Verdict | None] | None = None, title: str = "Stack"
) -> str:
    """Make a frame for a notebook that holds the page of some stacks; a sentence where there are none."""
    if not stacks:
        return "<p>There are no stacks.</p>"
    page = escape(html_page(stacks, verdicts, title), quote=True)
    return f'<iframe srcdoc="{page}" title="{escape(title)}" sandbox="allow-scripts" style="{_FRAME}"></iframe>'
