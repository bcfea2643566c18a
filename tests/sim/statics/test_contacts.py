"""Where blocks touch: patches of contact have the area, the place and the normal that geometry says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from stackgen.sim.statics.contacts import GROUND, Contact, find_contacts
from stackgen.stack import Stack
from tests.sim.statics.conftest import (
    CUBE,
    TRIANGLE,
    stack,
)


def area(contact: Contact) -> float:
    """Of the patch [cell^2]."""
    along = contact.points @ np.stack([contact.tangent, np.cross(contact.normal, contact.tangent)], axis=1)
    return float(ConvexHull(along).volume)


def one_contact(pair: Stack, tolerance: float = 0.02) -> Contact:
    """The one patch between two blocks."""
    (contact,) = [c for c in find_contacts(pair, tolerance) if c.by != GROUND]
    return contact


@pytest.mark.parametrize("d", [0.0, 0.3, -0.7])
@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_patch_of_displaced_cubes_is_their_overlap(d: float, yaw: float) -> None:
    contact = one_contact(stack((CUBE, 0, 0.5), (CUBE, d, 1.5), yaw=yaw))
    assert area(contact) == pytest.approx(1 - abs(d))
    assert (contact.block, contact.by) == (1, 0)
    np.testing.assert_allclose(contact.normal, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(contact.points[:, 2], 1)


def test_patch_of_a_cube_turned_by_an_eighth_is_an_octagon() -> None:
    poses = np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, np.pi / 4]])
    contact = one_contact(Stack(np.array([CUBE, CUBE]), poses))
    assert len(contact.points) == 8
    assert area(contact) == pytest.approx(2 * (math.sqrt(2) - 1))


@pytest.mark.parametrize(("gap", "touch"), [(-0.05, True), (0.0, True), (0.019, True), (0.021, False)])
def test_faces_touch_up_to_the_tolerance(gap: float, touch: bool) -> None:
    contacts = find_contacts(stack((CUBE, 0, 0.5), (CUBE, 0, 1.5 + gap)), 0.02)
    assert len(contacts) == 1 + touch


def test_a_slightly_tilted_block_touches_as_far_as_the_tolerance_goes() -> None:
    tilt = 0.05
    poses = np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1 + 0.5 * (math.cos(tilt) + math.sin(tilt)), 0, tilt, 0]])
    contact = one_contact(Stack(np.array([CUBE, CUBE]), poses))
    assert np.ptp(contact.points[:, 0]) == pytest.approx(0.02 / math.tan(tilt), rel=0.01)


def test_a_block_on_a_slope_touches_it_along_its_normal() -> None:
    up = np.array([2, 0, 1]) / math.sqrt(5)  # out of the triangle's right face
    middle = np.array([0.25, 0, 0.5])
    center = middle + up / 2
    poses = np.array([[0, 0, 0.5, 0, 0, 0], [*center, 0, math.atan2(up[0], up[2]), 0]])
    contact = one_contact(Stack(np.array([TRIANGLE, CUBE]), poses))
    np.testing.assert_allclose(np.abs(contact.normal @ up), 1)
    assert area(contact) == pytest.approx(1)


def test_an_apex_touches_along_a_line_and_neighbours_side_by_side() -> None:
    apex = one_contact(stack((TRIANGLE, 0, 0.5), (CUBE, 0.2, 1.5)))
    assert len(apex.points) == 2 and np.ptp(apex.points, axis=0) == pytest.approx([0, 1, 0])
    side = one_contact(stack((CUBE, 0, 0.5), (CUBE, 1.01, 0.5)))
    assert abs(side.normal[0]) == pytest.approx(1) and area(side) == pytest.approx(1)
