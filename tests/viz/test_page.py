"""The page of stacks holds them all and asks for nothing from outside."""

from __future__ import annotations

import json
import re
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.io.stacks_file import StackEntry, StacksFile
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.viz.page import html_page, write_html
from stackgen.world import PAPER_CATALOGUE, PAPER_WORLD, Catalogue, Shape

STACK = Stack(np.array([3, 0, 2, 0, 1]), np.random.default_rng(0).normal(size=(5, 6)))
FALLS = Verdict(False, np.arange(5) == 1, np.linspace(0, 1, 5), STACK.with_poses(STACK.poses + 1))


def page_data(page: str) -> dict:
    found = re.search(r'^<script type="application/json" id="stacks">(.*)</script>$', page, re.MULTILINE)
    assert found
    return json.loads(found.group(1))


def test_the_page_asks_for_nothing_from_outside(tmp_path: Path) -> None:
    write_html(tmp_path / "a.html", [STACK, STACK], [FALLS, None], "two")
    page = (tmp_path / "a.html").read_text()
    assert "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:\"" in page
    parts = re.sub(r"<(style|script)\b[^>]*>.*?</\1>", "", page, flags=re.DOTALL)
    assert not re.search(r"src=|href=|<script", parts)


def test_the_page_holds_the_stacks_their_verdicts_and_where_the_blocks_ended() -> None:
    data = page_data(html_page([STACK, STACK], [FALLS, None], "two"))
    with_verdict, plain = data["stacks"]
    assert data["title"] == "two"
    assert [s["name"] for s in data["shapes"]] == list(PAPER_CATALOGUE.names)
    assert with_verdict["shapes"] == STACK.shapes.tolist()
    assert with_verdict["fell"] == [1]
    assert with_verdict["stable"] is False
    assert np.array(with_verdict["sampled"])[:, :3] == pytest.approx(STACK.poses[:, :3], abs=1e-5)
    assert np.array(with_verdict["settled"])[:, :3] == pytest.approx(STACK.poses[:, :3] + 1, abs=1e-5)
    assert "stable" not in plain
    assert "settled" not in plain


def test_the_pages_edges_are_the_prisms_edges() -> None:
    for shape in page_data(html_page([STACK]))["shapes"]:
        size = np.array(PAPER_CATALOGUE[PAPER_CATALOGUE.index(shape["name"])].size)
        points = np.array(shape["points"])
        lengths = [np.linalg.norm(points[a] - points[b]) for a, b in shape["edges"]]
        n = len(lengths) // 3
        assert lengths[:n] == pytest.approx(lengths[n : 2 * n])
        assert lengths[2 * n :] == pytest.approx([size[1]] * n)


def test_a_title_cannot_break_out_of_the_page() -> None:
    title = "</script><script>alert(1)</script>"
    page = html_page([STACK], title=title)
    assert title not in page
    assert page_data(page)["title"] == title


def test_stacks_that_do_not_fit_together_are_refused() -> None:
    other = Stack(np.zeros(1, int), np.zeros((1, 6)), Catalogue((Shape.box("brick", 2),)))
    for arguments in ([], [STACK, other]):
        with pytest.raises(StackgenError, match="one catalogue"):
            html_page(arguments)


def test_stacks_and_files_show_themselves_in_notebooks() -> None:
    for shown in (STACK, StacksFile((StackEntry(STACK, FALLS),), PAPER_WORLD, silhouette='"><script>')):
        frame = re.fullmatch(r'<iframe srcdoc="([^"]*)"[^<>]*></iframe>', shown._repr_html_())
        assert frame
        assert page_data(unescape(frame.group(1)))["stacks"][0]["shapes"] == STACK.shapes.tolist()
    assert "no stacks" in StacksFile((), PAPER_WORLD)._repr_html_()
