"""Words by which users name parts: of the standard library alone, so that help which lists them is there at once."""

from __future__ import annotations

from typing import Literal

DEFAULT = "default"
"""Name of the weights in the package."""

CheckerName = Literal["simulator", "statics"]
"""The checkers that can be asked for by name."""

Preference = Literal["fit", "margin"]
"""What is best: the stack that fits best, or, of those that fit nearly as well, the one that stands most firmly."""
