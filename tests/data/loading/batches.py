"""The small dataset of tests/data/conftest.py in batches."""

from __future__ import annotations

from typing import Any

TRAIN, VALIDATION = 71, 23  # samples of `dataset`


def place_of(rank: int, world: int = 3) -> tuple[int, int]:
    return rank, world


def templates(batches: Any) -> list[int]:
    return [t for batch in batches for t in batch["template"].tolist()]
