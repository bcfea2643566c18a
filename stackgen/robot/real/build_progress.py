"""The progress of a build with a real arm, on disk after every block, so that it can be resumed after a stop."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stackgen.errors import MALFORMED, StackgenError
from stackgen.io.files import write_json
from stackgen.io.text import read_json
from stackgen.robot.workcell import Workcell
from stackgen.stack import Stack

FORMAT = "stackgen.build/1"
FILE = "progress.json"

Status = Literal["building", "stopped", "done"]

_SAME = 0.01  # poses that differ by less are the same [cell, rad]
_MAY_CHANGE = ("speeds",)  # parts of the workcell that do not change where blocks are


@dataclass(frozen=True)
class BuildProgress:
    """What stands already; its fields are the keys of the file.

    Args:
        shapes: (k,) names of the blocks.
        poses: (k, 6) poses in which they are to be [cell, rad].
        order: (k,) numbers of the blocks in the order of placing.
        cell: Workcell in which it is built, in plain form.
        placed: Number of blocks of the order that stand.
        status: Whether the build is under way, was stopped, or is done.
        why: Reason for which it was stopped.
    """

    shapes: tuple[str, ...]
    poses: tuple[tuple[float, ...], ...]
    order: tuple[int, ...]
    cell: dict[str, Any]
    placed: int = 0
    status: Status = "building"
    why: str | None = None

    @staticmethod
    def of(stack: Stack, order: tuple[int, ...], workcell: Workcell) -> BuildProgress:
        """Begin a build of which nothing stands yet."""
        poses = tuple(tuple(float(number) for number in pose) for pose in stack.poses)
        plain = json.loads(json.dumps(workcell.to_json()))  # lists for tuples, as when read back
        return BuildProgress(tuple(stack.names), poses, tuple(order), plain)

    @staticmethod
    def read(folder: Path) -> BuildProgress:
        """Read the file in the folder of a build.

        Raises:
            StackgenError: If there is none, or it is no such file.
        """
        path = folder / FILE
        if not path.is_file():
            raise StackgenError(f"--resume: {path} does not exist: there is no build to go on with; leave --resume out")
        try:
            plain = read_json(path)
            if plain.pop("format") != FORMAT:
                raise ValueError("format")
            found = BuildProgress(**plain)
            found = replace(
                found,
                shapes=tuple(found.shapes),
                poses=tuple(tuple(map(float, pose)) for pose in found.poses),
                order=tuple(map(int, found.order)),
                placed=int(found.placed),
            )
            if sorted(found.order) != list(range(len(found.shapes))) or not 0 <= found.placed <= len(found.order):
                raise ValueError("order")
        except MALFORMED as error:
            raise StackgenError(f"{path}: is not the progress of a build ({FORMAT})") from error
        return found

    def write(self, folder: Path) -> None:
        """Write the file into the folder of a build, whole or not at all."""
        plain = {"format": FORMAT, **vars(self)}
        write_json(folder / FILE, plain)

    @property
    def next(self) -> int | None:
        """Number of the block to be placed next; None when all stand."""
        return self.order[self.placed] if self.placed < len(self.order) else None

    def require_same(self, stack: Stack, order: tuple[int, ...], workcell: Workcell) -> None:
        """See that a plan is that of this build.

        Raises:
            StackgenError: If blocks, places, order or workcell are others.
        """
        now = BuildProgress.of(stack, order, workcell)
        if now.shapes != self.shapes or not np.allclose(now.poses, self.poses, atol=_SAME):
            raise StackgenError("--resume: the build that was interrupted was of another structure")
        if now.order != self.order:
            raise StackgenError("--resume: the build that was interrupted had another order; name the same --order")
        for name in sorted(self.cell):
            if name not in _MAY_CHANGE and self.cell.get(name) != now.cell.get(name):
                raise StackgenError(f"--resume: cell.{name} is not what it was when the build was interrupted")

    def describe(self) -> str:
        """Describe it in a line.

        >>> BuildProgress(("cube", "cube"), (), (1, 0), {}, placed=1).describe()
        '1 of 2 blocks stand (1); next is block 0 (cube)'
        """
        count = f"{self.placed} of {len(self.order)} blocks stand"
        if self.placed:
            count += f" ({', '.join(map(str, self.order[: self.placed]))})"
        return count if self.next is None else f"{count}; next is block {self.next} ({self.shapes[self.next]})"
