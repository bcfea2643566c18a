"""The Transformer's parts: layers that are torch's own, patches that are the picture, positions told apart."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stackgen.errors import StackgenError
from stackgen.models.transformer import (
    Attention,
    EncoderLayer,
    Patches,
    TransformerConfig,
    attend,
    sinusoids,
    split_heads,
    waves,
)
from stackgen.world import PAPER_GRID

CONFIG = TransformerConfig(width=32, layers=2, heads=4, feedforward=48)
NARROW = replace(CONFIG, width=8)


def close(a: Tensor, b: Tensor) -> bool:
    return torch.allclose(a, b, rtol=1e-4, atol=1e-5)


def test_an_encoder_layer_is_torch_s_transformer_encoder_layer() -> None:
    """Post-norm, ReLU, as in Vaswani et al. 2017; also with padding kept out, and with the norm first."""
    torch.manual_seed(0)
    x, seen = torch.randn(3, 9, 32), torch.arange(9) < torch.tensor([9, 4, 6])[:, None]
    for norm_first in (False, True):
        ours = EncoderLayer(CONFIG, norm_first)
        theirs = nn.TransformerEncoderLayer(32, 4, 48, dropout=0.0, batch_first=True, norm_first=norm_first)
        pairs = {
            "self_attn.in_proj_": ours.attention.qkv, "self_attn.out_proj.": ours.attention.out,
            "linear1.": ours.feedforward[0], "linear2.": ours.feedforward[2],
            "norm1.": ours.norm1, "norm2.": ours.norm2,
        }  # fmt: skip
        theirs.load_state_dict({f"{a}{n}": p for a, part in pairs.items() for n, p in part.named_parameters()})
        assert close(ours(x, None), theirs(x))
        assert close(ours(x, seen)[seen], theirs(x, src_key_padding_mask=~seen)[seen])


def test_attention_is_torch_s() -> None:
    q, k, v = (split_heads(torch.randn(2, 5, 12), 3) for _ in range(3))
    assert q.shape == (2, 3, 5, 4)
    merged = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
    assert close(attend(q, k, v, None), merged)
    assert Attention(12, 3)(torch.randn(2, 5, 12), None).shape == (2, 5, 12)


def test_each_patch_is_one_token_row_by_row() -> None:
    torch.manual_seed(0)
    patches = Patches(NARROW, PAPER_GRID)
    blank = patches(torch.zeros(1, 64, 64))
    for row, column in ((0, 0), (15, 16), (16, 15), (40, 63), (63, 63)):
        picture = torch.zeros(1, 64, 64)
        picture[0, row, column] = 1
        changed = (patches(picture) != blank).any(-1)[0]
        assert changed.nonzero().flatten().tolist() == [row // 16 * 4 + column // 16]


def test_overlapping_patches_share_pixels() -> None:
    torch.manual_seed(0)
    patches = Patches(replace(NARROW, stride=8), PAPER_GRID)
    blank = patches(torch.zeros(1, 64, 64))
    assert blank.shape == (1, 49, 8)
    picture = torch.zeros(1, 64, 64)
    picture[0, 20, 20] = 1
    assert (patches(picture) != blank).any(-1).sum() == 4


def test_equal_patches_differ_by_their_positions_alone() -> None:
    torch.manual_seed(0)
    tokens = Patches(NARROW, PAPER_GRID)(torch.ones(1, 64, 64))
    plain = tokens - sinusoids(torch.arange(16).float(), 8)
    assert close(plain, plain[:, :1].expand_as(plain))
    assert len({tuple(token) for token in tokens[0].tolist()}) == 16


def test_a_patch_of_a_cell_is_where_its_cell_is() -> None:
    """14 pixels a cell, 4 around it: from the left and from the ground, in cells."""
    patches = Patches(replace(NARROW, patch=22, stride=14, places=True), PAPER_GRID)
    z, x = torch.meshgrid(torch.tensor([3.5, 2.5, 1.5, 0.5]), torch.tensor([-1.5, -0.5, 0.5, 1.5]), indexing="ij")
    assert close(patches.positions, waves(torch.stack([x, z], dim=-1).flatten(0, 1)))
    plain = patches(torch.ones(1, 64, 64)) - patches.place(patches.positions)
    assert close(plain, plain[:, :1].expand_as(plain))


def test_how_alike_two_places_are_depends_on_their_distance_alone() -> None:
    places = torch.rand(6, 2) * 8
    alike = waves(places) @ waves(places).T
    assert close(waves(places + torch.tensor([3.0, -2.0])) @ waves(places + torch.tensor([3.0, -2.0])).T, alike)
    away = waves(torch.tensor([[0.0, 0.0]])) @ waves(torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.5, 0.0], [4.0, 4.0]])).T
    assert (away.diff() < 0).all()


@pytest.mark.parametrize(("patch", "stride"), [(80, 16), (16, 7), (10, 10)])
def test_patches_that_do_not_tile_are_refused(patch: int, stride: int) -> None:
    with pytest.raises(StackgenError, match="do not tile 64 pixels"):
        Patches(replace(NARROW, patch=patch, stride=stride), PAPER_GRID)


def test_sinusoids_tell_positions_apart() -> None:
    waves = sinusoids(torch.arange(51).float(), 32)
    assert waves.shape == (51, 32)
    assert close(waves[:, :16] ** 2 + waves[:, 16:] ** 2, torch.ones(51, 16))
    between = torch.cdist(waves, waves) + torch.eye(51) * 10
    assert between.min() > 0.1
