"""One trial: the sweep's program in a process of its own that never outlives its coordinator."""

from __future__ import annotations

import ctypes
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stackgen.errors import StackgenError
from stackgen.io.files import write_json
from stackgen.training.sweeps.file import DEFAULT_COMMAND, Sweep
from stackgen.training.sweeps.telling import METRICS_FILE, values_told

PATIENCE = 10.0
"""A child that is told to end is killed after this long [s]."""
PARAMETERS = "parameters.json"
RUN = "run"
"""A trial of `stackgen fit` leaves its files in TRIAL/run/version_0."""

_VARIABLE = re.compile(r"\$\{envvar:(\w+)\}")
_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None) if sys.platform == "linux" else None


def command_of(sweep: Sweep, values: Mapping[str, Any], folder: Path) -> list[str]:
    """Make the command line of a trial, with W&B's macros filled in.

    Args:
        sweep: The sweep file.
        values: Values of all parameters, by name.
        folder: The trial's folder, where `stackgen fit` is told to leave its files.

    Raises:
        StackgenError: If the command has a macro that is not known here.
    """
    values = dict(sorted(values.items(), key=lambda item: item[0].count(".")))  # a group before what is set within it
    macros: dict[str, list[str]] = {
        "${env}": [],  # `/usr/bin/env`, which finds a script's interpreter on Unix
        "${interpreter}": [sys.executable],
        "${program}": [sweep.program],
        "${args}": [f"--{name}={_text(value)}" for name, value in values.items()],
        "${args_no_hyphens}": [f"{name}={_text(value)}" for name, value in values.items()],
        "${args_no_boolean_flags}": [
            f"--{name}" if value is True else f"--{name}={_text(value)}"
            for name, value in values.items()
            if value is not False
        ],
        "${args_json}": [json.dumps(values)],
        "${args_json_file}": [str(folder / PARAMETERS)],
    }
    words: list[str] = []
    for word in map(str, sweep.command or DEFAULT_COMMAND):
        variable = _VARIABLE.fullmatch(word)
        if variable and variable[1] in os.environ:
            macros[word] = [os.environ[variable[1]]]
        if "${" in word and word not in macros:
            known = f"{', '.join(macros)} and ${{envvar:NAME}} of a variable that is set"
            raise StackgenError(f"command: {word} is not one of {known}")
        words += macros.get(word, [word])
    if not words:
        raise StackgenError("command: there is no program in it")
    if words[0] != "stackgen":
        return words
    command = [sys.executable, "-m", *words]
    return [*command, *_of_fit(values, folder)] if words[1:2] == ["fit"] else command


def _of_fit(values: Mapping[str, Any], folder: Path) -> list[str]:
    """Give the options of `stackgen fit` that a sweep sets itself."""
    own = {"name": RUN, "trainer.default_root_dir": folder}
    own |= {"trainer.enable_progress_bar": "false", "trainer.enable_model_summary": "false"}
    if taken := sorted(set(own) & set(values)):
        raise StackgenError(f"parameter {taken[0]}: a sweep sets it itself for every trial of `stackgen fit`")
    return [f"--{name}={value}" for name, value in own.items()]


def _text(value: Any) -> str:
    """Write a value as W&B does, and null, which W&B cannot write."""
    return "null" if value is None else str(value)


class Child:
    """The running process of a trial.

    Args:
        sweep: The sweep file.
        values: Values of all parameters, by name.
        folder: The trial's folder, made here: `log.txt`, `metrics.jsonl` and `parameters.json` go there.
        threads: Threads of its computations, where the environment does not say.
        lock: Descriptor of the sweep's lock; the child holds it too, so that no coordinator starts while it lives.

    Raises:
        StackgenError: If the program cannot be started.
    """

    def __init__(self, sweep: Sweep, values: Mapping[str, Any], folder: Path, threads: int, lock: int) -> None:
        self.log, self._metrics, self._metric = folder / "log.txt", folder / "metrics.jsonl", sweep.metric.name
        self.told: list[float] = []
        write_json(folder / PARAMETERS, dict(values))
        self._metrics.unlink(missing_ok=True)  # an interrupted try may have left one
        environment = {"OMP_NUM_THREADS": str(threads), **os.environ, METRICS_FILE: str(self._metrics.absolute())}
        command = command_of(sweep, values, folder)
        try:
            with self.log.open("wb") as log:
                self.process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, env=environment,
                    start_new_session=True, pass_fds=(lock,), preexec_fn=_die_with_parent,
                )  # fmt: skip
        except OSError as error:
            raise StackgenError(f"{command[0]} cannot be started: {error.strerror}") from error

    def news(self) -> list[tuple[int, float]]:
        """List the values of the metric that were told since the last call, each with its number, from 1."""
        known = len(self.told)
        self.told = values_told(self._metrics, self._metric)
        return list(enumerate(self.told, 1))[known:]

    def last_words(self) -> str:
        """Give the last line that the program printed."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1].strip()[:300] if lines else "(it printed nothing)"

    def stop(self) -> None:
        """Ask the program and what it started to end; kill them if they do not."""
        for blow in (signal.SIGTERM, signal.SIGKILL):
            if self.process.poll() is not None:
                return
            try:
                os.killpg(self.process.pid, blow)
                self.process.wait(PATIENCE)
            except ProcessLookupError:
                break
            except subprocess.TimeoutExpired:
                continue
        self.process.wait()


def _die_with_parent() -> None:
    """Ask Linux to kill this new process when its coordinator dies, however that happens."""
    if _libc is not None:
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
