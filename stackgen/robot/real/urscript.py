"""A whole build as a URScript program: to be read, reviewed, and sent to the arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.robot.backend import ArmState, execute
from stackgen.robot.planning.motion import Motion
from stackgen.robot.planning.plan import BlockPlan, BuildPlan
from stackgen.robot.real.gripper import ACTIVE, HOLDS, MOVING, POSITIONS, Gripper
from stackgen.robot.real.program import Controller, Grasps, controller_move, tool_offset
from stackgen.robot.workcell import Workcell
from stackgen.stack import Stack

Floats = NDArray[np.float64]

_INDENT = "  "


class UrScriptFile:
    """An arm that writes down what it is told to do.

    Args:
        workcell: Limits of the arm; a motion beyond them is refused.
        controller: Payload of the tool, and how near home the arm must be.
        gripper: Settings of the jaws.
    """

    def __init__(self, workcell: Workcell, controller: Controller, gripper: Gripper) -> None:
        self.workcell, self.controller, self.gripper = workcell, controller, gripper
        self.lines: list[str] = []
        self._grasps, self._doing = Grasps(), ""
        self._joints, self._opening = workcell.home_joints, workcell.jaws.opening

    def begin(self, step: BlockPlan, stack: Stack, slot: int) -> None:
        """Note that a block is begun.

        Args:
            step: Plan of the block.
            stack: Stack of the block.
            slot: Number of the slot where it waits, from 1.
        """
        self._grasps.begin(step)
        self._doing = f"block {step.block} ({stack.names[step.block]}): "
        x, y, z = step.goal[:3, 3]
        self.comment("")
        self.comment(f"Block {step.block} ({stack.names[step.block]}): from slot {slot} to {x:.4f}, {y:.4f}, {z:.4f} m")
        self.say(f'textmsg("stackgen: block {step.block} from slot {slot}")')

    def move(self, motion: Motion) -> None:
        """Write a movej or a movel."""
        try:
            move = controller_move(motion, self.workcell)
        except StackgenError as error:
            raise StackgenError(f"{self._doing}{error}") from error
        target = f"p{numbers(move.pose)}"
        if move.kind == "joint":
            target = f"get_inverse_kin({target}, qnear={numbers(move.joints)})"
        verb = "movej" if move.kind == "joint" else "movel"
        self.say(f"{verb}({target}, a={move.acceleration:.3f}, v={move.speed:.3f})  # {move.name}")
        self._joints = motion.end

    def open(self, width: float) -> None:
        """Write the opening of the jaws."""
        self.say(f"jaws_open({self.gripper.position(width)})" if self._robotiq else "jaws_open()")
        self._opening = width

    def close(self, force: float) -> None:
        """Write the closing of the jaws; the closing that takes the block checks that it did."""
        self.say(f"jaws_close({self.gripper.force(force)})" if self._robotiq else "jaws_close()")
        if self._grasps.is_grasp() and self._robotiq:
            self.say("jaws_must_hold()")
        self._opening = 0.0

    def state(self) -> ArmState:
        """Tell where the program has got to."""
        return ArmState(self._joints, self._opening)

    def stop(self) -> None:
        """End the program here."""
        self.say("halt")

    def say(self, line: str) -> None:
        """Write a line."""
        self.lines.append(_INDENT + one_line(line))

    def comment(self, text: str) -> None:
        """Write a comment."""
        self.lines.append(f"{_INDENT}# {one_line(text)}".rstrip() if text else "")

    @property
    def _robotiq(self) -> bool:
        return self.gripper.kind == "robotiq"

    def program(self, title: str) -> str:
        """Program as text.

        Args:
            title: What is built, in a line.
        """
        head = [
            "def stackgen_build():",
            f"{_INDENT}# {one_line(title)}",
            f"{_INDENT}# Written by stackgen for this workcell alone: read it, and run it slowly the first time.",
            f"{_INDENT}# Poses are those of the finger tips in the controller's base frame [m, rad].",
            f"{_INDENT}set_tcp(p{numbers(np.array(tool_offset(self.workcell)))})",
            f"{_INDENT}set_payload({self.controller.payload:g}, {numbers(self.controller.center_of_gravity)})",
        ]
        parts = [_HALT, _NEAR_HOME, _ROBOTIQ if self._robotiq else _DIGITAL]
        values = {
            "HOME": numbers(self.workcell.home_joints),
            "NEAR": f"{np.radians(self.controller.near_home):.4f}",
            "HOST": self.gripper.host or "127.0.0.1",
            "PORT": str(self.gripper.port),
            "SPEED": str(self.gripper.rate),
            "CLOSED": str(POSITIONS),
            "ACTIVE": str(ACTIVE),
            "MOVING": str(MOVING),
            "HOLDS": str(HOLDS),
            "OUTPUT": str(self.gripper.output),
            "SHUT": str(self.gripper.closed),
            "WIDE": str(not self.gripper.closed),
            "SECONDS": f"{self.gripper.seconds:g}",
        }
        for part in parts:
            text = part
            for name, value in values.items():
                text = text.replace(f"@{name}@", one_line(value))
            head += ["", *(_INDENT + line if line else "" for line in text.strip("\n").split("\n"))]
        return "\n".join([*head, *self.lines, f'{_INDENT}textmsg("stackgen: done")', "end", ""])


def urscript(plan: BuildPlan, workcell: Workcell, controller: Controller, gripper: Gripper) -> str:
    """Write a plan as a program that the arm can run on its own.

    Args:
        plan: Plan of the build.
        workcell: Workcell of the plan.
        controller: Payload of the tool, and how near home the arm must be.
        gripper: Settings of the jaws.

    Raises:
        StackgenError: If a motion leaves the workcell's workspace or is too fast.
    """
    arm = UrScriptFile(workcell, controller, gripper)
    slots = {block: number for number, block in enumerate(plan.order, 1)}
    execute(plan, arm, on_start=lambda step: arm.begin(step, plan.stack, slots[step.block]))
    count = f"{len(plan.blocks)} of {len(plan.stack)} blocks"
    return arm.program(f"{count}, in the order {', '.join(str(step.block) for step in plan.blocks)}.")


def numbers(values: Floats | tuple[float, ...]) -> str:
    """Write a list as URScript does.

    >>> numbers((0.5, -1e-9))
    '[0.5, 0]'
    """
    return "[" + ", ".join(f"{round(float(value), 6) + 0.0:.6g}" for value in values) + "]"


_HALT = """
def give_up(why):
  popup(why, "stackgen", error=True, blocking=True)
  halt
end
"""

_NEAR_HOME = """
# The way from anywhere else was not checked for collisions.
home = @HOME@
now = get_actual_joint_positions()
joint = 0
while joint < 6:
  if norm(now[joint] - home[joint]) > @NEAR@:
    give_up("The arm is not at its home position: bring it there, and start again.")
  end
  joint = joint + 1
end
movej(home, a=0.3, v=0.2)
"""

_ROBOTIQ = """
# Robotiq's socket protocol: each value that is set is acknowledged.
if not socket_open("@HOST@", @PORT@, "jaws"):
  give_up("No Robotiq gripper answers.")
end
def jaws_set(name, value):
  socket_set_var(name, value, "jaws")
  acknowledged = socket_read_byte_list(3, "jaws")
end
if socket_get_var("STA", "jaws") != @ACTIVE@:
  jaws_set("ACT", 0)
  jaws_set("ACT", 1)
  while socket_get_var("STA", "jaws") != @ACTIVE@:
    sleep(0.1)
  end
end
def jaws_go(position, force):
  jaws_set("FOR", force)
  jaws_set("SPE", @SPEED@)
  jaws_set("POS", position)
  jaws_set("GTO", 1)
  while socket_get_var("PRE", "jaws") != position:
    sleep(0.02)
  end
  while socket_get_var("OBJ", "jaws") == @MOVING@:
    sleep(0.02)
  end
end
def jaws_open(position):
  jaws_go(position, 0)
end
def jaws_close(force):
  jaws_go(@CLOSED@, force)
end
def jaws_must_hold():
  if socket_get_var("OBJ", "jaws") != @HOLDS@:
    give_up("The jaws closed on nothing: is the block in its slot?")
  end
end
"""

_DIGITAL = """
def jaws_open():
  set_standard_digital_out(@OUTPUT@, @WIDE@)
  sleep(@SECONDS@)
end
def jaws_close():
  set_standard_digital_out(@OUTPUT@, @SHUT@)
  sleep(@SECONDS@)
end
"""


def one_line(text: str) -> str:
    """Write text so that it cannot end the line it stands in: what is not printable becomes a question mark.

    >>> one_line("a house\\n  movej([0])")
    'a house?  movej([0])'
    """
    return "".join(character if character.isprintable() else "?" for character in text)
