"""The report as files: Markdown for people, CSV for spreadsheets, JSON for programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.box import SIMPLE
from rich.markup import escape
from rich.table import Table

from stackgen.evaluation.intervals import Estimate
from stackgen.evaluation.report.figures import ALL, Figures, Result
from stackgen.evaluation.report.known import NOTIONS, Unseen
from stackgen.evaluation.report.rows import KINDS, LIST_NAMES, Row, Training, run_seconds, trainings
from stackgen.evaluation.results import HEADINGS, PAPER_COLUMNS, TOP

FORMAT = "stackgen.report/1"
SECTIONS = {
    "one-shot": "One sample, as it comes",
    "verified": "Verified: the best of several samples, as a judge says",
}
HIDDEN = ("iou_given_stable", "side_iou", "top_iou", "front_iou_before_physics", "valid_diversity")
"""Columns that the paper's table lacks."""
ON_UNSEEN = ("stability", "front_iou", "avg_iou", "iou_given_stable", "valid_diversity")
NAMES = {
    **HEADINGS,
    "avg_iou": "average IoU",
    "side_iou": "side IoU",
    "top_iou": "top IoU",
    "iou_given_stable": "front IoU of the stable",
    "front_iou_before_physics": "front IoU as generated",
}


@dataclass(frozen=True)
class World:
    """What all figures hold for.

    Args:
        test_set: Name and hash of the manifest.
        scenes: How many of its scenes were asked about.
        all_scenes: How many it has.
        num_samples, seed: Of the protocol.
        physics: Of the verdicts.
        code: Version of this package.
        machine: Where what was run was run.
    """

    test_set: tuple[str, str]
    scenes: int
    all_scenes: int
    num_samples: int
    seed: int
    physics: dict[str, Any] | None
    code: str
    machine: str


def to_json(
    results: Sequence[Result], world: World, unseen: Unseen | None, groundwork: Sequence[Training] = ()
) -> dict[str, Any]:
    """Plain form of the whole report."""
    return {
        "format": FORMAT,
        **asdict(world),
        "test_set": dict(zip(("name", "sha256"), world.test_set, strict=True)),
        "interval": "95 %, cluster bootstrap over scenes",
        "unseen": unseen and {"training_sets": unseen.names, "sha256": sorted(unseen.hashes), "notions": NOTIONS},
        "groundwork": [asdict(training) for training in groundwork],
        "rows": [_row_to_json(result) for result in results],
    }


def _row_to_json(result: Result) -> dict[str, Any]:
    line, evaluation = result.line, result.line.evaluation
    return {
        "method": line.row.name,
        "kind": line.row.kind,
        "block_list": line.block_list,
        "recorded": line.recorded,
        "remarks": line.remarks,
        "samples_per_scene": evaluation.num_samples,
        "seconds_per_sample": evaluation.seconds_per_sample,
        "facts": evaluation.facts,
        "question": line.question,
        "training": line.row.training and asdict(line.row.training),
        "paper_percent": result.paper or None,
        "figures": {subset: figures.to_json() for subset, figures in result.figures.items()},
        "block_lists": {name: value and value.to_json() for name, value in evaluation.list_estimates().items()} or None,
    }


def to_csv(results: Sequence[Result]) -> str:
    """One line for each row, block list and set of scenes, in percent; empty where a figure does not exist."""
    buffer = io.StringIO()
    rows = [_csv_row(result, subset, some) for result in results for subset, some in result.figures.items()]
    writer = csv.DictWriter(buffer, rows[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def _csv_row(result: Result, subset: str, some: Figures) -> dict[str, Any]:
    line = result.line
    row: dict[str, Any] = {
        "method": line.row.name,
        "kind": line.row.kind,
        "block_list": line.block_list,
        "recorded": int(line.recorded),
        "scenes": subset,
        "number_of_scenes": some.scenes,
        "samples_per_scene": line.evaluation.num_samples,
        "seconds_per_sample": "" if subset != ALL else _blank(line.evaluation.seconds_per_sample),
    }
    for name, value in {**some.metrics, "valid_diversity_of_ceiling": some.of_ceiling}.items():
        row[name] = "" if value is None else round(100 * value.value, 4)
        row[f"{name}_low"] = "" if value is None else round(100 * value.low, 4)
        row[f"{name}_high"] = "" if value is None else round(100 * value.high, 4)
        if name in PAPER_COLUMNS:
            row[f"{name}_paper"] = _blank(result.paper.get(name)) if subset == ALL else ""
    return row


def _blank(value: float | None) -> float | str:
    return "" if value is None else value


def to_markdown(
    results: Sequence[Result],
    world: World,
    unseen: Unseen | None,
    pictures: Sequence[str],
    groundwork: Sequence[Training] = (),
) -> str:
    """The page `table.md`.

    Args:
        results: In the order of the rows.
        world: What they hold for.
        unseen: Scenes that are looked at on their own.
        pictures: Lines of Markdown that show the figures.
        groundwork: What comes before the rows from scratch.
    """
    parts = [_head(results, world)]
    for kind in KINDS:
        some = [result for result in results if result.line.row.kind == kind]
        if some:
            parts += [f"## {SECTIONS[kind]}", *_section(some, unseen)]
    parts += [*_block_lists(results), "## Pictures", *pictures, *_sources(results), *_from_scratch(results, groundwork)]
    return "\n\n".join(parts) + "\n"


def _head(results: Sequence[Result], world: World) -> str:
    partly = f"**the first {world.scenes} of {world.all_scenes}**" if world.scenes < world.all_scenes else world.scenes
    physics = world.physics or {}
    numbers = ", ".join(f"{name} {value:.6g}" for name, value in physics.items() if name != "engine")
    parts = [
        "# The paper's table, every row",
        "Made by `stackgen report --config configs/report.yaml`; what is changed here by hand is lost when it is made "
        f"again. Code {world.code}.",
        f"{partly} scenes of {world.test_set[0]} (SHA-256 of its manifest {world.test_set[1][:12]}...), "
        f"{world.num_samples} samples each, seed {world.seed}. Percent; in parentheses the 95 % interval, clustered by "
        "scene ([metrics.md](../metrics.md)). The *paper's* columns quote the paper, whose figures come from its own "
        "data and physics. **List**: whose block lists, the true ones or the most likely ones of the CNN. "
        f"Seconds were taken on {world.machine}. Physics: {physics.get('engine', 'not told')}, {numbers}.",
    ]
    if any(result.line.recorded for result in results):
        parts.append("†: recorded, not run here; see the section on where the figures come from.")
    return "\n\n".join(parts)


Cell = Callable[[Result, Figures], str]


def _section(results: Sequence[Result], unseen: Unseen | None) -> Iterator[str]:
    """The tables of one kind of rows."""
    yield "### The paper's columns"
    columns: dict[str, Cell] = {}
    for name in PAPER_COLUMNS:
        columns[NAMES[name]] = _metric(name)
        columns[f"*paper's* {NAMES[name]}"] = lambda result, _, name=name: (  # type: ignore[misc]
            f"*{result.paper[name]:.2f}*" if name in result.paper else ""
        )
    yield _table(results, ALL, columns)
    yield "### What they hide"
    hidden: dict[str, Cell] = {NAMES[name]: _metric(name) for name in HIDDEN}
    hidden["valid diversity / its ceiling"] = lambda _, some: percent(some.of_ceiling)
    hidden["seconds a sample"] = lambda result, _: _seconds(result.line.evaluation.seconds_per_sample)
    yield _table(results, ALL, hidden)
    yield from _ceiling_note(results)
    for notion, meaning in NOTIONS.items() if unseen else ():
        known = [result for result in results if notion in result.figures]
        if known and unseen:
            number = known[0].figures[notion].scenes
            yield f"### On the {number} scenes whose {notion} training has never seen"
            yield f"Of {' and '.join(unseen.names)}, {meaning}."
            yield _table(known, notion, {NAMES[name]: _metric(name) for name in ON_UNSEEN})


def _table(results: Sequence[Result], subset: str, columns: dict[str, Cell]) -> str:
    rows = [["method", "list", *columns], ["---"] * 2 + ["--:"] * len(columns)]
    for result in results:
        line = result.line
        name = f"{line.row.name}{' †' if line.recorded else ''}"
        cells = [cell(result, result.figures[subset]) for cell in columns.values()]
        rows.append([name, LIST_NAMES[line.block_list], *cells])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _metric(name: str) -> Cell:
    return lambda _, some: percent(some.metrics[name])


def percent(estimate: Estimate | None) -> str:
    """Value and interval; nothing where there is none.

    >>> percent(Estimate(0.5, 0.25, 0.751))
    '50.0 (25.0 to 75.1)'
    """
    if estimate is None:
        return ""
    return f"{100 * estimate.value:.1f} ({100 * estimate.low:.1f} to {100 * estimate.high:.1f})"


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


def _ceiling_note(results: Sequence[Result]) -> Iterator[str]:
    """What valid diversity is measured by."""
    known: dict[str, tuple[Estimate, int, str]] = {}
    for result in results:
        some = result.figures[ALL]
        if some.ceiling is not None:
            known.setdefault(result.line.block_list, (some.ceiling, some.ceiling_scenes, ""))
    if not known:
        return
    parts = [f"{percent(most)} with the {LIST_NAMES[source]} list ({number} scenes)" for source, (most, number, _) in
             known.items()]  # fmt: skip
    beyond = [f"{result.line.row.name} ({LIST_NAMES[result.line.block_list]} list) {100 * some.outside.value:.1f}"
              for result in results if (some := result.figures[ALL]).outside is not None]  # fmt: skip
    yield (
        f"Ceiling of valid diversity: {', '.join(parts)}: what samples drawn uniformly from all layouts that fill the "
        "silhouette's cells and stand would reach ([report.md](../report.md)). Valid is what stands with front IoU of "
        "at least 0.8, so a few valid samples have other layouts, whose block is in a wrong cell; of the valid samples "
        f"these are [%]: {', '.join(beyond)}."
    )


def _block_lists(results: Sequence[Result]) -> Iterator[str]:
    """The predictors' own figures, each once."""
    rows, seen = [], set()
    for result in results:
        estimates = result.line.evaluation.list_estimates()
        predictor = str(result.line.question.get("predictor"))
        if estimates and predictor not in seen:
            seen.add(predictor)
            rows.append([f"`{predictor[:12]}`", *(percent(estimate) for estimate in estimates.values())])
    if rows:
        head = ["network", "most likely list is the true one", f"true one among {TOP}", "can make the silhouette"]
        table = [head, ["---", *["--:"] * 3], *rows]
        yield "## Block lists of the CNN"
        yield "\n".join(f"| {' | '.join(row)} |" for row in table)


def _sources(results: Sequence[Result]) -> Iterator[str]:
    """Where each line comes from, and what it took."""
    yield "## Where the figures come from"
    head = ["method", "list", "weights", "sampling [s]", "judging [s]", "remarks"]
    rows = [head, ["---", "---", "---", "--:", "--:", "---"]]
    for result in results:
        line, facts = result.line, result.line.evaluation.facts
        digest = facts.get("weights_sha256")
        weights = f"{facts.get('weights', line.row.weights)}" + (f" `{digest[:12]}`" if digest else "")
        spent = ["" if facts.get(name) is None else f"{facts[name]:.0f}" for name in ("sampling_s", "judging_s")]
        remarks = [*line.remarks, *(["recorded, not run here"] if line.recorded else [])]
        rows.append([line.row.name, LIST_NAMES[line.block_list], weights, *spent, "; ".join(remarks)])
    yield "\n".join(f"| {' | '.join(row)} |" for row in rows)
    for row in _rows(results):
        if row.note:
            yield f"**{row.name}.** {row.note}"


def _rows(results: Sequence[Result]) -> list[Row]:
    """Each row once."""
    return list({result.line.row.name: result.line.row for result in results}.values())


def _from_scratch(results: Sequence[Result], groundwork: Sequence[Training]) -> Iterator[str]:
    """Everything that was done to get here, in order."""
    minutes = run_seconds(result.line for result in results) / 60
    before = trainings(_rows(results), groundwork)
    yield "## From scratch"
    text = f"The rows that are not recorded take {minutes:.1f} minutes from their weights, and the pictures one more."
    if before:
        hours = sum(training.hours for training in before)
        text += f" Before that come {hours:.1f} hours of generating and training:"
    yield text
    for training in before:
        yield f"**{training.name}**, {training.hours:g} hours on {training.machine}:"
        yield f"```bash\n{training.command.strip()}\n```"


def terminal_table(results: Sequence[Result]) -> Table:
    """The gist, for the terminal."""
    shown = ("stability", "front_iou", "avg_iou", "iou_given_stable", "valid_diversity")
    table = Table("method", "list", title="Mean [%], on all scenes", box=SIMPLE)
    for name in shown:
        table.add_column(NAMES[name], justify="right")
    for result in results:
        line = result.line
        cells = [result.figures[ALL].metrics[name] for name in shown]
        values = ("-" if cell is None else f"{100 * cell.value:.1f}" for cell in cells)
        table.add_row(escape(line.row.name), LIST_NAMES[line.block_list], *values)
    return table
