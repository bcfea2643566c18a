"""The pages of docs/ are true where a machine can tell: their Python prints what they say, their commands parse."""

from __future__ import annotations

import ast
import contextlib
import importlib
import io
import re
import shlex
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import pytest

from tests.conftest import Cli

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
FENCED = re.compile(r"^```(\w+)\n(.*?)^```\n", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Snippet:
    """A Python block, and what the page says that it prints."""

    code: str
    output: str | None


def snippets(text: str) -> list[Snippet]:
    """The Python blocks of a page, each with the text block right below it."""
    blocks = list(FENCED.finditer(text))
    found = []
    for block, after in zip_longest(blocks, blocks[1:]):
        if block[1] == "python":
            shows = after is not None and after[1] == "text" and not text[block.end() : after.start()].strip()
            found.append(Snippet(block[2], after[2] if after is not None and shows else None))
    return found


def commands(text: str) -> list[str]:
    """The command lines of a page."""
    text = "\n".join(block[2] for block in FENCED.finditer(text) if block[1] == "bash")
    lines = text.replace("\\\n", " ").splitlines()
    return [line.split("  #")[0].strip() for line in lines if line.strip() and not line.startswith("#")]


WITH_CODE = [page for page in PAGES if snippets(page.read_text())]


def test_a_snippet_is_known_with_its_output() -> None:
    text = "a\n```python\nx = 1\n```\nb\n```python\nprint(x)\n```\n\n```text\n1\n```\n"
    assert snippets(text) == [Snippet("x = 1\n", None), Snippet("print(x)\n", "1\n")]


@pytest.mark.parametrize("page", WITH_CODE, ids=lambda page: page.stem)
def test_the_python_of_a_page_prints_what_the_page_says(
    page: Path, monkeypatch: pytest.MonkeyPatch, no_new_metrics: None
) -> None:
    monkeypatch.chdir(ROOT)
    if page.stem == "robot":
        pytest.importorskip("pybullet", reason="the simulated arm needs it")
    names: dict[str, object] = {}
    for snippet in snippets(page.read_text()):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(snippet.code, str(page), "exec"), names)
        assert printed.getvalue() == (snippet.output or "")


def test_a_shard_is_read_with_webdataset_and_numpy_alone() -> None:
    first = snippets((DOCS / "data.md").read_text())[0].code
    modules = {
        alias.name for node in ast.walk(ast.parse(first)) if isinstance(node, ast.Import) for alias in node.names
    }
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(ast.parse(first)))
    assert modules == {"io", "json", "numpy", "webdataset"}


@pytest.mark.parametrize("line", [line for page in PAGES for line in commands(page.read_text())])
def test_the_commands_of_a_page_parse(
    line: str, cli: Cli, no_new_metrics: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    words = shlex.split(line)
    if words[:2] == ["python", "-m"] and words[2].startswith("benchmarks."):
        module = importlib.import_module(words[2])
        main = importlib.import_module(f"{words[2]}.__main__") if hasattr(module, "__path__") else module
        main.parser().parse_args(words[3:])
        return
    assert words[0] == "stackgen", line
    answer = cli(*words[1:], "--print_config")  # parses everything, runs nothing
    assert answer.code == 0, answer.err


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_the_links_of_a_page_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


def test_every_page_is_in_the_index() -> None:
    index = (DOCS / "README.md").read_text()
    assert [page.name for page in DOCS.glob("*.md") if page.name != "README.md" and f"({page.name})" not in index] == []
