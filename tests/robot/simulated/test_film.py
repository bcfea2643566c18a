"""Films hold the frames that were given, and appear only when all of them are written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stackgen.errors import StackgenError
from stackgen.robot.simulated.film import SUFFIXES, _Writer, check_film, outlined, picture
from stackgen.sim.bullet_engine import Mold, bullet, connect
from stackgen.sim.physics import Physics
from stackgen.world import PAPER_CATALOGUE


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_film_has_its_frames_and_leaves_nothing_beside_it(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"film{suffix}"
    writer = _Writer(path)
    for level in (20, 120, 220):
        writer.add(np.full((120, 160, 3), level, dtype=np.uint8))
    assert not path.exists()
    writer.finish()
    assert list(tmp_path.iterdir()) == [path]
    assert levels(path) == pytest.approx([20, 120, 220], abs=6)


def levels(path: Path) -> list[float]:
    """Mean brightness of each frame."""
    if path.suffix == ".gif":
        film = Image.open(path)
        found = []
        for number in range(film.n_frames):  # type: ignore[attr-defined]
            film.seek(number)
            found.append(float(np.asarray(film.convert("L")).mean()))
        return found
    import av

    with av.open(str(path)) as video:
        assert video.streams.video[0].codec_context.name == "h264"  # what browsers play
        return [float(frame.to_ndarray(format="rgb24").mean()) for frame in video.decode(video=0)]


def test_other_films_are_refused(tmp_path: Path) -> None:
    check_film(tmp_path / "a.MP4")
    with pytest.raises(StackgenError, match=r"written as \.mp4 or \.gif"):
        check_film(tmp_path / "a.mov")
    (tmp_path / "file").touch()
    with pytest.raises(StackgenError, match="file is not a folder"):
        check_film(tmp_path / "file" / "a.mp4")


def test_the_camera_sees_a_block_in_front_of_the_table() -> None:
    client = connect(Physics())
    try:
        empty = picture(client, (80, 60), near=True)
        mold = Mold.cast(PAPER_CATALOGUE[0], Physics(), client)
        mold.spawn([0, 0, 0.1], [0, 0, 0, 1], client)
        full = picture(client, (80, 60), near=True)
    finally:
        bullet.disconnect(client)
    changed = (empty != full).any(axis=2)
    assert empty.shape == (60, 80, 3) and changed[20:40, 30:50].any() and not changed[:, :10].any()


def test_blocks_of_one_colour_are_told_apart() -> None:
    bodies = np.array([[-1, -1, -1, -1], [0, 1, 1, 2], [0, 1, 1, 2], [0, 0, 0, 0]])
    shown = outlined(np.full((4, 4, 3), 200, dtype=np.uint8), bodies)
    assert (shown[2, 2] == 200).all() and (shown[2, [1, 3]] < 100).all()
    assert (shown[0] == shown[0, 0]).all() and (shown[2, 0] != shown[0, 0]).any()
