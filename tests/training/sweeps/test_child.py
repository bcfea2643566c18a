"""A trial's command line is the one that the sweep file says."""

from __future__ import annotations

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
    assert command_of(sweep, {"x.y": 1, "z": None}, tmp_path) == [sys.executable, "a", "x.y=1", "z=null"]
    fit = replace(sweep, command=["stackgen", "fit", "${args}"])
    words = command_of(fit, {"x": True}, tmp_path)
    assert words[:5] == [sys.executable, "-m", "stackgen", "fit", "--x=True"]
    assert f"--trainer.default_root_dir={tmp_path}" in words
    with pytest.raises(StackgenError, match="is not one of"):
        command_of(replace(sweep, command=["${args_json}"]), {}, tmp_path)


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
