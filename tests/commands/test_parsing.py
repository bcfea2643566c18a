"""Configuration files: one encoding, typed options count wherever they stand, and what is saved is read back."""

from __future__ import annotations

from pathlib import Path

import pytest

from stackgen.commands import test as test_verb
from stackgen.commands.cli import VERBS
from stackgen.commands.fit import parser_of
from stackgen.commands.generate import COMMAND as GENERATE
from stackgen.commands.parsing import own_sections, parse
from tests.conftest import Cli

VERBS_WITH_FILES = [verb for verb in VERBS if verb not in ("completion", "dataset")]


@pytest.mark.parametrize("verb", VERBS_WITH_FILES)
def test_a_configuration_in_utf_16_is_one_line(verb: str, cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes("name: bücher\n".encode("utf-16"))
    answer = cli(verb, "--config", path)
    assert answer.code == 2 and "x.yaml is text in UTF-16; save it as UTF-8" in answer.line


@pytest.mark.parametrize("verb", ["generate", "fit"])
@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("# für\n".encode("latin-1"), "is not text in UTF-8 (line 1); save it as UTF-8"),
        (b"", "holds no options"),
        (b"- a\n", "holds no options"),
        (b"a: [1\n", "is not YAML at line 2, column 1"),
        (b"a: " + b"[" * 5000, "is nested too deeply"),
    ],
    ids=["latin-1", "empty", "list", "cut", "deep"],
)
def test_a_file_that_is_no_configuration_is_one_line(
    verb: str, content: bytes, word: str, cli: Cli, tmp_path: Path
) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(content)
    answer = cli(verb, "--config", path)
    assert answer.code == 2 and "x.yaml" in answer.line and word in answer.line


def test_a_byte_order_mark_and_letters_of_other_languages_are_read(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes("name: bücher\nstacks: 4\n".encode("utf-8-sig"))
    values = parse(GENERATE.parser(), "generate", own_sections("generate", ["--config", str(path), "--out", "x"]))
    assert values.name == "bücher" and values.stacks == 4


@pytest.mark.parametrize(
    "arguments",
    [
        ["--seed", "5", "--config", "FILE", "--out", "x"],
        ["--config", "FILE", "--out", "x", "--seed", "5"],
        ["--seed=5", "--out", "x", "--config=FILE"],
        ["--out", "x", "-c", "FILE", "--seed=5"],
        ["--seed=5", "--out", "x", "-c", "OTHER", "-c", "FILE"],
    ],
)
def test_what_was_typed_counts_wherever_it_stands(arguments: list[str], tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("name: a\nseed: 3\nstacks: 4\n")
    (tmp_path / "other.yaml").write_text("name: b\nseed: 4\nstacks: 7\n")
    names = {"FILE": str(tmp_path / "x.yaml"), "OTHER": str(tmp_path / "other.yaml")}
    for name, path in names.items():
        arguments = [argument.replace(name, path) for argument in arguments]
    values = parse(GENERATE.parser(), "generate", own_sections("generate", arguments))
    assert values.seed == 5 and values.name == "a" and values.stacks == 4


WORDS = [
    "77950e8",
    "1e3",
    "0777",
    "12:30",
    "2026-01-01",
    "yes",
    "null",
    "~",
    "1_0",
    ".5",
    "08",
    "0x1f",
    "nan",
    "bücher",
]


@pytest.mark.parametrize("word", WORDS)
def test_saved_options_are_read_back_whatever_they_are(word: str) -> None:
    parser = test_verb.COMMAND.parser()
    values = parse(parser, "test", ["--name", word, "--method", f"a {word}"])
    assert values.name == word
    again = parse(parser, "test", ["--config", parser.dump(values, skip_unset=False)])
    assert again.name == word and again.method == f"a {word}"


def test_a_saved_run_is_read_back_whatever_its_name_is() -> None:
    parser, needed = parser_of("fit"), ["--model=stackgen.models.BlockListCNN", "--data.path=77950e8"]
    for word in WORDS[:3]:
        text = parser.dump(parse(parser, "fit", [f"--name={word}", *needed]), skip_validation=True)
        again = parse(parser, "fit", ["--config", text])
        assert again.name == word and again.data.path == "77950e8"


@pytest.mark.parametrize("value", ["._", "9" * 5000, "1e999", "{" * 3000, "!!float x", "\x07"])
def test_a_value_that_is_none_is_one_line(value: str, cli: Cli) -> None:
    answer = cli("generate", "--name", "x", "--out", "x", "--seed", value)
    assert answer.code == 2 and "seed" in answer.line


def test_an_option_is_named_as_it_is_typed(cli: Cli) -> None:
    answer = cli("sample", "arch.png", "--as", "sketch")
    assert answer.code == 2 and answer.err.startswith("stackgen sample: as: ") and "'photo'" in answer.err
