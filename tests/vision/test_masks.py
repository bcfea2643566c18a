"""Parts of masks are found, kept and removed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from stackgen.vision.masks import bounding_box, components, largest, near_parts, smoothed, without_specks


def test_the_largest_component_bridges_small_gaps_only() -> None:
    mask = np.zeros((20, 30), dtype=bool)
    mask[:, 2:10] = mask[:, 12:16] = mask[:, 25:28] = True
    assert np.array_equal(np.flatnonzero(largest(mask, 4).any(axis=0)), [*range(2, 10), *range(12, 16)])
    assert np.array_equal(np.flatnonzero(largest(mask, 0).any(axis=0)), [*range(2, 10)])


def random_mask(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((40, 50)) < 0.45


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("connectivity", "structure"), [(4, None), (8, np.ones((3, 3)))])
def test_components_are_those_of_scipy(seed: int, connectivity: int, structure: np.ndarray | None) -> None:
    mask = random_mask(seed)
    labels, areas = components(mask, connectivity)
    truth, count = ndimage.label(mask, structure)
    assert len(areas) == count + 1 and areas[0] == 0
    assert len(set(zip(labels.ravel().tolist(), truth.ravel().tolist(), strict=True))) == count + 1  # one to one
    assert sorted(areas[1:]) == sorted(np.bincount(truth.ravel())[1:])


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_without_specks_keeps_whole_parts_and_only_large_ones(share: float) -> None:
    mask = random_mask(7)
    labels, areas = components(mask)
    kept = without_specks(mask, share)
    assert {bool(kept[labels == part].all()) for part in np.unique(labels[kept])} == {True}
    assert set(np.unique(labels[kept])) == {i for i in range(1, len(areas)) if areas[i] >= share * areas.max()}
    assert not without_specks(np.zeros_like(mask), share).any()


def test_the_bounding_box_is_the_smallest_that_holds_all() -> None:
    mask = np.zeros((20, 30), dtype=bool)
    assert mask[bounding_box(mask)].size == 0
    mask[4, 7] = mask[11, 25] = True
    assert bounding_box(mask) == (slice(4, 12), slice(7, 26))


def test_a_median_filter_takes_away_what_is_thinner_than_half_its_size() -> None:
    mask = np.zeros((30, 30), dtype=bool)
    mask[:, 3:5], mask[:, 15:25] = True, True
    assert np.flatnonzero(smoothed(mask, 5).any(axis=0)).tolist() == list(range(15, 25))


def test_noise_has_no_more_than_some_parts() -> None:
    dots = np.zeros((400, 400), dtype=bool)
    dots[4::20, 4::20] = dots[5::20, 4::20] = dots[4::20, 5::20] = True
    dots[100:110, 100:110] = True
    found = near_parts(dots, 0.0)
    assert len(found) == 30 and max(map(np.count_nonzero, found)) >= 100
