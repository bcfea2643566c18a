"""The report as files: Markdown for people, CSV for spreadsheets, JSON for programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.box import SIMPLE
from rich.markup import escape
from rich.table import Table

from stackgen.evaluation.intervals import Estimate
from stackgen.evaluation.metrics import METRICS
from stackgen.evaluation.report.references import NOTIONS, Unseen
from stackgen.evaluation.report.results import ALL, Result, run_seconds
from stackgen.evaluation.report.rows import KINDS, NETWORKS, Row, Training, trainings
from stackgen.evaluation.results import PERCENT, TOP
from stackgen.evaluation.tables import HEADINGS, PAPER_COLUMNS

FORMAT = "stackgen.report/2"
SECTIONS = {
    "one-shot": "Single samples, neither simulated nor chosen",
    "verified": "Verified sampling: the best of several samples, chosen by a checker",
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
FITS = {"overlap": "largest overlap [cell]", "gap": "largest gap [cell]", "in_both": "stands in both engines [%]"}


@dataclass(frozen=True)
class Conditions:
    """What all numbers of a report hold for.

    Args:
        test_set: Name of the test set and hash of its manifest.
        scenes: How many of its scenes were asked about.
        all_scenes: How many it has.
        num_samples, seed: Settings of the protocol.
        physics: Numbers that the verdicts depend on.
        code: Version of this package.
        machine: Where the report was made.
    """

    test_set: tuple[str, str]
    scenes: int
    all_scenes: int
    num_samples: int
    seed: int
    physics: dict[str, Any]
    code: str
    machine: str


@dataclass(frozen=True)
class Report:
    """All that the tables show.

    Args:
        results: Results in the order of the rows.
        conditions: What they hold for.
        unseen: Scenes that are looked at on their own, if they are known.
        groundwork: What comes before the rows when everything is made from scratch.
    """

    results: Sequence[Result]
    conditions: Conditions
    unseen: Unseen | None = None
    groundwork: Sequence[Training] = ()


def to_json(report: Report) -> dict[str, Any]:
    """Give the plain form of the whole report."""
    unseen = report.unseen
    return {
        "format": FORMAT,
        **asdict(report.conditions),
        "test_set": dict(zip(("name", "sha256"), report.conditions.test_set, strict=True)),
        "interval": "95 %, cluster bootstrap over scenes",
        "unseen": unseen and {"training_sets": unseen.names, "sha256": sorted(unseen.hashes), "notions": NOTIONS},
        "groundwork": [asdict(training) for training in report.groundwork],
        "rows": [result.to_json() for result in report.results],
    }


def csv_rows(report: Report) -> list[dict[str, Any]]:
    """Make one line for each row, block list and set of scenes, in percent; empty where a metric does not exist."""
    return [_csv_row(result, subset) for result in report.results for subset in result.metrics]


def _csv_row(result: Result, subset: str) -> dict[str, Any]:
    answer = result.evaluation
    row: dict[str, Any] = {
        "method": result.row.name,
        "kind": result.row.kind,
        "block_list": result.block_list,
        "scenes": subset,
        "number_of_scenes": result.scenes[subset],
        "samples_per_scene": answer.num_samples,
        "seconds_per_sample": _blank(answer.seconds_per_sample if subset == ALL else None),
    }
    for name in (*METRICS, "of_diversity_limit"):
        value = result.metrics[subset].get(name)
        row[name] = "" if value is None else round(100 * value.value, 4)
        row[f"{name}_low"] = "" if value is None else round(100 * value.low, 4)
        row[f"{name}_high"] = "" if value is None else round(100 * value.high, 4)
        if name in PAPER_COLUMNS:
            row[f"{name}_paper"] = _blank(result.paper.get(name) if subset == ALL else None)
    for name in FITS:
        value, scale = result.fit[name] if subset == ALL else None, 100 if name == "in_both" else 1
        column = name if name == "in_both" else f"{name}_cells"
        row[column] = "" if value is None else round(scale * value.value, 4)
        row[f"{column}_low"] = "" if value is None else round(scale * value.low, 4)
        row[f"{column}_high"] = "" if value is None else round(scale * value.high, 4)
    return row


def _blank(value: float | None) -> float | str:
    return "" if value is None else value


def to_markdown(report: Report, pictures: Sequence[str]) -> str:
    """Write the page `table.md`; `pictures` are the lines of Markdown that show the pictures."""
    results = report.results
    parts = [_head(report.conditions)]
    for kind in KINDS:
        some = [result for result in results if result.row.kind == kind]
        if some:
            parts += [f"## {SECTIONS[kind]}", *_section(some, report.unseen)]
    parts += [*_block_lists(results), "## Pictures", *pictures, *_sources(results)]
    return "\n\n".join([*parts, *_from_scratch(results, report.groundwork)]) + "\n"


def _head(conditions: Conditions) -> str:
    partly = conditions.scenes < conditions.all_scenes
    number = f"**The first {conditions.scenes} of {conditions.all_scenes}**" if partly else conditions.scenes
    parts = [
        "# The paper's table, every row",
        f"`stackgen report` writes this page and overwrites what is changed here by hand. Code {conditions.code}.",
        f"{number} scenes of {conditions.test_set[0]} (SHA-256 of its manifest {conditions.test_set[1][:12]}...), "
        f"{conditions.num_samples} samples each, seed {conditions.seed}. Percent; in parentheses the 95 % interval, "
        "clustered by scene ([metrics.md](../metrics.md)). The *paper's* columns quote the paper, whose numbers come "
        "from its own data and physics. **List**: whose block lists, the true ones or the most likely ones of the CNN. "
        f"Seconds were measured on {conditions.machine}. Physics: {_numbers(conditions.physics)}.",
    ]
    return "\n\n".join(parts)


Text = Callable[[Result, str], str]
"""What stands in a cell of a table, from a result and a set of scenes."""


def _section(results: Sequence[Result], unseen: Unseen | None) -> Iterator[str]:
    """Make the tables of one kind of rows."""
    yield "### The paper's columns"
    columns: dict[str, Text] = {}
    for name in PAPER_COLUMNS:
        columns[NAMES[name]] = _metric(name)
        columns[f"*paper's* {NAMES[name]}"] = lambda result, _, name=name: (  # type: ignore[misc]
            f"*{result.paper[name]:.2f}*" if name in result.paper else ""
        )
    yield _table(results, ALL, columns)
    yield "### What they hide"
    hidden: dict[str, Text] = {NAMES[name]: _metric(name) for name in HIDDEN}
    hidden["valid diversity / its limit"] = _metric("of_diversity_limit")
    hidden["seconds a sample"] = lambda result, _: _seconds(result.evaluation.seconds_per_sample)
    yield _table(results, ALL, hidden)
    yield from _limit_note(results)
    yield "### How the blocks lie to each other, as they come"
    yield _fit_note(results)
    yield _table(results, ALL, {heading: _fit(name) for name, heading in FITS.items()})
    for notion, meaning in NOTIONS.items() if unseen else ():
        known = [result for result in results if notion in result.metrics]
        if known and unseen:
            yield f"### On the {known[0].scenes[notion]} scenes whose {notion} training has never seen"
            yield f"In {' and '.join(unseen.names)}, {meaning}."
            yield _table(known, notion, {NAMES[name]: _metric(name) for name in ON_UNSEEN})


def _table(results: Sequence[Result], subset: str, columns: dict[str, Text]) -> str:
    head = [["method", "list", *columns], ["---"] * 2 + ["--:"] * len(columns)]
    rows = [[*_label(result), *(text(result, subset) for text in columns.values())] for result in results]
    return _markdown([*head, *rows])


def _label(result: Result) -> tuple[str, str]:
    """Name a result in the first two columns of a table."""
    return result.row.name, result.list_name


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _metric(name: str) -> Text:
    return lambda result, subset: percent(result.metrics[subset].get(name))


def percent(estimate: Estimate | None) -> str:
    """Write a value and its interval; nothing where there is none.

    >>> percent(Estimate(0.5, 0.25, 0.751))
    '50.0 (25.0 to 75.1)'
    """
    if estimate is None:
        return ""
    return f"{100 * estimate.value:.1f} ({100 * estimate.low:.1f} to {100 * estimate.high:.1f})"


def _fit(name: str) -> Text:
    return lambda result, _: percent(result.fit[name]) if name == "in_both" else _cells(result.fit[name])


def _cells(estimate: Estimate | None) -> str:
    if estimate is None:
        return ""
    value, low, high = (abs(depth) for depth in (estimate.value, estimate.low, estimate.high))  # no -0.000
    return f"{value:.3f} ({low:.3f} to {high:.3f})"


def _fit_note(results: Sequence[Result]) -> str:
    """Say what overlaps, gaps and the second engine are."""
    note = (
        f"Before anything moves. {PERCENT} % of the samples have no block that is deeper in another or in the ground, "
        "and none that is higher above what is below it. "
    )
    engines = {result.evaluation.second["engine"]: result.evaluation.second for result in results
               if result.evaluation.second}  # fmt: skip
    if not engines:
        return f"{note}Only one engine is installed, so no other was asked."
    return f"{note}Stands in both: also in {' and '.join(map(_numbers, engines.values()))}, from the same poses."


def _numbers(physics: Mapping[str, Any]) -> str:
    """Write an engine and its numbers."""
    plain = {name: value if isinstance(value, str) else f"{value:.6g}" for name, value in physics.items()}
    return f"{plain.pop('engine', 'an unknown engine')} ({', '.join(f'{name} {plain[name]}' for name in plain)})"


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


def _limit_note(results: Sequence[Result]) -> Iterator[str]:
    """Say what valid diversity is measured by."""
    known = [result for result in results if result.limit_scenes[ALL]]
    if not known:
        return
    firsts: dict[str, Result] = {}
    for result in known:
        firsts.setdefault(result.list_name, result)
    limits = [
        f"{percent(some.metrics[ALL]['diversity_limit'])} with the {name} list ({some.limit_scenes[ALL]} scenes)"
        for name, some in firsts.items()
    ]
    beyond = [
        f"{result.row.name} ({result.list_name} list) {100 * some.value:.1f}"
        for result in known
        if (some := result.metrics[ALL]["beyond_diversity_limit"]) is not None
    ]
    yield (
        f"Diversity limit: {', '.join(limits)}. Samples drawn uniformly from all layouts that fill the silhouette's "
        "cells and stand would reach this valid diversity ([report.md](../report.md)). A sample is valid if it stands "
        "with front IoU of at least 0.8, so a few valid samples have other layouts, with a block in a wrong cell. "
        f"Their share of the valid samples [%]: {', '.join(beyond)}."
    )


def _block_lists(results: Sequence[Result]) -> Iterator[str]:
    """Give the predictors' own metrics, each once."""
    rows, seen = [], set()
    for result in results:
        estimates = result.evaluation.list_estimates()
        predictor = str(result.question.get("predictor"))
        if estimates and predictor not in seen:
            seen.add(predictor)
            who = "CNN" if result.list_name == NETWORKS else result.row.name
            rows.append([f"{who} `{predictor[:12]}`", *(percent(estimate) for estimate in estimates.values())])
    if rows:
        head = ["by", "most likely list is the true one", f"true one among {TOP}", "can make the silhouette"]
        yield "## Predicted block lists"
        yield _markdown([head, ["---", *["--:"] * 3], *rows])


def _sources(results: Sequence[Result]) -> Iterator[str]:
    """Say which weights each row was asked with, and what it took."""
    yield "## Weights and times"
    rows = [
        ["method", "list", "weights", "sampling [s]", "checking [s]", "remarks"],
        ["---", "---", "---", "--:", "--:", "---"],
    ]
    for result in results:
        facts, answer = result.evaluation.facts, result.evaluation
        digest = facts.get("weights_sha256")
        weights = str(facts.get("weights")) + (f" `{digest[:12]}`" if digest else "")
        spent = [f"{seconds:.0f}" for seconds in (answer.sampling_seconds, answer.checking_seconds or 0.0)]
        rows.append([*_label(result), weights, *spent, result.remark])
    yield _markdown(rows)
    for row in _rows(results):
        if row.note:
            yield f"**{row.name}.** {row.note}"


def _rows(results: Sequence[Result]) -> list[Row]:
    """List each row once."""
    return list({result.row.name: result.row for result in results}.values())


def _from_scratch(results: Sequence[Result], groundwork: Sequence[Training]) -> Iterator[str]:
    """List everything that was done to get here, in order."""
    before = trainings(_rows(results), groundwork)
    yield "## From scratch"
    text = f"From their weights, all rows take {run_seconds(results) / 60:.1f} minutes, and the pictures one more."
    if before:
        hours = sum(training.hours for training in before)
        text += f" Before that come {hours:.1f} hours of generating and training:"
    yield text
    for training in before:
        yield f"**{training.name}**, {training.hours:g} hours on {training.machine}:"
        yield f"```bash\n{training.command.strip()}\n```"


def terminal_table(results: Sequence[Result]) -> Table:
    """Make a short table for the terminal."""
    shown = ("stability", "front_iou", "avg_iou", "iou_given_stable", "valid_diversity")
    table = Table("method", "list", title="Mean [%], on all scenes", box=SIMPLE)
    for name in shown:
        table.add_column(NAMES[name], justify="right")
    for result in results:
        estimates = [result.metrics[ALL][name] for name in shown]
        values = ("-" if some is None else f"{100 * some.value:.1f}" for some in estimates)
        table.add_row(escape(result.row.name), result.list_name, *values)
    return table
