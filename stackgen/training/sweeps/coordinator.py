"""The one process of a sweep that asks Optuna for trials and tells it how they went.

All it knows lies in Optuna's journal. If it is killed at any moment, the same command continues the sweep: trials that
were running start again with the values they had, and there are exactly as many trials as were asked for.

Optuna's own heartbeat and retries are for SQL databases and for several workers. There, a trial that was interrupted
counts as failed and another one takes its place, and of two workers each may start the last one.
"""

from __future__ import annotations

import fcntl
import json
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stackgen.errors import StackgenError, require
from stackgen.io.files import write_atomically
from stackgen.io.provenance import cores
from stackgen.io.text import parse_yaml, read_yaml
from stackgen.training.runs import check_run_name
from stackgen.training.sweeps.child import Child, command_of
from stackgen.training.sweeps.file import Sweep
from stackgen.training.sweeps.space import constants_of, grid_of, grid_point, space_of
from stackgen.training.sweeps.telling import DIVERGED

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.distributions import BaseDistribution
    from optuna.pruners import BasePruner
    from optuna.samplers import BaseSampler
    from optuna.trial import FrozenTrial

JOURNAL, SWEEP_FILE, LOCK = "journal.log", "sweep.yaml", "lock"
DEFAULT_TRIALS = 30
FAILURES = 3
"""The sweep ends when so many trials in a row fail: the mistake is in what they share."""
_POLL = 0.1  # [s]


def run_sweep(
    sweep: Sweep,
    folder: Path,
    *,
    parallel: int = 1,
    seed: int = 0,
    tell: Callable[[str], None] = print,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> Study:
    """Run the trials of a sweep that are left to run.

    Args:
        sweep: The sweep file.
        folder: The sweep's folder; the folder of another sweep is refused.
        parallel: Number of trials at once.
        seed: Seed of the proposals; with one trial at once the same seed makes the same proposals.
        tell: Function that is given a line when a trial ends.
        advance: Function that is given (trials that have ended, trials in all).

    Raises:
        StackgenError: If another coordinator is at work in the folder, or trial after trial fails.
    """
    check_sweep(sweep)
    space, constants = space_of(sweep.parameters), constants_of(sweep.parameters)
    threads = max(1, cores() // parallel)
    with folder_lock(folder) as lock:
        remember(sweep, folder)
        study = open_study(sweep, folder, seed, parallel)
        if interrupted := requeue(study):
            tell(f"{interrupted} trials were interrupted and start again")
        running: dict[int, tuple[Trial, Child]] = {}
        failures = 0
        try:
            while True:
                while len(running) < parallel and (trial := next_trial(study, sweep, space)):
                    place = folder / "trials" / f"{trial.number:04d}"
                    child = Child(sweep, {**constants, **trial.params}, place, threads, lock)
                    running[trial.number] = trial, child
                advance(sum(trial.state.is_finished() for trial in trials_of(study)), trials_wanted(sweep))
                if not running:
                    return study
                time.sleep(_POLL)
                for number, (trial, child) in list(running.items()):
                    ended = follow(study, trial, child, sweep)
                    if ended is not None:
                        del running[number]
                        tell(line := line_of(ended, sweep))
                        failures = failures + 1 if "failure" in ended.user_attrs else 0
                        if failures == FAILURES:
                            raise StackgenError(f"{FAILURES} trials in a row failed; {line}; see {child.log}")
        finally:
            for _, child in running.values():
                child.stop()


def check_sweep(sweep: Sweep) -> None:
    """Refuse a sweep that cannot be run or whose findings could not be read back, before anything is made.

    Raises:
        StackgenError: The line names what is wrong.
    """
    check_run_name(sweep.name)
    trials_wanted(sweep)
    every = {**constants_of(sweep.parameters), **dict.fromkeys(space_of(sweep.parameters))}
    command_of(sweep, every, Path())


def next_trial(study: Study, sweep: Sweep, space: Mapping[str, BaseDistribution]) -> Trial | None:
    """Start the next trial, an interrupted one first; None if the sweep has all its trials or reached its target."""
    trials = trials_of(study)
    if not any(trial.state.name == "WAITING" for trial in trials):
        values = [trial.value for trial in trials if trial.state.name == "COMPLETE"]
        if len(trials) >= trials_wanted(sweep) or any(sweep.metric.is_reached_by(v) for v in values if v is not None):
            return None
        if sweep.method == "grid":
            study.enqueue_trial(grid_point(grid_of(space), len(trials)))
    return study.ask(dict(space))


def follow(study: Study, trial: Trial, child: Child, sweep: Sweep) -> FrozenTrial | None:
    """Hear what a trial has to tell and give it up if it is no good; answer the trial if it has ended, else None."""
    from optuna.trial import TrialState

    code = child.process.poll()  # before the last values are read
    known = trials_of(study)[trial.number].intermediate_values
    stop = sweep.early_terminate
    for step, value in child.news():
        if step not in known and math.isfinite(value):
            trial.report(value, step)
        whole = stop is not None and stop.max_iter is not None and step >= stop.max_iter
        if code is None and not whole and trial.should_prune():
            child.stop()
            return study.tell(trial, state=TrialState.PRUNED)
    if code is None:
        return None
    if child.told and not math.isfinite(child.told[-1]):
        trial.set_user_attr(DIVERGED, f"{sweep.metric.name} was {child.told[-1]} at report {len(child.told)}")
        return study.tell(trial, state=TrialState.FAIL)
    if code == 0 and (child.told or sweep.metric.name is None):
        return study.tell(trial, child.told[-1] if child.told else 0.0)  # Optuna wants a value of whatever ends well
    why = f"exit code {code}: {child.last_words()}" if code else f"it never told {sweep.metric.name}"
    trial.set_user_attr("failure", why)
    return study.tell(trial, state=TrialState.FAIL)


def line_of(trial: FrozenTrial, sweep: Sweep) -> str:
    """Say in a line how a trial ended."""
    if DIVERGED in trial.user_attrs:
        return f"trial {trial.number}: diverged: {trial.user_attrs[DIVERGED]}"
    if trial.state.name == "FAIL":
        return f"trial {trial.number}: failed: {trial.user_attrs['failure']}"
    if trial.state.name == "PRUNED":
        return f"trial {trial.number}: given up after {trial.last_step} reports at {trial.value:.4g}"
    return f"trial {trial.number}: " + (f"{sweep.metric.name} {trial.value:.4g}" if sweep.metric.name else "done")


def trials_of(study: Study) -> list[FrozenTrial]:
    """List all trials in the order of their numbers, not copied."""
    return study.get_trials(deepcopy=False)


def trials_wanted(sweep: Sweep) -> int:
    """Count the trials of the whole sweep."""
    if sweep.method != "grid":
        return sweep.run_cap or DEFAULT_TRIALS
    points = math.prod(map(len, grid_of(space_of(sweep.parameters)).values()))
    return min(points, sweep.run_cap or points)


def requeue(study: Study) -> int:
    """Let the trials wait that an earlier coordinator started and did not see the end of; answer how many there are."""
    from optuna.trial import TrialState

    left = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
    for trial in left:
        # The same trial again, not one like it, so that it counts once. Optuna has no public way.
        study._storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)
    return len(left)


def open_study(sweep: Sweep, folder: Path, seed: int = 0, parallel: int = 1) -> Study:
    """Open the journal of a sweep: its trials so far, what proposes more of them, and what gives them up."""
    optuna = require("optuna", "sweeps")
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    journal = folder / JOURNAL
    # Optuna waits half a minute for a lock of its own that a killed process left; nobody else is at work here.
    for stale in folder.glob(f"{JOURNAL}.lock*"):
        stale.unlink(missing_ok=True)
    mend_journal(journal)
    try:
        study = optuna.create_study(
            storage=optuna.storages.JournalStorage(JournalFileBackend(str(journal))),
            study_name=sweep.name,
            direction=sweep.metric.goal,
            pruner=_pruner(sweep),
            load_if_exists=True,
        )
        known, _ = len(trials_of(study)), study.direction  # which are only now taken apart
    except Exception as error:
        raise StackgenError(f"{journal} is damaged: {error!r:.80}; choose another --out") from error
    study.sampler = _sampler(sweep, seed, known, parallel)
    return study


def mend_journal(journal: Path) -> None:
    """Drop what a killed process or a machine without power left of lines: blanks, NULs and half a line at the end.

    Optuna would glue its next line to it, or read no further.

    Raises:
        StackgenError: If another line is damaged: what it said is lost.
    """
    if not journal.exists():
        return
    content = journal.read_bytes()
    lines = [line.strip(b"\0 \t\r") for line in content[: content.rfind(b"\n") + 1].split(b"\n")]
    for number, line in enumerate(lines, 1):
        if line and not _is_entry(line):
            raise StackgenError(f"{journal} is damaged at line {number}; choose another --out")
    whole = b"".join(line + b"\n" for line in lines if line)
    if whole != content:
        write_atomically(journal, whole)


def _is_entry(line: bytes) -> bool:
    try:
        return "op_code" in json.loads(line)
    except (ValueError, TypeError, RecursionError):
        return False


def _sampler(sweep: Sweep, seed: int, known: int, parallel: int) -> BaseSampler:
    from optuna.samplers import RandomSampler, TPESampler

    # A coordinator that continues must not propose what the first one proposed.
    own = int(np.random.SeedSequence([seed, known]).generate_state(1)[0])
    if sweep.method != "bayes":
        return RandomSampler(seed=own)
    startup = min(10, max(2, trials_wanted(sweep) // 3))
    return TPESampler(seed=own, n_startup_trials=startup, multivariate=True, constant_liar=parallel > 1)


def _pruner(sweep: Sweep) -> BasePruner:
    from optuna.pruners import NopPruner, SuccessiveHalvingPruner

    stop = sweep.early_terminate
    return SuccessiveHalvingPruner(stop.first_rung, stop.eta) if stop else NopPruner()


@contextmanager
def folder_lock(folder: Path) -> Iterator[int]:
    """Hold a sweep's folder; yields the descriptor, which children are given so that they hold it too.

    Raises:
        StackgenError: If another process holds it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("w")
    except OSError as error:
        raise StackgenError(f"--out {folder}: {error.strerror}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StackgenError(
                f"{folder} is in use: a coordinator, or a trial of one that was killed, still runs there"
            ) from None
        yield file.fileno()


_MAY_CHANGE = ("run_cap", "description", "project", "entity")


def remember(sweep: Sweep, folder: Path) -> None:
    """Write down which sweep this is; refuse the folder of another.

    Raises:
        StackgenError: If the folder's sweep differs in more than the number of trials.
    """
    path, content = folder / SWEEP_FILE, parse_yaml(sweep.to_yaml(), sweep.name)
    before = read_yaml(path) if path.exists() else content
    if not isinstance(before, dict):
        raise StackgenError(f"{path} is empty or damaged; put the sweep file there, or choose another --out")
    changed = [key for key in {**before, **content} if before.get(key) != content.get(key)]
    changed = [key for key in changed if key not in _MAY_CHANGE]
    if changed:
        raise StackgenError(f"{folder} holds a sweep with another {', '.join(changed)}; choose another --out or --name")
    write_atomically(path, sweep.to_yaml().encode())
