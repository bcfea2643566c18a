"""The numbers of the physics, in one place.

A verdict means nothing without them: they travel in every dataset manifest, weights card,
`stacks.json` and report.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

_OF_THE_WORLD = ("cell_size", "friction", "density", "gravity", "fall_height")


@dataclass(frozen=True)
class Physics:
    """How a stack is simulated and watched.

    Args:
        cell_size: Edge of a cube [m].
        friction: Coulomb coefficient between any two surfaces.
        density: Of every block [kg/m^3].
        gravity: [m/s^2].
        time_step: [s].
        solver_iterations: Of Bullet's sequential-impulse solver, per step. Few iterations at a long
            step leave the contacts unsolved: a standing tower then creeps and never rests (at 240 Hz
            and 20 iterations 7 of 8 did); at 480 Hz and 60 it rests at once, and needs fewer steps.
        solver_residual: The solver stops iterating below this squared residual.
        contact_threshold: Bullet keeps a contact point until its faces are further apart than this [m].
        watch: A stack is watched for at most this long [s].
        rest_window: A stack is at rest once no block moved more than `rest_motion` [cell] within
            this time [s]; the rollout then ends.
        rest_motion: See `rest_window` [cell].
        fall_height: A block fell when its centre dropped by more than this [cell] (SPEC: half a
            cell, "to a layer below where it began").
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

    @staticmethod
    def of_world(made: Mapping[str, Any] | None, given: Physics | None = None) -> Physics:
        """The physics of the world that something was made in, simulated as this version does.

        What blocks are and what counts as a fall belong to a world; step, solver and watch to the simulator.

        Args:
            made: A manifest's, card's or stacks file's physics, in plain form; None for the project's own.
            given: Its settings that are not the defaults win.

        >>> physics = Physics.of_world({"friction": 0.3, "fall_height": 0.25, "watch": 9.0}, Physics(friction=0.4))
        >>> physics.friction, physics.fall_height, physics.watch
        (0.4, 0.25, 2.0)
        """
        own = {name: made[name] for name in _OF_THE_WORLD if name in made} if made else {}
        changed = {k: v for k, v in asdict(given or Physics()).items() if v != getattr(Physics(), k)}
        return Physics(**{**own, **changed})

    def to_json(self) -> dict:
        """Plain form with the engine's name and version, for manifests and reports."""
        return {"engine": engine_version(), **asdict(self)}


def engine_version() -> str:
    """Name and version of the engine, `pybullet absent` where it is not installed."""
    try:
        return f"pybullet {version('pybullet')}"
    except PackageNotFoundError:
        return "pybullet absent"
