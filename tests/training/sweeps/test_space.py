"""The parameters of a W&B sweep file mean the same to Optuna."""

from __future__ import annotations

from typing import Any

import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from stackgen.errors import StackgenError
from stackgen.training.sweeps.space import grid_of, space_of


def test_parameters_of_wandb_are_distributions_of_optuna() -> None:
    found = space_of(
        {
            "a": {"values": [1, "x", True, None]},
            "b": {"min": 1, "max": 5},
            "c": {"min": 1.0, "max": 5},
            "d": {"distribution": "log_uniform_values", "min": 0.01, "max": 1},
            "e": {"distribution": "log_uniform", "min": 0, "max": 1},
            "f": {"distribution": "q_uniform", "min": 0, "max": 1, "q": 0.25},
            "g": {"parameters": {"h": {"distribution": "q_log_uniform_values", "min": 1, "max": 64}}},
            "constant": {"value": 3},
        }
    )
    assert found == {
        "a": CategoricalDistribution([1, "x", True, None]),
        "b": IntDistribution(1, 5),
        "c": FloatDistribution(1, 5),
        "d": FloatDistribution(0.01, 1, log=True),
        "e": FloatDistribution(1, 2.718281828459045, log=True),
        "f": FloatDistribution(0, 1, step=0.25),
        "g.h": IntDistribution(1, 64, log=True),
    }
    assert grid_of({"f": found["f"], "b": found["b"]}) == {"f": [0, 0.25, 0.5, 0.75, 1], "b": [1, 2, 3, 4, 5]}


@pytest.mark.parametrize(
    ("parameter", "word"),
    [
        ({"vales": [1]}, "vales"),
        ({"min": 1}, "give value, values, or min and max"),
        ({"distribution": "beta", "min": 0, "max": 1}, "'beta' is not one of uniform"),
        ({"distribution": "log_uniform_values", "min": 0, "max": 1}, "low"),
        ({"values": [{"a": 1}]}, "as text"),
        ({"distribution": "int_uniform", "min": 0.5, "max": 1}, "whole numbers"),
    ],
)
def test_a_parameter_that_is_not_understood_is_named(parameter: dict[str, Any], word: str) -> None:
    with pytest.raises(StackgenError, match=f"parameter x.*{word}"):
        space_of({"x": parameter})
