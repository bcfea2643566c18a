"""The arm builds a stack: the plan of `stackgen build`, carried out in simulation, as motion for the page.

Lengths in messages are in cells, joint angles in radians.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from xml.etree.ElementTree import Element, fromstring

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.robot.build import build, design, plan_stack
from stackgen.robot.planning.clearance import block_pose
from stackgen.robot.planning.urdf import with_jaws
from stackgen.robot.simulated.arm import SimulatedArm
from stackgen.robot.workcell import Workcell
from stackgen.sim.statics.fit import describe_misfits
from stackgen.studio.requests import ArmRequest, StackRequest
from stackgen.studio.work.judging import Message, chosen_stack, physics_of
from stackgen.viz.scene import quaternion_poses

Send = Callable[[Message], None]

RATE = 12
"""Frames of a build in a second of the arm's time."""

_TOGETHER = 12  # frames that are sent in one message
_STILL = 2e-3  # what moves less is not sent again [cell, and parts of quaternions]


def ordered(request: StackRequest, send: Send) -> None:
    """Find the order in which a stack can be built, and the margin after each step.

    Raises:
        StackgenError: If it cannot be built: the message says why.
    """
    content, entry = chosen_stack(request)
    with _words_of_the_page():
        found = design(entry.stack, Workcell(), physics_of(content))
    send({"order": list(found.order.blocks), "margins": [round(margin, 1) for margin in found.order.margins]})


def built(request: StackRequest, send: Send) -> None:
    """Build a stack: tell what is planned, then the motion, then what stands.

    Raises:
        StackgenError: If it cannot be built: the message says why.
    """
    content, entry = chosen_stack(request)
    for misfit in describe_misfits(entry.stack):
        if misfit.impossible:
            raise StackgenError(f"this structure cannot be built: {misfit.text}")
    k, workcell, physics = len(entry.stack), Workcell(), physics_of(content)
    send({"kind": "planned", "blocks": 0, "of": k})
    with _words_of_the_page():
        plan = plan_stack(
            entry.stack, workcell, physics, on_block=lambda done: send({"kind": "planned", "blocks": done, "of": k})
        )
    order = [step.block for step in plan.plan.blocks]
    send({"kind": "order", "order": order, "shapes": plan.plan.stack.shapes.tolist(), "rate": RATE})
    report = build(
        plan,
        content.world.grid,
        target=content.target,
        on_block=lambda done: send({"kind": "placed", "blocks": done}),
        camera=lambda arm: _Camera(arm, send).look,
    )
    send(
        {
            "kind": "built",
            "stands": report.success,
            "seconds": round(report.seconds, 1),
            "iou": None if report.iou_target is None else round(report.iou_target, 3),
            "unplanned": list(report.unplanned),
        }
    )


@contextmanager
def _words_of_the_page() -> Iterator[None]:
    """Name the way out that the page has where an error names an option of the command line."""
    try:
        yield
    except StackgenError as error:
        why, option, _ = str(error).partition("; --")
        raise StackgenError(f"{why}; choose another structure" if option else why) from error


class _Camera:
    """Looks at an arm after each step, and sends joint angles and the blocks that moved.

    Args:
        arm: Arm that builds.
        send: Takes messages.
    """

    def __init__(self, arm: SimulatedArm, send: Send) -> None:
        self.arm, self.send = arm, send
        self.every = round(1 / RATE / arm.physics.time_step)
        self.frames: list[Message] = []
        self.seen = np.full((len(arm.stack), 7), np.inf)

    def look(self, finished: bool) -> None:
        """Look, if it is time."""
        if not finished and self.arm.steps % self.every:
            return
        state = self.arm.state()
        size = self.arm.physics.cell_size
        poses = np.array([block_pose(self.arm.frame(block), size) for block in range(len(self.arm.stack))])
        now = np.array(quaternion_poses(poses, 4))
        moved = np.flatnonzero(np.abs(now - self.seen).max(axis=1) > _STILL)
        self.seen[moved] = now[moved]
        joints = [*state.joints.round(4).tolist(), round(float(state.opening) / size, 3)]
        self.frames.append({"joints": joints, "blocks": {str(block): now[block].tolist() for block in moved}})
        if finished or len(self.frames) == _TOGETHER:
            self.send({"kind": "motion", "frames": self.frames})
            self.frames = []


def described(request: ArmRequest, send: Send) -> None:
    """Describe the arm: its links from the base on, how each hangs on the one before, and their meshes."""
    workcell = Workcell()
    size = request.cell_size
    root = fromstring(with_jaws(workcell.arm, workcell.jaws, visual=False))
    joints = {_named(joint, "child"): joint for joint in root.iter("joint")}
    shapes = {link.get("name", ""): _shapes(link, size) for link in root.iter("link")}
    order, parents = [workcell.arm.base], {child: _named(joint, "parent") for child, joint in joints.items()}
    for parent in order:
        order += [child for child, above in parents.items() if above == parent and child in shapes]
    links = [{"name": order[0], "parent": None, "frame": _frame(workcell.base.table_from_base, size), "joint": "fixed"}]
    for name in order[1:]:
        joint = joints[name]
        axis = joint.find("axis")
        links.append(
            {
                "name": name,
                "parent": parents[name],
                "frame": _frame(_origin(joint), size),
                "joint": joint.get("type"),
                "axis": _numbers(None if axis is None else axis.get("xyz"), (1, 0, 0)),
            }
        )
    send({"links": [{**link, "shapes": shapes[str(link["name"])]} for link in links]})


def _shapes(link: Element, cell_size: float) -> list[Message]:
    """Describe what a link looks like: triangles (t, 3, 3) as base64 of float32, or a box."""
    shapes: list[Message] = []
    for collision in link.findall("collision"):
        frame = _frame(_origin(collision), cell_size)
        mesh, box = collision.find("geometry/mesh"), collision.find("geometry/box")
        if mesh is not None:
            triangles = (_stl(mesh.get("filename", "")) / cell_size).astype("<f4")
            shapes.append({"frame": frame, "triangles": base64.b64encode(triangles.tobytes()).decode("ascii")})
        elif box is not None:
            edges = [edge / cell_size for edge in _numbers(box.get("size"), (0, 0, 0))]
            shapes.append({"frame": frame, "box": edges})
    return shapes


def _stl(path: str) -> NDArray[np.float32]:
    """Read the triangles (t, 3, 3) of a binary STL file."""
    row = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.asarray(np.fromfile(path, dtype=row, offset=84)["corners"], dtype=np.float32)


def _origin(element: Element) -> NDArray[np.float64]:
    """Read the frame (4, 4) of an element's origin."""
    frame, origin = np.eye(4), element.find("origin")
    if origin is not None:
        roll, pitch, yaw = _numbers(origin.get("rpy"), (0, 0, 0))
        (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angle), math.sin(angle)) for angle in (roll, pitch, yaw))
        frame[:3, :3] = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
        frame[:3, 3] = _numbers(origin.get("xyz"), (0, 0, 0))
    return frame


def _frame(frame: NDArray[np.float64], cell_size: float) -> list[float]:
    """List a frame (4, 4) [m] row by row [cell]."""
    scaled = frame.copy()
    scaled[:3, 3] /= cell_size
    return scaled.round(6).ravel().tolist()


def _numbers(text: str | None, default: tuple[float, float, float]) -> list[float]:
    return list(default) if text is None else [float(number) for number in text.split()]


def _named(element: Element, child: str) -> str:
    found: Any = element.find(child)
    return "" if found is None else found.get("link", "")
