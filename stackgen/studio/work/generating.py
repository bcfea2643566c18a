"""A drawing becomes stacks, and messages tell how: noise that turns into structures, verdicts, and why.

The answer is that of `stackgen sample` for the picture of the drawing; :func:`command_line` says with which options.
"""

from __future__ import annotations

import base64
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.api import Model, best, load
from stackgen.errors import StackgenError
from stackgen.io.stacks_file import StacksFile, to_json
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.protocols import StackSampler
from stackgen.sampling.alignment import as_shown
from stackgen.sampling.verified import Budget
from stackgen.sampling.wrapped import WrappedSampler
from stackgen.stack import shapes_of
from stackgen.studio.requests import GenerateRequest, ReadRequest, Wish
from stackgen.studio.work.drawings import cells_high, mask_of, pack, picture_of, png, reading_of
from stackgen.studio.work.judging import Message, Recorder, entry_facts, physics_of
from stackgen.studio.work.methods import BEST, methods
from stackgen.vision.reader import Reading, read_picture
from stackgen.viz.scene import quaternion_poses
from stackgen.world import PAPER_GRID, Grid, Mask

Send = Callable[[Message], None]

DRAWS = 8
"""Stacks that verified sampling draws for a block list, at most."""

_SHOWN = 8  # stacks that are shown while they are denoised
_FRAMES = 50  # pictures of the noise, at most


def generate(request: GenerateRequest, send: Send) -> None:
    """Make stacks for a drawing; tell how it goes, then the file, then each stack.

    Raises:
        StackgenError: If nothing is drawn, or the method finds no stack.
    """
    mask, wish = mask_of(request.drawing), request.wish
    if wish.method not in {method["name"] for method in methods()}:
        raise StackgenError(f"method: there is no {wish.method!r}; /api/methods lists them")
    picture = picture_of(mask)
    reading = reading_of(picture)
    found, recorder = _best(reading, mask, wish) if wish.method == BEST else _of_model(reading, wish, send)
    found = replace(found, silhouette="silhouette.png")
    send(
        {
            "kind": "file",
            "file": to_json(found),
            "command": command_line(wish, reading, mask),
            "picture": base64.b64encode(png(picture)).decode("ascii"),
            "notes": [*reading.notes, *_scaled(found, mask), *_fewer(found, wish)],
        }
    )
    for number, entry in enumerate(found.entries):
        rollout = recorder.behind(entry.stack)
        send({"kind": "stack", "number": number, **entry_facts(entry, found, rollout)})


def read(request: ReadRequest, send: Send) -> None:
    """Read a picture, and turn what is in it into a drawing that fills its cells.

    Raises:
        StackgenError: If it is no picture, is too large, or nothing is seen in it.
    """
    reading = _read(request.picture)
    size = request.cells * int(PAPER_GRID.pixels_per_cell)
    square = Grid(request.cells, request.cells, size, PAPER_GRID.pixels_per_cell, 0)
    mask = replace(reading, exact=None).silhouette(square)
    overlay = _small(reading.overlay)
    send(
        {
            "bits": pack(mask),
            "cells": request.cells,
            "kind": reading.kind,
            "sure": round(reading.confidence, 3),
            "told": reading.describe(),
            "notes": list(reading.notes),
            "overlay": base64.b64encode(png(overlay)).decode("ascii"),
        }
    )


def command_line(wish: Wish, reading: Reading, mask: Mask) -> str:
    """Write the command that makes the same stacks from the downloaded picture."""
    words = ["stackgen", "sample", "silhouette.png", "--num_samples", str(wish.number), "--seed", str(wish.seed)]
    for name, counts in (("--blocks", wish.blocks), ("--inventory", wish.inventory)):
        words += [] if counts is None else [name, _counts(counts)]
    if wish.method == BEST:
        words += [] if reading.exact is not None else ["--cells", str(cells_high(mask))]
    else:
        words += ["--weights", wish.method]
        words += ["--verify", "--budget", str(DRAWS)] if wish.verified else ["--one_shot"]
        for name, value in _solver(wish).given().items():
            words += [f"--sampler.{name}", str(value)]
    return shlex.join([*words, "--out", "out/studio"])


def _best(reading: Reading, mask: Mask, wish: Wish) -> tuple[StacksFile, Recorder]:
    cells = "auto" if reading.exact is not None else str(cells_high(mask))
    found = best(
        reading,
        wish.number,
        wish.seed,
        blocks=None if wish.blocks is None else _counts(wish.blocks),
        inventory=None if wish.inventory is None else _counts(wish.inventory),
        cells=cells,
    )
    return found, Recorder(physics_of(found))


def _of_model(reading: Reading, wish: Wish, send: Send) -> tuple[StacksFile, Recorder]:
    loaded = _loaded(wish.method, _solver(wish))
    target = reading.silhouette(loaded.world.grid)
    recorder = Recorder(loaded.physics, lambda verdict: send({"kind": "checked", "stable": verdict.stable}))
    watched = _Watched(loaded.sampler, send, as_shown(target, loaded.sampler)[1])
    model = Model(watched, lambda: loaded.predictor, weights=loaded.weights, checker=recorder)
    asked: dict[str, Any] = {"num_samples": wish.number, "seed": wish.seed}
    asked["blocks"] = None if wish.blocks is None else _counts(wish.blocks)
    asked["inventory"] = None if wish.inventory is None else _counts(wish.inventory)
    if wish.verified:
        return model.sample_verified(reading, **asked, budget=Budget(DRAWS)), recorder
    return model.sample_checked(reading, **asked), recorder


@lru_cache(maxsize=8)
def _loaded(method: str, solver: SamplerConfig) -> Model:
    """Load a method; it stays in memory."""
    return load(method, sampler=solver)


def _solver(wish: Wish) -> SamplerConfig:
    return SamplerConfig(wish.sampler.kind, wish.sampler.steps)


def _counts(counts: Mapping[str, int]) -> str:
    return ",".join(f"{name}={number}" for name, number in counts.items() if number)


def _scaled(found: StacksFile, mask: Mask) -> list[str]:
    """Say that the drawing was scaled, where it was."""
    if found.target is None:
        return []
    high = found.target.any(axis=1).sum() / found.world.grid.pixels_per_cell
    drawn = cells_high(mask)
    if abs(high - drawn) < 0.75:
        return []
    return [f"The drawing is {drawn} cells high; this method knows one scale, so it was made {high:.0f} cells high."]


def _fewer(found: StacksFile, wish: Wish) -> list[str]:
    """Say why there are fewer structures than were asked for, where there are."""
    number = len(found.entries)
    if number == wish.number:
        return []
    return [f"Only {number} of {wish.number} structures: no other layout was found that stands and fits."]


def _read(text: str) -> Reading:
    """Read a picture that was sent: from a file, as every other picture, so that the same limits hold."""
    try:
        content = base64.b64decode(text, validate=True)
    except ValueError:
        raise StackgenError("picture is not base64") from None
    with TemporaryDirectory(prefix="stackgen-") as folder:
        path = Path(folder) / "picture"
        path.write_bytes(content)
        try:
            return read_picture(path, PAPER_GRID)
        except StackgenError as error:
            raise StackgenError(str(error).replace(str(path), "the picture")) from None


def _small(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Shrink a picture (H, W, 3) for the page."""
    factor = -(-max(picture.shape[:2]) // 900)
    return np.ascontiguousarray(picture[::factor, ::factor])


@dataclass
class _Watched(WrappedSampler):
    """A StackSampler that tells what another draws, and how, the first time that it is asked.

    Args:
        sampler: Sampler that draws.
        send: Takes messages.
        offset: Number of pixels by which the drawing was moved to the cells of the grid.
    """

    sampler: StackSampler
    send: Send
    offset: int
    asked: bool = False

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Any]]:
        """See StackSampler."""
        if self.asked:
            return self.sampler.sample_batch(silhouettes, counts, num_samples, seed)
        self.asked = True
        shapes, shown = shapes_of(counts[0]), min(num_samples, _SHOWN)
        self.send({"kind": "blocks", "shapes": shapes.tolist(), "draws": shown})
        steps = int(self.settings.get("steps", 0))
        every, step = max(1, steps // _FRAMES), 0

        def watch(poses: Any) -> None:
            nonlocal step
            if step % every == 0:
                self._tell(poses[:shown, : len(shapes)].double().cpu().numpy(), step, steps)
            step += 1

        sampler: Any = self.sampler
        if hasattr(sampler, "watch"):
            sampler.watch = watch
        try:
            drawn = sampler.sample_batch(silhouettes, counts, num_samples, seed)
        finally:
            if hasattr(sampler, "watch"):
                sampler.watch = None
        self._tell(np.array([stack.poses for stack in drawn[0][:shown]]), steps, steps)
        return drawn

    def _tell(self, poses: NDArray[np.float64], step: int, steps: int) -> None:
        moved = poses - np.array([self.offset / self.world.grid.pixels_per_cell, 0, 0, 0, 0, 0])
        self.send({"kind": "noise", "step": step, "steps": steps, "stacks": quaternion_poses(moved, 3)})
