"""Text is read in one encoding, refused in others by name, and written so that every reader of YAML reads it back."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from jsonargparse import get_loader

from stackgen.errors import StackgenError
from stackgen.io.text import parse_json, parse_yaml, read_json, read_text, read_yaml, to_yaml

LIKE_NUMBERS = st.from_regex(r"[-+]?[0-9_.:xobeEinfaN+-]{1,8}", fullmatch=True)
LIKE_WORDS = st.sampled_from(
    ["77950e8", "0777", "08", "12:30", "190:20:30.15", "2026-01-01", "yes", "no", "y", "n", "On", "off", "null", "~",
     "", "True", ".nan", "-.inf", "1.", "=", "<<", "- a", "a: b", "a #b", "# x", " x", "x ", "{a}", "[a", "*a", "!a",
     "%a", "@a", "|", ">", "a\nb", "bücher", "\u2028", "\x07", "'q'", '"q"', "1,000", "0b101", "1__0", "685_230.15"]
)  # fmt: skip


@given(st.one_of(LIKE_NUMBERS, LIKE_WORDS, st.text(max_size=20)))
def test_what_is_written_as_yaml_is_read_back_whatever_it_is(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        return  # half of a pair, no text
    content = {"name": text, "list": [text, 1, 1.5, None, True], text or "key": {"x": text}}
    written = to_yaml(content)
    assert parse_yaml(written, "x") == content
    assert yaml.safe_load(written) == content
    assert get_loader("yaml")(written) == content


@given(st.one_of(st.integers(), st.floats(allow_nan=False), st.booleans(), st.none(), st.text(max_size=5)))
def test_values_are_read_back_with_their_types(value: object) -> None:
    try:
        found = parse_yaml(to_yaml([value]), "x")[0]
    except UnicodeEncodeError:
        return
    assert found == value and type(found) is type(value)


@given(st.from_regex(r"[-+]?[0-9][0-9_.xob]{0,4}([eE][-+]?[0-9]{1,3})?", fullmatch=True))
def test_numbers_are_those_that_the_command_line_reads(text: str) -> None:
    assert repr(parse_yaml(f"a: {text}", "x")) == repr(get_loader("yaml")(f"a: {text}"))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_utf_8_is_read_with_and_without_a_mark(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes("name: bücher\r\n".encode(encoding))
    assert read_text(path) == "name: bücher\r\n"
    assert read_yaml(path) == {"name": "bücher"}


@pytest.mark.parametrize(
    ("encoding", "word"),
    [("utf-16", "is text in UTF-16"), ("utf-16-be", "UTF-8"), ("latin-1", r"is not text in UTF-8 \(line 2\)")],
)
@pytest.mark.parametrize("read", [read_text, read_yaml, read_json])
def test_other_encodings_are_named(encoding: str, word: str, read: object, tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes("a: 1\nname: bücher\n".encode(encoding))
    with pytest.raises(StackgenError, match=rf"x\.yaml {word}.*save it as UTF-8" if "is" in word else "UTF-8|NUL|x"):
        read(path)  # type: ignore[operator]


NO_YAML = [
    "a: [1", "a: b: c", "\x07", "- a\nb: c", "!!float x", "{" * 5000, "a: &a *b", "1: {[]: 2}",
    "a: !!python/object:os.system x", f"a: {'9' * 5000}", "? {a: b}\n: c",
]  # fmt: skip


@pytest.mark.parametrize("text", NO_YAML)
def test_what_is_no_yaml_is_one_line(text: str) -> None:
    with pytest.raises(StackgenError, match=r"^file\.yaml is not YAML") as caught:
        parse_yaml(text, "file.yaml")
    assert "\n" not in str(caught.value)


NO_JSON = ["", "{", "[1,]", "{'a': 1}", "[" * 100_000, "9" * 5000, "nul", "[NaN]", "[1e999]", '{"a": 1, "a": 1}']


@pytest.mark.parametrize("text", NO_JSON)
def test_what_is_no_json_is_one_line(text: str) -> None:
    with pytest.raises(StackgenError, match=r"^file\.json is not JSON") as caught:
        parse_json(text, "file.json")
    assert "\n" not in str(caught.value)


def test_what_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    for path, why in ((tmp_path / "gone", "no such file"), (tmp_path, "Is a directory"), (tmp_path / "a\0b", "null")):
        with pytest.raises(StackgenError, match=why):
            read_text(path)
