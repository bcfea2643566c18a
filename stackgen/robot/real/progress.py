"""How far a build with a real arm has got, on disk after every block, so that it can go on after a stop."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.robot.workcell import Cell
from stackgen.stack import Stack

FORMAT = "stackgen.build/1"
FILE = "progress.json"

Status = Literal["building", "stopped", "done"]

_SAME = 0.01  # poses that differ by less are the same [cell, rad]
_MAY_CHANGE = ("speeds",)  # parts of the cell that do not change where blocks are


@dataclass(frozen=True)
class Progress:
    """What stands already.

    Args:
        shapes: (k,) names of the blocks.
        poses: (k, 6) where they are to be [cell, rad].
        order: (k,) of placing.
        cell: Where it is built, in plain form.
        placed: How many of the order stand.
        status: Whether the build goes on, was stopped, or is done.
        why: It was stopped.
    """

    shapes: tuple[str, ...]
    poses: tuple[tuple[float, ...], ...]
    order: tuple[int, ...]
    cell: dict[str, Any]
    placed: int = 0
    status: Status = "building"
    why: str | None = None

    @staticmethod
    def of(stack: Stack, order: tuple[int, ...], cell: Cell) -> Progress:
        """A build of which nothing stands yet."""
        poses = tuple(tuple(float(number) for number in pose) for pose in stack.poses)
        plain = json.loads(json.dumps(cell.to_json()))  # lists for tuples, as when read back
        return Progress(tuple(stack.names), poses, tuple(order), plain)

    @staticmethod
    def read(folder: Path) -> Progress:
        """From the folder of a build.

        Raises:
            StackgenError: If there is none, or it is no such file.
        """
        path = folder / FILE
        if not path.is_file():
            raise StackgenError(f"--resume: {path} does not exist: there is no build to go on with; leave --resume out")
        try:
            plain = json.loads(path.read_text())
            if plain.pop("format") != FORMAT:
                raise ValueError("format")
            found = Progress(**plain)
            found = replace(
                found,
                shapes=tuple(found.shapes),
                poses=tuple(tuple(map(float, pose)) for pose in found.poses),
                order=tuple(map(int, found.order)),
                placed=int(found.placed),
            )
            if sorted(found.order) != list(range(len(found.shapes))) or not 0 <= found.placed <= len(found.order):
                raise ValueError("order")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise StackgenError(f"{path}: is not the progress of a build ({FORMAT})") from error
        return found

    def write(self, folder: Path) -> None:
        """Into the folder of a build, at once or not at all."""
        plain = {"format": FORMAT, **vars(self)}
        write_atomically(folder / FILE, (json.dumps(plain, indent=1, allow_nan=False) + "\n").encode())

    @property
    def next(self) -> int | None:
        """The block to be placed next."""
        return self.order[self.placed] if self.placed < len(self.order) else None

    def require_same(self, stack: Stack, order: tuple[int, ...], cell: Cell) -> None:
        """See that a plan is that of this build.

        Raises:
            StackgenError: If blocks, places, order or cell are others.
        """
        now = Progress.of(stack, order, cell)
        if now.shapes != self.shapes or not np.allclose(now.poses, self.poses, atol=_SAME):
            raise StackgenError("--resume: the build that was interrupted was of another structure")
        if now.order != self.order:
            raise StackgenError("--resume: the build that was interrupted had another order; name the same --order")
        for name in sorted(set(self.cell) | set(now.cell)):
            if name not in _MAY_CHANGE and self.cell.get(name) != now.cell.get(name):
                raise StackgenError(f"--resume: cell.{name} is not what it was when the build was interrupted")

    def describe(self) -> str:
        """In a line.

        >>> Progress(("cube", "cube"), (), (1, 0), {}, placed=1).describe()
        '1 of 2 blocks stand (1); next is block 0 (cube)'
        """
        count = f"{self.placed} of {len(self.order)} blocks stand"
        if self.placed:
            count += f" ({', '.join(map(str, self.order[: self.placed]))})"
        return count if self.next is None else f"{count}; next is block {self.next} ({self.shapes[self.next]})"
