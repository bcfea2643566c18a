"""The order of the blocks of one shape."""

from __future__ import annotations

import torch

from stackgen.models.poses import ranks, raster_order


def test_ranks_count_the_blocks_of_the_same_shape_before() -> None:
    shapes = torch.randint(0, 4, (20, 10), generator=torch.Generator().manual_seed(0))
    for row, found in zip(shapes.tolist(), ranks(shapes).tolist(), strict=True):
        assert found == [row[:i].count(shape) for i, shape in enumerate(row)]


def test_raster_order_is_by_shape_then_row_then_x_with_padding_last() -> None:
    random = torch.Generator().manual_seed(0)
    shapes = torch.randint(0, 4, (30, 10), generator=random)
    poses = torch.zeros(30, 10, 6)
    poses[..., 0] = torch.stack([torch.randperm(10, generator=random) for _ in range(30)]) * 0.4 - 2  # apart
    poses[..., 2] = torch.randint(0, 4, (30, 10), generator=random) + 0.5 + 0.05 * torch.randn(30, 10).clamp(-2, 2)
    shapes[:, 6:] = torch.where(torch.arange(30)[:, None] % 2 == 0, -1, shapes[:, 6:])
    order = raster_order(poses, shapes)
    for row, places in enumerate(order.tolist()):
        keys = [
            (int(shapes[row, i]) % 5, round(float(poses[row, i, 2]) - 0.5), float(poses[row, i, 0])) for i in places
        ]  # -1 % 5 is last
        real = sum(shape >= 0 for shape in shapes[row].tolist())
        assert keys[:real] == sorted(keys[:real]) and all(key[0] == 4 for key in keys[real:])
        assert sorted(places) == list(range(10))
