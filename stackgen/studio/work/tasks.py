"""The heavy work by name, as the processes of the studio do it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from stackgen.models.weights import DEFAULTS
from stackgen.studio.requests import CELL, Drawing, GenerateRequest, Wish
from stackgen.studio.work.building import built, described, ordered
from stackgen.studio.work.drawings import pack
from stackgen.studio.work.exporting import exported
from stackgen.studio.work.generating import generate, read
from stackgen.studio.work.judging import checked, pushed, tilted
from stackgen.studio.work.methods import BEST

TASKS: dict[str, Callable[[Any, Callable[[dict[str, Any]], None]], None]] = {
    "generate": generate,
    "read": read,
    "check": checked,
    "tilt": tilted,
    "push": pushed,
    "order": ordered,
    "build": built,
    "arm": described,
    "export": exported,
}
"""Functions of a request and of what takes their messages, the last of which is the answer."""


def warm_up() -> None:
    """Load and try what the first request needs, so that it is answered as quickly as all others."""
    arch = np.ones((4 * CELL, 4 * CELL), dtype=bool)
    arch[CELL:, CELL:-CELL] = False
    drawing = Drawing(cells=4, bits=pack(arch))
    for method in (DEFAULTS["sampler"], BEST):
        generate(GenerateRequest(drawing=drawing, wish=Wish(method=method, number=1, verified=False)), lambda _: None)
