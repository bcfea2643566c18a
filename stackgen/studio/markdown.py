"""A report in Markdown as a page: without scripts, and with links to nothing but what the gallery lists."""

from __future__ import annotations

from collections.abc import Callable
from html import escape

from markdown_it import MarkdownIt

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark"><title>{title}</title>
<link rel="icon" href="data:,"><link rel="stylesheet" href="/studio.css"></head>
<body class="reference">{body}</body></html>
"""


def markdown_page(text: str, title: str, address_of: Callable[[str], str | None]) -> str:
    """Make the page.

    Args:
        text: The Markdown; HTML in it is shown as text.
        title: Title of the page.
        address_of: Gives the address of what a link or a picture names; None for what is not there.

    >>> "<p>&lt;b&gt; <a>x</a></p>" in markdown_page("<b> [x](y)", "t", lambda name: None)
    True
    """
    reader = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = reader.parse(text)
    for part in (child for token in tokens for child in token.children or []):
        for name in {"href", "src"} & part.attrs.keys():
            address = address_of(str(part.attrs.pop(name)))
            if address is not None:
                part.attrs[name] = address
    return _PAGE.format(title=escape(title), body=reader.renderer.render(tokens, reader.options, {}))
