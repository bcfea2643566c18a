"""A sweep file's parameters as Optuna's distributions."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from stackgen.errors import MALFORMED, StackgenError, require

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

Parameter = Mapping[str, Any]
"""How a sweep file describes one parameter."""
KEYS = {"value", "values", "distribution", "min", "max", "q", "parameters"}
_PARAMETER_NAME = re.compile(r"\w[\w./-]*")
KINDS = ("uniform", "int_uniform", "q_uniform", "log_uniform", "log_uniform_values", "q_log_uniform_values")
_LISTED = ("constant", "categorical")
"""W&B's words for `value` and `values`, which say it already."""


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
            except MALFORMED as error:
                raise StackgenError(f"parameter {name}: {error}") from error
    if not found:
        raise StackgenError("a sweep needs a parameter with several values")
    return found


def grid_of(space: Mapping[str, BaseDistribution]) -> dict[str, Sequence[Any]]:
    """List all values of every parameter.

    Raises:
        StackgenError: If a parameter has no end of them.
    """
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    grid: dict[str, Sequence[Any]] = {}
    for name, d in space.items():
        if isinstance(d, CategoricalDistribution):
            grid[name] = list(d.choices)
        elif isinstance(d, IntDistribution):
            grid[name] = range(d.low, d.high + 1, d.step)
        elif isinstance(d, FloatDistribution) and d.step:
            grid[name] = [d.low + i * d.step for i in range(round((d.high - d.low) / d.step) + 1)]
        else:
            raise StackgenError(f"parameter {name}: a grid needs values, or whole numbers, or q_uniform")
    return grid


def grid_point(grid: Mapping[str, Sequence[Any]], number: int) -> dict[str, Any]:
    """Pick a point of a grid by its number; the last parameter changes fastest, and after the last point is the first.

    >>> grid_point({"a": [0, 1], "b": ["x", "y", "z"]}, 4)
    {'a': 1, 'b': 'y'}
    """
    point = {}
    for name, values in reversed(list(grid.items())):
        number, place = divmod(number, len(values))
        point[name] = values[place]
    return {name: point[name] for name in grid}


def _flat(parameters: Mapping[str, Parameter], prefix: str = "") -> dict[str, Parameter]:
    """Put nested parameters under dotted names."""
    found: dict[str, Parameter] = {}
    for name, given in parameters.items():
        _check_keys(f"{prefix}{name}", given)
        here = _flat(given["parameters"], f"{prefix}{name}.") if "parameters" in given else {f"{prefix}{name}": given}
        if twice := sorted(set(here) & set(found)):
            raise StackgenError(f"parameter {twice[0]} is given twice: with a dotted name and within a group")
        found |= here
    return found


def _check_keys(name: str, given: Any) -> None:
    """Refuse what a parameter has no use for; what W&B alone does is named as such."""
    if not _PARAMETER_NAME.fullmatch(name):
        raise StackgenError(f"parameter {name!r:.60}: a name is made of letters, digits, '_', '-', '.' and '/'")
    if isinstance(given, Mapping) and "probabilities" in given:
        raise StackgenError(f"parameter {name}: only W&B draws by `probabilities`; here all values are equally likely")
    if isinstance(given, Mapping) and (kind := given.get("distribution", KINDS[0])) not in (*KINDS, *_LISTED):
        raise StackgenError(
            f"parameter {name}: distribution {kind!r:.40} is not known here; there are {', '.join(KINDS)}"
        )
    if not isinstance(given, Mapping) or not given or set(given) - KEYS:
        unknown = ", ".join(sorted(set(map(str, given)) - KEYS)) if isinstance(given, Mapping) else f"{given!r:.60}"
        raise StackgenError(f"parameter {name}: {unknown or 'nothing'} is not understood; there are {sorted(KEYS)}")
    if not isinstance(given.get("parameters", {}), Mapping):
        raise StackgenError(f"parameter {name}: its parameters are no group of names")


def _distribution(given: Parameter) -> BaseDistribution:
    distributions = require("optuna", "sweeps").distributions
    if "values" in given:
        return distributions.CategoricalDistribution(_choices(given["values"]))
    low, high, q = given.get("min"), given.get("max"), given.get("q", 1)
    kind = given.get("distribution", KINDS[isinstance(low, int) and isinstance(high, int)])
    if kind in _LISTED:
        raise ValueError(f"distribution {kind!r} needs value or values")
    if low is None or high is None:
        raise ValueError("give value, values, or min and max")
    if not all(isinstance(number, int | float) and math.isfinite(number) for number in (low, high, q)):
        raise ValueError(f"min, max and q must be finite numbers, got {low!r:.40}, {high!r:.40} and {q!r:.40}")
    if kind in ("int_uniform", "q_log_uniform_values"):
        if low != int(low) or high != int(high) or (kind != "int_uniform" and q != 1):
            raise ValueError(f"min and max must be whole numbers, and q 1; got {low}, {high} and {q}")
        return distributions.IntDistribution(int(low), int(high), log=kind != "int_uniform")
    if kind == "log_uniform" and max(abs(low), abs(high)) > 300:
        raise ValueError(
            "min and max of log_uniform are exponents of e; log_uniform_values takes the values themselves"
        )
    if kind == "log_uniform":
        low, high = math.exp(low), math.exp(high)
    step = float(q) if kind == "q_uniform" else None
    return distributions.FloatDistribution(float(low), float(high), log=kind.startswith("log"), step=step)


def _choices(values: Any) -> list[Any]:
    """Check that Optuna, which takes 1, 1.0 and true for the same, can tell the values of a parameter apart."""
    if not isinstance(values, list | tuple) or not values:
        raise ValueError(f"values must be a list of at least one, got {values!r:.40}")
    for number, value in enumerate(values):
        if not isinstance(value, str | int | float | None):
            raise ValueError("write a group of settings as text, such as '{kind: cosine}'")
        if value != value:
            raise ValueError("a value is not a number; write it as text")
        if value in values[:number]:
            same = values[values.index(value)]
            raise ValueError(f"the values {same!r} and {value!r} are the same; leave one out, or write it as text")
    return list(values)
