"""A trial's command line is the one that the sweep file says."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from optuna.distributions import CategoricalDistribution

from stackgen.errors import StackgenError
from stackgen.training.sweeps.child import command_of
from stackgen.training.sweeps.file import EarlyTerminate, Metric, Sweep
from stackgen.training.sweeps.space import space_of
from tests.conftest import Cli
from tests.training.sweeps.test_coordinator import REAL, ROOT, sweep_of


def test_the_macros_of_wandb_are_filled_in(tmp_path: Path) -> None:
    sweep = replace(sweep_of(tmp_path / "program.py"), command=["${env}", "${interpreter}", "a", "${args_no_hyphens}"])
    assert command_of(sweep, {"x.y": 1, "z": None}, tmp_path) == [sys.executable, "a", "z=null", "x.y=1"]
    fit = replace(sweep, command=["stackgen", "fit", "${args}"])
    words = command_of(fit, {"x": True}, tmp_path)
    assert words[:5] == [sys.executable, "-m", "stackgen", "fit", "--x=True"]
    assert f"--trainer.default_root_dir={tmp_path}" in words
    with pytest.raises(StackgenError, match="is not one of"):
        command_of(replace(sweep, command=["${arg}"]), {}, tmp_path)


def test_every_word_that_wandb_takes_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLACE", "here")
    values = {"flag": True, "other": False, "rate": 1e-05}

    def words(*command: str | float) -> list[str]:
        return command_of(replace(sweep_of(tmp_path / "program.py"), command=list(command)), values, tmp_path)

    assert words("python", "main.py", "--epochs", 10, "--rate", 0.5) == [
        "python",
        "main.py",
        "--epochs",
        "10",
        "--rate",
        "0.5",
    ]
    assert words("a", "${args_no_boolean_flags}") == ["a", "--flag", "--rate=1e-05"]
    assert json.loads(words("a", "${args_json}")[1]) == values
    assert words("a", "${args_json_file}", "${envvar:PLACE}") == ["a", str(tmp_path / "parameters.json"), "here"]
    with pytest.raises(StackgenError, match="variable that is set"):
        words("a", "${envvar:NO_SUCH_PLACE}")
    with pytest.raises(StackgenError, match="no program"):
        words("${env}")


def test_a_group_comes_before_what_is_set_within_it(tmp_path: Path) -> None:
    values = {"a.b.c": 1, "a.b": "{c: 2}", "x": 3}
    assert command_of(sweep_of(Path("p")), values, tmp_path)[2:] == ["--x=3", "--a.b={c: 2}", "--a.b.c=1"]


def test_a_parameter_that_the_sweep_sets_itself_is_refused(tmp_path: Path) -> None:
    sweep = replace(sweep_of(Path("p")), command=["stackgen", "fit", "${args}"])
    with pytest.raises(StackgenError, match="parameter name: a sweep sets it itself"):
        command_of(sweep, {"name": "x"}, tmp_path)


def test_every_parameter_of_the_real_sweep_is_an_option_of_fit(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(ROOT)
    content = yaml.safe_load(REAL.read_text())
    sweep = Sweep(**{**content, "metric": Metric(**content["metric"]), "early_terminate": EarlyTerminate(min_iter=1)})
    space = space_of(sweep.parameters)
    assert sweep.run_cap is not None and sweep.run_cap >= 30
    values = {n: d.choices[-1] if isinstance(d, CategoricalDistribution) else d.low for n, d in space.items()}  # type: ignore[attr-defined]
    words = command_of(sweep, values, tmp_path)
    answer = cli(*words[3:], "--print_config")
    assert answer.code == 0, answer.err
    config = yaml.safe_load(answer.out)
    assert config["model"]["init_args"]["schedule"]["kind"] == "cosine"
    assert config["model"]["init_args"]["diffusion"]["guidance"] == 1.0
    assert config["name"] == "run"
