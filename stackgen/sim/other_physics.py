"""One warning where stacks, weights or verdicts were made with other physics than those in use.

Settings are compared in their plain form, as manifests, cards and reports carry them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stackgen.errors import warn

_said: set[str] = set()


def physics_differences(made: Mapping[str, Any], here: Mapping[str, Any]) -> list[str]:
    """List what differs between two physics; a setting that only one of them knows is no difference.

    >>> physics_differences({"friction": 0.3, "watch": 2.0}, {"friction": 0.5, "watch": 2, "engine": "pybullet 3"})
    ['friction 0.3 instead of 0.5']
    """
    return [
        f"{name} {made[name]} instead of {here[name]}"
        for name in made
        if name in here and made[name] != here[name] and not (name == "engine" and _absent(made, here))
    ]


def warn_of_other_physics(what: str, made: Mapping[str, Any] | None, here: Mapping[str, Any]) -> None:
    """Say in one line, once, if something was made with other physics than those here.

    Args:
        what: What was made, as the message names it.
        made: Physics it was made with, if that is known.
        here: Physics in use.
    """
    differences = physics_differences(made or {}, here)
    line = f"{what} was made with other physics than are used here: {', '.join(differences)}"
    if differences and line not in _said:
        _said.add(line)
        warn(line)


def _absent(*physics: Mapping[str, Any]) -> bool:
    """Tell whether one of them has no engine: a machine that only trains."""
    return any(str(settings["engine"]).endswith("absent") for settings in physics)
