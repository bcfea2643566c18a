"""The distances of the arm from everything: a copy of the workcell in which nothing moves by itself.

Arm, jaws and blocks are put where a plan has them and Bullet is asked for closest points. Lengths in metres.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stackgen.robot.planning.connection import Connected
from stackgen.robot.planning.urdf import FINGER_JOINTS, FINGERS, chain_links, self_collision_pairs, unusable, with_jaws
from stackgen.robot.workcell import Workcell
from stackgen.sim.bullet_engine import Mold, bullet
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.world import Shape

Floats = NDArray[np.float64]

SEEN = 0.05
"""Distances beyond this are not looked for [m]."""

TABLE = -1
"""Number of the table where blocks are numbered from 0."""


@dataclass(frozen=True)
class Near:
    """The least distance found.

    Args:
        distance: Distance [m]; `SEEN` where nothing is nearer.
        between: The two things, in words.
    """

    distance: float = SEEN
    between: str = "nothing"

    def __lt__(self, other: Near) -> bool:
        return self.distance < other.distance


def block_frame(pose: Floats, cell_size: float) -> Floats:
    """Frame (4, 4) [m] of a block's pose (6,) [cell, rad]."""
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_rotvec(pose[3:]).as_matrix()
    frame[:3, 3] = pose[:3] * cell_size
    return frame


def block_pose(frame: Floats, cell_size: float) -> Floats:
    """Inverse of :func:`block_frame`."""
    return np.concatenate([frame[:3, 3] / cell_size, Rotation.from_matrix(frame[:3, :3]).as_rotvec()])


def body_placement(shape: Shape, frame: Floats, cell_size: float) -> tuple[list[float], list[float]]:
    """Centre of mass [m] and quaternion of a block at a frame: what Bullet calls a body's pose."""
    position = frame[:3, 3] + frame[:3, :3] @ (shape.center_of_mass * cell_size)
    return position.tolist(), Rotation.from_matrix(frame[:3, :3]).as_quat().tolist()


def block_corners(stack: Stack, block: int, frame: Floats, cell_size: float) -> Floats:
    """Corners (V, 3) [m] of a block at a frame (4, 4)."""
    return stack.catalogue[int(stack.shapes[block])].vertices * cell_size @ frame[:3, :3].T + frame[:3, 3]


def load_arm(workcell: Workcell, client: int, visual: bool) -> int:
    """Load the arm with its jaws at its place; return Bullet's number of its body.

    Raises:
        StackgenError: If Bullet cannot read the description.
    """
    with tempfile.TemporaryDirectory(prefix="stackgen-") as folder:
        file = Path(folder) / "arm_with_jaws.urdf"
        file.write_text(with_jaws(workcell.arm, workcell.jaws, visual))
        yaw = Rotation.from_matrix(workcell.base.table_from_base[:3, :3]).as_quat().tolist()
        place = list(workcell.base.position), yaw
        try:
            return int(bullet.loadURDF(str(file), *place, useFixedBase=True, physicsClientId=client))
        except bullet.error as error:
            raise unusable(workcell.arm, error) from error


@dataclass(frozen=True)
class ArmIndices:
    """Bullet's numbers of the arm's links and joints; a joint and the link after it share theirs.

    Args:
        links: Number of each link, by its name.
        arm: Numbers of the arm's joints.
        fingers: Numbers of the two jaws.
    """

    links: dict[str, int]
    arm: tuple[int, ...]
    fingers: tuple[int, ...]

    @staticmethod
    def of(body: int, client: int) -> ArmIndices:
        """Read the numbers of a body."""
        numbers = range(bullet.getNumJoints(body, physicsClientId=client))
        infos = [bullet.getJointInfo(body, number, physicsClientId=client) for number in numbers]
        base = bullet.getBodyInfo(body, physicsClientId=client)[0].decode()
        links = {info[12].decode(): info[0] for info in infos} | {base: -1}
        by_name = {info[1].decode(): info[0] for info in infos}
        arm = tuple(info[0] for info in infos if info[2] == bullet.JOINT_REVOLUTE)
        return ArmIndices(links, arm, tuple(by_name[name] for name in FINGER_JOINTS))

    def name(self, link: int) -> str:
        """Name of a link."""
        return next(name for name, number in self.links.items() if number == link)


class Clearances(Connected):
    """Measures distances in a workcell with blocks.

    Args:
        workcell: The arm and its place.
        stack: Stack with the blocks.
        physics: Physics with the blocks' size.
    """

    def __init__(self, workcell: Workcell, stack: Stack, physics: Physics) -> None:
        super().__init__(bullet.connect(bullet.DIRECT))
        self.workcell, self.stack, self.physics = workcell, stack, physics
        self._arm = load_arm(workcell, self.client, visual=False)
        self.indices = ArmIndices.of(self._arm, self.client)
        slab = self.bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[2, 2, 0.5])
        self._table = self.bullet.createMultiBody(0, slab, -1, [0, 0, -0.5])
        molds = [Mold.cast(shape, physics, self.client) for shape in stack.catalogue]
        self._blocks = [
            self.bullet.createMultiBody(0, molds[shape].collision, -1, [0, 0, -5 - n])
            for n, shape in enumerate(stack.shapes)
        ]
        for block, shape in zip(self._blocks, stack.shapes, strict=True):
            self.bullet.changeDynamics(block, -1, **molds[shape].dynamics)
        links = self.indices.links
        self._pairs = [(links[a], links[b]) for a, b in self_collision_pairs(workcell.arm)]
        self._standing = {links[name] for name in chain_links(workcell.arm)[:2]}  # the arm's foot is at home there
        self._fingers = {links[name] for name in FINGERS}

    def put_block(self, number: int, frame: Floats) -> None:
        """Put a block at a frame (4, 4)."""
        shape = self.stack.catalogue[int(self.stack.shapes[number])]
        position, quaternion = body_placement(shape, frame, self.physics.cell_size)
        self.bullet.resetBasePositionAndOrientation(self._blocks[number], position, quaternion)

    def put_arm(self, joints: Floats, opening: float) -> None:
        """Put the arm at joint angles (n,) [rad], the jaws open to a width [m]."""
        for index, angle in zip(self.indices.arm, joints.tolist(), strict=True):
            self.bullet.resetJointState(self._arm, index, angle)
        for index in self.indices.fingers:
            self.bullet.resetJointState(self._arm, index, opening / 2)

    def of_arm(self, blocks: Iterable[int], touched: int | None = None) -> Near:
        """Least distance of the arm and its jaws from the table, from the arm itself and from some blocks.

        Finger tips go near the table on purpose; the workspace's lowest height is what keeps them off it.

        Args:
            blocks: Numbers of the blocks.
            touched: Number of the block that the fingers may touch.
        """
        nearest = self._to(self._table, "the table", self._standing | self._fingers)
        for number in blocks:
            skipped = self._fingers if number == touched else set()
            nearest = min(nearest, self._to(self._blocks[number], f"block {number}", skipped))
        for a, b in self._pairs:
            for point in self.bullet.getClosestPoints(self._arm, self._arm, SEEN, linkIndexA=a, linkIndexB=b):
                nearest = min(nearest, Near(point[8], f"{self.indices.name(a)} and {self.indices.name(b)}"))
        return nearest

    def of_block(self, number: int, others: Iterable[int], but: Collection[int] = ()) -> Near:
        """Least distance of a block from the table and from other blocks.

        Args:
            number: Number of the block.
            others: Numbers of the blocks that there are.
            but: Blocks, and `TABLE`, that it may touch.
        """
        nearest = Near()
        for other in (*others, TABLE):
            if other == number or other in but:
                continue
            body = self._table if other == TABLE else self._blocks[other]
            name = "the table" if other == TABLE else f"block {other}"
            for point in self.bullet.getClosestPoints(self._blocks[number], body, SEEN):
                nearest = min(nearest, Near(point[8], f"block {number} and {name}"))
        return nearest

    def touching(self, number: int, others: Iterable[int], within: float) -> frozenset[int]:
        """Find the blocks, and `TABLE`, that a block is within a distance [m] of."""
        bodies = {other: self._blocks[other] for other in others if other != number} | {TABLE: self._table}
        return frozenset(
            other for other, body in bodies.items() if self.bullet.getClosestPoints(self._blocks[number], body, within)
        )

    def _to(self, body: int, name: str, but: Collection[int]) -> Near:
        points = self.bullet.getClosestPoints(self._arm, body, SEEN)
        return min(
            (Near(point[8], f"{self.indices.name(point[3])} and {name}") for point in points if point[3] not in but),
            default=Near(),
        )
