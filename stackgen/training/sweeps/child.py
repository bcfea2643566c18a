"""One trial: the program of the sweep in a process of its own, that never outlives its coordinator."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from stackgen.errors import StackgenError
from stackgen.training.sweeps.file import DEFAULT_COMMAND, Sweep
from stackgen.training.sweeps.telling import METRICS_FILE, MetricsReader

PATIENCE = 10.0
"""A child that is told to end is killed after this long [s]."""
RUN = "run"
"""A trial of `stackgen fit` leaves its files in TRIAL/run/version_0."""

_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None) if sys.platform == "linux" else None


def command_of(sweep: Sweep, values: Mapping[str, Any], folder: Path) -> list[str]:
    """The command line of a trial, W&B's macros filled in.

    Args:
        sweep: Whose.
        values: Of all parameters.
        folder: Of the trial; a `stackgen fit` is told to leave its files there.

    Raises:
        StackgenError: If a macro is not known here.
    """
    fillings: dict[str, list[str]] = {
        "${env}": [],  # `/usr/bin/env`, which finds a script's interpreter on Unix
        "${interpreter}": [sys.executable],
        "${program}": [sweep.program],
        "${args}": [f"--{name}={_text(value)}" for name, value in values.items()],
        "${args_no_hyphens}": [f"{name}={_text(value)}" for name, value in values.items()],
    }
    words: list[str] = []
    for word in sweep.command or DEFAULT_COMMAND:
        if "${" in word and word not in fillings:
            raise StackgenError(f"command: {word} is not one of {', '.join(fillings)}")
        words += fillings.get(word, [word])
    if words[0] != "stackgen":
        return words
    own = [f"--name={RUN}", f"--trainer.default_root_dir={folder}"] if words[1:2] == ["fit"] else []
    quiet = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"] if own else []
    return [sys.executable, "-m", *words, *own, *quiet]


def _text(value: Any) -> str:
    """As W&B writes it, but for null, which it cannot."""
    return "null" if value is None else str(value)


class Child:
    """A trial that runs.

    Args:
        sweep: Whose.
        values: Of all parameters.
        folder: Of the trial: made here; `log.txt`, `metrics.jsonl` and `parameters.json` go there.
        threads: Of its computations; what the environment says goes first.
        lock: Descriptor of the sweep's lock, which the child holds too: as long as it lives nobody begins anew.
    """

    def __init__(self, sweep: Sweep, values: Mapping[str, Any], folder: Path, threads: int, lock: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        metrics = folder / "metrics.jsonl"
        metrics.unlink(missing_ok=True)  # of a try that was interrupted
        (folder / "parameters.json").write_text(json.dumps(dict(values), indent=1) + "\n")
        self.log = folder / "log.txt"
        self.reader = MetricsReader(metrics, sweep.metric.name)
        self.reports: list[float] = []
        environment = {"OMP_NUM_THREADS": str(threads), **os.environ, METRICS_FILE: str(metrics.absolute())}
        command = command_of(sweep, values, folder)
        try:
            with self.log.open("wb") as log:
                self.process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, env=environment,
                    start_new_session=True, pass_fds=(lock,), preexec_fn=_die_with_parent(),
                )  # fmt: skip
        except OSError as error:
            raise StackgenError(f"{command[0]} cannot be started: {error.strerror}") from error

    def new_reports(self) -> list[tuple[int, float]]:
        """Values of the metric since the last call, numbered from the first of all, which is 1."""
        known = len(self.reports)
        self.reports += self.reader.new()
        return list(enumerate(self.reports[known:], known + 1))

    @property
    def exit_code(self) -> int | None:
        """None while it runs."""
        return self.process.poll()

    def last_words(self) -> str:
        """The last line it printed."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1].strip()[:300] if lines else "(it printed nothing)"

    def stop(self) -> None:
        """End it and what it started."""
        end_group(self.process)


def end_group(process: subprocess.Popen[bytes]) -> None:
    """Ask a process group to end, then make it."""
    for blow in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is None:
            try:
                os.killpg(process.pid, blow)
            except ProcessLookupError:
                break
            until = time.monotonic() + PATIENCE
            while process.poll() is None and time.monotonic() < until:
                time.sleep(0.02)
    process.wait()


def _die_with_parent() -> Callable[[], None] | None:
    """On Linux: what a new process does so that it is killed when the coordinator is, however that happens."""
    if _libc is None:
        return None
    libc: ctypes.CDLL = _libc

    def ask_kernel() -> None:
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    return ask_kernel


def threads_each(parallel: int, environment: Mapping[str, str] = os.environ, cores: int | None = None) -> int:
    """Threads for each of some children.

    >>> threads_each(3, {}, 8), threads_each(4, {}, 2), threads_each(1, {"OMP_NUM_THREADS": "5"}, 8)
    (2, 1, 5)
    """
    if environment.get("OMP_NUM_THREADS", "").isdigit():
        return int(environment["OMP_NUM_THREADS"])
    there: Sequence[int] | range = range(cores) if cores else sorted(os.sched_getaffinity(0))
    return max(1, len(there) // parallel)
