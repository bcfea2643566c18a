"""Pictures of a simulated build: a PNG of the finished stack, and an MP4 or GIF of how it came to be."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError, require
from stackgen.io.files import require_folder, write_atomically
from stackgen.robot.simulated.arm import SimulatedArm
from stackgen.sim.bullet_engine import bullet
from stackgen.viz.film import Mp4
from stackgen.viz.render import save_image

Picture = NDArray[np.uint8]

FRAMES = 12  # of a film in a second
SPEED = 8.0  # simulated seconds in a second of film
SUFFIXES = (".mp4", ".gif")

_FILM = (480, 360)
_WALL, _TABLE = (245, 245, 243), (222, 215, 203)
_LAST = 1.5  # the finished stack is shown for so long at the end of a film [s]


def check_film(path: Path) -> None:
    """See that a film can be written under this name.

    Raises:
        StackgenError: If the suffix is unknown, there is no folder for it, or an MP4 lacks its encoder.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise StackgenError(f"--video {path}: films are written as {' or '.join(SUFFIXES)}; change the suffix")
    if path.suffix.lower() != ".gif":
        require("av", "film")
    require_folder(path.parent, f"--video {path}")


def picture(client: int, size: tuple[int, int] = (640, 480), near: bool = False) -> Picture:
    """Picture (H, W, 3) that a camera in front of the table takes.

    Args:
        client: Bullet's number of the simulation.
        size: (width, height) [pixel].
        near: Whether to show the structure below the jaws, or all of the arm.
    """
    target, distance, pitch = ([0, 0, 0.19], 0.85, -14) if near else ([0, 0.08, 0.2], 1.3, -20)
    view = bullet.computeViewMatrixFromYawPitchRoll(target, distance, 18, pitch, 0, 2)
    lens = bullet.computeProjectionMatrixFOV(42, size[0] / size[1], 0.05, 5)
    width, height, colours, _, bodies = bullet.getCameraImage(
        *size,
        view,
        lens,
        lightDirection=[-0.4, -0.7, 1.2],
        shadow=0,
        renderer=bullet.ER_TINY_RENDERER,
        physicsClientId=client,
    )
    shown = np.array(colours, dtype=np.uint8).reshape(height, width, 4)[..., :3]
    return outlined(shown, np.asarray(bodies).reshape(height, width))


def outlined(colours: Picture, bodies: NDArray[np.int_]) -> Picture:
    """Picture (H, W, 3) with a plain table and wall, and a line around every body: blocks of one colour touch.

    Args:
        colours: (H, W, 3) as Bullet draws it.
        bodies: (H, W) body of each pixel, negative for none, 0 for the table.
    """
    shown = colours.copy()
    shown[bodies < 0], shown[bodies == 0] = _WALL, _TABLE
    border = np.zeros(bodies.shape, dtype=bool)
    border[:, 1:] |= bodies[:, 1:] != bodies[:, :-1]
    border[1:] |= bodies[1:] != bodies[:-1]
    shown[border & (bodies > -1)] //= 3
    return shown


class Film:
    """Records a build.

    Args:
        picture: PNG file for the finished stack.
        video: MP4 or GIF file, if wanted; it appears when all of it is written.
    """

    def __init__(self, picture: Path, video: Path | None = None) -> None:
        self.picture, self.video = picture, video

    def camera(self, arm: SimulatedArm) -> Callable[[bool], None]:
        """Make what is called after every step of an arm, and once at the end."""
        writer = None if self.video is None else _Writer(self.video)
        every = max(1, round(SPEED / FRAMES / arm.physics.time_step))

        def step(finished: bool) -> None:
            if writer is not None and not finished and arm.steps % every == 0:
                writer.add(picture(arm.client, _FILM))
            if finished:
                save_image(self.picture, picture(arm.client, near=True))
                if writer is not None:
                    last = picture(arm.client, _FILM)
                    for _ in range(round(_LAST * FRAMES)):
                        writer.add(last)
                    writer.finish()

        return step


class _Writer:
    """Holds a film in memory, compressed, and writes it when it is finished."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._mp4 = None if path.suffix.lower() == ".gif" else Mp4(FRAMES)
        self._gif: list[Any] = []

    def add(self, frame: Picture) -> None:
        """Add a frame (H, W, 3); H and W are even for an MP4."""
        if self._mp4 is not None:
            self._mp4.add(frame)
            return
        from PIL import Image

        self._gif.append(Image.fromarray(frame).quantize(64))

    def finish(self) -> None:
        """Write the film.

        Raises:
            StackgenError: If it cannot be written.
        """
        write_atomically(self.path, self._gif_bytes() if self._mp4 is None else self._mp4.finish())

    def _gif_bytes(self) -> bytes:
        content, (first, *others) = io.BytesIO(), self._gif
        duration = round(1000 / FRAMES)
        first.save(content, format="GIF", save_all=True, append_images=others, duration=duration, loop=0)
        return content.getvalue()
