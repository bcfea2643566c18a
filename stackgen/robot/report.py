"""What became of a build: errors of each block, contacts that were not planned, and whether it stands."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.io.stacks_file import Entry, StacksFile, to_json
from stackgen.stack import Stack

Floats = NDArray[np.float64]

FORMAT = "stackgen.build/1"


@dataclass(frozen=True)
class PlacementError:
    """How far a block is from where it should be.

    Args:
        xy: Along the table [mm].
        z: Upwards [mm].
        yaw: About the vertical [deg], without its sign.
        tilt: Of its vertical axis [deg].
    """

    xy: float
    z: float
    yaw: float
    tilt: float

    @staticmethod
    def between(frame: Floats, goal: Floats) -> PlacementError:
        """Of a frame (4, 4) from its goal [m].

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


@dataclass(frozen=True)
class BlockReport:
    """What became of a block.

    Args:
        block: Its number in the stack.
        shape: Its name.
        slot_error: Of the slot it was fetched from: how far it lay from where the robot believed.
        released: When the jaws had let go.
        settled: At the end of the build.
        disturbed: How far later blocks moved it [mm].
        clearance: The least that was planned for arm, jaws and the block itself [mm].
        nearest: To what.
        ik_distance: Largest residual of the inverse kinematics [mm].
        ik_turn: Likewise [deg].
        seconds: Simulated time that it took.
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


@dataclass(frozen=True)
class BuildReport:
    """What became of a build.

    Args:
        blocks: In the order in which they were placed.
        order: Its strategy.
        safe: Whether every state on the way stands by itself.
        least_margin: Largest tilt that the least stable state survives [deg].
        grasp: `jaws` or `fixed`.
        built: Every block is within half a cell of its place.
        stands: No block falls when the built stack is simulated awake in a fresh world.
        iou_target: Of the built silhouette with the target (0 if it does not stand); None without a target.
        iou_generated: Of the built silhouette with that of the stack as it was generated and settled.
        generated_iou_target: Of the generated stack, settled, with the target.
        seconds: Simulated time from start to end.
        real_time_factor: Simulated seconds in a second.
        tracking_error: Largest difference of a joint from where it should have been [deg].
        torque: Largest of each joint [N m].
        stack: As it was built.
        design: As it should have been built.
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
        """Built and standing."""
        return self.built and self.stands

    @property
    def unplanned(self) -> tuple[str, ...]:
        """All contacts that should not have been."""
        return tuple(contact for block in self.blocks for contact in block.unplanned)

    def errors(self, key: str, when: str = "settled") -> Floats:
        """(k,) one of the placement errors, without its sign: `xy`, `z`, `yaw`, `tilt`; `released` or `settled`."""
        return np.abs([getattr(getattr(block, when), key) for block in self.blocks])

    def to_json(self) -> dict[str, Any]:
        """Plain form; the stacks as `stacks.json` has them."""
        plain = {k: v for k, v in vars(self).items() if k not in ("stack", "design", "blocks")}
        stacks = to_json(StacksFile((Entry(self.stack), Entry(self.design)), self.stack.catalogue))["stacks"]
        return {
            "format": FORMAT,
            **plain,
            "success": self.success,
            "unplanned_contacts": len(self.unplanned),
            "blocks": [asdict(block) for block in self.blocks],
            "stack": stacks[0],
            "design": stacks[1],
        }
