"""A small dataset in memory and in a file, and tiny networks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stackgen._lightning import pl
from stackgen.data.arrays import StackArrays
from stackgen.data.compact import save_npz
from stackgen.data.generation.designs import draw_design, realize
from stackgen.data.manifest import Manifest
from stackgen.data.shards import Sample
from stackgen.geometry import silhouette
from stackgen.models.transformer import TransformerConfig
from stackgen.world import PAPER_GRID, PAPER_WORLD

TINY = TransformerConfig(width=16, layers=1, heads=2, feedforward=32)
TINY_CROSS = TransformerConfig(
    width=16, layers=1, heads=2, feedforward=32, conditioning="cross", memory_layers=1, ordered=True
)


@pytest.fixture(scope="session")
def arrays() -> StackArrays:
    """Designs as drawn: 40 stacks of 4 to 10 blocks, a template each."""
    rng = np.random.default_rng(0)
    samples: list[Sample] = []
    while len(samples) < 40:
        design = draw_design(rng, PAPER_WORLD)
        stack = realize(design, rng, PAPER_WORLD)
        if len(stack) <= 10:
            meta = {"template": len(samples), "layout": design.key, "removed": []}
            shapes, poses = stack.shapes.astype(np.uint8), stack.poses.astype(np.float32)
            samples.append(Sample(str(len(samples)), shapes, poses, silhouette(stack, PAPER_GRID), meta))
    return StackArrays.from_samples(samples, PAPER_WORLD)


@pytest.fixture(scope="session")
def compact(arrays: StackArrays, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as a compact dataset: 32 for training, 8 for validation."""
    path = tmp_path_factory.mktemp("compact") / "small.npz"
    manifest = Manifest("small", 0, PAPER_WORLD, {"engine": "none"}, {})
    save_npz(path, {"train": arrays.select(slice(32)), "validation": arrays.select(slice(32, 40))}, manifest)
    return path


def trainer_for(folder: Path, **options: Any) -> pl.Trainer:
    """A trainer that says nothing and writes nothing by itself."""
    settings = {
        "accelerator": "cpu", "logger": False, "enable_progress_bar": False, "enable_model_summary": False,
        "enable_checkpointing": False, "num_sanity_val_steps": 0,
    }  # fmt: skip
    return pl.Trainer(default_root_dir=folder, **{**settings, **options})
