"""What a page or a script may ask of the studio: every number has bounds, every text a form, and nothing else is taken.

Lengths in cells, angles in degrees.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

CELL = 14
"""Edge of a cell in a drawing [pixel]: the scale of the paper's silhouettes."""

FEWEST_CELLS, MOST_CELLS = 4, 8
MOST_STACKS = 6
MOST_BLOCKS = 40
MOST_TEXT = 8_000_000
"""Longest picture, as base64: 6 MB."""

Counts = Annotated[dict[Annotated[str, Field(max_length=100)], Annotated[int, Field(ge=0, le=99)]], Field(max_length=8)]
Id = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]


class Request(BaseModel):
    """What all requests have in common: they are never changed, and unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Drawing(Request):
    """What was drawn, in a square of cells that stands on the ground.

    Args:
        cells: Cells along each edge of the square; a cell has 14 x 14 pixels.
        bits: Pixels row by row from the top, one bit each, rows padded to whole bytes, as base64.
    """

    cells: int = Field(ge=FEWEST_CELLS, le=MOST_CELLS)
    bits: str = Field(max_length=2400, pattern="^[A-Za-z0-9+/]*={0,2}$")


class Solver(Request):
    """How a diffusion model goes from noise to poses; null is as its weights have it."""

    kind: Literal["ddpm", "ddim", "dpm"] | None = None
    steps: int | None = Field(default=None, ge=1, le=1000)


class Wish(Request):
    """How stacks are made.

    Args:
        method: Name of a method, as `/api/methods` lists them.
        number: Number of stacks.
        seed: The same seed gives the same stacks.
        blocks: Block list, all of which is used; null to predict one.
        inventory: Blocks that there are; null for no limit.
        sampler: Settings of a diffusion model.
        verified: Whether many stacks are drawn and the best kept, or single samples shown as they come.
    """

    method: str = Field(default="best", max_length=60, pattern="^[a-z0-9-]+$")
    number: int = Field(default=3, ge=1, le=MOST_STACKS)
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    blocks: Counts | None = None
    inventory: Counts | None = None
    sampler: Solver = Solver()
    verified: bool = True


class GenerateRequest(Request):
    """A drawing, and how stacks are made for it."""

    drawing: Drawing
    wish: Wish = Wish()


class ReadRequest(Request):
    """A picture: a drawing, the photo of a sketch, or a depth frame.

    Args:
        picture: Content of an image file, as base64.
        cells: Cells along each edge of the drawing that it becomes.
    """

    picture: str = Field(max_length=MOST_TEXT)
    cells: int = Field(default=FEWEST_CELLS, ge=FEWEST_CELLS, le=MOST_CELLS)


class StackRequest(Request):
    """A stack of a stacks.json.

    Args:
        file: Content of the stacks.json, by its published schema.
        stack: Number of the stack in it, from 0.
    """

    file: dict[str, Any]
    stack: int = Field(default=0, ge=0, le=999)

    @field_validator("file")
    @classmethod
    def _plain(cls, file: dict[str, Any]) -> dict[str, Any]:
        """Refuse what other programs would not read: numbers that are not finite, and endless nesting."""
        try:
            json.dumps(file, allow_nan=False)
        except (ValueError, RecursionError):
            raise ValueError("it must hold finite numbers, and no more levels than a stacks.json has") from None
        return file


class TiltRequest(StackRequest):
    """A stack on a table that is tilted slowly, until a block falls.

    Args:
        degrees: Tilt at which it stops.
        direction: Direction from above in which the table dips: 0 to the right, 90 away from the viewer.
    """

    degrees: float = Field(ge=0, le=60, allow_inf_nan=False)
    direction: float = Field(default=0, ge=-360, le=360, allow_inf_nan=False)


class PushRequest(StackRequest):
    """A stack, one block of which is pushed at its centre of mass, harder and harder, until a block falls.

    Args:
        block: Number of the block.
        force: Horizontal force beyond which it does not grow, as a share of the block's weight.
        direction: Direction from above: 0 to the right, 90 away from the viewer.
    """

    block: int = Field(ge=0, le=999)
    force: float = Field(ge=0, le=5, allow_inf_nan=False)
    direction: float = Field(default=0, ge=-360, le=360, allow_inf_nan=False)


class ExportRequest(StackRequest):
    """A stack as a file: for 3-D programs, or as a film of how it settles."""

    format: Literal["glb", "mp4"]


class ArmRequest(Request):
    """The arm that builds.

    Args:
        cell_size: Edge of a cube [m]; lengths in the answer are in cells.
    """

    cell_size: float = Field(default=0.05, ge=0.001, le=10, allow_inf_nan=False)
