"""stackgen report: the paper's table, every row, from what has been tested and what is still to be run."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from stackgen.commands.parsing import Command
from stackgen.commands.progress_bar import progress_bar
from stackgen.data.shards import manifest_sha256
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import ParallelChecker, load_scenes, physics_of
from stackgen.evaluation.report.charts import draw_charts
from stackgen.evaluation.report.collect import Asked, Store, Task, answer, write_record
from stackgen.evaluation.report.figures import Result, results_of
from stackgen.evaluation.report.known import Ceiling, Unseen, read_ceiling, read_unseen
from stackgen.evaluation.report.plan import Plan, ReportSettings, machine, make_plan
from stackgen.evaluation.report.rows import LIST_NAMES, Line, Row, check_rows, run_seconds, trainings
from stackgen.evaluation.report.sheets import draw_sheets
from stackgen.evaluation.report.tables import World, terminal_table, to_csv, to_json, to_markdown
from stackgen.evaluation.results import Evaluation
from stackgen.io.files import write_atomically
from stackgen.io.provenance import code_version
from stackgen.protocols import StabilityChecker
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.physics import Physics
from stackgen.training.runs import RUNS
from stackgen.world import Catalogue, Grid

RESULTS = Path("docs/results")
CACHE = RUNS / ".report"


def main(
    settings: ReportSettings,
    out: Path = RESULTS,
    limit: int | None = None,
    workers: int | None = None,
    cache: Path = CACHE,
    runs: Path = RUNS,
) -> None:
    """Make the paper's table with every row: collect what has been tested, run what is missing, write it down.

    Each row with each block list is kept as soon as it is done: an interrupted report goes on where it
    stopped, and a finished one is made again in a minute.

    Args:
        settings: What to report.
        out: Folder for `table.md`, `.csv`, `.json`, the charts and the contact sheets.
        limit: Only the first so many scenes, to try things out; give another `out` then.
        workers: Processes that simulate; by default one for each core.
        cache: Folder in which answers are kept.
        runs: Folder in which `stackgen test` left its runs.
    """
    began, console = time.perf_counter(), Console()
    check_rows(settings.rows)
    workers = _checked_workers(workers)
    if limit is not None and (limit < 1 or out == RESULTS):
        raise StackgenError(f"report: limit must be at least 1, and out another folder than {RESULTS}: it is a trial")
    everything, manifest = load_scenes(settings.test_set)
    asked = Asked(everything[:limit], settings.num_samples, settings.seed, grid=Grid(**manifest["grid"]))
    with _checker(manifest, workers) as checker:
        world = _world(settings, asked, manifest, len(everything), physics_of(checker))
        lines = gather(settings, asked, world, manifest, checker, Store(cache, runs), console)
        unseen = _unseen(settings, world, console)
        results = results_of(_told(lines, unseen), _ceiling(settings, world, console), unseen)
        write_report(results, settings, world, unseen, asked, _simulator(manifest, until_fall=False), out)
    console.print(terminal_table(results))
    console.print(f"wrote {out}/table.md, .csv, .json and the pictures beside it", highlight=False)
    _tell_costs(results, settings, time.perf_counter() - began, console)


def _checked_workers(workers: int | None) -> int:
    if workers is not None and workers < 1:
        raise StackgenError(f"report: workers must be at least 1, got {workers}")
    return workers or os.cpu_count() or 1


@contextmanager
def _checker(manifest: Mapping[str, Any], workers: int) -> Iterator[StabilityChecker]:
    """PyBullet in the test set's world, on so many processes; a rollout ends at the first fall."""
    factory = partial(_simulator, manifest, until_fall=True)
    if workers == 1:
        yield factory()
        return
    with ParallelChecker(factory, workers) as checker:
        yield checker


def _simulator(manifest: Mapping[str, Any], until_fall: bool) -> SimulatorChecker:
    catalogue, physics = Catalogue.from_json(manifest["catalogue"]), Physics.of_world(manifest.get("physics"))
    return SimulatorChecker(physics, catalogue, until_fall)


def _world(
    settings: ReportSettings, asked: Asked, manifest: dict[str, Any], number: int, physics: dict[str, Any] | None
) -> World:
    """What all figures hold for."""
    return World(
        (str(manifest["name"]), manifest_sha256(manifest)),
        len(asked.scenes),
        number,
        settings.num_samples,
        settings.seed,
        physics,
        code_version(),
        machine(),
    )


def gather(
    settings: ReportSettings,
    asked: Asked,
    world: World,
    manifest: Mapping[str, Any],
    checker: StabilityChecker,
    store: Store,
    console: Console,
) -> list[Line]:
    """The lines of all rows; what is missing is run, and kept at once.

    Raises:
        StackgenError: If a row has neither weights nor a record.
    """
    facts = {
        "code": world.code,
        "machine": world.machine,
        "dataset": dict(zip(("name", "sha256"), world.test_set, strict=True)),
    }
    plan = make_plan(settings, asked, facts, manifest, world.physics)
    everything = [task for row in settings.rows for task in plan.tasks.get(row.name, ())]
    found = {_place(task): store.find(task.question) for task in everything}
    _tell_plan(settings.rows, plan, found, store, console)
    missing = [task for task in everything if found[_place(task)] is None]
    answers = {place: pair[0] for place, pair in found.items() if pair}
    answers |= _run(missing, asked, checker, store)
    lines: list[Line] = []
    for row in settings.rows:
        if row.name not in plan.tasks:
            lines += plan.record_of(row, asked, world.test_set[1], world.physics)
            continue
        own = [Line(row, answers[_place(task)], task.question) for task in plan.tasks[row.name]]
        if row.recorded is not None and world.scenes == world.all_scenes:
            write_record(own)
        lines += own
    return lines


def _place(task: Task) -> tuple[str, str]:
    return task.row.name, task.block_list


def _run(
    missing: Sequence[Task], asked: Asked, checker: StabilityChecker, store: Store
) -> dict[tuple[str, str], Evaluation]:
    """Ask what is to be asked, one after the other; each answer is kept at once."""
    answers: dict[tuple[str, str], Evaluation] = {}
    if not missing:
        return answers
    number = len(asked.scenes)
    with progress_bar("scenes", len(missing) * number) as (advance, say):
        for task in missing:
            before, began = len(answers) * number, time.perf_counter()
            try:
                found = answer(task, asked, checker, lambda done, _, before=before: advance(before + done))  # type: ignore[misc]
                store.keep(found, task.question)
            except KeyboardInterrupt:
                done = f"{len(answers)} of {len(missing)} are done and kept"
                raise KeyboardInterrupt(f"{done}: the same command goes on from there") from None
            answers[_place(task)] = found
            say(f"{task.row.name}, {LIST_NAMES[task.block_list]} list: {time.perf_counter() - began:.0f} s")
    return answers


def _tell_plan(
    rows: Sequence[Row], plan: Plan, found: Mapping[tuple[str, str], Any], store: Store, console: Console
) -> None:
    """Say where each answer comes from, and what is not taken for one."""
    for row in rows:
        if row.name in plan.absent:
            console.print(f"{row.name}: recorded in {row.recorded} ({plan.absent[row.name]})", highlight=False)
        for task in plan.tasks.get(row.name, ()):
            pair = found[_place(task)]
            state = "to be run" if pair is None else f"kept in {pair[1]}"
            console.print(f"{row.name}, {LIST_NAMES[task.block_list]} list: {state}", highlight=False)
            for path, remark in store.left_out(task.question):
                console.print(f"  left out {path}: {remark}", style="yellow", highlight=False)


def _told(lines: Sequence[Line], unseen: Unseen | None) -> list[Line]:
    """The lines, with a remark where it is not known what training has seen."""
    told = []
    for line in lines:
        trained_on = line.evaluation.facts.get("trained_on") or {}
        if unseen is not None and trained_on and trained_on["sha256"] not in unseen.hashes:
            remark = f"trained on {trained_on['name']}, of which it is not known what it holds of the test set"
            line = replace(line, remarks=(*line.remarks, remark))
        told.append(line)
    return told


def _ceiling(settings: ReportSettings, world: World, console: Console) -> Ceiling | None:
    if settings.ceiling is None:
        return None
    try:
        return read_ceiling(settings.ceiling, world.test_set[1], world.physics)
    except StackgenError as error:
        console.print(f"no ceiling of valid diversity: {error}", style="yellow", highlight=False)
        return None


def _unseen(settings: ReportSettings, world: World, console: Console) -> Unseen | None:
    try:
        return read_unseen(world.test_set[1], settings.training_sets)
    except StackgenError as error:
        console.print(f"no figures on unseen scenes: {error}", style="yellow", highlight=False)
        return None


def write_report(
    results: Sequence[Result],
    settings: ReportSettings,
    world: World,
    unseen: Unseen | None,
    asked: Asked,
    checker: StabilityChecker,
    out: Path,
) -> None:
    """Write tables and pictures; the checker judges the samples that are drawn once more.

    Raises:
        StackgenError: If one cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StackgenError(f"{out}: no folder to write to: {error.strerror}") from error
    pictures = draw_charts(results, out)
    scenes = {scene.name: scene for scene in asked.scenes}
    pictures += draw_sheets([result.line for result in results], scenes, checker, out, asked.grid)
    content = json.dumps(to_json(results, world, unseen, settings.groundwork), indent=1, allow_nan=False)
    write_atomically(out / "table.json", f"{content}\n".encode())
    write_atomically(out / "table.csv", to_csv(results).encode())
    write_atomically(out / "table.md", to_markdown(results, world, unseen, pictures, settings.groundwork).encode())


def _tell_costs(results: Sequence[Result], settings: ReportSettings, spent: float, console: Console) -> None:
    """What this report took, what all rows would take anew, and what training them took."""
    again = run_seconds(result.line for result in results)
    hours = sum(training.hours for training in trainings(settings.rows, settings.groundwork))
    console.print(
        f"This report took {spent / 60:.1f} minutes. From shipped weights, with nothing kept: {again / 60:.1f} minutes "
        f"and the pictures. From scratch: {hours:.1f} hours of generating and training before that, as far as the rows "
        "tell; the commands are at the end of table.md.",
        highlight=False,
    )


COMMAND = Command(
    "report",
    main,
    """
    stackgen report --config configs/report.yaml
    stackgen report --config configs/report.yaml --limit 20 --out out/report
    """,
    settings=("settings", ReportSettings),
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
