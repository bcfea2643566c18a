"""A small dataset in memory and in a file, and tiny networks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stackgen._lightning import pl
from stackgen.data.generation.templates import draw_template, realize
from stackgen.data.loading.arrays import StackArrays, save_npz
from stackgen.data.shards import Manifest, Sample
from stackgen.geometry import silhouette
from stackgen.models.diffusion.denoiser import DenoiserConfig
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID

TINY = DenoiserConfig(width=16, layers=1, heads=2, feedforward=32)
TINY_CROSS = DenoiserConfig(
    width=16, layers=1, heads=2, feedforward=32, conditioning="cross", memory_layers=1, ordered=True
)


@pytest.fixture(scope="session")
def arrays() -> StackArrays:
    """Designs as drawn: 40 stacks of 4 to 10 blocks, a template each."""
    rng = np.random.default_rng(0)
    samples: list[Sample] = []
    while len(samples) < 40:
        design = draw_template(rng)
        stack = realize(design, rng)
        if len(stack) <= 10:
            meta = {"template": len(samples), "layout": design.key, "removed": []}
            shapes, poses = stack.shapes.astype(np.uint8), stack.poses.astype(np.float32)
            samples.append(Sample(str(len(samples)), shapes, poses, silhouette(stack), meta))
    return StackArrays.from_samples(samples)


@pytest.fixture(scope="session")
def compact(arrays: StackArrays, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as a compact dataset: 32 for training, 8 for validation."""
    path = tmp_path_factory.mktemp("compact") / "small.npz"
    manifest = Manifest("small", 0, PAPER_CATALOGUE, PAPER_GRID, 10, {"engine": "none"}, {}).to_json()
    save_npz(path, {"train": arrays.select(slice(32)), "validation": arrays.select(slice(32, 40))}, manifest)
    return path


def trainer_for(folder: Path, **options: Any) -> pl.Trainer:
    """A trainer that says nothing and writes nothing by itself."""
    settings = {
        "accelerator": "cpu", "logger": False, "enable_progress_bar": False, "enable_model_summary": False,
        "enable_checkpointing": False, "num_sanity_val_steps": 0,
    }  # fmt: skip
    return pl.Trainer(default_root_dir=folder, **{**settings, **options})
