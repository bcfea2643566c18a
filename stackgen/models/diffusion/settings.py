"""How a diffusion model samples: settings that can be given on the command line, without importing torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from stackgen.errors import StackgenError

SamplerKind = Literal["ddpm", "ddim", "dpm"]
SPACING = 1.3
"""Default of `SamplerConfig.spacing`: best for 4 to 8 steps on validation scenes, see docs/sampling.md."""

_OF_KIND = {"ddpm": ("variance", "temperature"), "ddim": ("eta",), "dpm": ("eta",)}


@dataclass(frozen=True)
class SamplerConfig:
    """Settings of the way from noise to poses; what is null is taken from the weights.

    Args:
        kind: Solver: `ddpm`, ancestral sampling (paper); `ddim` (Song et al. 2021); `dpm`, DPM-Solver++ (2M), which
            looks back one step (Lu et al. 2022).
        steps: Number of calls of the network, 1..T; all T by default.
        spacing: Spacing of the steps: at 1 they lie evenly in t; above, they get closer towards the clean end, as
            the power `spacing` of even ones.
        eta: Share of fresh noise in each step of `ddim` and `dpm`: 0 for none, 1 for as much as `ddpm` has.
        variance: Variance of the noise of `ddpm`: `beta` (paper) or the smaller `posterior`.
        guidance: Weight of classifier-free guidance (Ho & Salimans 2022), for a model that was trained with
            `drop_silhouette`: 1 is none, 0 leaves the silhouette out.
        guided: Range of t in which guidance acts, as two shares of T.
        antithetic: Whether the samples that are drawn together for one silhouette are drawn apart: their noise is
            negatively correlated. Each alone is distributed as before; together they differ more often.
        temperature: Factor of the noise that `ddpm` adds in the lower half of the steps, where layouts are decided and
            only places are left: below 1 blocks lie closer to where the model expects them.
        mend: Number of times, 0 for never, that a stack is mended whose blocks lie in each other: those go to where the
            drawing is still empty, and the whole is denoised anew from 40 % of the noise. Nothing is simulated.

    Raises:
        StackgenError: If a number is out of its range.
    """

    kind: SamplerKind | None = None
    steps: int | None = None
    spacing: float | None = None
    eta: float | None = None
    variance: Literal["beta", "posterior"] | None = None
    guidance: float | None = None
    guided: tuple[float, float] | None = None
    antithetic: bool | None = None
    temperature: float | None = None
    mend: int | None = None

    def __post_init__(self) -> None:
        if self.guided is not None:
            object.__setattr__(self, "guided", tuple(self.guided))  # JSON has lists
        if self.steps is not None and self.steps < 1:
            raise StackgenError(f"sampler.steps must be at least 1, got {self.steps}")
        if self.spacing is not None and not 1 <= self.spacing <= 10:
            raise StackgenError(f"sampler.spacing must lie in 1..10, got {self.spacing}")
        if self.eta is not None and not 0 <= self.eta <= 1:
            raise StackgenError(f"sampler.eta must lie in 0..1, got {self.eta}")
        if self.temperature is not None and not 0 <= self.temperature <= 10:
            raise StackgenError(f"sampler.temperature must lie in 0..10, got {self.temperature}")
        if self.mend is not None and not 0 <= self.mend <= 10:
            raise StackgenError(f"sampler.mend must lie in 0..10, got {self.mend}")
        if self.guidance is not None and not 0 <= self.guidance <= 100:
            raise StackgenError(f"sampler.guidance must lie in 0..100, got {self.guidance}")
        if self.guided is not None and not 0 <= self.guided[0] < self.guided[1] <= 1:
            raise StackgenError(f"sampler.guided must be two shares of T, such as [0.3, 1], got {list(self.guided)}")

    def over(self, base: SamplerConfig) -> SamplerConfig:
        """Take the settings of `base` for what is null here; the noise of another kind does not carry over.

        >>> SamplerConfig(kind="ddim").over(SamplerConfig(kind="ddpm", steps=8, variance="beta"))
        ... # doctest: +ELLIPSIS
        SamplerConfig(kind='ddim', steps=8, spacing=None, eta=None, variance=None, ...)
        """
        if self.kind not in (None, base.kind):
            base = replace(base, eta=None, variance=None, temperature=None)
        return SamplerConfig(**{**asdict(base), **self.given()})

    def complete(
        self,
        steps: int,
        variance: Literal["beta", "posterior"],
        guidance: float | None = None,
        antithetic: bool = False,
        temperature: float = 1.0,
        mend: int = 0,
    ) -> SamplerConfig:
        """Fill in all that matters: a model's T and its own settings; `guidance` is null if it has none.

        Raises:
            StackgenError: If a setting belongs to another kind, or there are more steps than T.
        """
        kind = self.kind or "ddpm"
        for name in ("eta", "variance", "temperature"):
            if getattr(self, name) is not None and name not in _OF_KIND[kind]:
                own = " or ".join(_OF_KIND[kind])
                raise StackgenError(f"sampler.{name} is not for {kind}; set {own}, or choose another kind")
        if self.steps is not None and self.steps > steps:
            raise StackgenError(f"sampler.steps: this model has {steps} steps, not {self.steps}")
        if guidance is None and (self.guidance is not None or self.guided is not None):
            raise StackgenError(
                "sampler.guidance and sampler.guided need a model trained with diffusion.drop_silhouette"
            )
        defaults = SamplerConfig(kind, steps, SPACING, antithetic=antithetic or None, mend=mend or None)
        if kind == "ddpm":
            defaults = replace(defaults, variance=variance, temperature=temperature if temperature != 1 else None)
        else:
            defaults = replace(defaults, eta=0.0)
        if guidance is not None:
            defaults = replace(defaults, guidance=guidance, guided=(0.0, 1.0))
        return replace(defaults, **self.given())

    @staticmethod
    def of_card(card: Mapping[str, Any]) -> SamplerConfig:
        """Read how to sample some weights from their card.

        Raises:
            StackgenError: If the card has settings that no sampler has.
        """
        try:
            return SamplerConfig(**card.get("sampler", {}))
        except TypeError as error:
            raise StackgenError(f"the weights card of {card.get('name')}: sampler: {error}") from error

    def given(self) -> dict[str, Any]:
        """Give the settings that are not null, as JSON allows."""
        return {name: value for name, value in asdict(self).items() if value is not None}
