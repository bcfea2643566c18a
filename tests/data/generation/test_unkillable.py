"""Whatever is killed, whenever: started again, the run ends with the bytes of an undisturbed one."""

from __future__ import annotations

import errno
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import pytest

from stackgen.data.dataset import Dataset
from stackgen.data.generation import workshop as workshop_module
from stackgen.data.generation.generate import generate, generate_range
from stackgen.data.generation.workshop import MadeShard
from stackgen.data.manifest import SPLITS
from stackgen.errors import StackgenError
from stackgen.io import files
from tests.conftest import CHILD, workers_of
from tests.data.generation.making import SMALL, Stored, contents, copy, flip


@pytest.fixture(autouse=True)
def no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes are killed here, not the machine."""
    monkeypatch.setattr(files.os, "fsync", lambda file: None)


class Killed(BaseException):
    """The end of the process, as far as that can be had within it."""


class Fuse:
    """Stands in for what changes the disk; burns through at one of the steps.

    Args:
        step: Number of the step before which the process ends; the half-written file of a step stays there.
    """

    def __init__(self, step: int) -> None:
        self.step, self.taken = step, 0

    def before(self, leave: Path | None = None) -> None:
        if self.taken == self.step:
            if leave is not None:
                leave.with_name(f".{leave.name}.0123abcd.tmp").write_bytes(b"half")
            raise Killed
        self.taken += 1


@contextmanager
def kill_at(step: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fuse]:
    """Count renaming, unlinking and removing of folders, and end before one of them."""
    fuse, replace_, unlink, rmtree = Fuse(step), os.replace, Path.unlink, shutil.rmtree

    def counted_replace(source: Path, target: Path) -> None:
        fuse.before(Path(target))
        replace_(source, target)

    def counted_unlink(path: Path, missing_ok: bool = False) -> None:
        if path.suffix != ".tmp":
            fuse.before()
        unlink(path, missing_ok)

    def counted_rmtree(path: Path, ignore_errors: bool = False) -> None:
        fuse.before()
        rmtree(path, ignore_errors)

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "replace", counted_replace)
        patch.setattr(Path, "unlink", counted_unlink)
        patch.setattr(workshop_module.shutil, "rmtree", counted_rmtree)
        yield fuse


@pytest.mark.parametrize("draw", [0, 15])
def test_a_kill_at_any_step_changes_nothing(
    draw: int, shards: dict[int, MadeShard], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each step that changes the disk is tried in turn; the run is then taken up with others at work."""
    settings = replace(SMALL, draw=draw, exclude_testset=False)  # which takes longest, and is not asked here
    generate(settings, tmp_path / "undisturbed", executor=Stored(shards))
    wanted = contents(tmp_path / "undisturbed")
    for step in range(1000):
        out = tmp_path / str(step)
        try:
            with kill_at(step, monkeypatch):
                generate(settings, out, executor=Stored(shards, together=1 + step % 3))
        except Killed:
            generate(settings, out, executor=Stored(shards, together=1 + (step + 1) % 3))
            assert contents(out) == wanted, f"killed before step {step}"
            shutil.rmtree(out)
        else:
            break
    assert step > 2 * len(Dataset.open(tmp_path / "undisturbed").manifest.shards)


def test_a_run_that_is_killed_again_and_again_gets_there(
    small: Path, shards: dict[int, MadeShard], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, kills, out = random.Random(0), 0, tmp_path / "small"
    while True:
        try:
            with kill_at(rng.randrange(6), monkeypatch):
                generate(SMALL, out, executor=Stored(shards, together=rng.randint(1, 3)))
            break
        except Killed:
            kills += 1
    assert kills >= 3 and contents(out) == contents(small)


def test_a_shard_that_was_damaged_since_the_kill_is_made_again(
    small: Path, shards: dict[int, MadeShard], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, said = tmp_path / "small", list[str]()
    with pytest.raises(Killed), kill_at(7, monkeypatch):
        generate(SMALL, out, executor=Stored(shards))
    first, second = (out / shards[number].name for number in (0, 1))
    flip(first, 700)
    second.unlink()
    (out / "progress" / "000002.json").write_text("{")
    generate(SMALL, out, executor=Stored(shards), say=said.append)
    assert contents(out) == contents(small)
    assert [any(name in line for line in said) for name in (first.name, second.name, "000002.json")] == [True] * 3


def test_a_full_disk_is_one_line_and_nothing_is_lost(
    small: Path, shards: dict[int, MadeShard], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "small"
    left = iter(range(10))  # each file is flushed, and its folder

    def full(file: int) -> None:
        if next(left, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        with pytest.raises(StackgenError, match=r"^disk full: .*free some space and run the same command") as caught:
            generate(SMALL, out, executor=Stored(shards))
    assert "\n" not in str(caught.value)
    assert not list(out.rglob("*.tmp")) and len(list(out.glob("*.tar"))) == 2
    generate(SMALL, out, executor=Stored(shards))
    assert contents(out) == contents(small)


# Jobs that share a folder.


def test_ranges_of_shards_are_collected_by_a_run_without_one(
    small: Path, shards: dict[int, MadeShard], tmp_path: Path
) -> None:
    out, done = tmp_path / "small", list[int]()
    held = generate_range(SMALL, out, range(3, 5), Stored(shards), progress=done.append)
    assert held == shards[3].samples + shards[4].samples and done == [1, 2]
    assert not (out / "dataset.json").exists()
    assert generate_range(SMALL, out, range(0, 2), Stored(shards)) == shards[0].samples + shards[1].samples
    kept = Stored({number: shard for number, shard in shards.items() if number not in (0, 1, 3, 4)})
    generate(SMALL, out, executor=kept)  # it cannot make those that are there already
    assert contents(out) == contents(small)
    assert generate_range(SMALL, out, range(0, 2), Stored({})) == 0 and contents(out) == contents(small)


def test_ranges_of_too_many_shards_leave_nothing_behind(
    small: Path, shards: dict[int, MadeShard], tmp_path: Path
) -> None:
    generate_range(SMALL, tmp_path / "small", range(len(shards)), Stored(shards))
    generate(SMALL, tmp_path / "small", executor=Stored({}))
    assert contents(tmp_path / "small") == contents(small)


# Real processes, really killed.


@contextmanager
def job(out: Path, workers: int, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A run in a process group of its own; whatever is left of it ends with the block."""
    script = folder / "run.py"
    script.write_text(
        "from pathlib import Path; from tests.data.generation.making import SMALL\n"
        "from stackgen.data.generation.generate import generate\n"
        f"if __name__ == '__main__': generate(SMALL, Path({str(out)!r}), workers={workers})\n"
    )
    process = subprocess.Popen([sys.executable, str(script)], env=CHILD, start_new_session=True)
    try:
        yield process
    finally:
        for pid in [process.pid, *workers_of(process.pid)]:
            kill(pid)
        process.wait()


def kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def wait_for(process: subprocess.Popen[bytes], out: Path) -> None:
    """Until the first shard is there."""
    while not list(out.glob("*.tar")):
        assert process.poll() is None
        time.sleep(0.02)


@pytest.mark.slow
def test_a_run_without_its_parent_ends_and_goes_on_to_the_same_bytes(
    small: Path, shards: dict[int, MadeShard], tmp_path: Path
) -> None:
    out = tmp_path / "killed"
    with job(out, 2, tmp_path) as process:
        wait_for(process, out)
        kill(process.pid)
        process.wait()
        assert not (out / "dataset.json").exists() and list(out.glob("*.tar"))
        deadline = time.monotonic() + 60
        while workers_of(process.pid):  # they end on their own when nobody is left to work for
            assert time.monotonic() < deadline
            time.sleep(0.1)
    generate(SMALL, out, executor=Stored(shards))
    assert contents(out) == contents(small)


@pytest.mark.slow
def test_a_run_that_is_killed_with_all_its_workers_goes_on_to_the_same_bytes(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "killed"
    with job(out, 1, tmp_path) as process:
        wait_for(process, out)
        for pid in [*workers_of(process.pid), process.pid]:
            kill(pid)
    generate(SMALL, out, workers=3)
    assert contents(out) == contents(small)


@pytest.mark.slow
def test_a_run_survives_the_death_of_a_worker(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "killed"
    with job(out, 2, tmp_path) as process:
        while len(workers_of(process.pid)) < 2:
            assert process.poll() is None
            time.sleep(0.1)
        kill(workers_of(process.pid)[0])
        assert process.wait() == 0
    assert contents(out) == contents(small)


def test_a_complete_dataset_is_left_alone(small: Path, tmp_path: Path) -> None:
    out = copy(small, tmp_path / "copy")
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    manifest = generate(SMALL, out, executor=Stored({}))
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before
    assert sum(manifest.count(split) for split in SPLITS) == 45
