"""What every network that samples asks of silhouettes and block lists."""

from __future__ import annotations

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.models.diffusion.network import DiffusionConfig, PoseDiffusion
from stackgen.models.diffusion.sampler import DiffusionSampler
from stackgen.models.diffusion.schedules import ScheduleConfig
from stackgen.models.sampler import pad_shapes
from stackgen.world import PAPER_WORLD, Mask
from tests.models.conftest import TINY


def pictures(count: int, size: int = 64) -> Mask:
    return np.zeros((count, size, size), dtype=bool)


@pytest.mark.parametrize(
    ("silhouettes", "counts", "message"),
    [
        (pictures(1, 32), [[1, 0, 0, 0]], r"\(B, 64, 64\)"),
        (pictures(2), [[1, 0, 0, 0]], "as many"),
        (pictures(1)[0], [[1, 0, 0, 0]], r"\(B, 64, 64\)"),
        (pictures(1), [[0, 0, 0, 0]], "1 to 10 blocks"),
        (pictures(1), [[11, 0, 0, 0]], "1 to 10 blocks"),
    ],
)
def test_what_cannot_be_sampled_is_refused(silhouettes: Mask, counts: list[list[int]], message: str) -> None:
    sampler = DiffusionSampler(PoseDiffusion(TINY, ScheduleConfig(), DiffusionConfig(), PAPER_WORLD), PAPER_WORLD)
    with pytest.raises(StackgenError, match=message):
        sampler.sample_batch(silhouettes, np.array(counts), 1, 0)


def test_padded_shapes_are_the_block_lists() -> None:
    counts = np.array([[2, 0, 1, 0], [0, 1, 0, 0]])
    shapes, mask = pad_shapes(counts, 4)
    assert shapes.tolist() == [[0, 0, 2, -1], [1, -1, -1, -1]]
    assert (mask == (shapes >= 0)).all()
