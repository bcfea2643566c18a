"""The engines that are installed here; what a test of one engine needs."""

from __future__ import annotations

import importlib.util

import pytest

ENGINES = [
    pytest.param(engine, marks=pytest.mark.skipif(not importlib.util.find_spec(package), reason=f"needs {package}"))
    for engine, package in (("bullet", "pybullet"), ("mujoco", "mujoco"))
]
"""Each engine as a parameter of a test; one that is not installed is skipped."""
