"""What could not be read: named when it is first met, counted, and reported. Never silent."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from stackgen.data.loading.decoding import Decoded, Frame, decode_shard
from stackgen.data.sources import Shard
from stackgen.errors import StackgenError, warn

NAMED = 10
"""Broken samples that are named one by one; of more there is only the number."""


@dataclass(frozen=True)
class Loss:
    """Samples that could not be read.

    Args:
        what: Line that names the shard or the sample, and says what is wrong.
        samples: Their number.
    """

    what: str
    samples: int = 1


class Losses:
    """Counts losses, each only once between two reports however often it is met.

    Args:
        where: Named in every line, if anything; for one of several processes.
    """

    def __init__(self, where: str = "") -> None:
        self._label = f"data{' ' if where else ''}{where}"
        self._named: set[Loss] = set()
        self._lately: set[Loss] = set()

    def add(self, losses: Iterable[Loss]) -> None:
        """Count some; name those that were not met before."""
        for loss in losses:
            self._lately.add(loss)
            if loss not in self._named:
                self._named.add(loss)
                if loss.samples > 1 or len(self._named) <= NAMED:
                    warn(f"{self._label}: {loss.what}")

    def report(self, within: str) -> None:
        """Say how many samples were lost since the last report, if any were."""
        count = sum(loss.samples for loss in self._lately)
        if count:
            warn(f"{self._label}: samples skipped in {within}: {count}")
        self._lately.clear()


def read_decoded(shard: Shard, frame: Frame) -> tuple[Decoded, list[Loss]]:
    """The samples of a shard and what is lost of it: broken samples, or everything if its checksum is wrong."""
    try:
        content = shard.read()
    except StackgenError as error:
        return decode_shard(b"", frame), [Loss(f"{error}; its {shard.samples} samples are skipped", shard.samples)]
    return decode_sound(content, shard, frame)


def decode_sound(content: bytes, shard: Shard, frame: Frame) -> tuple[Decoded, list[Loss]]:
    """The samples in the bytes of a shard whose checksum is right, and the broken ones among them."""
    decoded = decode_shard(content, frame)
    losses = [Loss(f"skipped a broken sample of {shard.name}, {fault}") for fault in decoded.broken]
    absent = shard.samples - len(decoded.positions) - len(losses)
    if absent > 0:
        losses.append(Loss(f"{shard.name} lacks {absent} of the samples that dataset.json says it has", absent))
    return decoded, losses
