"""Actions of the arm: opening and closing the jaws, and motions that ruckig makes as fast as their limits allow.

A joint motion goes straight in joint space, a line straight in space; both start and end at rest. T samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from stackgen.errors import StackgenError, require
from stackgen.robot.workcell import Speeds

Floats = NDArray[np.float64]
Kind = Literal["joint", "line"]

RATE = 120.0
"""Samples of a motion in a second: about the UR5's own control rate."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The joint angles over time.

    Args:
        name: Part in the work: `transit`, `approach`, `lift`, `lower`, `retreat`, `straighten`.
        kind: Straight in joint space, or in space.
        times: (T,) from 0 on [s].
        positions: (T, n) joint angles [rad].
        velocities: (T, n) joint speeds [rad/s].
        speed: Limit it was planned with: of the tool on a line [m/s], of the fastest joint otherwise [rad/s].
    """

    name: str
    kind: Kind
    times: Floats
    positions: Floats
    velocities: Floats
    speed: float

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return float(self.times[-1])

    @property
    def end(self) -> Floats:
        """(n,) the last joint angles [rad]."""
        return self.positions[-1]

    @cached_property
    def _spline(self) -> CubicHermiteSpline:
        return CubicHermiteSpline(self.times, self.positions, self.velocities)

    def at(self, times: ArrayLike) -> tuple[Floats, Floats]:
        """Joint angles [rad] and speeds [rad/s] (..., n) at any times; at rest after the end."""
        clipped = np.clip(np.asarray(times, dtype=float), 0, self.duration)
        return self._spline(clipped), self._spline(clipped, 1)


@dataclass(frozen=True)
class Open:
    """Open the jaws.

    Args:
        width: Distance between the pads [m].
    """

    width: float


@dataclass(frozen=True)
class Close:
    """Close the jaws.

    Args:
        force: Force with which they close [N].
    """

    force: float


Action = Motion | Open | Close
"""One thing an arm does."""


def joint_motion(name: str, start: Floats, goal: Floats, speeds: Speeds) -> Motion | None:
    """Move straight in joint space, all joints starting and stopping together; None where nothing is to be done."""
    if np.abs(goal - start).max() < 1e-6:
        return None
    limits = np.radians([speeds.joint, speeds.joint_acceleration, speeds.joint_jerk])
    # One parameter from 0 to 1 keeps the path straight; the joint that goes furthest is the one that limits it.
    furthest = float(np.abs(goal - start).max())
    times, fraction, rate = _profile(1.0, *(limits / furthest))
    positions = start + fraction[:, None] * (goal - start)
    return Motion(
        name=name,
        kind="joint",
        times=times,
        positions=positions,
        velocities=rate[:, None] * (goal - start),
        speed=float(limits[0]),
    )


def line_motion(name: str, joints: Floats, distances: Floats, *, speed: float, speeds: Speeds) -> Motion:
    """Move along joint angles (m, n) that were solved at distances (m,) on a straight line [m].

    The tool keeps to its limits, and slows down where a joint would have to turn faster than it may.
    """
    path = CubicSpline(distances, joints)
    fine = np.linspace(0, distances[-1], 64)
    turning, bending = np.abs(path(fine, 1)).max(), np.abs(path(fine, 2)).max()
    fastest = np.radians(speeds.joint) / max(float(turning), 1e-9)
    # Half of the joints' acceleration is for speeding up, half for the bends of the path.
    curving = (0.5 * np.radians(speeds.joint_acceleration) / max(float(bending), 1e-9)) ** 0.5
    hardest = 0.5 * np.radians(speeds.joint_acceleration) / max(float(turning), 1e-9)
    top = float(min(speed, fastest, curving))
    times, along, rate = _profile(
        float(distances[-1]), top, float(min(speeds.line_acceleration, hardest)), speeds.line_jerk
    )
    velocities = path(along, 1) * rate[:, None]
    return Motion(name=name, kind="line", times=times, positions=path(along), velocities=velocities, speed=top)


def _profile(length: float, speed: float, acceleration: float, jerk: float) -> tuple[Floats, Floats, Floats]:
    """Time the fastest way over a length under limits: times (T,), way (T,) and rate (T,)."""
    ruckig = require("ruckig", "robot")
    wanted, found = ruckig.InputParameter(1), ruckig.Trajectory(1)
    wanted.current_position, wanted.target_position = [0.0], [length]
    wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = [speed], [acceleration], [jerk]
    if ruckig.Ruckig(1).calculate(wanted, found) not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise StackgenError(f"no motion over {length:g} keeps to speed {speed:g}, acceleration {acceleration:g}")
    times = np.linspace(0, found.duration, max(3, int(np.ceil(found.duration * RATE)) + 1))
    samples = [found.at_time(float(time)) for time in times]
    return times, np.array([s[0][0] for s in samples]), np.array([s[1][0] for s in samples])
