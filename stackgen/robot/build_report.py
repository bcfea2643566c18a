"""The report of a build: errors of each block, contacts that were not planned, and whether the result stands."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.io.stacks_file import StackEntry, entry_to_json
from stackgen.stack import Stack

Floats = NDArray[np.float64]

FORMAT = "stackgen.build/1"


@dataclass(frozen=True)
class PlacementError:
    """How far a block is from where it should be.

    Args:
        xy: Distance along the table [mm].
        z: Height above the place [mm].
        yaw: Turn about the vertical [deg], without its sign.
        tilt: Turn of its vertical axis [deg].
    """

    xy: float
    z: float
    yaw: float
    tilt: float

    @staticmethod
    def between(frame: Floats, goal: Floats) -> PlacementError:
        """Measure a frame (4, 4) against its goal (4, 4) [m].

        >>> moved = np.eye(4)
        >>> moved[:3, 3] = 0.003, 0.004, 0.001
        >>> PlacementError.between(moved, np.eye(4))
        PlacementError(xy=5.0, z=1.0, yaw=0.0, tilt=0.0)
        """
        offset = (frame[:3, 3] - goal[:3, 3]) * 1e3
        turn = frame[:3, :3] @ goal[:3, :3].T
        yaw = abs(np.degrees(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])))
        tilt = np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1)))
        values = np.hypot(*offset[:2]), offset[2], yaw, tilt
        return PlacementError(*(round(float(value), 9) + 0.0 for value in values))


@dataclass(frozen=True, kw_only=True)
class BlockReport:
    """The report of one block.

    Args:
        block: Number of the block in the stack.
        shape: Name of its shape.
        slot_error: Error of its place in the slot, against where the robot believed it to be.
        released: Error when the jaws had let go.
        settled: Error at the end of the build.
        disturbed: Distance by which later blocks moved it [mm].
        clearance: Least planned distance of arm, jaws and the block itself from anything else [mm].
        nearest: The two things at that distance.
        ik_distance: Largest distance that the inverse kinematics left [mm].
        ik_turn: Largest turn that the inverse kinematics left [deg].
        seconds: Simulated time that it took [s].
        unplanned: Contacts that should not have been, in words.
    """

    block: int
    shape: str
    slot_error: PlacementError
    released: PlacementError
    settled: PlacementError
    disturbed: float
    clearance: float
    nearest: str
    ik_distance: float
    ik_turn: float
    seconds: float
    unplanned: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class BuildReport:
    """The report of a build.

    Args:
        blocks: Reports of the blocks, in the order in which they were placed.
        order: Strategy of the order.
        safe: Whether every state on the way stands by itself.
        least_margin: Largest tilt that the least stable state survives [deg].
        grasp: `jaws` or `fixed`.
        built: Whether every block is within half a cell of its place.
        stands: Whether no block falls when the built stack is simulated awake in a fresh world.
        iou_target: IoU of the built silhouette with the target (0 if it does not stand); None without a target.
        iou_generated: IoU of the built silhouette with that of the stack as it was generated and settled.
        generated_iou_target: IoU of the generated stack, settled, with the target.
        seconds: Simulated time from start to end [s].
        real_time_factor: Simulated seconds in a second.
        tracking_error: Largest difference of a joint from where it should have been [deg].
        torque: Largest torque of each joint [N m].
        stack: Blocks as they were built.
        design: Blocks as they should have been built.
    """

    blocks: tuple[BlockReport, ...]
    order: str
    safe: bool
    least_margin: float
    grasp: str
    built: bool
    stands: bool
    iou_target: float | None
    iou_generated: float
    generated_iou_target: float | None
    seconds: float
    real_time_factor: float
    tracking_error: float
    torque: tuple[float, ...]
    stack: Stack
    design: Stack

    @property
    def success(self) -> bool:
        """Whether it is built and stands."""
        return self.built and self.stands

    @property
    def unplanned(self) -> tuple[str, ...]:
        """All contacts that should not have been."""
        return tuple(contact for block in self.blocks for contact in block.unplanned)

    def to_json(self) -> dict[str, Any]:
        """Plain form; the stacks as `stacks.json` has them."""
        plain = {k: v for k, v in vars(self).items() if k not in ("stack", "design", "blocks")}
        return {
            "format": FORMAT,
            **plain,
            "success": self.success,
            "unplanned_contacts": len(self.unplanned),
            "blocks": [asdict(block) for block in self.blocks],
            "stack": entry_to_json(StackEntry(self.stack)),
            "design": entry_to_json(StackEntry(self.design)),
        }
