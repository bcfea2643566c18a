"""Sweeps: one file for W&B and for here, exactly the trials asked for, whatever happens to the coordinator."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from stackgen.errors import StackgenError
from stackgen.io.text import read_yaml
from stackgen.training.sweeps.coordinator import folder_lock, mend_journal, open_study, run_sweep
from stackgen.training.sweeps.file import EarlyTerminate, Metric, Sweep
from stackgen.training.sweeps.findings import ranking, write_findings
from tests.conftest import CHILD, Cli

ROOT = Path(__file__).parents[3]
REAL = ROOT / "configs" / "sweeps" / "ddpm.yaml"

PROGRAM = """
import json, os, sys, time
from pathlib import Path
values = dict(word[2:].split("=", 1) for word in sys.argv[1:])
told = Path(os.environ["STACKGEN_METRICS"])
with open(told.parent / "starts", "a") as file:
    file.write(f"{os.getpid()}\\n")
if values.get("fails") == "True":
    sys.exit("no luck")
for step in range(1, 4):
    with told.open("a") as file:
        file.write(json.dumps({"step": step, "loss": (float(values["x"]) - 3) ** 2 + 1 / step}) + "\\n")
    time.sleep(float(values.get("nap", 0)))
(told.parent / "done").touch()
"""


@pytest.fixture
def program(tmp_path: Path) -> Path:
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    return path


def sweep_of(program: Path, **options: Any) -> Sweep:
    """A sweep over x whose loss is least at 3."""
    given: dict[str, Any] = {
        "parameters": {"x": {"min": 0, "max": 7}},
        "metric": Metric("loss"),
        "command": ["${interpreter}", "${program}", "${args}"],
        "method": "random",
        "name": "toy",
        **options,
    }
    return Sweep(str(program), **given)


def states(folder: Path, sweep: Sweep) -> list[str]:
    return [trial.state.name.lower() for trial in open_study(sweep, folder).trials]


def starts(folder: Path) -> list[int]:
    """How often each trial's program was started."""
    return [len(path.read_text().split()) for path in sorted(folder.glob("trials/*/starts"))]


def test_a_sweep_ends_with_the_best_configuration_and_pictures(
    cli: Cli, program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    sweep = sweep_of(program, run_cap=8, parameters={"x": {"min": 0, "max": 7}, "y.z": {"value": 2}})
    Path("toy.yaml").write_text(sweep.to_yaml())
    answer = cli("sweep", "--config", "toy.yaml", "--parallel", 2)
    assert answer.code == 0, answer.err
    folder = Path("runs/sweeps/toy")
    with (folder / "leaderboard.csv").open() as file:
        rows = list(csv.DictReader(file))
    losses = [float(row["loss"]) for row in rows]
    assert len(rows) == 8 and losses == sorted(losses)
    assert all(float(row["loss"]) == pytest.approx((int(row["x"]) - 3) ** 2 + 1 / 3, rel=1e-5) for row in rows)
    assert yaml.safe_load((folder / "best.yaml").read_text()) == {"x": int(rows[0]["x"]), "y": {"z": 2}}
    for name in ("slices.png", "importance.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    assert f"optuna-dashboard {folder}/journal.log" in answer.out
    again = cli("sweep", "--config", "toy.yaml", "--run_cap", 9)  # one more, of the same sweep
    assert again.code == 0 and len(states(folder, sweep)) == 9
    assert starts(folder) == [1] * 9
    other = cli("sweep", "--config", "toy.yaml", "--metric.goal", "maximize")
    assert other.code == 2 and "another metric" in other.line


def test_a_grid_without_a_metric_is_run_and_listed(program: Path, cli: Cli, tmp_path: Path) -> None:
    content = {"program": "program.py", "method": "grid", "parameters": {"x": {"values": [4, 5, 6]}}}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(content))
    answer = cli("sweep", "--config", tmp_path / "s.yaml", "--program", program, "--out", tmp_path / "s")
    assert answer.code == 0, answer.err
    rows = list(csv.DictReader((tmp_path / "s" / "leaderboard.csv").open()))
    assert [(row["state"], row["x"]) for row in rows] == [("complete", "4"), ("complete", "5"), ("complete", "6")]
    assert not (tmp_path / "s" / "best.yaml").exists()
    assert "metric" not in yaml.safe_load(cli("sweep", "--config", tmp_path / "s.yaml", "--export_wandb").out)
    answer = cli("sweep", "--config", tmp_path / "s.yaml", "--method", "bayes", "--out", tmp_path / "t")
    assert answer.code == 2 and "needs a metric" in answer.line and not (tmp_path / "t").exists()


def test_no_trial_starts_once_the_target_is_reached(program: Path, tmp_path: Path) -> None:
    parameters = {"x": {"values": [5, 3, 4]}}
    sweep = sweep_of(program, method="grid", parameters=parameters, metric=Metric("loss", target=1.0))
    run_sweep(sweep, tmp_path)
    assert states(tmp_path, sweep) == ["complete", "complete"]


def test_a_grid_is_visited_once(program: Path, tmp_path: Path) -> None:
    sweep = sweep_of(program, method="grid", parameters={"x": {"values": [0, 1, 2]}, "z": {"min": 4, "max": 5}})
    study = run_sweep(sweep, tmp_path / "out", parallel=3, tell=lambda line: None)
    assert sorted((trial.params["x"], trial.params["z"]) for trial in study.trials) == [
        (x, z) for x in (0, 1, 2) for z in (4, 5)
    ]


def test_bad_trials_are_given_up_and_their_programs_end(program: Path, tmp_path: Path) -> None:
    parameters = {"x": {"values": [3, 4, 5, 6, 7, 8]}, "nap": {"value": 0.4}}
    stop = EarlyTerminate(min_iter=1, eta=2)
    sweep = sweep_of(program, method="grid", parameters=parameters, early_terminate=stop)
    folder = tmp_path / "out"
    study = run_sweep(sweep, folder, tell=lambda line: None)
    best = ranking(study)[0]
    assert best.params["x"] == 3 and best.state.name == "COMPLETE"
    given_up = [trial for trial in study.trials if trial.state.name == "PRUNED"]
    assert given_up and min(trial.params["x"] for trial in given_up) > 3
    assert len(given_up) + sum(trial.state.name == "COMPLETE" for trial in study.trials) == 6
    for trial in study.trials:
        assert (folder / f"trials/{trial.number:04d}/done").exists() == (trial.state.name == "COMPLETE")


def test_an_interrupted_sweep_goes_on_with_the_same_trials(program: Path, tmp_path: Path) -> None:
    sweep, folder = (
        sweep_of(program, run_cap=5, parameters={"x": {"min": 0, "max": 7}, "nap": {"value": 0.1}}),
        tmp_path,
    )
    lines: list[str] = []

    def interrupt(line: str) -> None:
        lines.append(line)
        if len(lines) == 1:  # the other trial may have ended too, but nobody has heard of it
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_sweep(sweep, folder, parallel=2, tell=interrupt)
    before = {trial.number: trial.params for trial in open_study(sweep, folder).trials}
    assert states(folder, sweep).count("complete") == 1 and states(folder, sweep).count("running") >= 1
    study = run_sweep(sweep, folder, parallel=2, tell=lines.append)
    assert states(folder, sweep) == ["complete"] * 5
    assert "were interrupted and start again" in lines[1]
    assert {n: study.trials[n].params for n in before} == before
    assert sum(starts(folder)) <= 5 + 2


def test_a_folder_has_one_coordinator(program: Path, tmp_path: Path) -> None:
    with folder_lock(tmp_path), pytest.raises(StackgenError, match="is in use"):
        run_sweep(sweep_of(program), tmp_path)


def test_a_program_that_always_fails_ends_the_sweep_with_its_last_words(program: Path, tmp_path: Path) -> None:
    parameters = {"x": {"min": 0, "max": 7}, "fails": {"value": True}}
    sweep = sweep_of(program, parameters=parameters)
    with pytest.raises(StackgenError, match=r"3 trials in a row failed.*no luck"):
        run_sweep(sweep, tmp_path / "out", tell=lambda line: None)
    assert states(tmp_path / "out", sweep) == ["fail"] * 3
    with pytest.raises(StackgenError, match=r"no trial of .* ran to its end"):
        write_findings(open_study(sweep, tmp_path / "out"), sweep, tmp_path / "out")


def test_a_journal_that_was_cut_off_is_mended(program: Path, tmp_path: Path) -> None:
    sweep = sweep_of(program, run_cap=2)
    run_sweep(sweep, tmp_path, tell=lambda line: None)
    journal = tmp_path / "journal.log"
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code": 4, "wor')
    mend_journal(journal)
    assert journal.read_bytes() == whole
    assert states(tmp_path, sweep) == ["complete"] * 2


@pytest.mark.parametrize("litter", [b"\n\n", b"\0" * 40, b"\0\n \n\0", b'\n{"op_code": 4, "wor'])
def test_blanks_and_nuls_of_a_journal_are_mended(litter: bytes, program: Path, tmp_path: Path) -> None:
    sweep = sweep_of(program, run_cap=2)
    run_sweep(sweep, tmp_path, tell=lambda line: None)
    journal = tmp_path / "journal.log"
    whole = journal.read_bytes()
    lines = whole.splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:3]) + litter.partition(b"{")[0] + b"".join(lines[3:]) + litter)
    mend_journal(journal)
    assert journal.read_bytes() == whole
    assert states(tmp_path, sweep) == ["complete"] * 2


@pytest.mark.parametrize(
    "damage", ["half a line", "nonsense", "entry without meaning", "no direction", "empty sweep", "half a sweep"]
)
def test_a_record_that_is_damaged_is_named(damage: str, program: Path, tmp_path: Path) -> None:
    sweep = sweep_of(program, run_cap=1)
    run_sweep(sweep, tmp_path, tell=lambda line: None)
    journal, file = tmp_path / "journal.log", tmp_path / "sweep.yaml"
    lines = journal.read_bytes().splitlines(keepends=True)
    if damage == "half a line":
        journal.write_bytes(b"".join([*lines[:2], lines[2][:20] + b"\n", *lines[3:]]))
    elif damage == "nonsense":
        journal.write_bytes(b"[1, 2]\n")
    elif damage == "no direction":
        journal.write_bytes(re.sub(rb'("directions": ?)\[\d\]', rb"\1[]", journal.read_bytes()))
    elif damage == "entry without meaning":
        journal.write_bytes(b'{"op_code": 0}\n')
    else:
        file.write_bytes(b"" if damage == "empty sweep" else file.read_bytes()[:5])
    with pytest.raises(StackgenError, match=r"(journal\.log|sweep\.yaml) is (empty or )?damaged") as caught:
        run_sweep(sweep, tmp_path, tell=lambda line: None)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["lr search 1", "../../x", "", ".", "a/b", "x\ny"])
def test_a_name_that_no_run_may_have_is_refused_before_anything_is_made(
    name: str, program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StackgenError, match="run name"):
        run_sweep(sweep_of(program, name=name), tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == [program.name]


DIVERGING = """
import json, os, sys
x = float(sys.argv[1].partition("=")[2])
with open(os.environ["STACKGEN_METRICS"], "a") as file:
    for step in range(3):
        lost = {"diverged": True} if x > 3 else {"loss": float("nan") if x > 2 else float("inf")}
        file.write(json.dumps({"step": step, **({"loss": x + 1 - step / 3} if x < 2 or step < 1 else lost)}) + "\\n")
sys.exit(2 if x > 3 else 0)
"""


def test_trials_that_diverge_are_called_so_and_the_sweep_goes_on(program: Path, tmp_path: Path) -> None:
    program.write_text(DIVERGING)
    sweep = sweep_of(program, method="grid", parameters={"x": {"values": [2.5, 3.5, 4.5, 2, 5.5, 1]}})
    lines: list[str] = []
    study = run_sweep(sweep, tmp_path, tell=lines.append)
    assert [("diverged" in line) for line in lines] == [True] * 5 + [False]
    write_findings(study, sweep, tmp_path)
    rows = list(csv.DictReader((tmp_path / "leaderboard.csv").open()))
    assert [row["state"] for row in rows] == ["complete"] + ["diverged"] * 5
    assert [row["loss"] for row in rows[1:]] == ["nan"] * 5
    assert yaml.safe_load((tmp_path / "best.yaml").read_text()) == {"x": 1}


def test_every_value_that_was_tried_is_reported(program: Path, tmp_path: Path) -> None:
    """Also where one name is the beginning of another, and where a text looks like a number."""
    parameters = {
        "x": {"values": [3, 4]},
        "x.rate": {"value": 0.1},
        "tag": {"values": ["77950e8", "yes"]},
        "t.u": {"value": "0777"},
    }
    sweep = sweep_of(program, method="grid", parameters=parameters, run_cap=1)
    write_findings(run_sweep(sweep, tmp_path, tell=lambda line: None), sweep, tmp_path)
    tried = json.loads((tmp_path / "trials/0000/parameters.json").read_text())
    assert tried == {"x.rate": 0.1, "t.u": "0777", "x": 3, "tag": "77950e8"}
    assert read_yaml(tmp_path / "best.yaml") == tried


def test_without_optuna_the_help_and_the_export_work_and_a_sweep_names_the_extra(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert "--parallel" in cli("sweep", "--help").out
    assert cli("sweep", "--config", REAL, "--export_wandb").code == 0
    answer = cli("sweep", "--config", REAL, "--out", tmp_path / "out")
    assert answer.code == 2 and "pip install 'stackgen[sweeps]'" in answer.line
    assert not (tmp_path / "out").exists()


def test_what_is_exported_is_the_file(cli: Cli) -> None:
    answer = cli("sweep", "--config", REAL, "--export_wandb")
    assert answer.code == 0, answer.err
    assert yaml.safe_load(answer.out) == yaml.safe_load(REAL.read_text())


@pytest.mark.slow
def test_a_killed_coordinator_leaves_nobody_behind_and_goes_on_with_exactly_its_trials(
    program: Path, tmp_path: Path
) -> None:
    parameters = {"x": {"min": 0, "max": 7}, "nap": {"value": 0.3}}
    sweep, folder = sweep_of(program, run_cap=9, method="bayes", parameters=parameters), tmp_path / "out"
    (tmp_path / "toy.yaml").write_text(sweep.to_yaml())
    words = ["sweep", "--config", str(tmp_path / "toy.yaml"), "--out", str(folder), "--parallel", "2"]
    for ended in (2, 5):
        process = subprocess.Popen(
            [sys.executable, "-m", "stackgen", *words], env=CHILD, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        while len(list(folder.glob("trials/*/done"))) < ended:
            assert process.poll() is None
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        pids = [int(pid) for path in folder.glob("trials/*/starts") for pid in path.read_text().split()]
        time.sleep(0.3)
        assert not [pid for pid in pids if alive(pid)]
    study = run_sweep(sweep, folder, parallel=2, tell=lambda line: None)
    assert states(folder, sweep) == ["complete"] * 9
    assert [json.loads(path.read_text())["x"] for path in sorted(folder.glob("trials/*/parameters.json"))] == [
        trial.params["x"] for trial in study.trials
    ]
    assert sum(starts(folder)) <= 9 + 2 * 2


def alive(pid: int) -> bool:
    """Whether a process runs; one that is dead and not yet buried does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_a_sweep_of_fit_finds_a_configuration_that_fits(
    cli: Cli, towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "disabled")
    base = {
        "model": {
            "class_path": "stackgen.models.DDPM",
            "init_args": {"denoiser": {"width": 32, "layers": 1, "heads": 2, "feedforward": 64}},
        },
        "data": {"path": str(towers_dataset), "batch_size": 16},
        "trainer": {"max_epochs": 1, "callbacks": {"class_path": "stackgen.training.EMA"}},
    }
    Path("base.yaml").write_text(yaml.safe_dump(base))
    rate = "model.optimizer.learning_rate"
    sweep = Sweep(
        "stackgen",
        {rate: {"values": [1e-05, 0.01]}},
        Metric("validation/loss"),
        method="grid",
        command=["stackgen", "fit", "--config", "base.yaml", "${args}"],
        name="tiny",
    )
    Path("tiny.yaml").write_text(sweep.to_yaml())
    answer = cli("sweep", "--config", "tiny.yaml")
    assert answer.code == 0, answer.err
    best = Path("runs/sweeps/tiny/best.yaml")
    config = yaml.safe_load(best.read_text())
    assert config["model"]["init_args"]["optimizer"]["learning_rate"] == 0.01
    answer = cli("fit", "--config", best, "--trainer.fast_dev_run", "true")
    assert answer.code == 0, answer.err
