"""The one process of a sweep that asks Optuna for trials and tells it how they went.

All it knows lies in the journal: killed at any moment, it goes on with the same command, begins the trials
that were running again, with the values they had, and ends with exactly as many trials as were asked for.
"""

from __future__ import annotations

import fcntl
import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.training.sweeps.child import Child, threads_each
from stackgen.training.sweeps.file import Sweep
from stackgen.training.sweeps.space import constants_of, grid_of, space_of, suggest

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.distributions import BaseDistribution
    from optuna.pruners import BasePruner
    from optuna.samplers import BaseSampler

JOURNAL, SWEEP_FILE, LOCK = "journal.log", "sweep.yaml", "lock"
DEFAULT_TRIALS = 30
FAILURES = 3
"""So many trials that fail in a row, and the sweep ends: the mistake is in what they share."""
_POLL = 0.1  # [s]

Tell = Callable[[str], None]


def run_sweep(
    sweep: Sweep,
    folder: Path,
    parallel: int = 1,
    seed: int = 0,
    tell: Tell = print,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> Study:
    """Run what is left of a sweep.

    Args:
        sweep: What to try.
        folder: Where it lives; another sweep's is refused.
        parallel: Trials at once.
        seed: Of the proposals; with one trial at once the same seed makes the same proposals.
        tell: Told a line when a trial ends.
        advance: Told (trials done, trials in all).

    Raises:
        StackgenError: If another coordinator is at work there, or trial after trial fails.
    """
    space, constants = space_of(sweep.parameters), constants_of(sweep.parameters)
    with folder_lock(folder) as lock:
        remember(sweep, folder)
        study = open_study(sweep, folder, seed, parallel)
        wanted = trials_wanted(sweep)
        waiting = unfinished(study)
        if waiting:
            tell(f"going on: {len(waiting)} trials were interrupted and begin again")
        running: dict[int, tuple[Trial, Child]] = {}
        failures = 0
        try:
            while True:
                total = len(study.get_trials(deepcopy=False))
                while len(running) < parallel and (waiting or total < wanted):
                    trial = waiting.pop(0) if waiting else study.ask()
                    total = max(total, trial.number + 1)
                    values = {**constants, **_values(study, trial, sweep, space)}
                    place = folder / "trials" / f"{trial.number:04d}"
                    running[trial.number] = trial, Child(sweep, values, place, threads_each(parallel), lock)
                advance(total - len(running) - len(waiting), wanted)
                if not running:
                    return study
                time.sleep(_POLL)
                for number, (trial, child) in list(running.items()):
                    line = follow(study, trial, child, sweep)
                    if line is not None:
                        del running[number]
                        failures = failures + 1 if line.startswith(f"trial {number}: failed") else 0
                        tell(line)
                        if failures == FAILURES:
                            raise StackgenError(f"{FAILURES} trials in a row failed; {line}; see {child.log}")
        finally:
            for _, child in running.values():
                child.stop()


def follow(study: Study, trial: Trial, child: Child, sweep: Sweep) -> str | None:
    """Hear what a trial has to say, give it up if it is no good; a line when it has ended, else None."""
    from optuna.trial import TrialState

    code = child.exit_code  # before the last reports are read
    known = study.get_trials(deepcopy=False)[trial.number].intermediate_values
    stop = sweep.early_terminate
    for step, value in child.new_reports():
        if step not in known and math.isfinite(value):
            trial.report(value, step)
        whole = stop is not None and stop.max_iter is not None and step >= stop.max_iter
        if code is None and not whole and trial.should_prune():
            child.stop()
            study.tell(trial, state=TrialState.PRUNED)
            return f"trial {trial.number}: given up after {step} reports at {value:.4g}"
    if code is None:
        return None
    if code == 0 and child.reports and math.isfinite(child.reports[-1]):
        study.tell(trial, child.reports[-1])
        return f"trial {trial.number}: {sweep.metric.name} {child.reports[-1]:.4g}"
    why = f"exit code {code}: {child.last_words()}" if code else f"it never told {sweep.metric.name}"
    trial.set_user_attr("failure", why)
    study.tell(trial, state=TrialState.FAIL)
    return f"trial {trial.number}: failed: {why}"


def _values(study: Study, trial: Trial, sweep: Sweep, space: dict[str, BaseDistribution]) -> dict[str, Any]:
    """What a trial tries; in a grid the point of its number."""
    if sweep.method == "grid":
        from optuna.samplers import PartialFixedSampler, RandomSampler

        grid = grid_of(space)
        point = next(itertools.islice(itertools.product(*grid.values()), trial.number, None))
        study.sampler = PartialFixedSampler(dict(zip(grid, point, strict=True)), RandomSampler())
    return suggest(trial, space)


def trials_wanted(sweep: Sweep) -> int:
    """Trials of the whole sweep."""
    if sweep.method != "grid":
        return sweep.run_cap or DEFAULT_TRIALS
    points = math.prod(map(len, grid_of(space_of(sweep.parameters)).values()))
    return min(points, sweep.run_cap or points)


def unfinished(study: Study) -> list[Trial]:
    """The trials that an earlier coordinator began and did not see the end of."""
    from optuna import Trial
    from optuna.trial import TrialState

    left = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
    # The same trial again, not one like it, so that it is counted once; Optuna has no public way to take one up.
    return [Trial(study, trial._trial_id) for trial in left]


def open_study(sweep: Sweep, folder: Path, seed: int = 0, parallel: int = 1) -> Study:
    """The sweep's trials so far, and who proposes more."""
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    journal = folder / JOURNAL
    # Who holds the sweep's own lock is alone: what lies there is of a process that was killed.
    for stale in folder.glob(f"{JOURNAL}.lock*"):
        stale.unlink(missing_ok=True)
    mend_journal(journal)
    study = optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(journal))),
        study_name=sweep.name,
        direction=sweep.metric.goal,
        pruner=_pruner(sweep),
        load_if_exists=True,
    )
    study.sampler = _sampler(sweep, seed, len(study.get_trials(deepcopy=False)), parallel)
    return study


def mend_journal(journal: Path) -> None:
    """Cut off a last line that a killed process left half-written."""
    if journal.exists():
        content = journal.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            write_atomically(journal, whole)


def _sampler(sweep: Sweep, seed: int, known: int, parallel: int) -> BaseSampler:
    import optuna

    # A coordinator that goes on must not propose again what it proposed first.
    own = int(np.random.SeedSequence([seed, known]).generate_state(1)[0])
    if sweep.method != "bayes":
        return optuna.samplers.RandomSampler(seed=own)
    startup = min(10, max(2, trials_wanted(sweep) // 3))
    return optuna.samplers.TPESampler(seed=own, n_startup_trials=startup, multivariate=True, constant_liar=parallel > 1)


def _pruner(sweep: Sweep) -> BasePruner:
    from optuna.pruners import NopPruner, SuccessiveHalvingPruner

    stop = sweep.early_terminate
    return SuccessiveHalvingPruner(stop.first_rung, stop.eta) if stop else NopPruner()


@contextmanager
def folder_lock(folder: Path) -> Iterator[int]:
    """Hold a sweep's folder; the descriptor, to be handed to children, who hold it with us.

    Raises:
        StackgenError: If somebody else does.
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
    """Write down which sweep this is; refuse a folder of another.

    Raises:
        StackgenError: If the folder's sweep differs in more than the number of trials.
    """
    path, content = folder / SWEEP_FILE, sweep.to_json()
    before: dict[str, Any] = yaml.safe_load(path.read_text()) if path.exists() else content
    changed = [key for key in {**before, **content} if before.get(key) != content.get(key)]
    changed = [key for key in changed if key not in _MAY_CHANGE]
    if changed:
        raise StackgenError(f"{folder} holds a sweep with another {', '.join(changed)}; choose another --out or --name")
    write_atomically(path, sweep.to_yaml().encode())
