"""Training samples per second of four denoisers of one size, on one and two threads, each in a process of its own.

`config` is the network of the configuration; `joint` the paper's encoder over block and silhouette tokens at that
size; `torch` the same with PyTorch's own `nn.TransformerEncoder` in place of the layers. Lightning trains them as
`stackgen fit` does: loader, bucketing, mirroring, gradient clipping, AdamW and EMA are measured, too. `plain` is
what one writes first: `torch`'s network under a Trainer with its defaults, from torch's DataLoader, all ten blocks
of every sample computed; neither `--precision` nor `--allocator` touches it. A draw is a sample with one noise: what a
network learns from. The stacks are those of testset-v1, which any clone has, repeated, so that bucketed batches are as
full as those of a dataset of usual size; nothing that is learnt here is kept.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import sys
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from benchmarks.common import ROOT, argument_parser, peak_rss_mb, plain_table, report, run_child, start

if TYPE_CHECKING:
    from stackgen.data.arrays import StackArrays
    from stackgen.models.diffusion.module import DDPM

NETWORKS = ("config", "joint", "torch", "plain")
ALLOCATOR = {"MALLOC_MMAP_THRESHOLD_": "2000000000", "MALLOC_TRIM_THRESHOLD_": "20000000000"}
"""Keeps memory that was freed; on a busy machine fresh pages are slow."""
REPEATS = 20
"""Copies of the 500 stacks."""
CONFIG = Path("configs/model/ddpm-small.yaml")


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--config", type=Path, default=CONFIG, help="configuration of a DDPM")
    options.add_argument("--networks", nargs="+", choices=NETWORKS, default=list(NETWORKS), help="networks to train")
    options.add_argument("--threads", nargs="+", type=int, default=[1, 2], help="numbers of threads")
    options.add_argument("--precision", help="precision of Lightning's Trainer; the configuration's if left out")
    options.add_argument("--allocator", action="store_true", help="let glibc keep memory that was freed")
    options.add_argument("--warmup", type=int, default=10, help="steps before the clock starts")
    options.add_argument("--steps", type=int, default=100, help="steps that are timed")
    options.add_argument("--child", action="store_true", help="measure one network in this process and print JSON")
    return options


def main() -> None:
    """Measure in children, so that thread counts and peaks of memory are each one's own."""
    options = parser().parse_args()
    if options.child:
        print(json.dumps(measure(options, options.networks[0], options.threads[0])))
        return
    rows = [in_child(options, network, threads) for network in options.networks for threads in options.threads]
    plain = {row["threads"]: row["samples_per_second"] * row["draws"] for row in rows if row["network"] == "plain"}
    cells = [
        [
            row["network"],
            str(row["threads"]),
            f"{row['parameters'] / 1e6:.2f} M",
            str(row["draws"]),
            f"{row['steps_per_second']:.2f}",
            f"{row['samples_per_second']:.0f}",
            f"{row['samples_per_second'] * row['draws']:.0f}",
            f"{row['samples_per_second'] * row['draws'] / plain[row['threads']]:.1f}" if plain else "",
            f"{row['peak_rss_mb']:.0f}",
        ]
        for row in rows
    ]
    headings = ("network", "threads", "weights", "draws", "steps/s", "samples/s", "draws/s", "x plain", "RSS [MB]")
    metrics = {
        "config": str(options.config),
        "steps": options.steps,
        "precision": options.precision,
        "allocator": options.allocator,
        "rows": rows,
    }
    report("training_speed", metrics, [plain_table(f"Training, {options.config}", headings, cells)], options.out)


def in_child(options: argparse.Namespace, network: str, threads: int) -> dict[str, Any]:
    """One measurement in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.training_speed", "--child", "--config", str(options.config)]
    command += ["--networks", network, "--threads", str(threads)]
    command += ["--warmup", str(options.warmup), "--steps", str(options.steps)]
    command += ["--precision", options.precision] if options.precision else []
    if options.allocator and network != "plain":
        command = ["env", *(f"{name}={value}" for name, value in ALLOCATOR.items()), *command]
    return json.loads(run_child(command, threads).output.strip().splitlines()[-1])


def measure(options: argparse.Namespace, network: str, threads: int) -> dict[str, Any]:
    """Train for some steps in this process."""
    import numpy as np
    import torch
    from lightning.pytorch import Trainer

    from stackgen.data.dataset import TESTSET, Dataset
    from stackgen.training.callbacks import EMA

    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    config = yaml.safe_load((ROOT / options.config).read_text())
    data, settings = config["data"], config["trainer"]
    stacks = Dataset.open(TESTSET).split("test")
    arrays = stacks.select(np.tile(np.arange(len(stacks)), REPEATS))
    loader = loader_of(arrays, data, plain=network == "plain")
    module = build(config["model"]["init_args"], network)
    module.model.fit_normalization(*arrays.pose_statistics())
    stopwatch = _stopwatch(options.warmup)
    recipe: dict[str, Any] = {"callbacks": [stopwatch]}
    if network != "plain":
        recipe = {
            "callbacks": [EMA(), stopwatch],
            "precision": options.precision or settings.get("precision", "32-true"),
            "gradient_clip_val": settings.get("gradient_clip_val"),
        }
    trainer = Trainer(
        accelerator="cpu",
        max_steps=options.warmup + options.steps,
        **recipe,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(module, train_dataloaders=loader)
    seconds = stopwatch.end - stopwatch.begin
    return {
        "network": network,
        "threads": threads,
        "parameters": sum(parameter.numel() for parameter in module.parameters()),
        "draws": module.draws,
        "precision": trainer.precision,
        "steps_per_second": options.steps / seconds,
        "samples_per_second": stopwatch.samples / seconds,
        "peak_rss_mb": peak_rss_mb(),
    }


def loader_of(arrays: StackArrays, data: dict[str, Any], plain: bool) -> Any:
    """Training batches: the configuration's, or those of torch's DataLoader with its defaults."""
    import numpy as np
    from torch.utils.data import DataLoader

    from stackgen.data.loading.cached import CachedLoader

    if not plain:
        options = {name: data.get(name, False) for name in ("bucket_by_blocks", "mirror")}
        return CachedLoader(arrays, data["batch_size"], train=True, **options)
    batch = arrays.batch(np.arange(len(arrays)))
    samples = [{name: tensor[i] for name, tensor in batch.items()} for i in range(len(arrays))]
    return DataLoader(samples, data["batch_size"], shuffle=True)  # type: ignore[arg-type]


def build(init_args: dict[str, Any], network: str) -> DDPM:
    """The training module of a configuration, with its own network or one of the other two."""
    from torch import Tensor, nn

    from stackgen.models.diffusion.module import DDPM
    from stackgen.models.diffusion.network import DiffusionConfig
    from stackgen.models.diffusion.schedules import ScheduleConfig
    from stackgen.models.optimization import OptimizerConfig
    from stackgen.models.transformer import TransformerConfig
    from stackgen.world import PAPER_WORLD

    denoiser = TransformerConfig(**init_args["denoiser"])
    if network != "config":
        denoiser = dataclasses.replace(
            denoiser,
            conditioning="joint",
            mask_padding=False,
            patch=16,
            stride=16,
            ordered=False,
            self_conditioning=False,
        )
    module = DDPM(
        denoiser,
        ScheduleConfig(**init_args.get("schedule", {})),
        DiffusionConfig(**init_args.get("diffusion", {})),
        OptimizerConfig(**init_args.get("optimizer", {})),
        init_args.get("draws", 1) if network == "config" else 1,  # the joint encoder gains nothing from several
    )
    module.build(PAPER_WORLD)
    if network in ("torch", "plain"):

        class TorchEncoder(nn.Module):
            """All layers as one of Denoiser's."""

            def __init__(self, c: TransformerConfig) -> None:
                super().__init__()
                layer = nn.TransformerEncoderLayer(c.width, c.heads, c.feedforward, c.dropout, batch_first=True)
                self.encoder = nn.TransformerEncoder(layer, c.layers)

            def forward(self, x: Tensor, seen: Tensor | None) -> Tensor:
                return self.encoder(x)

        module.model.denoiser.layers = nn.ModuleList([TorchEncoder(denoiser)])
    return module


def _stopwatch(warmup: int) -> Any:
    """A callback that times the steps after the first `warmup` and counts their samples."""
    from lightning.pytorch import Callback

    class Stopwatch(Callback):
        begin = end = 0.0
        samples = 0

        def on_train_batch_end(self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
            self.end = time.perf_counter()
            if trainer.global_step <= warmup:
                self.begin = self.end
            else:
                self.samples += len(batch["mask"])

    return Stopwatch()


if __name__ == "__main__":
    start(main)
