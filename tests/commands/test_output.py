"""One mechanism says what verbs found: to a person, to a program, or to nobody."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from rich.table import Table

from stackgen.commands.cli import VERBS, main
from stackgen.commands.completion import parsers_of
from stackgen.commands.output import Form, chosen, tell, telling, wrote
from stackgen.errors import StackgenError
from tests.conftest import Cli

STAND = Path("examples/stacks/arch.json").absolute()
FALL = Path("examples/stacks/cantilever.json").absolute()


def some(form: Form) -> None:
    """Tell a table, lines and facts."""
    with telling(form):
        table = Table("name", "value", box=None, pad_edge=False)
        table.add_row("[red]a[/]", "word " * 40)
        tell(table, "a line with [brackets]", number=1, array=np.array([1.0, np.nan]), path=Path("x"))
        tell(number=2)
        wrote(Path("a"), Path("b"))
        wrote(Path("c"))


def test_a_person_reads_tables_and_lines_that_no_pipe_wraps(capsys: pytest.CaptureFixture[str]) -> None:
    some("text")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6 and lines[1].split() == ["a", *["word"] * 40]
    assert lines[2:] == ["a line with [brackets]", "wrote a", "wrote b", "wrote c"]


def test_a_program_reads_one_object_of_json(capsys: pytest.CaptureFixture[str]) -> None:
    some("json")
    found = json.loads(capsys.readouterr().out)
    assert found == {"number": 2, "array": [1.0, None], "path": "x", "wrote": ["a", "b", "c"]}


def test_quiet_is_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    some("quiet")
    assert capsys.readouterr() == ("", "")


def test_what_fails_tells_a_program_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with suppress(ZeroDivisionError), telling("json"):
        tell(number=1 / 0)
    assert capsys.readouterr().out == ""
    with pytest.raises(StackgenError, match="give one of them"):
        chosen(True, True)


def options_of_verbs() -> Iterator[tuple[str, set[str]]]:
    """Every verb with its options."""
    for verb in VERBS:
        found = parsers_of(verb)
        for name, parser in found.items() if isinstance(found, dict) else [("", found)]:
            yield f"{verb} {name}".strip(), {text for action in parser._actions for text in action.option_strings}


def test_every_verb_that_reports_has_both_options() -> None:
    silent = {name for name, options in options_of_verbs() if not {"--json", "--quiet"} <= options}
    assert silent <= {"fit", "validate", "completion", "sample", "studio"}


@pytest.mark.parametrize(("file", "code"), [(STAND, 0), (FALL, 1)], ids=["stands", "falls"])
def test_check_says_the_same_to_all(cli: Cli, file: Path, code: int) -> None:
    told = cli("check", file, "--json")
    quiet = cli("check", file, "--quiet")
    assert (told.code, quiet.code, quiet.out) == (code, code, "")
    (stack,) = json.loads(told.out)["stacks"]
    assert stack["verdict"]["stands"] == (code == 0) and bool(stack["verdict"]["fell"]) == (code == 1)


def test_stacks_come_from_standard_input_too(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for verb, options, code in (("check", (), 1), ("show", ("--out", str(tmp_path / "a.png")), 0), ("show", (), 2)):
        with FALL.open() as stream:
            monkeypatch.setattr("sys.stdin", stream)
            assert main([verb, "-", *options]) == code
    assert (tmp_path / "a.html").is_file()
    assert "standard input has no name" in capsys.readouterr().err
