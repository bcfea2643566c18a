"""The numbers of the physics, in one place.

A verdict means nothing without them: every dataset manifest, weights card, `stacks.json` and report
carries them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.world import Shape

Engine = Literal["bullet", "mujoco"]
"""The engines that simulate."""

MUJOCO_NUMBERS: dict[str, Any] = {"time_step": 0.001, "solref": "0.004 1", "solimp": "0.99 0.999 0.0001"}
"""MuJoCo's step [s]; the time constant [s] and the damping ratio of its contacts; their least and greatest
impedance, and the depth at which that is reached [m]. They take the place of Bullet's numbers."""

_PACKAGES: dict[Engine, str] = {"bullet": "pybullet", "mujoco": "mujoco"}
_BULLET_NUMBERS = ("time_step", "solver_iterations", "solver_residual", "contact_threshold")
_MAY_BE_ZERO = ("friction", "gravity", "solver_residual", "contact_threshold", "rest_motion")
_TAKEN_OVER = ("cell_size", "friction", "density", "gravity", "fall_height")


@cache
def default_engine() -> Engine:
    """Name the engine that is used where none is asked for: Bullet where it is installed, elsewhere MuJoCo."""
    return "mujoco" if find_spec("mujoco") and not find_spec("pybullet") else "bullet"


@dataclass(frozen=True)
class Physics:
    """Numbers by which a stack is simulated and watched.

    Args:
        engine: Engine that simulates, `bullet` or `mujoco`; by default Bullet where it is installed.
        cell_size: Edge of a cube [m]. Stacks are simulated at one scale, that of the default: whether rigid blocks
            stand does not depend on it.
        friction: Coulomb coefficient between any two surfaces.
        density: Density of every block [kg/m^3].
        gravity: Acceleration of gravity [m/s^2].
        time_step: Step of Bullet's simulation [s].
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
        StackgenError: If a number makes no sense, there is no such engine, or it does not use a number that was set.
    """

    engine: Engine = field(default_factory=default_engine)
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
        if self.engine not in get_args(Engine):
            raise StackgenError(f"physics: engine must be {' or '.join(get_args(Engine))}, got {self.engine!r}")
        for name, value in vars(self).items():
            if name == "engine":
                continue
            least = "at least 0" if name in _MAY_BE_ZERO else "positive"
            fine = isinstance(value, int | float) and 0 <= value < math.inf and (value or name in _MAY_BE_ZERO)
            if not fine:
                raise StackgenError(f"physics: {name} must be {least} and finite, got {value!r}")
        unused = [item.name for item in fields(self) if item.name in _BULLET_NUMBERS and self._is_set(item.name)]
        if self.engine == "mujoco" and unused:
            raise StackgenError(f"physics: {' and '.join(unused)} belong to Bullet: leave them out with engine mujoco")

    def _is_set(self, name: str) -> bool:
        """Tell whether a number is not the default."""
        return getattr(self, name) != getattr(Physics, name)

    @property
    def step(self) -> float:
        """Step of the engine in use [s]."""
        return float(MUJOCO_NUMBERS["time_step"]) if self.engine == "mujoco" else self.time_step

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

    def to_json(self) -> dict[str, Any]:
        """Return the plain form, for manifests and reports: the engine's name and version, and the numbers it uses."""
        plain: dict[str, Any] = {**asdict(self), "engine": engine_version(self.engine)}
        if self.engine == "mujoco":
            plain = {name: value for name, value in plain.items() if name not in _BULLET_NUMBERS} | MUJOCO_NUMBERS
        return plain

    @staticmethod
    def settings_of(made: Mapping[str, Any]) -> dict[str, Any]:
        """Return the arguments behind a plain form; without an engine, or with an unknown one, those of Bullet.

        >>> Physics.settings_of({"engine": "mujoco 4.0.0", "friction": 0.3, "time_step": 0.001, "solref": "0.004 1"})
        {'engine': 'mujoco', 'friction': 0.3}
        """
        mujoco = str(made.get("engine")).startswith("mujoco")
        dropped = {"engine", *(MUJOCO_NUMBERS if mujoco else ())}
        rest = {name: value for name, value in made.items() if name not in dropped}
        return {"engine": "mujoco" if mujoco else "bullet", **rest}


def engine_version(engine: Engine) -> str:
    """Return name and version of an engine, such as `pybullet absent` where it is not installed."""
    try:
        return f"{_PACKAGES[engine]} {version(_PACKAGES[engine])}"
    except PackageNotFoundError:
        return f"{_PACKAGES[engine]} absent"


def unit_inertia(shape: Shape) -> NDArray[np.float64]:
    """Compute the diagonal inertia (3,) of a prism of mass 1 about its centre of mass [cell^2], without products."""
    a = np.asarray(shape.outline) - shape.center_of_mass[[0, 2]]
    b = np.roll(a, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    second = ((a**2 + a * b + b**2) * cross[:, None]).sum(axis=0) / (6 * cross.sum())  # means of x^2 and z^2
    xx, zz, yy = second[0], second[1], shape.depth**2 / 12
    return np.array([yy + zz, xx + zz, xx + yy])
