"""Can contact forces hold a stack at rest, how far may it be tilted, and if they cannot, which blocks move?

Rigid-block statics with Coulomb friction: no time passes and no simulator is asked. `contacts` finds
where the blocks touch, `programs` holds the linear programs; here are the verdict, its margin and the
reasons. docs/statics.md says what is assumed, and how well the answers agree with PyBullet.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import centers_of_mass
from stackgen.protocols import Verdict
from stackgen.sim.physics import Physics
from stackgen.sim.statics.contacts import GROUND, Contact, find_contacts
from stackgen.sim.statics.programs import Statics
from stackgen.stack import Stack

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

CONTACT_TOLERANCE = 0.3
"""Faces up to this far apart touch [cell]. A block that floats sinks onto what is below it: up to half a
cell, that is no fall. Settled stacks need 0.01; samples of a network, which float, all of it."""

SAFETY = math.radians(0.5)
"""Margin below which a stack is not called stable [rad]."""


@dataclass(frozen=True)
class StaticsAnswer:
    """What statics says of a stack.

    Args:
        stable: Whether forces exist that hold every block, also at any tilt up to the safety margin.
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


class StaticsChecker:
    """A StabilityChecker that needs no simulator.

    Args:
        physics: Numbers of the physics, of which friction matters; the project's own by default.
        contact_tolerance: Faces up to this far apart touch [cell].
        safety: Margin that a stack must have to be called stable [rad]; 0 accepts all that could stand.

    Raises:
        StackgenError: If the tolerance or the safety margin is out of range.

    >>> cube, far = [0, 0, 0.5, 0, 0, 0], [0.6, 0, 1.5, 0, 0, 0]
    >>> StaticsChecker().check(Stack([0, 0], [cube, far])).fell.tolist()
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
        """Give the verdict on one stack. Statics moves nothing: the settled stack is the stack, and no block sinks."""
        found = self.answer(stack)
        return Verdict(found.stable, found.unheld, np.zeros(len(stack)), stack, found.stable, found.margin)

    def check_all(self, stacks: Iterable[Stack]) -> list[Verdict]:
        """Give the verdicts on many stacks, in order."""
        return [self.check(stack) for stack in stacks]

    def answer(self, stack: Stack, with_push: bool = False) -> StaticsAnswer:
        """Find all that statics says of a stack.

        Args:
            stack: The stack, its blocks in any poses.
            with_push: Whether to find the push, too: it takes several times as long as the rest.
        """
        if not len(stack):
            return StaticsAnswer(True, math.pi / 2, None, np.zeros(0, dtype=bool), 0.0, ())
        contacts = tuple(find_contacts(stack, self.contact_tolerance))
        statics = Statics(stack, contacts, self.physics.friction)
        everything = np.arange(len(stack))
        tilt = statics.limit(everything)
        if tilt is None:
            residual, falling = statics.missing()
            return StaticsAnswer(False, 0.0, 0.0 if with_push else None, falling, residual, contacts)
        margin = math.atan(tilt[0])
        stable = margin >= self.safety
        pushes = [statics.limit(everything[i : i + 1]) for i in everything] if with_push else []
        push = min((limit[0] for limit in pushes if limit), default=0.0) if with_push else None
        unheld = np.zeros(len(stack), dtype=bool) if stable else statics.moving(tilt[1])
        return StaticsAnswer(stable, margin, push, unheld, 0.0, contacts)

    def reasons(self, stack: Stack, found: StaticsAnswer) -> dict[int, str]:
        """Say why each block that is not held is not, by its number.

        >>> checker, stack = StaticsChecker(), Stack([0, 0], [[0, 0, 0.5, 0, 0, 0], [0.75, 0, 1.5, 0, 0, 0]])
        >>> checker.reasons(stack, checker.answer(stack))
        {1: 'centre of mass 0.25 cells beside its support'}
        """
        if found.stable:
            return {}
        unheld = np.flatnonzero(found.unheld).tolist()
        if not found.residual:
            return {i: f"would go at a tilt of {math.degrees(found.margin):.1f} degrees" for i in unheld}
        _, never = Statics(stack, found.contacts, _GLUE).missing()
        centers = centers_of_mass(stack)
        return {i: _reason(i, centers[i], found, slides=not never[i]) for i in unheld}


_GLUE = 10.0
"""Friction at which nothing slides: blocks that it holds would only slide."""


def _reason(block: int, center: Floats, found: StaticsAnswer, slides: bool) -> str:
    """Say why one block is not held; `slides` tells that friction without limit would hold it."""
    supports = [contact for contact in found.contacts if contact.supports(block)]
    if not supports:
        return "hangs in the air"
    below = sorted({contact.other(block) for contact in supports})
    if GROUND not in below and found.unheld[below].all():
        return f"loses its support, block {' and '.join(map(str, below))}"
    if slides:
        return "would slide"
    corners = np.concatenate([contact.points for contact in supports])[:, :2].astype(np.float32)
    beside = -cv2.pointPolygonTest(cv2.convexHull(corners), (float(center[0]), float(center[1])), measureDist=True)
    if beside > 0.005:  # what two decimals would show as 0.00 is not the reason
        return f"centre of mass {beside:.2f} cells beside its support"
    return "is tipped over by what it carries"
