"""The numbers of the physics, in one place.

A verdict means nothing without them: every dataset manifest, weights card, `stacks.json` and report
carries them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from stackgen.errors import StackgenError

_MAY_BE_ZERO = ("friction", "gravity", "solver_residual", "contact_threshold", "rest_motion")
_TAKEN_OVER = ("cell_size", "friction", "density", "gravity", "fall_height")


@dataclass(frozen=True)
class Physics:
    """Numbers by which a stack is simulated and watched.

    Args:
        cell_size: Edge of a cube [m].
        friction: Coulomb coefficient between any two surfaces.
        density: Density of every block [kg/m^3].
        gravity: Acceleration of gravity [m/s^2].
        time_step: Step of the simulation [s].
        solver_iterations: Iterations of Bullet's sequential-impulse solver per step; docs/physics.md says why 60.
        solver_residual: Squared residual below which the solver stops iterating.
        contact_threshold: Distance between faces up to which Bullet keeps a contact point [m].
        watch: Longest time for which a stack is watched [s].
        rest_window: Time within which no block of a stack at rest moves more than `rest_motion` [s]; the
            rollout then ends.
        rest_motion: Largest motion of a block at rest [cell].
        fall_height: Drop of its centre from which on a block fell [cell] (paper: "to a layer below where it
            began", here half a cell).

    Raises:
        StackgenError: If a number makes no sense.
    """

    cell_size: float = 0.05
    friction: float = 0.5
    density: float = 600.0
    gravity: float = 9.81
    time_step: float = 1 / 480
    solver_iterations: int = 60
    solver_residual: float = 1e-6
    contact_threshold: float = 0.002
    watch: float = 2.0
    rest_window: float = 0.0625
    rest_motion: float = 5e-4
    fall_height: float = 0.5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            least = "at least 0" if name in _MAY_BE_ZERO else "positive"
            fine = isinstance(value, int | float) and 0 <= value < math.inf and (value or name in _MAY_BE_ZERO)
            if not fine:
                raise StackgenError(f"physics: {name} must be {least} and finite, got {value!r}")

    @staticmethod
    def recorded(made: Mapping[str, Any] | None, given: Physics | None = None) -> Physics:
        """Return the physics that something was made with, simulated as this version does.

        What blocks are and what counts as a fall are taken over; step, solver and watch are the simulator's own.

        Args:
            made: Physics of a manifest, card or stacks file, in plain form; None for the project's own.
            given: Physics whose settings that are not the defaults win.

        >>> physics = Physics.recorded({"friction": 0.3, "fall_height": 0.25, "watch": 9.0}, Physics(friction=0.4))
        >>> physics.friction, physics.fall_height, physics.watch
        (0.4, 0.25, 2.0)
        """
        own = {name: made[name] for name in _TAKEN_OVER if name in made} if made else {}
        changed = {k: v for k, v in asdict(given or Physics()).items() if v != getattr(Physics(), k)}
        return Physics(**{**own, **changed})

    def to_json(self) -> dict:
        """Return the plain form, with the engine's name and version, for manifests and reports."""
        return {"engine": engine_version(), **asdict(self)}


def engine_version() -> str:
    """Return name and version of the engine, `pybullet absent` where it is not installed."""
    try:
        return f"pybullet {version('pybullet')}"
    except PackageNotFoundError:
        return "pybullet absent"
