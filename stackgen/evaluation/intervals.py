"""Estimates with intervals that know that samples of one scene are not independent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

RESAMPLES = 2000
"""Draws of the bootstrap."""


@dataclass(frozen=True)
class Estimate:
    """A value and its 95 % interval."""

    value: float
    low: float
    high: float

    def to_json(self) -> dict[str, float]:
        """Give the plain form."""
        return {"value": self.value, "low": self.low, "high": self.high}


def clustered_ratio(sums: ArrayLike, weights: ArrayLike, seed: int = 0) -> Estimate | None:
    """Divide the sum of the sums by the sum of the weights, with a cluster bootstrap over scenes.

    Whole scenes are drawn with replacement, as many as there are, 2000 times; the interval is from
    the 2.5th to the 97.5th percentile of the ratio. Unlike a normal interval it never leaves the
    values that the metric can take. The seed is fixed: equal scores, equal interval.

    Args:
        sums, weights: (m,) sum and weight of each scene.
        seed: Seed of the resampling.

    Returns:
        None where the weights are all 0: the metric does not exist.

    >>> clustered_ratio([3, 3, 3], [3, 3, 3])
    Estimate(value=1.0, low=1.0, high=1.0)
    """
    s, w = np.asarray(sums, dtype=float), np.asarray(weights, dtype=float)
    if not w.sum():
        return None
    m = len(s)
    drawn = _draws(m, seed)
    resampled_weights = drawn @ w
    kept = resampled_weights > 0  # a draw in which the metric does not exist says nothing
    ratios = (drawn @ s)[kept] / resampled_weights[kept]
    low, high = np.percentile(ratios, [2.5, 97.5])
    value = s.sum() / w.sum()
    return Estimate(float(value), float(min(low, value)), float(max(high, value)))  # not apart by rounding


def clustered_percentile(values: Sequence[Sequence[float]], percent: float, seed: int = 0) -> Estimate | None:
    """Find the value that so many percent of all values do not exceed, with the same bootstrap over scenes.

    Args:
        values: Values of each of m scenes.
        percent: Which percentile, above 0 and at most 100.
        seed: Seed of the resampling.

    Returns:
        None where there are no values.

    >>> clustered_percentile([[1.0, 2.0], [3.0]], 100).value
    3.0
    """
    flat = np.array([value for some in values for value in some])
    if not len(flat):
        return None
    order, scene = np.argsort(flat, kind="stable"), np.repeat(np.arange(len(values)), [len(some) for some in values])

    def found(times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Find the percentile of each of some draws (n, m)."""
        below = np.cumsum(times[:, scene[order]], axis=1)
        return flat[order][(below < percent / 100 * below[:, -1:]).sum(axis=1)]

    drawn = _draws(len(values), seed)
    value = found(np.ones((1, len(values))))[0]
    low, high = np.percentile(found(drawn[(drawn[:, np.unique(scene)] > 0).any(axis=1)]), [2.5, 97.5])
    return Estimate(float(value), float(min(low, value)), float(max(high, value)))


@lru_cache(maxsize=8)
def _draws(m: int, seed: int) -> NDArray[np.float64]:
    """Draw (RESAMPLES, m) how often each of m scenes is taken: the slow part, and a report asks hundreds of times."""
    return np.random.default_rng(seed).multinomial(m, np.full(m, 1 / m), size=RESAMPLES).astype(float)
