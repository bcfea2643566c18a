"""Classifier-free guidance: a model that sometimes was shown no silhouette guides itself."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from stackgen.data.arrays import StackArrays
from stackgen.errors import StackgenError
from stackgen.models.diffusion.denoiser import Denoiser
from stackgen.models.diffusion.network import DiffusionConfig, PoseDiffusion
from stackgen.models.diffusion.sampler import DiffusionSampler
from stackgen.models.diffusion.schedules import ScheduleConfig
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.world import PAPER_WORLD
from tests.models.conftest import TINY

STEPS = 10


class Blind(Denoiser):
    """Estimates the noise that leads to `seeing` where it is shown a silhouette, to `blind` where not."""

    def __init__(self, model: PoseDiffusion, seeing: float, blind: float) -> None:
        super().__init__(TINY, PAPER_WORLD)
        self.schedule, self.seeing, self.blind = model.schedule, seeing, blind

    def encode(self, silhouette: Tensor) -> Tensor:
        return silhouette.flatten(1).any(1)[:, None, None]

    def forward(
        self,
        poses: Tensor,
        t: Tensor,
        shapes: Tensor,
        mask: Tensor,
        memory: Tensor,
        estimate: Tensor | None = None,
        *_: object,
    ) -> Tensor:
        shown = memory.repeat_interleave(len(poses) // len(memory), 0)
        clean = torch.where(shown, self.seeing, self.blind)
        signal, sigma = self.schedule.signal_and_noise(t)
        return (poses - signal * clean) / sigma


@pytest.fixture
def batch(arrays: StackArrays) -> dict[str, Tensor]:
    """Twelve stacks as the DataModule gives them."""
    return arrays.batch(range(12))


def model_with(drop_silhouette: float, guidance: float = 1.0, clip: float | None = None) -> PoseDiffusion:
    torch.manual_seed(0)
    diffusion = DiffusionConfig(drop_silhouette=drop_silhouette, guidance=guidance, clip=clip)
    return PoseDiffusion(TINY, ScheduleConfig(steps=STEPS), diffusion, PAPER_WORLD)


@pytest.mark.parametrize("weight", [0.0, 1.0, 1.5, 3.0])
def test_the_estimate_moves_away_from_what_it_is_without_the_silhouette(
    batch: dict[str, Tensor], weight: float
) -> None:
    model = model_with(0.1)
    model.denoiser = Blind(model, seeing=0.4, blind=0.1)
    config = SamplerConfig("ddim", guidance=weight)
    question = batch["silhouette"], batch["shapes"], batch["mask"], torch.Generator().manual_seed(0)
    found = model.sample(*question, sampler=config)
    assert found == pytest.approx(torch.full_like(found, 0.1 + weight * 0.3), abs=1e-3)


def test_guidance_keeps_to_its_interval_and_to_the_bound(batch: dict[str, Tensor]) -> None:
    model = model_with(0.1, clip=1.0)
    model.denoiser = Blind(model, seeing=0.0, blind=0.5)
    question = batch["silhouette"], batch["shapes"], batch["mask"]
    late, early = (
        model.sample(*question, torch.Generator().manual_seed(0), SamplerConfig("ddim", guidance=9.0, guided=guided))
        for guided in ((0.0, 0.3), (0.5, 1.0))
    )
    assert late == pytest.approx(torch.full_like(late, -1.0), abs=1e-3)  # (1 - 9) / 2, bounded
    assert early == pytest.approx(torch.zeros_like(early), abs=2e-3)  # what came after forgot it


def test_the_weight_is_the_models_unless_another_is_asked_for() -> None:
    sampler = DiffusionSampler(model_with(0.1, guidance=2.0), PAPER_WORLD)
    assert sampler.settings["guidance"] == 2.0
    assert sampler.configured(SamplerConfig(guidance=1.0)).settings["guidance"] == 1.0
    assert "guidance" not in DiffusionSampler(model_with(0.0), PAPER_WORLD).settings


def test_only_what_was_trained_without_silhouettes_guides_itself() -> None:
    with pytest.raises(StackgenError, match="drop_silhouette"):
        DiffusionSampler(model_with(0.0), PAPER_WORLD, sampler=SamplerConfig(guidance=2.0))
    with pytest.raises(StackgenError, match="guidance needs"):
        DiffusionConfig(guidance=2.0)
    with pytest.raises(StackgenError, match=r"must lie in \[0, 1\)"):
        DiffusionConfig(drop_silhouette=1.0)


def test_training_hides_that_share_of_the_silhouettes(
    batch: dict[str, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole pictures, and the steps and noise stay what they are without."""
    model, pictures = model_with(0.25), []
    encode = model.denoiser.encode

    def seen(picture: Tensor) -> Tensor:
        pictures.append(picture)
        return encode(picture)

    monkeypatch.setattr(model.denoiser, "encode", seen)
    many = {name: tensor.repeat(100, *[1] * (tensor.ndim - 1)) for name, tensor in batch.items()}
    steps = [model.loss(many, 1, torch.Generator().manual_seed(0), share)[1] for share in (0.25, 0.0)]
    empty = ~pictures[0].flatten(1).any(1)
    assert 0.2 < empty.float().mean() < 0.3
    assert torch.equal(pictures[0][~empty], pictures[1][~empty])
    assert torch.equal(steps[0], steps[1])
