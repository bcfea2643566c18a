"""The denoiser: the paper's architecture to the letter, and the symmetries of a set of blocks."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from stackgen.models.diffusion.denoiser import Denoiser
from stackgen.models.transformer import (
    Attention,
    TransformerConfig,
    sinusoids,
)
from stackgen.world import PAPER_WORLD

PAPER = TransformerConfig(width=32, layers=2, heads=4, feedforward=48)
MASKED = replace(PAPER, mask_padding=True)
CROSS = replace(PAPER, conditioning="cross", memory_layers=1, patch=16, stride=8)
PLACED = replace(CROSS, self_conditioning=True, places=True)
KINDS = {"paper": PAPER, "masked": MASKED, "cross": CROSS, "placed": PLACED}
BATCH, BLOCKS = 4, 7


def made(config: TransformerConfig) -> Denoiser:
    """With every weight drawn, also those that begin at zero."""
    torch.manual_seed(0)
    model = Denoiser(config, PAPER_WORLD).eval()
    with torch.no_grad():
        for weight in model.parameters():
            weight.normal_(0, 0.2)
    return model


def scene(lengths: tuple[int, ...] = (7, 5, 6, 3)) -> dict[str, Tensor]:
    """Inputs of a batch of stacks of these lengths."""
    torch.manual_seed(1)
    mask = torch.arange(BLOCKS) < torch.tensor(lengths)[:, None]
    return {
        "poses": torch.randn(BATCH, BLOCKS, 6),
        "t": torch.tensor([1, 13, 28, 50]),
        "shapes": torch.where(mask, torch.randint(0, 4, (BATCH, BLOCKS)), -1),
        "mask": mask,
    }


def silhouettes(seed: int = 2) -> Tensor:
    return (torch.rand(BATCH, 64, 64, generator=torch.Generator().manual_seed(seed)) < 0.5).float()


@torch.no_grad()
def run(model: Denoiser, inputs: dict[str, Tensor], picture: Tensor | None = None) -> Tensor:
    return model(**inputs, memory=model.encode(silhouettes() if picture is None else picture), places=places)


def places(poses: Tensor) -> Tensor:
    return 2 * poses[..., [0, 2]] + 1


def close(a: Tensor, b: Tensor) -> bool:
    return torch.allclose(a, b, rtol=1e-4, atol=1e-5)


# The paper's numbers.


def test_the_paper_s_model_has_the_paper_s_size() -> None:
    model = Denoiser(TransformerConfig(), PAPER_WORLD)
    config, d = model.config, 512
    assert (config.width, config.layers, config.heads, config.feedforward) == (512, 6, 8, 2048)
    assert (config.conditioning, config.mask_padding, config.ordered) == ("joint", False, False)
    assert len(model.layers) == 6 and len(model.memory_encoder) == 0
    assert {part.heads for part in model.modules() if isinstance(part, Attention)} == {8}

    def linear(i: int, o: int) -> int:
        return i * o + o

    layer = 4 * linear(d, d) + linear(d, 2048) + linear(2048, d) + 2 * 2 * d
    tokens = linear(6, d) + linear(d, d) + 4 * d + 2 * linear(d, d) + linear(256, d) + linear(d, d)
    assert sum(p.numel() for p in model.parameters()) == 6 * layer + tokens + linear(d, 6)
    assert model.encode(torch.zeros(1, 64, 64)).shape == (1, 16, d)


def test_padding_is_zero_vectors_that_the_paper_does_not_mask() -> None:
    model, inputs, seen = made(PAPER), scene(), []
    model.layers[0].register_forward_pre_hook(lambda module, args: seen.append(args))
    run(model, inputs)
    tokens, mask = seen[0]
    assert mask is None and tokens.shape == (BATCH, BLOCKS + 16, 32)
    assert (tokens[:, :BLOCKS][~inputs["mask"]] == 0).all()
    assert (tokens[:, :BLOCKS][inputs["mask"]].abs().sum(-1) > 0).all()
    # The block tokens are sums: pose, shape and time.
    poses, shapes = model.pose_embedding(inputs["poses"]), model.shape_embedding(inputs["shapes"].clamp(min=0))
    time = model.time_embedding(sinusoids(inputs["t"].float(), 32))
    assert close(tokens[:, :BLOCKS][inputs["mask"]], (poses + shapes + time[:, None])[inputs["mask"]])


# Symmetries.


@pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)
def test_permuted_blocks_get_permuted_estimates(config: TransformerConfig) -> None:
    model, inputs = made(config), scene((7, 7, 7, 7))
    order = torch.stack([torch.randperm(BLOCKS) for _ in range(BATCH)])
    shuffled = {
        **inputs,
        "poses": inputs["poses"].gather(1, order[..., None].expand(-1, -1, 6)),
        "shapes": inputs["shapes"].gather(1, order),
    }
    expected = run(model, inputs).gather(1, order[..., None].expand(-1, -1, 6))
    assert close(run(model, shuffled), expected)
    assert not close(run(model, inputs), expected)


@pytest.mark.parametrize("config", [MASKED, CROSS], ids=["masked", "cross"])
def test_ordered_blocks_are_told_apart_within_their_shape_alone(config: TransformerConfig) -> None:
    model, inputs = made(replace(config, ordered=True)), scene((7, 7, 7, 7))
    inputs["shapes"] = torch.tensor([0, 1, 1, 2, 2, 2, 3]).expand(BATCH, -1)
    expected = run(model, inputs)

    def moved(order: list[int]) -> bool:
        change = {**inputs, "poses": inputs["poses"][:, order], "shapes": inputs["shapes"][:, order]}
        return close(run(model, change), expected[:, order])

    assert moved([3, 0, 4, 1, 2, 6, 5])  # other shapes in between
    assert not moved([0, 2, 1, 3, 4, 5, 6])  # two of one shape change places


@pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)
def test_what_stands_at_padding_does_not_matter(config: TransformerConfig) -> None:
    model, inputs = made(config), scene()
    other = {**inputs, "poses": torch.where(inputs["mask"][..., None], inputs["poses"], torch.tensor(1e3))}
    assert close(run(model, other)[inputs["mask"]], run(model, inputs)[inputs["mask"]])


@pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)
def test_masked_padding_may_be_left_out_and_the_paper_s_may_not(config: TransformerConfig) -> None:
    model, inputs = made(config), scene((4, 4, 3, 4))
    short = {name: part[:, :4] if part.ndim > 1 else part for name, part in inputs.items()}
    same = close(run(model, short)[short["mask"]], run(model, inputs)[inputs["mask"]])
    assert same == (config is not PAPER)


@pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)
def test_one_memory_serves_several_rows(config: TransformerConfig) -> None:
    model, inputs = made(config), scene()
    memory = model.encode(silhouettes()[:2])
    shared = model(**inputs, memory=memory, places=places)
    repeated = model(**inputs, memory=memory.repeat_interleave(2, 0), places=places)
    assert close(shared, repeated)
    assert not close(shared, model(**inputs, memory=memory.repeat(2, 1, 1), places=places))


@pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)
def test_rows_of_a_batch_do_not_see_each_other(config: TransformerConfig) -> None:
    model, inputs, picture = made(config), scene(), silhouettes()
    whole = run(model, inputs, picture)
    for row in range(BATCH):
        alone = {name: part[row : row + 1] for name, part in inputs.items()}
        mask = inputs["mask"][row]
        assert close(run(model, alone, picture[row : row + 1])[0][mask], whole[row][mask])


@pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)
def test_every_input_matters(config: TransformerConfig) -> None:
    model, inputs = made(config), scene((7, 7, 7, 7))
    base = run(model, inputs)
    for change in (
        {"poses": inputs["poses"] + 0.5},
        {"t": inputs["t"].flip(0)},
        {"shapes": 3 - inputs["shapes"]},
    ):
        assert not close(run(model, {**inputs, **change}), base)
    assert not close(run(model, inputs, silhouettes(3)), base)


def test_zeros_are_no_estimate_wherever_they_lie() -> None:
    model, inputs = made(PLACED), scene()
    estimate = torch.randn(BATCH, BLOCKS, 6)
    none = run(model, inputs)
    zeros, some = (run(model, {**inputs, "estimate": it}) for it in (0 * estimate, estimate))
    assert close(zeros, none)
    assert not close(some, none)


def test_an_untrained_cross_model_begins_with_zero() -> None:
    assert (run(Denoiser(CROSS, PAPER_WORLD), scene()) == 0).all()
