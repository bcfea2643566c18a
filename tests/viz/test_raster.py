"""The rasteriser: faces have their area, cameras see what they look at, prisms are closed."""

from __future__ import annotations

import numpy as np
import pytest

from stackgen.viz.raster import Camera, borders, fill_nearest
from stackgen.world import PAPER_CATALOGUE, Shape


def test_a_filled_face_has_its_area_and_neighbours_share_no_pixel() -> None:
    a, b, off = (np.zeros((80, 90), np.int32) for _ in range(3))
    for picture, corners in (
        (a, [[10.3, 5.2], [60.7, 20.1], [30.9, 70.5]]),
        (b, [[60.7, 20.1], [10.3, 5.2], [70.2, 3.3]]),
        (off, [[-50.0, -50], [-10, -50], [-10, -10]]),
    ):
        fill_nearest(picture, np.zeros(picture.shape, np.float32), 1, np.array(corners), np.ones(3))
    area = abs(np.cross([50.4, 14.9, 0], [20.6, 65.3, 0])[2]) / 2
    assert a.sum() == pytest.approx(area, rel=0.01)
    assert not (a & b).any()
    assert not off.any()


def test_borders_are_the_pixels_on_both_sides_of_a_step() -> None:
    values = np.zeros((6, 7))
    values[2, 3:], values[3, 3:] = 0.5, 2.0
    rows, columns = np.nonzero(borders(values, 1.0))
    assert sorted(set(zip(rows.tolist(), columns.tolist(), strict=True))) == sorted(
        {(3, 2), *((row, column) for row in (2, 3, 4) for column in range(3, 7))}
    )
    assert not borders(values, 2.0).any() and borders(values).sum() == 4 * 4 + 2


def test_the_camera_sees_all_points_and_nearer_is_nearer() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) * 5
    camera = Camera.looking_at(points, (300, 200), 0.4, 0.3, 0.1)
    pixels, nearness = camera.project(points)
    assert (pixels >= [30 - 1e-6, 20 - 1e-6]).all()
    assert (pixels <= [270 + 1e-6, 180 + 1e-6]).all()
    assert (nearness > 0).all()
    assert (np.argsort(nearness) == np.argsort((points - camera.eye) @ camera.back)).all()


@pytest.mark.parametrize("shape", list(PAPER_CATALOGUE), ids=lambda shape: shape.name)
def test_faces_are_planar_face_outwards_and_enclose_the_volume(shape: Shape) -> None:
    volume = 0.0
    for face in shape.faces:
        p = shape.vertices[face]
        normal = np.cross(p[1] - p[0], p[2] - p[0])
        assert np.abs((p - p[0]) @ normal).max() < 1e-9
        assert ((shape.vertices - p[0]) @ normal).max() < 1e-9
        volume += sum(np.linalg.det([p[0], p[i], p[i + 1]]) for i in range(1, len(p) - 1)) / 6
    assert volume == pytest.approx(shape.volume)
