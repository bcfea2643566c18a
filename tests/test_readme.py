"""What the README and the helps show can be typed: verbs, options, files and targets exist."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
from pathlib import Path

import pytest
import yaml

import stackgen
from stackgen.commands.cli import VERBS
from tests.conftest import Cli

ROOT = Path(__file__).parents[1]


def blocks(language: str) -> list[str]:
    """The README's fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Command lines of the README, continued lines joined, comments cut."""
    lines = "\n".join(blocks("bash")).replace("\\\n", " ").splitlines()
    return [line.split("  #")[0].strip() for line in lines if line.strip() and not line.startswith("#")]


def examples() -> list[str]:
    """Command lines of the helps."""
    found: list[str] = []
    for module in sorted({verb.module for verb in VERBS.values()}):
        content = importlib.import_module(module)
        texts = [content.COMMAND.example] if hasattr(content, "COMMAND") else list(content.EXAMPLES.values())
        found += [line.strip() for text in texts for line in text.strip().splitlines()]
    return found


def test_the_first_screen_shows_the_two_commands() -> None:
    first_screen = "\n".join((ROOT / "README.md").read_text().splitlines()[:25])
    assert "make demo" in first_screen and "make test" in first_screen


def test_every_target_of_make_exists() -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    asked = [line.split()[1] for line in commands() if line.startswith("make ")]
    assert asked and set(asked) <= set(targets)


def test_ci_runs_the_tests() -> None:
    assert "make test" in (ROOT / ".ci" / "run").read_text()


@pytest.mark.parametrize("line", [line for line in commands() + examples() if line.startswith("stackgen ")])
def test_every_command_line_parses(line: str, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    _, verb, *arguments = shlex.split(re.split(" [<>] ", line)[0])
    assert verb in VERBS
    for argument in arguments:
        if argument.startswith(("configs/", "examples/")):
            assert Path(argument).exists(), f"{line}: there is no {argument}"
    answer = cli(verb, *arguments, "--print_config")  # parses everything, runs nothing
    assert answer.code == 0, answer.err


CONFIGS = sorted((ROOT / "configs").rglob("*.yaml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_config_parses(path: Path, cli: Cli) -> None:
    """Those of a folder with its verb; those with a section for each verb with all of these."""
    content = yaml.safe_load(path.read_text()) or {}
    sections = [verb for verb in VERBS if isinstance(content.get(verb), dict)]
    verbs = {"generate": ["generate"], "model": ["fit"]}.get(path.parent.name, sections)
    if path.parent.parent.name == "worlds":
        verbs = ["generate" if path.stem == "generate" else "fit"]
    for verb in verbs:
        # What a command line must add to the file; what the file has already may be given twice.
        more = {"fit": ["--data.path", "x"], "generate": ["--out", "x"], "sample": ["a.png", "--out", "x"]}
        answer = cli(verb, "--config", path, *more.get(verb, []), "--print_config")
        assert answer.code == 0, answer.err


def test_a_wrong_option_would_be_noticed(cli: Cli) -> None:
    assert cli("sample", "a.png", "--out", "x", "--wrong", 1, "--print_config").code == 2
    assert cli("fit", "--data.wrong", 1, "--print_config").code == 2


@pytest.mark.parametrize("code", blocks("python"))
def test_python_blocks_use_names_that_exist(code: str) -> None:
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            owner = {"stackgen": stackgen, "model": stackgen.Model}.get(node.value.id)
            assert owner is None or hasattr(owner, node.attr), ast.unparse(node)
