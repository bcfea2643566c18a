"""A sweep file's parameters as Optuna's distributions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from stackgen.errors import StackgenError, require

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

Parameter = Mapping[str, Any]
"""How a sweep file describes one parameter."""
KEYS = {"value", "values", "distribution", "min", "max", "q", "parameters"}
KINDS = ("uniform", "int_uniform", "q_uniform", "log_uniform", "log_uniform_values", "q_log_uniform_values")


def constants_of(parameters: Mapping[str, Parameter]) -> dict[str, Any]:
    """Find the parameters that have one value.

    >>> constants_of({"a": {"value": 1}, "b": {"parameters": {"c": {"value": None}, "d": {"values": [1, 2]}}}})
    {'a': 1, 'b.c': None}
    """
    return {name: given["value"] for name, given in _flat(parameters).items() if "value" in given}


def space_of(parameters: Mapping[str, Parameter]) -> dict[str, BaseDistribution]:
    """Find the parameters that have several values, and their distributions.

    Raises:
        StackgenError: If a parameter is not understood.

    >>> space_of({"rate": {"distribution": "log_uniform_values", "min": 1e-4, "max": 1e-2}})
    {'rate': FloatDistribution(high=0.01, log=True, low=0.0001, step=None)}
    >>> space_of({"draws": {"min": 1, "max": 4}, "kind": {"values": ["linear", "cosine"]}})["draws"]
    IntDistribution(high=4, log=False, low=1, step=1)
    """
    found = {}
    for name, given in _flat(parameters).items():
        if "value" not in given:
            try:
                found[name] = _distribution(given)
            except (ValueError, TypeError) as error:
                raise StackgenError(f"parameter {name}: {error}") from error
    if not found:
        raise StackgenError("a sweep needs a parameter with several values")
    return found


def grid_of(space: Mapping[str, BaseDistribution]) -> dict[str, list[Any]]:
    """List all values of every parameter.

    Raises:
        StackgenError: If a parameter has no end of them.
    """
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    grid: dict[str, list[Any]] = {}
    for name, d in space.items():
        if isinstance(d, CategoricalDistribution):
            grid[name] = list(d.choices)
        elif isinstance(d, IntDistribution):
            grid[name] = list(range(d.low, d.high + 1, d.step))
        elif isinstance(d, FloatDistribution) and d.step:
            grid[name] = [d.low + i * d.step for i in range(round((d.high - d.low) / d.step) + 1)]
        else:
            raise StackgenError(f"parameter {name}: a grid needs values, or whole numbers, or q_uniform")
    return grid


def grid_point(grid: Mapping[str, list[Any]], number: int) -> dict[str, Any]:
    """Pick a point of a grid by its number; the last parameter changes fastest.

    >>> grid_point({"a": [0, 1], "b": ["x", "y", "z"]}, 4)
    {'a': 1, 'b': 'y'}
    """
    return dict(zip(grid, next(itertools.islice(itertools.product(*grid.values()), number, None)), strict=True))


def _flat(parameters: Mapping[str, Parameter], prefix: str = "") -> dict[str, Parameter]:
    """Put nested parameters under dotted names."""
    found: dict[str, Parameter] = {}
    for name, given in parameters.items():
        if not isinstance(given, Mapping) or set(given) - KEYS:
            unknown = sorted(set(given) - KEYS) if isinstance(given, Mapping) else given
            raise StackgenError(f"parameter {prefix}{name}: {unknown} is not understood; there are {sorted(KEYS)}")
        if "parameters" in given:
            found |= _flat(given["parameters"], f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = given
    return found


def _distribution(given: Parameter) -> BaseDistribution:
    distributions = require("optuna", "sweeps").distributions
    if "values" in given:
        if any(isinstance(value, dict | list) for value in given["values"]):
            raise ValueError("write a group of settings as text, such as '{kind: cosine}'")
        return distributions.CategoricalDistribution(given["values"])
    if not {"min", "max"} <= set(given):
        raise ValueError("give value, values, or min and max")
    low, high, q = given["min"], given["max"], given.get("q", 1)
    kind = given.get("distribution", KINDS[isinstance(low, int) and isinstance(high, int)])
    if kind not in KINDS:
        raise ValueError(f"distribution {kind!r} is not one of {', '.join(KINDS)}")
    if kind in ("int_uniform", "q_log_uniform_values"):
        if low != int(low) or high != int(high) or (kind != "int_uniform" and q != 1):
            raise ValueError(f"min and max must be whole numbers, and q 1; got {low}, {high} and {q}")
        return distributions.IntDistribution(int(low), int(high), log=kind != "int_uniform")
    if kind == "log_uniform":  # W&B: the ends are exponents
        low, high = math.exp(low), math.exp(high)
    step = float(q) if kind == "q_uniform" else None
    return distributions.FloatDistribution(float(low), float(high), log=kind.startswith("log"), step=step)
