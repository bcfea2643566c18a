"""Diffusion over poses: losses and samples where a perfect predictor makes them known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from stackgen.data.arrays import StackArrays
from stackgen.errors import StackgenError
from stackgen.models.diffusion.network import DiffusionConfig, PoseDiffusion
from stackgen.models.diffusion.sampler import DiffusionSampler
from stackgen.models.diffusion.schedules import ScheduleConfig
from stackgen.models.diffusion.settings import SPACING, SamplerConfig
from stackgen.models.transformer import TransformerConfig
from stackgen.stack import shapes_of
from stackgen.world import PAPER_WORLD
from tests.models.conftest import TINY, TINY_CROSS

MEAN, STD = np.array([0.1, 0, 1.9, 0, 0, 0]), np.array([1.1, 0.01, 1.2, 0.02, 0.03, 0.04])

Prediction = Literal["epsilon", "v"]


class Oracle(torch.nn.Module):
    """Knows the clean poses (B, N, 6), but for a constant error, and answers as the diffusion asks."""

    def __init__(self, model: PoseDiffusion, clean: Tensor, error: float = 0.0) -> None:
        super().__init__()
        self.config, self.parts = model.denoiser.config, (model.schedule, model.config.prediction)
        self.clean = clean + error
        self.calls = 0

    def encode(self, silhouette: Tensor) -> Tensor:
        return torch.zeros(len(silhouette), 1, 1)

    def forward(
        self, x: Tensor, t: Tensor, shapes: Tensor, mask: Tensor, memory: Tensor, seen: Tensor | None = None, *_: object
    ) -> Tensor:
        self.calls += 1
        (schedule, prediction), clean = self.parts, self.clean.repeat_interleave(len(x) // len(self.clean), 0)
        signal, sigma = schedule.signal_and_noise(t)
        noise = (x - signal * clean) / sigma
        return noise if prediction == "epsilon" else signal * noise - sigma * clean


class Silent(Oracle):
    """Estimates zero."""

    def forward(
        self, x: Tensor, t: Tensor, shapes: Tensor, mask: Tensor, memory: Tensor, seen: Tensor | None = None, *_: object
    ) -> Tensor:
        return torch.zeros_like(x)


def model_for(
    prediction: Prediction = "epsilon", denoiser: TransformerConfig = TINY, clip: float | None = None
) -> PoseDiffusion:
    torch.manual_seed(0)
    model = PoseDiffusion(denoiser, ScheduleConfig(), DiffusionConfig(prediction, clip), PAPER_WORLD)
    with torch.no_grad():
        for weight in model.parameters():
            weight.normal_(0, 0.1)
    model.fit_normalization(MEAN, STD)
    return model.eval().requires_grad_(False)


@pytest.fixture
def batch(arrays: StackArrays) -> dict[str, Tensor]:
    return arrays.batch(range(12))


def normalised(model: PoseDiffusion, batch: dict[str, Tensor]) -> Tensor:
    return (batch["poses"] - model.mean) / model.std


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# Losses.


@pytest.mark.parametrize("prediction", ["epsilon", "v"])
def test_a_perfect_predictor_has_no_loss(prediction: Prediction, batch: dict[str, Tensor]) -> None:
    model = model_for(prediction)
    model.denoiser = Oracle(model, normalised(model, batch))  # type: ignore[assignment]
    losses, t = model.loss(batch, 4, generator())
    assert losses.shape == t.shape == (48,)
    late = t > 3  # before, a float's rounding is divided by a tiny sigma
    assert losses[late].max() < 1e-6 and losses.max() < 1e-3


def test_an_error_of_the_clean_estimate_costs_what_the_algebra_says(batch: dict[str, Tensor]) -> None:
    """delta off: epsilon is off by delta sqrt(abar) / sqrt(1 - abar), v by delta / sqrt(1 - abar)."""
    delta = 0.3
    for prediction in ("epsilon", "v"):
        model = model_for(prediction)
        model.denoiser = Oracle(model, normalised(model, batch), delta)  # type: ignore[assignment]
        losses, t = model.loss(batch, 8, generator())
        bar = model.schedule.alpha_bar[t].float()
        expected = delta**2 / (1 - bar) * (bar if prediction == "epsilon" else 1)
        assert losses == pytest.approx(expected, rel=1e-2)


def test_saying_nothing_costs_the_target(batch: dict[str, Tensor]) -> None:
    """A zero estimate: E |epsilon|^2 = 1, and E |v|^2 = abar + (1 - abar) x_0^2, averaged over the real blocks."""
    for prediction in ("epsilon", "v"):
        model = model_for(prediction)
        clean = normalised(model, batch)
        model.denoiser = Silent(model, clean)  # type: ignore[assignment]
        losses, t = model.loss(batch, 400, generator())
        bar = model.schedule.alpha_bar[t].float()
        mask = batch["mask"].float()
        square = ((clean.square().mean(-1) * mask).sum(-1) / mask.sum(-1)).repeat_interleave(400)
        expected = torch.ones_like(bar) if prediction == "epsilon" else bar + (1 - bar) * square
        assert losses.mean().item() == pytest.approx(expected.mean().item(), rel=0.02)


def test_every_step_is_drawn_alike(batch: dict[str, Tensor]) -> None:
    model = model_for()
    model.denoiser = Silent(model, normalised(model, batch))  # type: ignore[assignment]
    _, t = model.loss(batch, 1000, generator())
    shares = torch.bincount(t, minlength=51)
    assert shares[0] == 0 and len(shares) == 51
    assert shares[1:].float() == pytest.approx(torch.full((50,), 240.0), abs=5 * 240**0.5)


@pytest.mark.parametrize("denoiser", [TINY, TINY_CROSS], ids=["paper", "cross"])
def test_what_stands_at_padding_costs_nothing(denoiser: TransformerConfig, batch: dict[str, Tensor]) -> None:
    model = model_for(denoiser=denoiser)
    other = {**batch, "poses": torch.where(batch["mask"][..., None], batch["poses"], torch.tensor(9.0))}
    assert not batch["mask"].all()
    a, b = (model.loss(those, 2, generator())[0] for those in (batch, other))
    assert a == pytest.approx(b, rel=1e-4)


def test_the_order_of_the_blocks_costs_nothing_where_the_model_orders_them(batch: dict[str, Tensor]) -> None:
    model = model_for(denoiser=TINY_CROSS)
    order = torch.stack([torch.randperm(10) for _ in range(12)])
    shuffled = {
        **batch,
        "poses": batch["poses"].gather(1, order[..., None].expand(-1, -1, 6)),
        "shapes": batch["shapes"].gather(1, order),
        "mask": batch["mask"].gather(1, order),
    }
    a, b = (model.loss(those, 2, generator())[0] for those in (batch, shuffled))
    assert a == pytest.approx(b, rel=1e-4)


def test_draws_of_one_sample_share_its_picture_and_nothing_else(batch: dict[str, Tensor]) -> None:
    model = model_for()
    losses, t = model.loss(batch, 3, generator())
    repeated = {name: part.repeat_interleave(3, 0) for name, part in batch.items()}
    again, steps = model.loss(repeated, 1, generator())
    assert (t == steps).all() and losses == pytest.approx(again, rel=1e-4)


# Normalisation.


def test_constant_dimensions_are_not_divided_by_nothing() -> None:
    model = PoseDiffusion(TINY, ScheduleConfig(), DiffusionConfig(), PAPER_WORLD)
    model.fit_normalization(np.zeros(6), np.zeros(6))
    assert (model.std > 0).all()
    bounded = PoseDiffusion(TINY, ScheduleConfig(), DiffusionConfig(least_std=0.05), PAPER_WORLD)
    bounded.fit_normalization(MEAN, STD)
    assert bounded.std == pytest.approx(torch.tensor([1.1, 0.05, 1.2, 0.05, 0.05, 0.05]))
    assert bounded.mean == pytest.approx(torch.as_tensor(MEAN, dtype=torch.float32))


# Samples.


@pytest.mark.parametrize("prediction", ["epsilon", "v"])
@pytest.mark.parametrize("clip", [None, 6.0])
def test_a_perfect_predictor_samples_the_truth(
    prediction: Prediction, clip: float | None, batch: dict[str, Tensor]
) -> None:
    """Un-normalised again, in cells and radians."""
    model = model_for(prediction, clip=clip)
    batch = {**batch, "poses": torch.where(batch["mask"][..., None], batch["poses"], model.mean)}
    model.denoiser = Oracle(model, normalised(model, batch))  # type: ignore[assignment]
    found = model.sample(batch["silhouette"], batch["shapes"], batch["mask"], generator())
    assert found == pytest.approx(batch["poses"], abs=2e-3)


@pytest.mark.parametrize("denoiser", [TINY, TINY_CROSS], ids=["paper", "cross"])
def test_samples_depend_on_the_seed_and_on_nothing_else(denoiser: TransformerConfig, arrays: StackArrays) -> None:
    sampler = DiffusionSampler(model_for(denoiser=denoiser), PAPER_WORLD)
    pictures, counts = arrays.images(range(5)), arrays.counts[:5]

    def poses(seed: int) -> np.ndarray:
        torch.rand(3)  # the global stream does not matter
        scenes = sampler.sample_batch(pictures, counts, 3, seed)
        assert [len(scene) for scene in scenes] == [3] * 5
        for scene, wanted in zip(scenes, counts, strict=True):
            for stack in scene:
                assert stack.shapes.tolist() == shapes_of(wanted).tolist()
        return np.concatenate([stack.poses for scene in scenes for stack in scene])

    assert (poses(1) == poses(1)).all()
    assert (poses(1) != poses(2)).any(axis=1).all()
    assert len({row.tobytes() for row in poses(1)}) == len(poses(1))  # no two blocks alike


class Oracles(torch.nn.Module):
    """An oracle for each batch, in turn."""

    def __init__(self, oracles: list[Oracle]) -> None:
        super().__init__()
        self.config, self.oracles, self.turn = oracles[0].config, oracles, -1

    def encode(self, silhouette: Tensor) -> Tensor:
        self.turn += 1
        return torch.zeros(len(silhouette), 1, 1)

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.oracles[self.turn](*inputs)


@pytest.mark.parametrize("batch_size", [512, 6, 1])
def test_scenes_do_not_mix(batch_size: int, arrays: StackArrays) -> None:
    """Each scene's blocks go to its own oracle's places, also in several batches."""
    model, together = model_for(), max(1, min(4, batch_size // 3))
    order = [np.argsort(arrays.shapes[i, : arrays.lengths[i]], kind="stable") for i in range(4)]
    truth = [torch.from_numpy(arrays.poses[i][o]) for i, o in enumerate(order)]
    clean = torch.stack([torch.nn.functional.pad((t - model.mean) / model.std, (0, 0, 0, 10 - len(t))) for t in truth])
    oracles = Oracles([Oracle(model, clean[i : i + together]) for i in range(0, 4, together)])
    model.denoiser = oracles  # type: ignore[assignment]
    sampler = DiffusionSampler(model, PAPER_WORLD, batch=batch_size)
    scenes = sampler.sample_batch(arrays.images(range(4)), arrays.counts[:4], 3, 0)
    assert oracles.turn == len(oracles.oracles) - 1
    for scene, expected in zip(scenes, truth, strict=True):
        for stack in scene:
            assert stack.poses == pytest.approx(expected.numpy(), abs=2e-3)


# Settings of the sampler.


SETTINGS = [
    SamplerConfig(),
    SamplerConfig("ddpm", 8, variance="posterior"),
    SamplerConfig("ddim", 8),
    SamplerConfig("ddim", 5, spacing=2.0, eta=1.0),
    SamplerConfig("dpm", 8),
    SamplerConfig("dpm", 1),
    SamplerConfig(antithetic=True),
    SamplerConfig("dpm", 6, eta=0.5, antithetic=True),
    SamplerConfig(mend=1),
    SamplerConfig("ddim", 8, mend=2),
]


@pytest.mark.parametrize("sampler", SETTINGS, ids=str)
@pytest.mark.parametrize("prediction", ["epsilon", "v"])
def test_a_perfect_predictor_samples_the_truth_in_every_way(
    sampler: SamplerConfig, prediction: Prediction, batch: dict[str, Tensor]
) -> None:
    model = model_for(prediction)
    batch = {**batch, "poses": torch.where(batch["mask"][..., None], batch["poses"], model.mean)}
    model.denoiser = Oracle(model, normalised(model, batch))  # type: ignore[assignment]
    found = model.sample(batch["silhouette"], batch["shapes"], batch["mask"], generator(), sampler)
    assert found == pytest.approx(batch["poses"], abs=2e-3)
    assert model.denoiser.calls == (sampler.steps or 50)


def test_settings_change_the_samples_and_their_absence_nothing(arrays: StackArrays) -> None:
    sampler = DiffusionSampler(model_for("v", TINY_CROSS), PAPER_WORLD)
    scene = arrays.images([0]), arrays.counts[:1], 2, 0

    def poses(settings: SamplerConfig) -> np.ndarray:
        return np.concatenate([stack.poses for stack in sampler.configured(settings).sample_batch(*scene)[0]])

    found = [poses(settings) for settings in SETTINGS]
    assert all((a != b).any() for i, a in enumerate(found) for b in found[:i])
    assert (found[0] == poses(SamplerConfig("ddpm", 50, variance="beta"))).all()


def test_what_the_card_says_of_sampling_holds_unless_overridden() -> None:
    model = model_for()
    sampler = DiffusionSampler(model, PAPER_WORLD, card={"sampler": {"kind": "dpm", "steps": 8, "eta": 0.5}})
    assert sampler.sampler == SamplerConfig("dpm", 8, SPACING, eta=0.5)
    assert sampler.configured(SamplerConfig(steps=5)).sampler == SamplerConfig("dpm", 5, SPACING, eta=0.5)
    assert sampler.configured(SamplerConfig("ddpm")).sampler == SamplerConfig("ddpm", 8, SPACING, variance="beta")
    with pytest.raises(StackgenError, match="weights card"):
        DiffusionSampler(model, PAPER_WORLD, card={"sampler": {"colour": "red"}})


def test_samples_are_drawn_apart_where_model_or_setting_says_so(arrays: StackArrays) -> None:
    own, model = model_for("v", TINY_CROSS), model_for("v", TINY_CROSS)
    model.config = replace(model.config, antithetic=True)
    apart, alone = DiffusionSampler(model, PAPER_WORLD), DiffusionSampler(own, PAPER_WORLD)
    assert apart.settings["antithetic"] is True and "antithetic" not in alone.settings

    def poses(sampler: DiffusionSampler, number: int) -> np.ndarray:
        scenes = sampler.sample_batch(arrays.images([0, 1]), arrays.counts[:2], number, 0)
        return np.concatenate([stack.poses for scene in scenes for stack in scene])

    asked = alone.configured(SamplerConfig(antithetic=True))
    refused = apart.configured(SamplerConfig(antithetic=False))
    assert (poses(apart, 3) == poses(asked, 3)).all() and (poses(refused, 3) == poses(alone, 3)).all()
    assert (poses(apart, 3) != poses(alone, 3)).any()
    assert (poses(apart, 1) == poses(alone, 1)).all()  # one sample has none to be apart from


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": 51}, "this model has 50 steps"),
        ({"steps": 0}, "at least 1"),
        ({"eta": 0.5}, "eta is not for ddpm"),
        ({"kind": "dpm", "variance": "beta"}, "variance is not for dpm"),
        ({"kind": "dpm", "eta": 1.5}, "0..1"),
        ({"kind": "dpm", "temperature": 0.5}, "temperature is not for dpm; set eta"),
        ({"temperature": -0.1}, "0..10"),
        ({"mend": -1}, "mend must lie in 0..10"),
        ({"spacing": 0.5}, "1..10"),
        ({"guidance": 2.0}, "sampler.guidance"),
        ({"guidance": -1.0}, "must lie in"),
        ({"guided": [0.5, 0.2]}, "two shares"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(StackgenError, match=message):
        DiffusionSampler(model_for(), PAPER_WORLD, sampler=SamplerConfig(**settings))


# Self-conditioning.


def test_the_network_is_shown_its_last_estimate(batch: dict[str, Tensor], monkeypatch: pytest.MonkeyPatch) -> None:
    """None at the first step, then the estimate before, bounded."""
    model, shown = model_for("v", replace(TINY_CROSS, self_conditioning=True), clip=1.5), []
    forward = model.denoiser.forward

    def watched(x: Tensor, t: Tensor, *rest: Any) -> Tensor:
        out = forward(x, t, *rest)
        shown.append((rest[-2], model._clean(x, t, out)))
        return out

    monkeypatch.setattr(model.denoiser, "forward", watched)
    model.sample(batch["silhouette"], batch["shapes"], batch["mask"], generator(), SamplerConfig("ddim", 10))
    assert shown[0][0] is None and len(shown) == 10
    for (seen, _), (_, before) in zip(shown[1:], shown, strict=False):
        assert (seen == before).all() and before.abs().max() <= 1.5
