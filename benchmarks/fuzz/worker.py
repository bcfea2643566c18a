"""One input at a time, in a process with a limit of time and memory."""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import random
import resource
import shutil
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

from benchmarks.fuzz.kinds import KINDS

SECONDS, PATIENCE = 20.0, 600.0
"""Processor time that an input may take, and time in all, about [s]."""
MEMORY = 14 * 2**30
"""Address space that a worker may take [byte]."""


def one(kind: str, seed: int) -> tuple[str, str]:
    """Try one input in a folder of its own, and look at what it leaves behind."""
    folder = Path(tempfile.mkdtemp(prefix="stackgen-fuzz-"))
    before = os.getcwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            outcome, text = KINDS[kind](folder, random.Random(f"{kind} {seed}"))
        left = [p for p in folder.rglob("*") if p.name.endswith((".tmp", ".unfinished")) or p.name == "pwned"]
        if left or (outcome == "refused" and (folder / "out").exists()):
            return "half-written", f"{left or 'out'}: {text}"
        return outcome, text
    finally:
        os.chdir(before)
        shutil.rmtree(folder, ignore_errors=True)


def _work(pipe: Any) -> None:
    """Try inputs as they come."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    import torch

    torch.set_num_threads(1)
    with contextlib.suppress(EOFError):
        while True:
            kind, seed = pipe.recv()
            try:
                answer = one(kind, seed)
            except BaseException as error:  # noqa: BLE001 - a defect, like any other
                answer = "traceback", "".join(traceback.format_exception(error))[-1500:]
            pipe.send(answer)


class Worker:
    """A process that tries inputs, and is replaced when it hangs or dies."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, there = context.Pipe()
        self.process = context.Process(target=_work, args=(there,), daemon=True)
        self.process.start()
        there.close()
        self.known = set[str]()

    def give(self, kind: str, seed: int) -> tuple[str, str, float]:
        """Try one input: what became of it, what was said, and its processor time [s]."""
        self.pipe.send((kind, seed))
        limit = SECONDS + (40.0 if kind not in self.known else 0.0)  # the first of a kind loads torch and the rest
        self.known.add(kind)
        begin, used = time.monotonic(), _processor_time(self.process.pid)
        while not self.pipe.poll(1.0):
            taken = _processor_time(self.process.pid) - used
            if taken > limit or time.monotonic() - begin > PATIENCE:
                self._end()
                return "hang", f"{taken:.0f} s of processor time", taken
        try:
            outcome, text = self.pipe.recv()
        except (EOFError, OSError):
            self._end()
            outcome, text = "died", "the process ended"
        return outcome, text, max(_processor_time(self.process.pid) - used, 0.0)

    def _end(self) -> None:
        self.process.kill()
        self.process.join()
        self._begin()


def _processor_time(process: int | None) -> float:
    """Give the processor time that a process has taken so far [s]: others that are at work do not count."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # it has ended
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
