"""Films of pictures."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import Any

from stackgen.errors import require
from stackgen.viz.render import Picture


class Mp4:
    """An MP4 that grows in memory: H.264, which browsers play.

    Args:
        rate: Frames in a second.

    Raises:
        StackgenError: If the encoder is not installed.
    """

    def __init__(self, rate: int) -> None:
        self._av: Any = require("av", "film")
        self._content = io.BytesIO()
        self._file = self._av.open(self._content, "w", format="mp4")
        self._stream = self._file.add_stream("libx264", rate)
        self._stream.pix_fmt = "yuv420p"
        self._begun = False

    def add(self, picture: Picture) -> None:
        """Add a frame (H, W, 3); H and W are even."""
        if not self._begun:
            self._stream.height, self._stream.width = picture.shape[:2]
            self._begun = True
        self._file.mux(self._stream.encode(self._av.VideoFrame.from_ndarray(picture, format="rgb24")))

    def finish(self) -> bytes:
        """Give the whole film."""
        self._file.mux(self._stream.encode(None))
        self._file.close()
        return self._content.getvalue()


def mp4_bytes(pictures: Iterable[Picture], rate: int) -> bytes:
    """Make a film of pictures (H, W, 3) of one even size.

    Raises:
        StackgenError: If the encoder is not installed.
    """
    film = Mp4(rate)
    for picture in pictures:
        film.add(picture)
    return film.finish()
