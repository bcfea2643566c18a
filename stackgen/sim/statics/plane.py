"""Does a part of a stack stand? Statics answers where that is beyond doubt, at a fraction of a simulation's cost.

The generator takes blocks out of stacks at rest. What is left keeps its poses, so where its blocks touch
is known once for the whole stack, and each part of it is the same small problem with rows and columns
left out: are there forces that only push, act inside the contacts and stay in the friction cones, and
that cancel every weight? There are three answers:

- **stands**: yes, even with contacts narrowed at both ends, a fifth of the friction, and a pull to either
  side. A margin on each makes up for what statics cannot know (how a load divides between supports) and
  for what moves a little when a block is taken out.
- **falls**: no, even with contacts widened, more friction, neighbours nearby as props, and gaps closed.
- **unsure**: ask the simulator.

The problem is plane: designs are prisms side by side in the (x, z) plane, all symmetric about it, and
have three equations a block. A stack that has left the plane is for the simulator, too. Non-negative
least squares looks for a solution (Lawson and Hanson 1974); its residual is 0 if there is one.

Legend: k blocks of the whole stack, c contacts, n forces. Lengths in cells, forces in weights of a cube.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from stackgen.errors import StackgenError
from stackgen.geometry import centers_of_mass, rotation_matrices
from stackgen.sim.statics.contacts import GROUND, PlaneContacts, find_plane_contacts
from stackgen.stack import Stack

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Ints = NDArray[np.int64]
Outcome = Literal["stands", "falls", "unsure"]

_BALANCED = 1e-6
"""Norm of the missing forces and torques that is rounding."""

_MISSING = 1e-3
"""Norm of the missing forces and torques from which on they are certainly missing."""


@dataclass(frozen=True)
class StaticsMargins:
    """Margins by which statics is certain enough to answer for the simulator.

    Settings and manifests call them `certificate`. docs/statics.md says how often they would be wrong.

    Args:
        enabled: Whether statics is asked at all; false simulates every stack.
        sure_designs: Whether only designs that certainly stand are built: one at its limit leaves parts at theirs.
        inset: Part of both ends of each contact that bears nothing in a stack that certainly stands [cell].
        pull: Pull to either side on every block that a stack that certainly stands survives [share of its weight].
        friction_kept: Share of the friction with which a stack that certainly stands must hold.
        touch: Largest gap between faces that touch in a stack that certainly stands [cell].
        confirm: Share of inset and pull. A stack of which statics was unsure, but which stood when simulated, is
            taken only if forces hold it without inset and pull (others lean on a neighbour, or are held by a
            friction that need not last), and need not stand a second time if they do with this share of both.
        outset: Length added to both ends of each contact, with which a stack that certainly falls still falls [cell].
        friction_spared: Multiple of the friction with which a stack that certainly falls still falls.
        reach: Largest gap between faces that touch in a stack that certainly falls, below a block or beside it [cell].
        out_of_plane: Largest distance, turn and lean of a block out of the plane of the design for statics to
            answer at all [cell, rad].

    Raises:
        StackgenError: If a number is out of range.
    """

    enabled: bool = True
    sure_designs: bool = True
    inset: float = 0.015
    pull: float = 0.025
    friction_kept: float = 0.2
    touch: float = 0.002
    confirm: float = 0.5
    outset: float = 0.0
    friction_spared: float = 1.2
    reach: float = 0.1
    out_of_plane: float = 0.05

    def __post_init__(self) -> None:
        if min(self.inset, self.pull, self.outset, self.out_of_plane) < 0 or not 0 < self.touch <= self.reach < 0.5:
            raise StackgenError(
                "certificate: inset, pull, outset and out_of_plane must be at least 0, 0 < touch <= reach < 0.5"
            )
        if not (0 <= self.friction_kept <= 1 <= self.friction_spared and 0 <= self.confirm <= 1):
            raise StackgenError(
                "certificate: friction_kept and confirm must lie in 0..1, friction_spared must be at least 1"
            )


class PlaneStatics:
    """Tells of each part of one stack at rest whether it stands.

    >>> tower = Stack([0, 0, 0], [[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0], [0.48, 0, 2.5, 0, 0, 0]])
    >>> statics = PlaneStatics(tower, friction=0.5, margins=StaticsMargins())
    >>> [statics.outcome(np.array(part)) for part in ([0, 1], [0, 2], [0, 1, 2])]
    ['stands', 'falls', 'unsure']
    """

    def __init__(self, stack: Stack, friction: float, margins: StaticsMargins) -> None:
        self.margins = margins
        self.friction = friction
        self.weights = np.array([stack.catalogue[s].volume for s in stack.shapes])
        self.plane = _plane(stack, margins.out_of_plane)
        self.centers = centers_of_mass(stack)[:, [0, 2]]
        near, wide = find_plane_contacts(stack, (margins.touch, margins.reach))
        # A neighbour that is merely near would have to be leant on first: it holds nothing for certain.
        self.near = near.on_top()
        self.certain = self._with_margins(1.0)
        self.possible = _Forces.of(wide, self.centers, margins.outset, friction * margins.friction_spared)
        self.lifted = self.possible.lifted(len(stack))

    def outcome(self, part: Ints) -> Outcome:
        """Tell whether the part of the stack that consists of these blocks stands."""
        if not self.plane[part].all():
            return "unsure"
        kept = np.zeros(len(self.weights) + 1, dtype=bool)  # GROUND is the last
        kept[part] = kept[GROUND] = True
        if not self.lifted[part][:, kept].any(axis=1).all():
            return "falls"  # something hangs in the air
        if self._holds(self.certain, kept, part, self.margins.pull):
            return "stands"
        return "falls" if self.possible.missing(kept, part, self.weights, 0.0) > _MISSING else "unsure"

    @property
    def silent(self) -> bool:
        """Whether the stack has left the plane, so that statics cannot answer."""
        return not self.plane.all()

    def holds(self, share: float) -> bool:
        """Tell whether forces hold the whole stack with this share of inset and pull."""
        part, kept = np.arange(len(self.weights)), np.ones(len(self.weights) + 1, dtype=bool)
        return self._holds(self._with_margins(share), kept, part, share * self.margins.pull)

    def _with_margins(self, share: float) -> _Forces:
        inset = share * self.margins.inset
        return _Forces.of(self.near, self.centers, -inset, self.friction * self.margins.friction_kept)

    def _holds(self, forces: _Forces, kept: Flags, part: Ints, pull: float) -> bool:
        return all(forces.missing(kept, part, self.weights, side) < _BALANCED for side in {pull, -pull})


@dataclass(frozen=True)
class _Forces:
    """Forces that may arise at the ends of contacts, each along one side of its friction cone.

    Args:
        block, by: (n,) number of the block that is pushed, and of the one that pushes or GROUND.
        effects: (3 k, n) force in x and z and torque on each block, by a unit of each force.
    """

    block: Ints
    by: Ints
    effects: Floats

    @staticmethod
    def of(contacts: PlaneContacts, centers: Floats, outset: float, friction: float) -> _Forces:
        """Collect the forces of contacts that are wider by `outset` at both ends.

        Args:
            contacts: Contacts of the stack.
            centers: (k, 2) centres of mass in the plane [cell].
            outset: Length added at both ends [cell]; contacts that become narrower until nothing is left are dropped.
            friction: Coefficient of friction.
        """
        k = len(centers)
        along = np.stack([contacts.normal[:, 1], -contacts.normal[:, 0]], axis=1)
        ends = contacts.ends + outset * along[:, None] * _BOTH
        there = np.flatnonzero(((ends[:, 1] - ends[:, 0]) * along).sum(axis=1) >= 0)
        grip = np.where(contacts.upright, 0.0, friction)  # nothing squeezed upright faces
        slip = grip[:, None, None] * along[:, None] * _BOTH
        force = np.broadcast_to((contacts.normal[:, None] + slip)[:, None], (len(along), 2, 2, 2))[there]
        block, by, ends = contacts.block[there], contacts.by[there], ends[there]
        effects = np.zeros((len(there), 2, 2, k + 1, 3))  # contact, end, side of the cone, block or GROUND
        for sign, whom in ((1.0, block), (-1.0, by)):
            arm = ends - np.append(centers, [[0, 0]], axis=0)[whom][:, None]
            torque = arm[:, :, None, 0] * force[..., 1] - arm[:, :, None, 1] * force[..., 0]
            effects[np.arange(len(there)), :, :, whom] += sign * np.concatenate([force, torque[..., None]], axis=-1)
        columns = np.ascontiguousarray(effects[..., :k, :].reshape(4 * len(there), 3 * k).T)
        return _Forces(np.repeat(block, 4), np.repeat(by, 4), columns)

    def lifted(self, k: int) -> Flags:
        """Tell which blocks (k, k + 1) some force of another block, or of GROUND, the last, pushes upwards."""
        lifts = np.zeros((k + 1, k + 1), dtype=bool)
        upwards = self.effects[3 * self.block + 1, np.arange(len(self.block))]
        lifts[self.block[upwards > 0], self.by[upwards > 0]] = True
        lifts[self.by[upwards < 0], self.block[upwards < 0]] = True
        return lifts[:k]

    def missing(self, kept: Flags, part: Ints, weights: Floats, pull: float) -> float:
        """Return the norm of the forces and torques that the blocks of a part lack to be at rest.

        Args:
            kept: (k + 1,) which blocks are in the part, and GROUND.
            part: Numbers of the blocks in the part.
            weights: (k,) weights of all blocks [weight of a cube].
            pull: Pull to one side on each block, as a share of its weight.

        Returns:
            The norm; nan if it was not found.
        """
        needed = np.zeros((len(part), 3))
        needed[:, 0], needed[:, 1] = -pull * weights[part], weights[part]
        rows = (3 * part[:, None] + np.arange(3)).ravel()
        effects = self.effects[rows[:, None], np.flatnonzero(kept[self.block] & kept[self.by])]
        if not effects.size:
            return float(np.linalg.norm(needed))
        try:
            return float(nnls(effects, needed.ravel())[1])
        except RuntimeError:  # too many iterations
            return float("nan")


_BOTH = np.array([[-1.0], [1.0]])
"""Both ends of a segment, both sides of a cone."""


def _plane(stack: Stack, limit: float) -> Flags:
    """Tell which blocks (k,) are in the plane of the design and neither turned nor leaning out of it."""
    aside = rotation_matrices(stack.poses[:, 3:])[..., [0, 2], 1]  # of each block's y axis
    return np.asarray((np.abs(stack.poses[:, 1]) <= limit) & (np.abs(aside).max(axis=1, initial=0) <= limit))
