"""What the diffusion model is compared with: heuristics, found by name, and learned baselines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

from stackgen.baselines.brute_force import BruteForce
from stackgen.baselines.greedy_random import GreedyRandom
from stackgen.baselines.heuristic import Heuristic
from stackgen.baselines.random_placement import RandomPlacement

if TYPE_CHECKING:
    from stackgen.baselines.modules import TranReg, TranVAE

__all__ = ["HEURISTICS", "BruteForce", "GreedyRandom", "RandomPlacement", "TranReg", "TranVAE"]

__getattr__, __dir__, _ = lazy_loader.attach(__name__, submod_attrs={"modules": ["TranReg", "TranVAE"]})

HEURISTICS: dict[str, type[Heuristic]] = {kind.kind: kind for kind in (BruteForce, GreedyRandom, RandomPlacement)}
"""Heuristics by name; wherever weights are asked for, the name stands for one with its default settings."""
