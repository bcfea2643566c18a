"""What is read is bounded in size and time: bombs, promises without content, pipes that nobody writes to."""

from __future__ import annotations

import io
import os
import time
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from stackgen.commands.parsing import _read_files_as
from stackgen.data.shards import read_shard
from stackgen.errors import StackgenError, printable
from stackgen.io.arrays import read_npy, read_npz
from stackgen.io.files import held
from stackgen.io.stacks_file import read_stacks
from stackgen.io.terminal import Screen
from stackgen.io.text import parse_json, parse_yaml, read_text
from stackgen.models.transformer import TransformerConfig
from stackgen.world import Grid

LAUGHS = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
MERGES = "a0: &a0 {x0: 1}\n" + "".join(
    f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}], x{i}: 1}}\n" for i in range(1, 12)
)


@pytest.mark.parametrize("bomb", [LAUGHS, MERGES, "a: &a [*a]", "[" * 100_000, "{a: " * 5_000, "a: " + "9" * 10_000])
def test_a_bomb_is_one_line_at_once(bomb: str) -> None:
    begin = time.process_time()
    with pytest.raises(StackgenError, match="not YAML") as refused:
        parse_yaml(bomb, "it")
    assert "\n" not in str(refused.value) and time.process_time() - begin < 5


def test_the_command_line_s_reader_knows_bombs_too() -> None:
    from jsonargparse import get_loader

    for mode in ("yaml", "omegaconf+"):
        _read_files_as(mode)
        with pytest.raises(ValueError, match="aliases"):
            get_loader(mode)(LAUGHS)


def test_aliases_that_people_write_are_read() -> None:
    assert parse_yaml("a: &a {x: 1}\nb: {<<: *a, y: 2}\nc: [*a, *a]", "it") == {
        "a": {"x": 1},
        "b": {"x": 1, "y": 2},
        "c": [{"x": 1}, {"x": 1}],
    }


def test_nested_json_is_one_line() -> None:
    for text in ("[" * 100_000, '{"a":' * 100_000, "1" * 10_000):
        with pytest.raises(StackgenError, match="not JSON"):
            parse_json(text, "it")


def npy(array: object) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(array), allow_pickle=True)
    return buffer.getvalue()


def test_a_header_that_promises_what_is_not_there_makes_no_room() -> None:
    good = npy(np.arange(6.0))
    np.testing.assert_array_equal(read_npy(good), np.arange(6.0))
    for bad in (good.replace(b"(6,)", b"(10000000000000,)"), good[:-1], good + b"x", npy([{}]), b"", good[:20]):
        with pytest.raises(ValueError):  # noqa: PT011 - numpy's own words differ
            read_npy(bad)
    packed = io.BytesIO()
    np.savez_compressed(packed, a=np.arange(3), b=np.array("text"))
    found = read_npz(packed.getvalue())
    assert found["a"].tolist() == [0, 1, 2] and str(found["b"]) == "text"


def test_what_is_packed_beyond_belief_is_not_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stackgen.io.arrays._LARGE", 2**20)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", npy(np.zeros(2**20)))
    with pytest.raises(ValueError, match="are packed into"):
        read_npz(packed.getvalue())


def test_packed_arrays_with_a_changed_byte_are_refused_or_as_they_were() -> None:
    np.savez_compressed(packed := io.BytesIO(), a=np.arange(9))
    content = packed.getvalue()
    for place in range(len(content)):
        with suppress(ValueError):
            found = read_npz(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
            assert [array.tolist() for array in found.values()] in ([], [list(range(9))])


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "train-000000.tar"
    os.mkfifo(path)
    for read in (read_text, read_stacks, lambda path: list(read_shard(path))):
        with pytest.raises(StackgenError, match="no regular file"):
            read(path)
    for read in (read_text, read_stacks):
        with pytest.raises(StackgenError, match=r"[Ii]s a (folder|directory)"):
            read(tmp_path)


@pytest.mark.parametrize("layers", [10**17, -1, 1001])
def test_numbers_beyond_belief_are_refused(layers: int) -> None:
    with pytest.raises(StackgenError, match="layers"):
        TransformerConfig(layers=layers)
    with pytest.raises(StackgenError, match="grid"):
        Grid(width=10**9)


def test_a_folder_is_held_by_one_or_shared_by_many(tmp_path: Path) -> None:
    with held(tmp_path), pytest.raises(StackgenError, match="another command"), held(tmp_path, shared=True):
        pass
    shared = held(tmp_path, shared=True)
    with shared, held(tmp_path, shared=True), pytest.raises(StackgenError, match="another command"), held(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_control_characters_are_shown_and_not_obeyed() -> None:
    from rich.table import Table

    assert printable("a\x1b[2J\r\n\x9b\u202e") == "a\\x1b[2J\\r\\n\\x9b\\u202e"
    table = Table("\x1b]0;title\x07")
    table.add_row("a\x1b[2J")
    out = io.StringIO()
    screen = Screen(file=out, width=80)
    screen.print("b\x1b[2J\nc", table)
    assert "\x1b" not in out.getvalue() and "b\\x1b[2J\nc" in out.getvalue() and "a\\x1b[2J" in out.getvalue()
