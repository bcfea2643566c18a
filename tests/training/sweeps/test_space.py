"""The parameters of a W&B sweep file mean the same to Optuna."""

from __future__ import annotations

from typing import Any

import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from stackgen.errors import StackgenError
from stackgen.training.sweeps.space import grid_of, grid_point, space_of


def test_parameters_of_wandb_are_distributions_of_optuna() -> None:
    found = space_of(
        {
            "a": {"values": [2, "x", True, None]},
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
        "a": CategoricalDistribution([2, "x", True, None]),
        "b": IntDistribution(1, 5),
        "c": FloatDistribution(1, 5),
        "d": FloatDistribution(0.01, 1, log=True),
        "e": FloatDistribution(1, 2.718281828459045, log=True),
        "f": FloatDistribution(0, 1, step=0.25),
        "g.h": IntDistribution(1, 64, log=True),
    }
    grid = grid_of({"f": found["f"], "b": found["b"]})
    assert {name: list(values) for name, values in grid.items()} == {"f": [0, 0.25, 0.5, 0.75, 1], "b": [1, 2, 3, 4, 5]}


@pytest.mark.parametrize(
    ("parameter", "word"),
    [
        ({"vales": [1]}, "vales"),
        ({"min": 1}, "give value, values, or min and max"),
        ({"distribution": "beta", "min": 0, "max": 1}, "'beta' is not known here; there are uniform"),
        ({"distribution": "normal", "mu": 0, "sigma": 1}, "'normal' is not known here; there are uniform"),
        ({"distribution": "categorical", "min": 0, "max": 1}, "'categorical' needs value or values"),
        ({"min": 0, "max": 1, "mu": 0, "sigma": 1}, "mu, sigma is not understood"),
        ({"values": [1, 2], "probabilities": [0.1, 0.9]}, "only W&B draws by `probabilities`"),
        ({"values": []}, "at least one"),
        ({"values": 3}, "must be a list"),
        ({"values": [1, 2, True]}, "values 1 and True are the same"),
        ({"values": [0.5, float("nan")]}, "not a number"),
        ({"min": "0", "max": 1}, "finite numbers"),
        ({"min": 0.0, "max": float("inf")}, "finite numbers"),
        ({"distribution": "log_uniform", "min": 0, "max": 1000}, "exponents"),
        ({"parameters": 3}, "no group"),
        ({}, "nothing is not understood"),
        ({"distribution": "log_uniform_values", "min": 0, "max": 1}, "low"),
        ({"values": [{"a": 1}]}, "as text"),
        ({"distribution": "int_uniform", "min": 0.5, "max": 1}, "whole numbers"),
    ],
)
def test_a_parameter_that_is_not_understood_is_named(parameter: dict[str, Any], word: str) -> None:
    with pytest.raises(StackgenError, match=f"parameter x.*{word}"):
        space_of({"x": parameter})


def test_a_name_that_no_program_could_tell_from_another_is_refused() -> None:
    with pytest.raises(StackgenError, match=r"parameter a\.b is given twice"):
        space_of({"a.b": {"values": [1, 2]}, "a": {"parameters": {"b": {"values": [3, 4]}}}})
    for name in ("", " x", "a b", "../x", "--x", "x=3", "x\n"):
        with pytest.raises(StackgenError, match="a name is made of"):
            space_of({name: {"values": [1, 2]}})


def test_a_grid_of_any_size_is_counted_and_not_written_out() -> None:
    grid = grid_of(space_of({"a": {"min": 0, "max": 10**12}, "b": {"values": ["x", "y"]}}))
    assert grid_point(grid, 10**12) == {"a": 5 * 10**11, "b": "x"}
