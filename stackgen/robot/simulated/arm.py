"""The arm with its jaws in PyBullet, as a build uses it.

The blocks are those of the verdicts: same shapes, masses, friction and step (stackgen.sim). The jaws are two
sliding fingers that a gear constraint keeps symmetric; they hold by friction, or, on request, by a fixed constraint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stackgen.robot.backend import ArmState
from stackgen.robot.planning.arm_model import arm_model
from stackgen.robot.planning.clearance import ArmIndices, block_pose, body_placement, load_arm
from stackgen.robot.planning.connection import Connected
from stackgen.robot.planning.motion import Motion
from stackgen.robot.planning.urdf import FINGERS, PALM, chain_links
from stackgen.robot.workcell import Grasp, Workcell
from stackgen.sim.bullet_engine import Mold, bullet, connect
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.viz.gltf import prism_mesh
from stackgen.viz.render import shape_colour
from stackgen.world import Shape

Floats = NDArray[np.float64]

_JAW_SPEED = 0.08  # of each finger [m/s]
_JAW_TIME = 2.0  # jaws that have not come to rest by then are as they are [s]
_ASLEEP = 0.005  # what is slower than this [m/s, rad/s] for two seconds is at rest
_SETTLE = 0.1  # the arm's rest after each motion [s]


@dataclass(frozen=True)
class PickNoise:
    """How far blocks lie from where the robot believes, as standard deviations of normal distributions.

    Args:
        distance: Distance along x and along y [m].
        turn: Turn about z [rad].
        seed: Seed of the noise: the same seed gives the same noise.
    """

    distance: float = 0.0
    turn: float = 0.0
    seed: int = 0

    def disturb(self, frames: list[Floats]) -> list[Floats]:
        """Move frames (4, 4), and turn each about its own place."""
        random = np.random.default_rng(self.seed)
        moved = []
        for frame in frames:
            x, y, turn = random.normal(size=3) * [self.distance, self.distance, self.turn]
            new = frame.copy()
            new[:3, :3] = Rotation.from_rotvec([0, 0, turn]).as_matrix() @ frame[:3, :3]
            new[:3, 3] += [x, y, 0]
            moved.append(new)
        return moved


class SimulatedArm(Connected):
    """A workcell in PyBullet: arm, jaws, table and blocks.

    Args:
        workcell: The arm, its place and its jaws.
        stack: Stack with the blocks.
        frames: (4, 4) frame of each block at the beginning.
        physics: Physics of the blocks; its time step is the simulation's.
        grasp: How blocks are held: by friction, or by a fixed constraint.
    """

    def __init__(
        self,
        workcell: Workcell,
        stack: Stack,
        frames: list[Floats],
        physics: Physics,
        *,
        grasp: Grasp = "jaws",
    ) -> None:
        self.workcell, self.stack, self.grasp = workcell, stack, grasp
        self.on_step: Callable[[], None] = lambda: None  # called after every step
        super().__init__(connect(physics))
        self.physics = physics
        self.arm = load_arm(workcell, self.client, visual=True)
        self.indices = ArmIndices.of(self.arm, self.client)
        self.fingers = {self.indices.links[name] for name in FINGERS}
        self.steps = 0
        self.tracking_error = 0.0  # the largest of any joint so far [rad]
        self.torque = np.zeros(len(workcell.home))  # the largest of each joint so far [N m]
        self._constraint: int | None = None
        self.blocks = [
            self._spawn(stack.catalogue[int(shape)], int(shape), frame)
            for shape, frame in zip(stack.shapes, frames, strict=True)
        ]
        self._prepare_arm()

    @property
    def time(self) -> float:
        """Time simulated so far [s]."""
        return self.steps * self.physics.time_step

    def move(self, motion: Motion) -> None:
        """Follow a motion, then wait until the arm has come to rest."""
        number = max(1, round(motion.duration / self.physics.time_step))
        positions, velocities = motion.at(np.arange(1, number + 1) * self.physics.time_step)
        for wanted, speed in zip(positions.tolist(), velocities.tolist(), strict=True):
            self._command(wanted, speed)
            self._step()
            if self.steps % 8 == 0:
                self._measure(wanted)
        self._hold_at(motion.end)
        self.wait(_SETTLE)

    def open(self, width: float) -> None:
        """Open the jaws; what a fixed constraint held is let go."""
        if self._constraint is not None:
            self.bullet.removeConstraint(self._constraint)
            self._constraint = None
        self._drive_jaws(width / 2, self.workcell.jaws.force)

    def close(self, force: float) -> None:
        """Close the jaws, or, with a fixed constraint, until they nearly touch, and then hold the block between."""
        block = self._between_fingers()
        if self.grasp == "jaws" or block is None:
            self._drive_jaws(0.0, force)
            return
        shape = self.stack.catalogue[int(self.stack.shapes[block])]
        self._drive_jaws((shape.depth * self.physics.cell_size + 0.008) / 2, force)
        self._fix(self.blocks[block])

    def state(self) -> ArmState:
        """Tell where arm and jaws are in the simulation."""
        states = self.bullet.getJointStates(self.arm, self.indices.arm)
        jaws = self.bullet.getJointStates(self.arm, self.indices.fingers)
        return ArmState(np.array([state[0] for state in states]), sum(state[0] for state in jaws))

    def stop(self) -> None:
        """Hold every joint where it is."""
        self._hold_at(self.state().joints)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds / self.physics.time_step)):
            self._step()

    def frame(self, block: int) -> Floats:
        """Frame (4, 4) of a block in the table frame."""
        shape = self.stack.catalogue[int(self.stack.shapes[block])]
        position, quaternion = self.bullet.getBasePositionAndOrientation(self.blocks[block])
        frame = np.eye(4)
        frame[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        frame[:3, 3] = position - frame[:3, :3] @ (shape.center_of_mass * self.physics.cell_size)
        return frame

    def built(self) -> Stack:
        """Stack of the blocks where they are."""
        size = self.physics.cell_size
        return self.stack.with_poses([block_pose(self.frame(block), size) for block in range(len(self.stack))])

    def touches(self) -> set[tuple[str, int, int]]:
        """Find what touches what right now: (`arm`, link, block) and (`block`, block, other block)."""
        numbers = {body: number for number, body in enumerate(self.blocks)}
        found = set()
        for point in self.bullet.getContactPoints():
            a, b, link_a, link_b, distance, force = point[1], point[2], point[3], point[4], point[8], point[9]
            if distance > 0 or force < 1e-3:
                continue
            if a == self.arm and b in numbers:
                found.add(("arm", link_a, numbers[b]))
            elif b == self.arm and a in numbers:
                found.add(("arm", link_b, numbers[a]))
            elif a in numbers and b in numbers:
                found.add(("block", min(numbers[a], numbers[b]), max(numbers[a], numbers[b])))
            elif self.arm in (a, b):
                found.add(("arm", link_a if a == self.arm else link_b, -1))
        return found

    def _spawn(self, shape: Shape, index: int, frame: Floats) -> int:
        """A block with the physics of the verdicts and a colour for the camera."""
        mold = Mold.cast(shape, self.physics, self.client)
        visual = block_visual(shape, index, self.physics.cell_size, self.client)
        position, quaternion = body_placement(shape, frame, self.physics.cell_size)
        body = self.bullet.createMultiBody(mold.mass, mold.collision, visual, position, quaternion)
        # Without the anchor a stack at rest creeps by a millimetre in a few seconds, as nothing real does (a
        # verdict's watch is too short to notice); what has come to rest sleeps, until touched: half of the time.
        self.bullet.changeDynamics(body, -1, **mold.dynamics, frictionAnchor=1)
        self.bullet.changeDynamics(
            body, -1, activationState=bullet.ACTIVATION_STATE_ENABLE_SLEEPING, sleepThreshold=_ASLEEP
        )
        return int(body)

    def _prepare_arm(self) -> None:
        """Home position, open jaws, the gear between them, rubber on the pads, the foot free of the table."""
        home = self.workcell.home_joints
        self._efforts = arm_model(self.workcell.arm).effort.tolist()
        for index, angle in zip(self.indices.arm, home.tolist(), strict=True):
            self.bullet.resetJointState(self.arm, index, angle)
        for index in self.indices.fingers:
            self.bullet.resetJointState(self.arm, index, self.workcell.jaws.opening / 2)
            self.bullet.changeDynamics(self.arm, index, lateralFriction=self.workcell.jaws.friction)
        left, right = self.indices.fingers
        gear = self.bullet.createConstraint(
            self.arm, left, self.arm, right, bullet.JOINT_GEAR, [0, 1, 0], [0, 0, 0], [0, 0, 0]
        )
        self.bullet.changeConstraint(gear, gearRatio=-1, maxForce=10_000, erp=0.3)
        for name in chain_links(self.workcell.arm)[:2]:
            link = self.indices.links[name]
            self.bullet.setCollisionFilterPair(self.arm, 0, link, -1, 0)
        self._hold_at(home)
        self._drive_jaws(self.workcell.jaws.opening / 2, self.workcell.jaws.force)
        self.steps = 0

    def _hold_at(self, joints: Floats) -> None:
        self._command(joints.tolist(), [0.0] * len(joints))

    def _command(self, positions: list[float], velocities: list[float]) -> None:
        self.bullet.setJointMotorControlArray(
            self.arm,
            self.indices.arm,
            bullet.POSITION_CONTROL,
            targetPositions=positions,
            targetVelocities=velocities,
            forces=self._efforts,
            positionGains=[0.6] * len(positions),
            velocityGains=[1.0] * len(positions),
        )

    def _drive_jaws(self, half: float, force: float) -> None:
        """Move the fingers until they rest; each presses with half of the force."""
        for index in self.indices.fingers:
            self.bullet.setJointMotorControl2(
                self.arm, index, bullet.POSITION_CONTROL, half, force=force / 2, maxVelocity=_JAW_SPEED
            )
        for step in range(round(_JAW_TIME / self.physics.time_step)):
            self._step()
            speeds = self.bullet.getJointStates(self.arm, self.indices.fingers)
            if step > 24 and max(abs(state[1]) for state in speeds) < 5e-4:
                return

    def _between_fingers(self) -> int | None:
        """Find the block at the finger tips; None where there is none."""
        link = self.indices.links[PALM]
        state = self.bullet.getLinkState(self.arm, link, computeForwardKinematics=1)
        down = Rotation.from_quat(state[5]).as_matrix()[:, 2]
        tip = np.array(state[4]) + down * self.workcell.jaws.reach
        reach = 0.8 * self.physics.cell_size
        distances = [float(np.linalg.norm(self.frame(block)[:3, 3] - tip)) for block in range(len(self.stack))]
        nearest = int(np.argmin(distances))
        return nearest if distances[nearest] < reach else None

    def _fix(self, block: int) -> None:
        """Put a fixed constraint between palm and block, as they are."""
        link = self.indices.links[PALM]
        state = self.bullet.getLinkState(self.arm, link, computeForwardKinematics=1)
        back = bullet.invertTransform(state[0], state[1])
        there = self.bullet.getBasePositionAndOrientation(block)
        position, quaternion = bullet.multiplyTransforms(*back, *there)
        self._constraint = self.bullet.createConstraint(
            self.arm, link, block, -1, bullet.JOINT_FIXED, [0, 0, 0], position, [0, 0, 0], quaternion
        )
        self.bullet.changeConstraint(self._constraint, maxForce=500)

    def _measure(self, wanted: list[float]) -> None:
        states = self.bullet.getJointStates(self.arm, self.indices.arm)
        error = max(abs(state[0] - angle) for state, angle in zip(states, wanted, strict=True))
        self.tracking_error = max(self.tracking_error, error)
        self.torque = np.maximum(self.torque, [abs(state[3]) for state in states])

    def _step(self) -> None:
        self.bullet.stepSimulation()
        self.steps += 1
        self.on_step()


def block_visual(shape: Shape, index: int, cell_size: float, client: int) -> int:
    """Make the visual shape of a block: its mesh, in the colour of its number in the catalogue."""
    points, normals, triangles = prism_mesh(shape)
    return int(
        bullet.createVisualShape(
            bullet.GEOM_MESH,
            vertices=((points - shape.center_of_mass) * cell_size).tolist(),
            normals=normals.tolist(),
            indices=triangles.ravel().tolist(),
            rgbaColor=[*(channel / 255 for channel in shape_colour(index)), 1.0],
            physicsClientId=client,
        )
    )
