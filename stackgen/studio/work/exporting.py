"""A stack as a file: GLB for 3-D programs, or the film of how it settles."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator

import numpy as np

from stackgen.sim.checkers import judged
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Rollout
from stackgen.studio.requests import ExportRequest
from stackgen.studio.work.judging import Message, Recorder, chosen_stack, physics_of
from stackgen.viz.film import mp4_bytes
from stackgen.viz.gltf import glb_bytes
from stackgen.viz.render import Picture, render_stack
from stackgen.world import Grid

FILM = 20
"""Frames of a film in a second."""

_SIZE = (640, 480)
_HELD = 1.2  # how long the last frame stays [s]


def exported(request: ExportRequest, send: Callable[[Message], None]) -> None:
    """Make the file.

    Raises:
        StackgenError: If the encoder of films is not installed.
    """
    content, entry = chosen_stack(request)
    if request.format == "glb":
        made, media = glb_bytes(entry.stack, content.cell_size), "model/gltf-binary"
    else:
        physics = physics_of(content)
        rollout = Recorder(physics).rollout(entry.stack)
        made, media = mp4_bytes(_frames(rollout, content.world.grid, physics), FILM), "video/mp4"
    send({"media": media, "content": base64.b64encode(made).decode("ascii")})


def _frames(rollout: Rollout, grid: Grid, physics: Physics) -> Iterator[Picture]:
    """Draw a rollout frame by frame; what fell is outlined at the end."""
    assert rollout.trajectory is not None
    number = max(2, round(rollout.time * FILM))
    places = np.linspace(0, len(rollout.trajectory) - 1, number).round().astype(int)
    for place in places:
        yield render_stack(rollout.start.with_poses(rollout.trajectory[place]), _SIZE, grid=grid, supersample=1)
    last = render_stack(rollout.end, _SIZE, judged(rollout, physics).fell, grid=grid)
    for _ in range(round(_HELD * FILM)):
        yield last
