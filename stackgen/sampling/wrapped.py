"""What samplers that ask another sampler have in common."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stackgen.protocols import StackSampler
from stackgen.world import World


class WrappedSampler:
    """A StackSampler that has another one sample, and says of itself what that one says."""

    sampler: StackSampler

    @property
    def world(self) -> World:
        """World of the other sampler."""
        return self.sampler.world

    @property
    def settings(self) -> Mapping[str, Any]:
        """Settings of the other sampler."""
        return self.sampler.settings

    @property
    def card(self) -> Mapping[str, Any]:
        """Card of the other sampler."""
        return self.sampler.card
