"""The report: it knows its answers again, mixes nothing, counts right, and goes on where it stopped."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.evaluation.engines import completed, second_engine
from stackgen.evaluation.intervals import Estimate
from stackgen.evaluation.metrics import METRICS, SampleScore, SceneScore
from stackgen.evaluation.report.charts import draw_charts
from stackgen.evaluation.report.references import (
    LIMIT_FILE,
    SEEN_FILE,
    DiversityLimit,
    Unseen,
    format_layout,
    parse_layout,
    read_diversity_limit,
    read_unseen,
)
from stackgen.evaluation.report.results import ALL, Result, result_of
from stackgen.evaluation.report.rows import Row, Training, check_rows
from stackgen.evaluation.report.sheets import pick_examples
from stackgen.evaluation.report.store import Store, differences, key_of, other_conditions
from stackgen.evaluation.report.tables import Conditions, Report, csv_rows, to_json, to_markdown
from stackgen.evaluation.requests import Method
from stackgen.evaluation.results import (
    PREDICTED_LIST,
    TRUE_LIST,
    Evaluation,
    SceneResult,
    read_evaluation,
    write_csv,
    write_evaluation,
)
from stackgen.evaluation.tables import PAPER_COLUMNS
from stackgen.protocols import StabilityChecker, Verdict
from stackgen.sim.physics import Physics
from stackgen.stack import Layout, Stack

ONE: Layout = ((0, 0), (1,), (), ())
OTHER: Layout = ((1,), (0, 0), (), ())
THIRD: Layout = ((0, 1), (0,), (), ())
PHYSICS = {"engine": "pybullet 3.2.7", "friction": 0.5}
ROW = Row("A method", Method("a"), paper="StackGen")


def question(**changes: Any) -> dict[str, Any]:
    asked = {"test_set": "t", "scenes": 2, "num_samples": 3, "seed": 0, "batch_size": 64, "physics": PHYSICS}
    return {"sampler": {"weights": "w"}, "block_list": PREDICTED_LIST, "predictor": "p", **asked, **changes}


def sample(stable: bool = True, iou: float = 0.9, shape: Layout = ONE) -> SampleScore:
    seen = iou if stable else 0.0
    return SampleScore(stable, {"front": seen, "side": seen / 2, "top": seen / 4}, iou, shape, 0.25, 0.0, stable)


def scene(name: str, *samples: SampleScore) -> SceneResult:
    fell = tuple(() if s.stable else (1,) for s in samples)
    drop = tuple(0.0 if s.stable else 1.5 for s in samples)
    cubes = np.array([0, 0]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1 / 3 + 1, 0, 0, 0.1]])
    stacks = tuple(Stack(*cubes) for _ in samples)
    return SceneResult(name, (2, 1, 0, 0), SceneScore(samples), fell, drop, 0, True, 0.25, stacks)


@pytest.fixture
def answered() -> Evaluation:
    """Two scenes: of one all samples are valid, of two layouts; of the other one falls and one misses."""
    scenes = (
        scene("00000-t1", sample(), sample(), sample(shape=OTHER)),
        scene("00001-t1", sample(), sample(stable=False), sample(iou=0.5, shape=THIRD)),
    )
    return Evaluation("A method", PREDICTED_LIST, scenes, 3, 0, PHYSICS, {"weights": "a"})


def test_an_evaluation_is_read_as_it_was_written(answered: Evaluation, tmp_path: Path) -> None:
    write_evaluation(tmp_path / "e.json", answered, question())
    found, asked = read_evaluation(tmp_path / "e.json")
    assert found == answered and asked == question()
    for mine, theirs in zip(found.scenes, answered.scenes, strict=True):
        assert mine.seconds == theirs.seconds
        for a, b in zip(mine.stacks, theirs.stacks, strict=True):
            assert np.array_equal(a.shapes, b.shapes) and np.array_equal(a.poses, b.poses)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "stackgen.evaluation/2"}', '{"format": "else"}'])
def test_a_damaged_evaluation_is_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "e.json").write_text(text)
    with pytest.raises(StackgenError, match=r"e\.json is (damaged|not JSON)"):
        read_evaluation(tmp_path / "e.json")


def test_numbers_that_no_stack_has_are_damage(answered: Evaluation, tmp_path: Path) -> None:
    write_evaluation(tmp_path / "e.json", answered, question())
    text = (tmp_path / "e.json").read_text()
    (tmp_path / "e.json").write_text(text.replace('"shapes": [[', f'"shapes": [[{10**20}, ', 1))
    with pytest.raises(StackgenError, match=r"e\.json is damaged"):
        read_evaluation(tmp_path / "e.json")


@pytest.mark.parametrize(
    "changes",
    [
        {"sampler": {"weights": "v"}}, {"sampler": {"weights": "w", "settings": {"steps": 8}}},
        {"block_list": TRUE_LIST}, {"predictor": "q"}, {"test_set": "u"}, {"scenes": 3}, {"num_samples": 1},
        {"seed": 1}, {"batch_size": 8}, {"physics": {**PHYSICS, "friction": 0.4}},
    ],
)  # fmt: skip
def test_another_question_has_another_key(changes: dict[str, Any]) -> None:
    assert key_of(question(**changes)) != key_of(question())
    assert key_of(question()) == key_of(dict(reversed(question().items())))
    assert differences(question(), question(**changes))


def test_an_answer_is_found_by_its_question_alone(answered: Evaluation, tmp_path: Path) -> None:
    store = Store(tmp_path / "cache", tmp_path / "runs")
    assert store.find(question()) is None
    store.keep(answered, question())
    found = store.find(question())
    assert found is not None and found[0] == answered
    assert store.find(question(seed=1)) is None


def test_half_of_an_answer_is_none_and_said_to_be(answered: Evaluation, tmp_path: Path) -> None:
    store = Store(tmp_path, tmp_path)
    store.keep(answered, question())
    (file,) = tmp_path.glob("*.json")
    whole = file.read_text()
    file.write_text(whole[:500])
    with pytest.warns(UserWarning, match="not JSON"):
        assert store.find(question()) is None
    file.write_text(whole.replace("stackgen.evaluation/2", "stackgen.evaluation/1"))
    with pytest.warns(UserWarning, match="older version"):
        assert store.find(question()) is None


def test_an_answer_of_an_earlier_version_is_completed(answered: Evaluation, tmp_path: Path) -> None:
    store = Store(tmp_path, tmp_path)
    store.keep(answered, question())
    (file,) = tmp_path.glob("*.json")
    content = json.loads(file.read_text())
    content["rows"][0]["kept"].pop("second")
    for scene in content["rows"][0]["results"]:
        for some in scene["samples"]:
            for name in ("overlap", "gap", "in_both"):
                some.pop(name)
    file.write_text(json.dumps(content))
    found = store.find(question())
    assert found is not None and set(found[0].fit().values()) == {None}
    second = Leaning()
    whole = completed(found[0], second)
    assert second.asked == 5  # of six samples one falls
    fit = {name: value(estimate) for name, estimate in whole.fit().items()}
    assert fit == pytest.approx({"overlap": 1 / 6, "gap": 0.0, "in_both": 5 / 6}, abs=0.06)
    assert completed(whole, second) is whole and second.asked == 5
    assert completed(whole, None) is whole


class Leaning(StabilityChecker):
    """By which everything stands."""

    physics = Physics(engine="mujoco")
    asked = 0

    def check(self, stack: Stack) -> Verdict:
        self.asked += 1
        return Verdict(True, np.zeros(len(stack), bool), np.zeros(len(stack)), stack)


def test_a_second_engine_is_the_other_one() -> None:
    with second_engine(Physics(engine="bullet", friction=0.4)) as second:
        if find_spec("mujoco"):
            assert second is not None and second.physics == Physics(engine="mujoco", friction=0.4)
        else:
            assert second is None


def test_a_list_is_the_method_s_own_where_it_predicts_itself() -> None:
    own = replace(ROW, model=Method("search", "search"))
    assert [own.list_name(PREDICTED_LIST), ROW.list_name(PREDICTED_LIST), own.list_name(TRUE_LIST)] == [
        "own", "CNN's", "true",
    ]  # fmt: skip


def test_tests_under_other_conditions_are_left_out_and_named(answered: Evaluation, tmp_path: Path) -> None:
    test = tmp_path / "runs" / "run" / "test_0"
    test.mkdir(parents=True)
    other = question(physics={**PHYSICS, "friction": 0.4}, test_set="another")
    write_evaluation(test / "evaluation-predicted.json", answered, other)
    store = Store(tmp_path / "cache", tmp_path / "runs")
    assert store.find(question()) is None
    ((path, remark),) = store.left_out(question())
    assert path.parent == test and remark == "other physics: friction 0.4, not 0.5; another test set: another"
    assert not list(store.left_out(question(sampler={"weights": "v"})))
    here = store.find(other)
    assert here is not None and here[1].parent == test


def test_equal_conditions_have_no_remark() -> None:
    assert other_conditions(question(), question(seed=3)) == ()


def result(answered: Evaluation, unseen: Unseen | None = None) -> Result:
    known = {"00000-t1": {ONE, OTHER}, "00001-t1": {ONE, THIRD, OTHER}}
    limit = DiversityLimit({(name, (2, 1, 0, 0)): frozenset(layouts) for name, layouts in known.items()})
    return result_of(ROW, answered, question(), limit=limit, unseen=unseen)


def value(estimate: Estimate | None) -> float:
    assert estimate is not None
    return estimate.value


def test_the_metrics_of_a_known_answer(answered: Evaluation) -> None:
    found = result(answered)
    values = {name: value(estimate) for name, estimate in found.metrics[ALL].items()}
    assert set(values) == {*METRICS, "diversity_limit", "of_diversity_limit", "beyond_diversity_limit"}
    assert values["stability"] == pytest.approx(5 / 6) and values["front_iou"] == pytest.approx((4 * 0.9 + 0.5) / 6)
    assert values["side_iou"] == pytest.approx(values["front_iou"] / 2)
    assert values["top_iou"] == pytest.approx(values["front_iou"] / 4)
    assert values["diversity"] == pytest.approx(2 / 3)
    assert values["valid_diversity"] == pytest.approx((2 / 3 + 1 / 3) / 2)
    two, three = 2 / 3 * (1 - 1 / 8), 1 - (2 / 3) ** 3
    assert values["diversity_limit"] == pytest.approx((two + three) / 2)
    assert values["of_diversity_limit"] == pytest.approx(1 / (two + three))
    assert found.limit_scenes[ALL] == 2 and values["beyond_diversity_limit"] == 0


def test_valid_samples_of_other_layouts_are_counted(answered: Evaluation) -> None:
    limit = DiversityLimit({("00000-t1", (2, 1, 0, 0)): frozenset([OTHER])})
    assert value(limit.estimates(answered)[1]["beyond_diversity_limit"]) == pytest.approx(2 / 3)
    of_another_list = DiversityLimit({("00000-t1", (1, 1, 0, 0)): frozenset([ONE])})
    assert of_another_list.estimates(answered) == (0, {})


def test_one_sample_has_no_diversity(answered: Evaluation) -> None:
    found = result(replace(answered, num_samples=1)).metrics[ALL]
    assert found["diversity"] is None and found["valid_diversity"] is None and "of_diversity_limit" not in found


def test_unseen_scenes_are_counted_on_their_own(answered: Evaluation) -> None:
    unseen = Unseen(("base",), frozenset(["x"]), {"designs": frozenset(["00001-t1"]), "layouts": frozenset()})
    found = result(answered, unseen)
    assert set(found.metrics) == {ALL, "designs"} and found.scenes == {ALL: 2, "designs": 1}
    assert value(found.metrics["designs"]["stability"]) == pytest.approx(2 / 3) and not found.remark
    elsewhere = replace(answered, facts={"trained_on": {"name": "mine", "sha256": "y"}})
    assert result(elsewhere, unseen).remark.startswith("trained on mine")


def test_what_ships_says_which_scenes_training_has_not_seen() -> None:
    data = json.loads(SEEN_FILE.read_text())
    found = read_unseen(data["test_set"])
    assert found.scenes["layouts"] < found.scenes["designs"]  # who knows a design knows its layout
    with pytest.raises(StackgenError, match="another test set"):
        read_unseen("else")
    limit = json.loads(LIMIT_FILE.read_text())["figures"]
    assert read_diversity_limit(LIMIT_FILE, data["test_set"], limit["physics"]).layouts
    with pytest.raises(StackgenError, match="knows the training sets"):
        read_unseen(data["test_set"], ["unheard-of"])


def test_a_diversity_limit_under_other_conditions_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "limit.json"
    part = {"scenes": [{"scene": "00000-t1", "counts": [2, 1, 0, 0], "valid": [format_layout(ONE)]}]}
    path.write_text(json.dumps({"figures": {"test_set": "t", "physics": PHYSICS, "lists": {TRUE_LIST: part}}}))
    assert read_diversity_limit(path, "t", PHYSICS).layouts == {("00000-t1", (2, 1, 0, 0)): frozenset([ONE])}
    for test_set, physics in (("u", PHYSICS), ("t", {**PHYSICS, "friction": 0.4})):
        with pytest.raises(StackgenError, match="another test set or other physics"):
            read_diversity_limit(path, test_set, physics)
    path.write_text("{}")
    with pytest.raises(StackgenError, match="damaged"):
        read_diversity_limit(path, "t", PHYSICS)


@pytest.mark.parametrize("layout", [ONE, ((), (), (), ()), ((10, 2), (), (3,), ())])
def test_layouts_are_read_as_they_were_written(layout: Layout) -> None:
    assert parse_layout(format_layout(layout)) == layout


def test_examples_are_successes_and_failures_of_distinct_scenes(answered: Evaluation) -> None:
    many = tuple(replace(answered.scenes[i % 2], name=str(i)) for i in range(40))
    successes, failures = pick_examples(replace(answered, scenes=many))
    assert len(successes) == len(failures) == 4
    assert all(example.scene.score.samples[example.number].valid for example in successes)
    assert not any(example.scene.score.samples[example.number].valid for example in failures)
    assert len({example.scene.name for example in successes}) == 4
    assert successes[0].scene.name == "0" and successes[-1].scene.name == "39"


@pytest.mark.parametrize(
    "rows", [[], [ROW, ROW], [replace(ROW, name="?")], [replace(ROW, kind="verified")], [replace(ROW, paper="Else")]]
)
def test_rows_that_say_nothing_are_one_line(rows: list[Row]) -> None:
    with pytest.raises(StackgenError, match=r"^report: "):
        check_rows(rows)


CONDITIONS = Conditions(("towers", "0123456789abcdef"), 2, 2, 3, 0, PHYSICS, "0.1.0", "a machine")


def test_tables_hold_every_row_in_the_section_of_its_kind(answered: Evaluation, tmp_path: Path) -> None:
    verified = replace(ROW, name="Verified one", kind="verified", paper=None, note="Eight draws.")
    other = replace(answered, checking_seconds=88.5)
    training = Training("The data", "stackgen generate --config x.yaml", 1.5, "a machine")
    plain, chosen = (result_of(row, some, question()) for row, some in ((ROW, answered), (verified, other)))
    results = [replace(plain, remark="on other data"), chosen]
    report = Report(results, CONDITIONS, groundwork=[training])
    text = to_markdown(report, ["![a](a.png)"])
    one_shot, _, rest = text.partition("## Verified")
    assert "| A method | CNN's |" in one_shot and "Verified one" not in one_shot
    assert "| Verified one | CNN's |" in rest and "Eight draws." in rest and "on other data" in rest
    assert "*85.20*" in one_shot and "take 1.5 minutes" in rest and training.command in rest
    assert "83.3 (66.7 to 100.0)" in one_shot  # stability: two scenes
    write_csv(tmp_path / "table.csv", csv_rows(report))
    rows = list(csv.DictReader(io.StringIO((tmp_path / "table.csv").read_text())))
    assert [row["method"] for row in rows] == ["A method", "Verified one"]
    assert float(rows[0]["stability"]) == pytest.approx(83.3333) and rows[0]["stability_paper"] == "85.2"
    assert rows[1]["stability_paper"] == "" and rows[1]["number_of_scenes"] == "2"
    assert "| A method | CNN's | 0.250 (0.250 to 0.250) | 0.000 (0.000 to 0.000) | 83.3 (66.7 to 100.0) |" in one_shot
    assert (rows[0]["overlap_cells"], rows[0]["in_both"]) == ("0.25", "83.3333")
    first = json.loads(json.dumps(to_json(report), allow_nan=False))["rows"][0]
    assert first["remark"] == "on other data" and set(first["paper_percent"]) == set(PAPER_COLUMNS)
    assert first["metrics"]["all"]["stability"]["value"] == pytest.approx(5 / 6)


def test_a_chart_is_the_same_twice(answered: Evaluation, tmp_path: Path) -> None:
    results = [result_of(ROW, answered, question())]
    names = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        names = draw_charts(results, folder)
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert len(files) == len(names) == 4
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
