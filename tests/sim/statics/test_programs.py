"""The linear programs agree with the textbook's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from stackgen.geometry import centers_of_mass
from stackgen.sim.statics.contacts import GROUND, find_contacts
from stackgen.sim.statics.programs import inradius
from stackgen.stack import Stack
from tests.sim.statics.conftest import (
    FREE,
    shaken,
)


def corner_forces_hold(whole: Stack, friction: float = 0.5) -> bool:
    """The textbook's linear program: a force in each corner of each patch, solved by SciPy."""
    centers, columns = centers_of_mass(whole), []
    for contact in find_contacts(whole, FREE.contact_tolerance):
        across = np.cross(contact.normal, contact.tangent)
        signs = [(0, 0)] if contact.upright else [(1, 1), (1, -1), (-1, 1), (-1, -1)]
        for point in contact.points:
            for a, b in signs:
                force = contact.normal + friction * (a * contact.tangent + b * across)
                column = np.zeros((len(whole), 6))
                column[contact.block] = np.r_[force, np.cross(point - centers[contact.block], force)]
                if contact.by != GROUND:
                    column[contact.by] = -np.r_[force, np.cross(point - centers[contact.by], force)]
                columns.append(column.ravel())
    needed = np.zeros((len(whole), 6))
    needed[:, 2] = [whole.catalogue[shape].volume for shape in whole.shapes]
    return bool(linprog(np.zeros(len(columns)), A_eq=np.array(columns).T, b_eq=needed.ravel()).status == 0)


def test_forces_of_patches_exist_where_forces_at_their_corners_do() -> None:
    rng = np.random.default_rng(2)
    held = []
    for whole in shaken(60):
        noisy = whole.with_poses(whole.poses + rng.normal(0, 0.02, whole.poses.shape))
        for one in (whole, noisy):
            held.append(corner_forces_hold(one))
            assert FREE.answer(one).stable == held[-1]
    assert 20 < sum(held) < 100


@pytest.mark.parametrize("seed", range(5))
def test_inradius_of_a_polygon_is_the_distance_of_its_nearest_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(12, 2)) @ rng.normal(size=(2, 2))
    corners -= corners.mean(axis=0)
    hull = ConvexHull(corners)
    asked = []

    def furthest(direction: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        asked.append(direction)
        return corners[(corners @ direction).argmax()], direction

    assert inradius(furthest)[0] == pytest.approx(-hull.equations[:, 2].max(), abs=1e-3)
    assert len(asked) <= 4 + 2 * len(hull.vertices)
