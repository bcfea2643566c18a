"""Can contact forces hold a stack at rest? Rigid-block statics with Coulomb friction, as a linear program.

Each block needs forces that cancel its weight, and torques about its centre of mass that cancel each
other: six equations. The unknowns are the forces at the corners of the patches where blocks touch:
each lies in a friction cone, here a pyramid of `CONE_SIDES` sides, and so is a sum of the pyramid's
edges with weights that are not negative. Forces that solve this exist, or they do not: a question for a
linear program, and HiGHS answers it. No time, no simulator.

The margin asks it for tilted ground. The pairs (x, y) of horizontal pulls, as shares of the weight, that
a stack survives form a convex polygon about the origin. Its vertex furthest in a direction is one more
linear program, so the polygon grows from inside until its side nearest to the origin is known
(Bretl and Lall, "Testing Static Equilibrium for Legged Robots", 2008): the worst of all directions.

Legend: k blocks, n forces. Lengths in cells, forces in weights of one cubic cell, so neither density
nor gravity nor scale matters. docs/equilibrium.md says what is assumed and how well it agrees.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import highspy
import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import centers_of_mass
from stackgen.protocols import Verdict
from stackgen.sim.contacts import FLAT, GROUND, Contact, distance, find_contacts, hull
from stackgen.sim.physics import Physics
from stackgen.stack import Stack, StackgenError

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

CONE_SIDES = 4
"""Of the pyramid around the friction cone. It touches the cone from outside: a block slides down a
slope at exactly the angle of friction whichever way the slope runs, and never before."""

CONTACT_TOLERANCE = 0.08
"""Faces up to this far apart touch [cell]."""

SAFETY = math.radians(0.5)
"""Margin below which a stack is not called stable [rad]."""

_EPSILON = 1e-6
"""Below it a motion is none."""


@dataclass(frozen=True)
class Equilibrium:
    """What statics says of a stack.

    Args:
        stable: Forces exist that hold every block, and go on to exist up to the safety margin.
        margin: Largest tilt of the ground that the stack survives, in the worst direction [rad]; 0 where
            nothing holds it even on level ground.
        push: Largest horizontal force at the centre of mass of any one block, in the worst direction, as
            a share of that block's weight; None where it was not asked for.
        unheld: (k,) blocks that no forces can hold; of a stack that only lacks the safety margin, those
            that would move first.
        residual: Sum of the forces and torques that are missing, in weights of one cubic cell and that
            times cells; 0 where nothing is missing.
        contacts: Where the blocks touch.
    """

    stable: bool
    margin: float
    push: float | None
    unheld: Flags
    residual: float
    contacts: tuple[Contact, ...]


class EquilibriumChecker:
    """A StabilityChecker that needs no simulator.

    Args:
        physics: Whose friction it takes; the project's own by default.
        contact_tolerance: Faces up to this far apart touch [cell].
        safety: Margin that a stack must have to be called stable [rad]; 0 takes all that could stand.

    >>> cube, far = [0, 0, 0.5, 0, 0, 0], [0.6, 0, 1.5, 0, 0, 0]
    >>> EquilibriumChecker().check(Stack([0, 0], [cube, far])).fell.tolist()
    [False, True]
    """

    def __init__(
        self, physics: Physics | None = None, contact_tolerance: float = CONTACT_TOLERANCE, safety: float = SAFETY
    ) -> None:
        if not (0 < contact_tolerance < 1 and 0 <= safety < math.pi / 2):
            raise StackgenError(
                f"contact_tolerance must lie in (0, 1) cells and safety in [0, pi/2) rad, "
                f"got {contact_tolerance} and {safety}"
            )
        self.physics = physics or Physics()
        self.contact_tolerance = contact_tolerance
        self.safety = safety

    def check(self, stack: Stack) -> Verdict:
        """Judge one stack. Statics moves nothing: the settled stack is the stack, and no block sinks."""
        found = self.equilibrium(stack)
        return Verdict(found.stable, found.unheld, np.zeros(len(stack)), stack, found.stable, found.margin)

    def equilibrium(self, stack: Stack, with_push: bool = False) -> Equilibrium:
        """All that statics says of a stack.

        Args:
            stack: Blocks in any poses.
            with_push: Whether to find the push, too: it takes several times as long as the rest.
        """
        if not len(stack):
            return Equilibrium(True, math.pi / 2, None, np.zeros(0, dtype=bool), 0.0, ())
        contacts = tuple(find_contacts(stack, self.contact_tolerance))
        program = _Program(stack, contacts, self.physics.friction)
        everything = np.arange(len(stack))
        tilt = program.limit(everything)
        if tilt is None:
            residual, falling = program.missing()
            return Equilibrium(False, 0.0, 0.0 if with_push else None, falling, residual, contacts)
        margin = math.atan(tilt[0])
        stable = margin >= self.safety
        pushes = [program.limit(everything[i : i + 1]) for i in everything] if with_push else []
        push = min((limit[0] for limit in pushes if limit), default=0.0) if with_push else None
        return Equilibrium(stable, margin, push, tilt[1] & (not stable), 0.0, contacts)

    def reasons(self, stack: Stack, found: Equilibrium) -> dict[int, str]:
        """Why each block that is not held is not, in words, by its number.

        >>> checker, stack = EquilibriumChecker(), Stack([0, 0], [[0, 0, 0.5, 0, 0, 0], [0.75, 0, 1.5, 0, 0, 0]])
        >>> checker.reasons(stack, checker.equilibrium(stack))
        {1: 'centre of mass 0.25 cells beside its support'}
        """
        if found.stable:
            return {}
        unheld = np.flatnonzero(found.unheld).tolist()
        if not found.residual:
            return {i: f"would go at a tilt of {math.degrees(found.margin):.1f} degrees" for i in unheld}
        _, never = _Program(stack, found.contacts, _GLUE).missing()
        centers = centers_of_mass(stack)
        return {i: _reason(i, centers[i], found, slides=not never[i]) for i in unheld}


_GLUE = 10.0
"""Friction at which nothing slides: what it holds would only slide."""


def _reason(block: int, center: Floats, found: Equilibrium, slides: bool) -> str:
    supports = [contact for contact in found.contacts if contact.supports(block)]
    if not supports:
        return "hangs in the air"
    below = sorted({contact.other(block) for contact in supports})
    if GROUND not in below and found.unheld[below].all():
        return f"loses its support, block {' and '.join(map(str, below))}"
    if slides:
        return "would slide"
    corners = np.concatenate([contact.points for contact in supports])
    beside = distance((center[0], center[1]), hull([(x, y) for x, y, _ in corners.tolist()]))
    if beside > 0.005:  # what two decimals would show as 0.00 is not the reason
        return f"centre of mass {beside:.2f} cells beside its support"
    return "is tipped over by the blocks that it touches"


class _Program:
    """The linear programs of one stack.

    Rows: six equations a block, forces, then torques about its centre of mass. Columns: the n contact
    forces, then what a question adds.
    """

    def __init__(self, stack: Stack, contacts: tuple[Contact, ...], friction: float) -> None:
        self.k = len(stack)
        self.weights = np.array([stack.catalogue[s].volume for s in stack.shapes])
        self.forces = _force_columns(contacts, centers_of_mass(stack), friction)

    def limit(self, pulled: NDArray[np.int64]) -> tuple[float, Flags] | None:
        """How hard some blocks may be pulled together in the worst horizontal direction.

        Returns:
            The pull as a share of their weight and (k,) which blocks would move first; None if
            no forces hold the stack as it is.
        """
        weights = np.tile(self.weights[pulled], (2, 1))
        pulls = _Columns(np.stack([6 * pulled, 6 * pulled + 1]), weights, -np.inf)
        solver = self._solver(self.forces, pulls)
        columns = len(self.forces.rows) + np.arange(2, dtype=np.int32)

        def furthest(direction: Floats) -> tuple[Floats, Flags]:
            solver.changeColsCost(2, columns, -direction)
            if not _solve(solver):
                raise _NothingHoldsIt
            found = solver.getSolution()
            moving = np.abs(np.array(found.row_dual)).reshape(self.k, 6).max(axis=1) > _EPSILON
            return np.array([found.col_value[i] for i in columns]), moving

        try:
            limit, moving = inradius(furthest)
        except _NothingHoldsIt:
            return None
        return None if limit < -_EPSILON else (max(limit, 0.0), moving)  # rounding must not fell a knife-edge

    def missing(self) -> tuple[float, Flags]:
        """The least sum of missing forces and torques, and (k,) which blocks fall for want of them.

        The dual solution is a motion of the blocks, bounded in each coordinate, along which no contact
        resists and the weights do the most work: the blocks that sink in it are those that cannot be held.
        """
        rows, ones = np.arange(6 * self.k)[:, None], np.ones((6 * self.k, 1))
        solver = self._solver(self.forces, _Columns(rows, ones, cost=1), _Columns(rows, -ones, cost=1))
        if not _solve(solver):
            raise ArithmeticError("HiGHS found no solution where one is certain")
        sinking = np.array(solver.getSolution().row_dual).reshape(self.k, 6)
        return float(solver.getInfo().objective_function_value), np.abs(sinking).max(axis=1) > _EPSILON

    def _solver(self, *parts: _Columns) -> highspy.Highs:
        """HiGHS with these columns."""
        needed = np.zeros((self.k, 6))
        needed[:, 2] = self.weights
        needed = needed.ravel()
        index = np.concatenate([part.rows.ravel() for part in parts]).astype(np.int32)
        value = np.concatenate([part.values.ravel() for part in parts])
        there = (index >= 0) & (np.abs(value) > 1e-12)
        ends = np.cumsum(np.r_[0, np.concatenate([np.full(*part.rows.shape) for part in parts])])
        starts = np.r_[0, np.cumsum(there)][ends].astype(np.int32)
        lower = np.concatenate([np.full(len(part.rows), part.lower) for part in parts])
        cost = np.concatenate([np.full(len(part.rows), part.cost) for part in parts])
        n, layout, sense = len(lower), int(highspy.MatrixFormat.kColwise), int(highspy.ObjSense.kMinimize)
        upper, continuous = np.full(n, np.inf), np.zeros(n, dtype=np.int32)
        solver = highspy.Highs()
        for option, choice in _OPTIONS.items():
            solver.setOptionValue(option, choice)
        solver.passModel(
            *(n, len(needed), int(starts[-1]), layout, sense, 0.0, cost, lower, upper, needed, needed),
            *(starts, index[there], value[there], continuous),
        )
        return solver


class _NothingHoldsIt(Exception):
    """No contact forces solve the equations, whatever the pull."""


_OPTIONS = {
    "output_flag": False,
    "threads": 1,
    "solver": "simplex",
    # Small, well scaled programs, of which only the objective changes from one to the next: the primal
    # simplex goes on from where it stands, and what helps with large ones only costs time.
    "presolve": "off",
    "simplex_strategy": 4,
    "simplex_scale_strategy": 0,
    "primal_simplex_bound_perturbation_multiplier": 0.0,
}


def _solve(solver: highspy.Highs) -> bool:
    """Whether there is a solution."""
    solver.run()
    status = solver.getModelStatus()
    if status not in (highspy.HighsModelStatus.kOptimal, highspy.HighsModelStatus.kInfeasible):
        solver.clearSolver()  # rounding got in the way: start afresh, with HiGHS's own choices
        solver.setOptionValue("simplex_strategy", 1)
        solver.setOptionValue("simplex_scale_strategy", 2)
        solver.run()
        status = solver.getModelStatus()
    return bool(status == highspy.HighsModelStatus.kOptimal)


@dataclass(frozen=True)
class _Columns:
    """Columns of a linear program: rows (c, z) where they are not zero, -1 for none, and values there (c, z)."""

    rows: NDArray[np.int64]
    values: Floats
    lower: float = 0.0
    cost: float = 0.0


def _force_columns(contacts: tuple[Contact, ...], centers: Floats, friction: float) -> _Columns:
    """What each contact force does to the two blocks: a column for each edge of each cone."""
    if not contacts:
        return _Columns(np.zeros((0, 12), dtype=np.int64), np.zeros((0, 12)))
    edges = [_cone(contact, friction) for contact in contacts]
    sizes = [(len(contact.points), len(edge)) for contact, edge in zip(contacts, edges, strict=True)]
    each = np.repeat(np.arange(len(contacts)), [p * c for p, c in sizes])
    where = np.concatenate([np.repeat(c.points, m, axis=0) for c, (_, m) in zip(contacts, sizes, strict=True)])
    force = np.concatenate([np.tile(edge, (p, 1)) for edge, (p, _) in zip(edges, sizes, strict=True)])
    block = np.array([contact.block for contact in contacts])[each]
    by = np.array([contact.by for contact in contacts])[each]
    values = np.concatenate(
        [force, np.cross(where - centers[block], force), -force, -np.cross(where - centers[by], force)], axis=1
    )
    rows = np.stack([block, by], axis=1)[:, :, None] * 6 + np.arange(6)
    rows[by == GROUND, 1] = -1
    return _Columns(rows.reshape(-1, 12), values)


def _cone(contact: Contact, friction: float) -> Floats:
    """Edges (CONE_SIDES, 3) of the friction pyramid; the normal alone (1, 3) where friction counts for nothing.

    It does so at upright faces. Two neighbours could hold a block between them by squeezing it, and
    statics would find that force; but nothing ever squeezed them, so the block falls.
    """
    if friction == 0 or abs(contact.normal[2]) < FLAT:
        return contact.normal[None]
    angles = 2 * np.pi / CONE_SIDES * (np.arange(CONE_SIDES) + 0.5)
    sideways = np.outer(np.cos(angles), contact.tangent)
    sideways += np.outer(np.sin(angles), np.cross(contact.normal, contact.tangent))
    return contact.normal + friction / math.cos(np.pi / CONE_SIDES) * sideways


def inradius(furthest: Callable[[Floats], tuple[Floats, Flags]], tolerance: float = 5e-4) -> tuple[float, Flags]:
    """Distance from the origin to the border of a convex set in the plane around it.

    Args:
        furthest: The point (2,) of the set that is furthest in a direction (2,), and a note on it.
        tolerance: By how much the distance may be too large.

    Returns:
        The distance, and the note on the nearest side.
    """
    found: list[tuple[float, Floats]] = []  # (angle of the direction, point): a polygon inside the set
    best, note = math.inf, np.zeros(0, dtype=bool)
    asked = [-np.pi / 2, 0.0, np.pi / 2, np.pi]
    while asked:
        for angle in asked:
            direction = np.array([math.cos(angle), math.sin(angle)])
            point, about = furthest(direction)
            found.append((angle, point))
            if direction @ point < best:
                best, note = float(direction @ point), about
        found.sort(key=lambda pair: pair[0])
        distance, angle = min(_sides([point for _, point in found]), default=(math.inf, 0.0))
        asked = [angle] if distance < best - tolerance and len(found) < 64 else []
    return best, note


def _sides(polygon: list[Floats]) -> list[tuple[float, float]]:
    """Distance from the origin and angle of the outward normal of each side of a counter-clockwise polygon."""
    sides = []
    for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        length = math.hypot(bx - ax, by - ay)
        if length > 1e-9:
            sides.append((((by - ay) * ax - (bx - ax) * ay) / length, math.atan2(ax - bx, by - ay)))
    return sides
