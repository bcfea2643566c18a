"""Tran-Reg and Tran-VAE as networks: the denoiser's layers, targets for equal blocks, and samples in random order."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from stackgen.baselines.regression import BlockTokens, PoseRegressor, RegressionConfig, Trunk, best_match, shuffled
from stackgen.baselines.tran_reg import TranRegNetwork
from stackgen.baselines.tran_vae import TranVAENetwork, VAEConfig
from stackgen.errors import StackgenError
from stackgen.models.diffusion.denoiser import Denoiser
from stackgen.models.poses import raster_order
from stackgen.models.sampler import NetworkSampler
from stackgen.models.transformer import TransformerConfig, sinusoids
from stackgen.world import PAPER_WORLD

PAPER = TransformerConfig(width=16, layers=3, heads=2, feedforward=24)
CROSS = replace(PAPER, conditioning="cross", memory_layers=1, mask_padding=True, ordered=True)
KINDS = {"paper": PAPER, "masked": replace(PAPER, mask_padding=True), "cross": CROSS}
RASTER = RegressionConfig()
MATCHED = RegressionConfig("matched")
VAE = VAEConfig(encoder_layers=1, latent=4)
BLOCKS = 7


def weighted(network: Any) -> Any:
    """With every weight drawn, also those that begin at zero."""
    torch.manual_seed(0)
    with torch.no_grad():
        for weight in network.parameters():
            weight.normal_(0, 0.2)
    return network.eval()


def regression(config: TransformerConfig = CROSS, target: RegressionConfig = RASTER) -> TranRegNetwork:
    return weighted(TranRegNetwork(config, target, PAPER_WORLD))


def vae(config: TransformerConfig = CROSS, target: RegressionConfig = RASTER) -> TranVAENetwork:
    return weighted(TranVAENetwork(config, target, VAE, PAPER_WORLD))


def batch_of(lengths: tuple[int, ...] = (7, 5, 6, 3), blocks: int = BLOCKS) -> dict[str, Tensor]:
    """Stacks of these lengths: blocks on four rows, shuffled."""
    random = torch.Generator().manual_seed(1)
    size = (len(lengths), blocks)
    mask = torch.arange(blocks) < torch.tensor(lengths)[:, None]
    poses = 0.01 * torch.randn((*size, 6), generator=random)
    poses[..., 0] = torch.stack([torch.randperm(blocks, generator=random) for _ in lengths]) * 0.5 - 2
    poses[..., 2] = torch.randint(0, 4, size, generator=random) + 0.5
    shapes = torch.where(mask, torch.randint(0, 4, size, generator=random), -1)
    picture = (torch.rand((len(lengths), 64, 64), generator=random) < 0.5).float()
    return {"poses": poses * mask[..., None], "shapes": shapes, "mask": mask, "silhouette": picture}


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def close(a: Tensor, b: Tensor) -> bool:
    return torch.allclose(a, b, rtol=1e-4, atol=1e-5)


def size(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


# The paper's architecture.


def test_tran_reg_is_the_denoiser_without_noisy_poses_and_time() -> None:
    """The paper: the same number of layers and heads, the same widths."""
    with torch.device("meta"):
        denoiser, network = (
            Denoiser(TransformerConfig(), PAPER_WORLD),
            TranRegNetwork(TransformerConfig(), RASTER, PAPER_WORLD),
        )
    without = size(denoiser.pose_embedding) + size(denoiser.time_embedding)
    assert size(network) == size(denoiser) - without


def test_tran_vae_has_two_and_four_of_the_layers() -> None:
    with torch.device("meta"):
        denoiser, network = (
            Denoiser(TransformerConfig(), PAPER_WORLD),
            TranVAENetwork(TransformerConfig(), RASTER, VAEConfig(), PAPER_WORLD),
        )
    assert (len(network.encoder.layers), len(network.decoder.layers)) == (2, 4)
    assert size(network.encoder) + size(network.decoder) == size(denoiser.layers)


@pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)
def test_the_trunk_computes_what_the_denoiser_s_layers_do(config: TransformerConfig) -> None:
    """With the same weights; the condition is to it what time is to the denoiser."""
    denoiser = weighted(Denoiser(replace(config, ordered=False), PAPER_WORLD))
    trunk = Trunk(config, config.layers, conditioned=True)
    state = (
        {f"norm.{n}": p for n, p in denoiser.final_norm.state_dict().items()} if config.conditioning == "cross" else {}
    )
    trunk.load_state_dict({**{f"layers.{n}": p for n, p in denoiser.layers.state_dict().items()}, **state})
    batch, t = batch_of(), torch.tensor([1, 13, 28, 50])
    memory = denoiser.encode(batch["silhouette"])
    tokens = denoiser.pose_embedding(batch["poses"]) + denoiser.shape_embedding(batch["shapes"].clamp(min=0))
    time = denoiser.time_embedding(sinusoids(t.float(), config.width))
    found = denoiser.head(trunk(tokens, batch["mask"], memory, time))
    expected = denoiser(batch["poses"], t, batch["shapes"], batch["mask"], memory)
    assert close(found[batch["mask"]], expected[batch["mask"]])


def test_tokens_are_shape_embedding_plus_positional_encoding() -> None:
    tokens, shapes = BlockTokens(PAPER, PAPER_WORLD), torch.tensor([[2, 0, 2]])
    assert close(tokens(shapes), tokens.shape_embedding(shapes) + sinusoids(torch.arange(3).float(), 16))
    assert not close(*tokens(shapes)[0, [0, 2]])  # two of one shape are told apart


def test_what_only_a_denoiser_has_is_refused() -> None:
    with pytest.raises(StackgenError, match="self_conditioning"):
        TranRegNetwork(replace(CROSS, self_conditioning=True), RASTER, PAPER_WORLD)
    for layers in (0, 3):
        with pytest.raises(StackgenError, match="encoder_layers"):
            TranVAENetwork(CROSS, RASTER, replace(VAE, encoder_layers=layers), PAPER_WORLD)


# Whose target is whose.


def test_blocks_are_shuffled_but_those_of_one_shape_stay_in_raster_order() -> None:
    network, batch = regression(), batch_of((7,) * 40)
    shapes, mask, poses = network.scene(batch, seeded())
    assert mask.all() and len({tuple(row) for row in shapes.tolist()}) > 20
    for row in range(40):
        for kind in range(4):
            mine = poses[row][shapes[row] == kind]
            key = (2 * mine[:, 2]).round() * 100 + mine[:, 0]
            assert (key.diff() > 0).all()
        block = torch.cat([batch["shapes"][row][:, None], batch["poses"][row]], 1)
        moved = torch.cat([shapes[row][:, None], poses[row]], 1)
        assert sorted(block.tolist()) == sorted(moved.tolist())


def test_every_order_of_the_shapes_is_equally_likely() -> None:
    shapes = torch.tensor([[0, 0, 1, -1]]).expand(6000, -1)
    orders, counts = shuffled(shapes, seeded()).unique(dim=0, return_counts=True)
    assert orders.tolist() == [[0, 1, 2, 3], [0, 2, 1, 3], [2, 0, 1, 3]]
    assert (counts - 2000).abs().max() < 200


@pytest.mark.parametrize("lengths", [(7, 7, 7, 7), (7, 5, 6, 3)])
def test_the_match_is_the_best_of_all_permutations(lengths: tuple[int, ...]) -> None:
    shapes = batch_of(lengths)["shapes"].sort(-1, descending=True).values
    cost = torch.rand((4, BLOCKS, BLOCKS), generator=seeded())
    cost *= (shapes >= 0)[:, :, None] & (shapes >= 0)[:, None, :]
    found = best_match(cost, shapes)
    for row in range(4):
        kinds, costs = shapes[row].tolist(), cost[row].tolist()
        assert [kinds[j] for j in found[row]] == kinds
        allowed = (
            p for p in itertools.permutations(range(BLOCKS)) if all(kinds[j] == kinds[i] for i, j in enumerate(p))
        )
        best = min(sum(costs[i][j] for i, j in enumerate(p)) for p in allowed)
        assert sum(costs[i][j] for i, j in enumerate(found[row].tolist())) == pytest.approx(best)


@pytest.mark.parametrize("loss", ["squared", "absolute"])
def test_a_matched_error_forgives_which_of_equal_blocks_is_where(loss: Any) -> None:
    network = regression(target=RegressionConfig("matched", loss))
    ordered = regression(target=RegressionConfig("raster", loss))
    batch = batch_of((7, 7, 7, 7))
    poses, shapes, mask = batch["poses"], torch.tensor([[0, 1, 1, 2, 2, 2, 3]]).expand(4, -1), batch["mask"]
    swapped, wrong = poses[:, [0, 2, 1, 4, 5, 3, 6]], poses[:, [1, 0, 2, 3, 4, 5, 6]]
    assert close(network.error(swapped, poses, shapes, mask), torch.zeros(4))
    assert (network.error(wrong, poses, shapes, mask) > 0.01).all()
    assert (ordered.error(swapped, poses, shapes, mask) > 0.01).all()


@pytest.mark.parametrize("target", [RASTER, MATCHED], ids=["raster", "matched"])
@pytest.mark.parametrize(("loss", "expected"), [("squared", 4.0), ("absolute", 2.0)])
def test_the_error_is_the_mean_over_real_blocks(target: RegressionConfig, loss: Any, expected: float) -> None:
    network, batch = regression(target=replace(target, loss=loss)), batch_of()
    estimate = torch.where(batch["mask"][..., None], batch["poses"] + 2, 1e3)
    far = 100 * torch.arange(BLOCKS)[:, None]  # apart, so that no other match is better
    error = network.error(estimate + far, batch["poses"] + far, batch["shapes"], batch["mask"])
    assert close(error, torch.full((4,), expected))


# Regression.


@pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)
def test_padding_does_not_matter_unless_it_is_the_paper_s(config: TransformerConfig) -> None:
    network, batch = regression(config), batch_of((4, 4, 3, 4))
    memory = network.silhouette(batch["silhouette"])
    long = network(batch["shapes"], batch["mask"], memory)
    short = network(batch["shapes"][:, :4], batch["mask"][:, :4], memory)
    mask = batch["mask"][:, :4]
    assert close(short[mask], long[:, :4][mask]) == network.trims == (config is not PAPER)


def test_the_samples_differ_by_the_order_of_the_blocks_alone() -> None:
    """With several orders there are several answers; where only one order exists, there is one answer."""
    network, picture = regression(), batch_of()["silhouette"][:1]
    mixed = torch.tensor([[0, 0, 1, 2, 3]]).expand(6, -1)
    real = torch.ones_like(mixed, dtype=torch.bool)
    poses = network.sample(picture, mixed, real, seeded())
    assert not close(poses[0], poses[1])
    equal = torch.zeros_like(mixed)
    poses = network.sample(picture, equal, real, seeded()).sort(dim=1).values  # as a set
    assert close(poses[1:], poses[:1].expand_as(poses[1:]))


def test_poses_come_back_to_the_blocks_they_are_for() -> None:
    network, batch = regression(), batch_of()
    network.fit_normalization(np.arange(6), np.full(6, 2.0))
    shapes, mask = batch["shapes"], batch["mask"]

    def draw(shapes: Tensor, mask: Tensor, memory: Tensor, generator: torch.Generator) -> Tensor:
        assert (mask == (shapes >= 0)).all() and (mask.int().diff(dim=1) <= 0).all()
        return shapes[..., None].expand(-1, -1, 6).float()

    network.draw = draw  # type: ignore[method-assign]
    poses = network.sample(batch["silhouette"], shapes, mask, seeded())
    assert close(poses, shapes[..., None] * 2.0 + torch.arange(6))


@pytest.mark.parametrize("make", [regression, vae])
@pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)
def test_every_part_learns(config: TransformerConfig, make: Any) -> None:
    network = make(config, MATCHED)
    batch = batch_of()
    losses = network.losses(batch) if isinstance(network, TranVAENetwork) else (network.loss(batch),)
    torch.cat(losses).sum().backward()
    assert [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0] == []


# The autoencoder.


def test_the_divergence_is_the_one_of_gaussians() -> None:
    network, batch = vae(), batch_of()
    shapes, mask, poses = network.scene(batch, seeded())
    mean, log_variance = network.encode(poses, shapes, mask, network.silhouette(batch["silhouette"]))
    posterior = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    expected = torch.distributions.kl_divergence(posterior, torch.distributions.Normal(0.0, 1.0)).sum(-1)
    assert close(network.losses(batch, seeded())[1], expected)


def test_the_posterior_sees_a_stack_and_not_its_padding() -> None:
    network, batch = vae(), batch_of((4, 4, 4, 4))
    memory, poses, shapes, mask = (
        network.silhouette(batch["silhouette"]),
        batch["poses"],
        batch["shapes"],
        batch["mask"],
    )
    mean, _ = network.encode(poses, shapes, mask, memory)
    padded = torch.where(mask[..., None], poses, 1e3)
    assert close(network.encode(padded, shapes, mask, memory)[0], mean)
    assert not close(network.encode(poses + 0.5 * mask[..., None], shapes, mask, memory)[0], mean)


def test_the_latent_vector_decides() -> None:
    network, batch = vae(), batch_of((7, 7, 7, 7))
    memory = network.silhouette(batch["silhouette"])
    first, second = (
        network.decode(torch.full((4, 4), value), batch["shapes"], batch["mask"], memory) for value in (0.0, 1.0)
    )
    assert not close(first, second)
    poses = network.sample(
        batch["silhouette"][:1], torch.zeros(2, 5, dtype=torch.long), torch.ones(2, 5).bool(), seeded()
    )
    assert not close(*poses.sort(dim=1).values)


def test_the_weight_of_the_divergence_rises_to_its_value() -> None:
    config = VAEConfig(kl_weight=0.5, kl_warmup=4)
    assert [config.weight(step) for step in range(6)] == pytest.approx([0, 0.125, 0.25, 0.375, 0.5, 0.5])
    assert VAEConfig(kl_weight=0.5, kl_warmup=0).weight(1) == 0.5


# As samplers.


@pytest.mark.parametrize("make", [regression, vae])
@pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)
def test_samplers_keep_to_the_block_list_and_the_seed(config: TransformerConfig, make: Any) -> None:
    sampler = NetworkSampler(make(config), PAPER_WORLD, batch=4)
    pictures = batch_of()["silhouette"][:3].numpy() > 0.5
    counts = np.array([[2, 1, 0, 1], [0, 3, 1, 0], [10, 0, 0, 0]])
    first, again = (sampler.sample_batch(pictures, counts, 2, seed=3) for _ in range(2))
    other = sampler.sample_batch(pictures, counts, 2, seed=4)
    assert [[stack.counts.tolist() for stack in scene] for scene in first] == [[c] * 2 for c in counts.tolist()]
    poses, same, different = (np.concatenate([s.poses for scene in x for s in scene]) for x in (first, again, other))
    assert (poses == same).all() and (poses != different).any()


@pytest.mark.parametrize(
    ("shape", "counts", "samples", "message"),
    [
        ((1, 64, 64), [[0, 0, 0, 0]], 1, "1 to 10 blocks"),
        ((1, 64, 64), [[11, 0, 0, 0]], 1, "1 to 10 blocks"),
        ((1, 32, 32), [[1, 0, 0, 0]], 1, "silhouettes"),
        ((2, 64, 64), [[1, 0, 0, 0]], 1, "as many block lists"),
        ((1, 64, 64), [[1, 0, 0]], 1, "4 counts of 0 or more"),
        ((1, 64, 64), [[2, -1, 0, 0]], 1, "4 counts of 0 or more"),
        ((1, 64, 64), [[1, 0, 0, 0]], 0, "at least 1"),
    ],
)
def test_what_cannot_be_sampled_is_one_line(shape: Any, counts: Any, samples: int, message: str) -> None:
    sampler = NetworkSampler(regression(), PAPER_WORLD)
    with pytest.raises(StackgenError, match=message):
        sampler.sample_batch(np.zeros(shape, bool), np.array(counts), samples, 0)


def test_the_raster_order_is_the_denoiser_s() -> None:
    """Ours and the baseline number equal blocks alike, so that only the generative part differs."""
    network: PoseRegressor = regression()
    batch = batch_of((7, 7, 7, 7))
    order = raster_order(batch["poses"], batch["shapes"])
    shapes, _, poses = network.scene(batch, seeded())
    for row in range(4):
        ours = batch["poses"][row][order[row]][batch["shapes"][row][order[row]] == 0]
        assert close(poses[row][shapes[row] == 0], ours)
