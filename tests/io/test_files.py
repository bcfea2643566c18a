"""Files appear whole or not at all."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path

import pytest

from stackgen.errors import StackgenError
from stackgen.io.files import is_endless, require_folder, staged, write_json


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_staged_files_appear_together_and_take_the_place_of_an_earlier_result(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "out"
    for count in (3, 1):
        with staged(folder, replaces="part-*") as stage:
            for number in range(count):
                (stage / f"part-{number}").write_text(str(count))
        assert names(folder) == [f"part-{number}" for number in range(count)]
    assert (folder / "part-0").read_text() == "1"


def interrupted(folder: Path) -> None:
    with staged(folder, replaces="*.txt") as stage:
        (stage / "b.txt").touch()
        raise KeyboardInterrupt


def test_a_block_that_fails_leaves_the_earlier_result_or_no_folder(tmp_path: Path) -> None:
    old = tmp_path / "old"
    with staged(old, replaces="*.txt") as stage:
        (stage / "a.txt").touch()
    for folder, left in ((old, ["a.txt"]), (tmp_path / "new", None)):
        with pytest.raises(KeyboardInterrupt):
            interrupted(folder)
        assert (names(folder) if folder.exists() else None) == left


def test_json_is_written_with_numbers_that_every_reader_knows(tmp_path: Path) -> None:
    write_json(tmp_path / "a" / "b.json", {"x": [1.5, None]})
    assert json.loads((tmp_path / "a" / "b.json").read_text()) == {"x": [1.5, None]}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a" / "b.json", float("nan"))
    assert names(tmp_path / "a") == ["b.json"]


def test_a_file_in_the_place_of_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StackgenError, match=r"--out x: .*file is not a folder"):
        require_folder(tmp_path / "file" / "below", "--out x")


def test_a_device_is_written_to_and_not_replaced() -> None:
    write_json("/dev/null", 1)
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_pipes_are_told_from_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").touch()
    assert is_endless(str(tmp_path / "pipe")) and is_endless("/dev/zero")
    assert not any(
        map(is_endless, (str(tmp_path / "file"), str(tmp_path), "gone", "/dev/stdin", "/dev/null", "a\0b", ""))
    )
