"""stackgen report: the paper's table, every row, from what has been tested and what is still to be run."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from stackgen.commands.asking import arguments_of
from stackgen.commands.output import tell
from stackgen.commands.parsing import CONFIG_FLAGS, Command, option_values
from stackgen.commands.progress_bar import after, progress_bar
from stackgen.errors import StackgenError
from stackgen.evaluation.engines import completed, second_engine
from stackgen.evaluation.parallel import simulating
from stackgen.evaluation.protocol import Scene, evaluate, load_scenes
from stackgen.evaluation.report.charts import draw_charts
from stackgen.evaluation.report.references import DiversityLimit, Unseen, read_diversity_limit, read_unseen
from stackgen.evaluation.report.results import Result, result_of, run_seconds
from stackgen.evaluation.report.rows import ReportSettings, check_rows, trainings
from stackgen.evaluation.report.sheets import draw_sheets
from stackgen.evaluation.report.store import Store
from stackgen.evaluation.report.tables import Conditions, Report, csv_rows, terminal_table, to_json, to_markdown
from stackgen.evaluation.report.tasks import Task, tasks_of
from stackgen.evaluation.results import Evaluation, write_csv
from stackgen.io.files import write_atomically, write_json
from stackgen.io.provenance import code_version, cores, machine
from stackgen.io.text import read_json
from stackgen.protocols import StabilityChecker
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.physics import Physics
from stackgen.training.runs import RUNS

ROWS = Path(__file__).parents[1] / "assets" / "report.yaml"
"""The paper's table, where no other rows are given."""


def main(
    settings: ReportSettings,
    out: Path = Path("out/report"),
    limit: int | None = None,
    workers: int | None = None,
    cache: Path = RUNS / ".report",
    runs: Path = RUNS,
) -> None:
    """Make the paper's table with every row: collect what has been tested, run what is missing, write it down.

    Each row with each block list is kept as soon as it is done: an interrupted report continues where it
    stopped, and a finished one is made again in a minute.

    Args:
        settings: What to report.
        out: Folder for `table.md`, `.csv`, `.json`, the charts and the contact sheets.
        limit: Number of scenes to ask about, from the first, to try things out; all by default.
        workers: Processes that simulate; by default one for each core.
        cache: Folder in which results are kept.
        runs: Folder in which `stackgen test` left its runs.
    """
    began = time.perf_counter()
    check_rows(settings.rows)
    if (limit is not None and limit < 1) or (workers is not None and workers < 1):
        raise StackgenError("--limit and --workers must be at least 1")
    everything, dataset = load_scenes(settings.test_set)
    scenes, manifest = everything[:limit], dataset.manifest
    physics = Physics.recorded(manifest.physics)
    processes = workers or cores()
    with simulating(physics, processes) as checker, second_engine(physics, processes) as second:
        conditions = Conditions(
            test_set=(manifest.name, manifest.sha256),
            scenes=len(scenes),
            all_scenes=len(everything),
            num_samples=settings.num_samples,
            seed=settings.seed,
            physics=checker.physics.to_json(),
            code=code_version(),
            machine=machine(),
        )
        test_set = {"name": manifest.name, "sha256": manifest.sha256}
        facts = {"code": conditions.code, "machine": conditions.machine, "dataset": test_set}
        tasks = tasks_of(settings, manifest, len(scenes), physics=conditions.physics, facts=facts)
        answers = gather(tasks, scenes, checker, second, Store(cache, runs))
    limits, unseen = _references(settings, conditions)
    results = [result_of(t.row, answers[t.place], t.question, limit=limits, unseen=unseen) for t in tasks]
    pictures = draw_charts(results, out)
    whole = SimulatorChecker(physics)  # for the pictures: what falls, falls to the end
    pictures += draw_sheets(results, {scene.name: scene for scene in scenes}, whole, out, grid=dataset.world.grid)
    write_report(Report(results, conditions, unseen, settings.groundwork), pictures, out)
    tell(terminal_table(results), f"wrote {out}/table.md, .csv, .json and the pictures beside it")
    tell(**read_json(out / "table.json"), wrote=[out])
    _tell_costs(results, settings, time.perf_counter() - began)


def gather(
    tasks: Sequence[Task],
    scenes: Sequence[Scene],
    checker: StabilityChecker,
    second: StabilityChecker | None,
    store: Store,
) -> dict[tuple[str, str], Evaluation]:
    """Find the answers that are kept, complete them, run what is missing, and keep that at once."""
    answers: dict[tuple[str, str], Evaluation] = {}
    missing = []
    for task in tasks:
        found = store.find(task.question)
        tell(f"{_title(task)}: {f'kept in {found[1]}' if found else 'to be run'}")
        if found is None:
            missing.append(task)
        else:
            answers[task.place] = completed(found[0], second)
            if answers[task.place] is not found[0]:
                store.keep(answers[task.place], task.question)
        for path, remark in store.left_out(task.question):
            tell(f"  left out {path}: {remark}", style="yellow")
    return answers | _run(missing, scenes, checker, second, store)


def _title(task: Task) -> str:
    return f"{task.row.name}, {task.row.list_name(task.request.block_list)} list"


def _run(
    missing: Sequence[Task],
    scenes: Sequence[Scene],
    checker: StabilityChecker,
    second: StabilityChecker | None,
    store: Store,
) -> dict[tuple[str, str], Evaluation]:
    """Run one task after the other."""
    answers: dict[tuple[str, str], Evaluation] = {}
    if not missing:
        return answers
    with progress_bar("scenes", len(missing) * len(scenes)) as (advance, say):
        for task in missing:
            before, began = len(answers) * len(scenes), time.perf_counter()
            try:
                found = completed(evaluate(task.request, scenes, checker, after(before, advance)), second)
                store.keep(found, task.question)
            except KeyboardInterrupt:
                done = f"{len(answers)} of {len(missing)} are done and kept"
                raise KeyboardInterrupt(f"{done}: the same command continues from there") from None
            answers[task.place] = found
            say(f"{_title(task)}: {time.perf_counter() - began:.0f} s")
    return answers


def _references(settings: ReportSettings, conditions: Conditions) -> tuple[DiversityLimit | None, Unseen | None]:
    """Read what is known of the scenes, or say what is left out of the report."""
    limit, unseen = None, None
    try:
        if settings.diversity_limit is not None:
            limit = read_diversity_limit(settings.diversity_limit, conditions.test_set[1], conditions.physics)
    except StackgenError as error:
        tell(f"no diversity limit: {error}", style="yellow")
    try:
        unseen = read_unseen(conditions.test_set[1], settings.training_sets)
    except StackgenError as error:
        tell(f"no metrics on unseen scenes: {error}", style="yellow")
    return limit, unseen


def write_report(report: Report, pictures: Sequence[str], out: Path) -> None:
    """Write the tables.

    Raises:
        StackgenError: If one cannot be written.
    """
    write_json(out / "table.json", to_json(report))
    write_csv(out / "table.csv", csv_rows(report))
    write_atomically(out / "table.md", to_markdown(report, pictures).encode())


def _tell_costs(results: Sequence[Result], settings: ReportSettings, spent: float) -> None:
    """Say what this report took, what all rows take from their weights, and what training them took."""
    again = run_seconds(results)
    hours = sum(training.hours for training in trainings(settings.rows, settings.groundwork))
    tell(
        f"This report took {spent / 60:.1f} minutes. From shipped weights, with nothing kept, it takes "
        f"{again / 60:.1f} minutes and the pictures. From scratch, {hours:.1f} hours of generating and training come "
        "before that; the commands are at the end of table.md.",
        seconds=spent,
    )


COMMAND = Command(
    "report",
    main,
    """
    stackgen report
    stackgen report --limit 20 --workers 2
    stackgen report --config configs/report.yaml --out docs/results
    """,
    settings={"settings": ReportSettings},
    reports=True,
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb, by default for the rows of the paper's table."""
    given = option_values(argv, CONFIG_FLAGS)
    return COMMAND.run(arguments_of(verb, argv if given else ["--config", str(ROWS), *argv]))
