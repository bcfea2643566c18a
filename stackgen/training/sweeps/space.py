"""A sweep file's parameters as Optuna's distributions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from stackgen.errors import StackgenError

if TYPE_CHECKING:
    from optuna import Trial
    from optuna.distributions import BaseDistribution

Entry = Mapping[str, Any]
KEYS = {"value", "values", "distribution", "min", "max", "q", "parameters"}


def constants_of(parameters: Mapping[str, Entry]) -> dict[str, Any]:
    """The parameters with one value.

    >>> constants_of({"a": {"value": 1}, "b": {"parameters": {"c": {"value": None}, "d": {"values": [1, 2]}}}})
    {'a': 1, 'b.c': None}
    """
    return {name: entry["value"] for name, entry in _flat(parameters).items() if "value" in entry}


def space_of(parameters: Mapping[str, Entry]) -> dict[str, BaseDistribution]:
    """The parameters with several.

    Raises:
        StackgenError: If one is not understood.

    >>> space_of({"rate": {"distribution": "log_uniform_values", "min": 1e-4, "max": 1e-2}})
    {'rate': FloatDistribution(high=0.01, log=True, low=0.0001, step=None)}
    >>> space_of({"draws": {"min": 1, "max": 4}, "kind": {"values": ["linear", "cosine"]}})["draws"]
    IntDistribution(high=4, log=False, low=1, step=1)
    """
    found = {}
    for name, entry in _flat(parameters).items():
        if "value" not in entry:
            try:
                found[name] = _distribution(name, entry)
            except (ValueError, TypeError) as error:
                raise StackgenError(f"parameter {name}: {error}") from error
    if not found:
        raise StackgenError("a sweep needs a parameter with several values")
    return found


def suggest(trial: Trial, space: Mapping[str, BaseDistribution]) -> dict[str, Any]:
    """A trial's values; those that it has already, of an earlier coordinator, stay."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    values: dict[str, Any] = {}
    for name, d in space.items():
        if isinstance(d, FloatDistribution):
            values[name] = trial.suggest_float(name, d.low, d.high, step=d.step, log=d.log)
        elif isinstance(d, IntDistribution):
            values[name] = trial.suggest_int(name, d.low, d.high, step=d.step, log=d.log)
        else:
            assert isinstance(d, CategoricalDistribution)
            values[name] = trial.suggest_categorical(name, d.choices)
    return values


def grid_of(space: Mapping[str, BaseDistribution]) -> dict[str, list[Any]]:
    """All values of every parameter.

    Raises:
        StackgenError: If one has no end of them.
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


def _flat(parameters: Mapping[str, Entry], prefix: str = "") -> dict[str, Entry]:
    """Nested parameters under dotted names."""
    found: dict[str, Entry] = {}
    for name, entry in parameters.items():
        if not isinstance(entry, Mapping) or set(entry) - KEYS:
            unknown = sorted(set(entry) - KEYS) if isinstance(entry, Mapping) else entry
            raise StackgenError(f"parameter {prefix}{name}: {unknown} is not understood; there are {sorted(KEYS)}")
        if "parameters" in entry:
            found |= _flat(entry["parameters"], f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = entry
    return found


def _distribution(name: str, entry: Entry) -> BaseDistribution:
    if "values" in entry:
        from optuna.distributions import CategoricalDistribution

        if any(isinstance(value, dict | list) for value in entry["values"]):
            raise StackgenError(f"parameter {name}: write a group of settings as text, such as '{{kind: cosine}}'")
        return CategoricalDistribution(entry["values"])
    if not {"min", "max"} <= set(entry):
        raise StackgenError(f"parameter {name}: give value, values, or min and max")
    whole = isinstance(entry["min"], int) and isinstance(entry["max"], int)
    kind = entry.get("distribution", "int_uniform" if whole else "uniform")
    if kind not in _KINDS:
        raise StackgenError(f"parameter {name}: distribution {kind!r} is not one of {', '.join(_KINDS)}")
    return _KINDS[kind](entry["min"], entry["max"], entry.get("q", 1))


def _float(low: float, high: float, **options: Any) -> BaseDistribution:
    from optuna.distributions import FloatDistribution

    return FloatDistribution(float(low), float(high), **options)


def _whole(low: float, high: float, **options: Any) -> BaseDistribution:
    from optuna.distributions import IntDistribution

    if low != int(low) or high != int(high):
        raise ValueError(f"min and max must be whole numbers, got {low} and {high}")
    return IntDistribution(int(low), int(high), **options)


def _log_steps(low: float, high: float, q: float) -> BaseDistribution:
    if q != 1:
        raise ValueError(f"locally q_log_uniform_values goes by whole numbers: q must be 1, got {q}")
    return _whole(low, high, log=True)


_KINDS: dict[str, Callable[[float, float, float], BaseDistribution]] = {
    "uniform": lambda low, high, _: _float(low, high),
    "int_uniform": lambda low, high, _: _whole(low, high),
    "q_uniform": lambda low, high, q: _float(low, high, step=float(q)),
    "log_uniform": lambda low, high, _: _float(math.exp(low), math.exp(high), log=True),  # W&B: ends are exponents
    "log_uniform_values": lambda low, high, _: _float(low, high, log=True),
    "q_log_uniform_values": _log_steps,
}
