"""The two heads of the block-list network, alike in everything else, after a short training in the same world.

`classes` is the paper's, `chain` ours for worlds of many lists. Trained on the training split, measured on stacks of
the validation split, evenly spaced; intervals are 95 %, clustered by template.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from benchmarks.common import argument_parser, plain_table, report, start

if TYPE_CHECKING:
    from stackgen.data.arrays import StackArrays
    from stackgen.models.block_list.network import BlockListNetwork

HEADS = ("classes", "chain")


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--data", type=Path, default=Path("data/base.npz"), help="dataset folder or .npz")
    options.add_argument("--heads", nargs="+", choices=HEADS, default=list(HEADS), help="heads to train")
    options.add_argument("--steps", type=int, default=300, help="steps of training")
    options.add_argument("--batch_size", type=int, default=128, help="pictures of a step")
    options.add_argument("--number", type=int, default=1000, help="validation stacks")
    options.add_argument("--seed", type=int, default=0, help="seed of the weights and the order of the stacks")
    return options


def main() -> None:
    """Train and measure each head."""
    options = parser().parse_args()
    rows = [measure(options, head) for head in options.heads]
    cells = [[row["head"], *(_text(row[name]) for name in ("loss", "exact", "top3"))] for row in rows]
    headings = ("head", "cross-entropy", "exact match", "among the first 3")
    metrics = {"data": str(options.data), "steps": options.steps, "number": options.number, "seed": options.seed}
    title = f"Block lists after {options.steps} steps of {options.batch_size}, n = {options.number}"
    report("block_list_heads", {**metrics, "rows": rows}, [plain_table(title, headings, cells)], options.out)


def measure(options: argparse.Namespace, head: Literal["classes", "chain"]) -> dict[str, Any]:
    """Train a network with one head, and ask it."""
    import numpy as np
    import torch

    from stackgen.data.dataset import Dataset
    from stackgen.evaluation.intervals import clustered_ratio
    from stackgen.models.block_list.network import BlockListNetwork, CNNConfig

    dataset = Dataset.open(options.data)
    torch.manual_seed(options.seed)
    small = CNNConfig(channels=24, layers=2, stem_stride=7, pool=5, hidden=128)
    network = BlockListNetwork(replace(small, head=head), dataset.world)
    train(network, dataset.split("train"), options)
    found = dataset.split("validation")
    asked = found.select(np.linspace(0, len(found) - 1, options.number).astype(int))
    parts = [asked.batch(part) for part in np.array_split(np.arange(len(asked)), max(1, len(asked) // 250))]
    network.eval()
    with torch.inference_mode():
        losses = [-network(part["silhouette"], part["counts"][:, None])[:, 0] for part in parts]
        hits = [(network.best(part["silhouette"], 3) == part["counts"][:, None]).all(-1) for part in parts]
    right = torch.cat(hits)
    metrics = {"loss": torch.cat(losses), "exact": right[:, 0], "top3": right.any(1)}
    _, scene = np.unique(asked.template, return_inverse=True)
    estimates = {
        name: clustered_ratio(np.bincount(scene, values.double().numpy()), np.bincount(scene))
        for name, values in metrics.items()
    }
    return {"head": head, **{name: estimate and estimate.to_json() for name, estimate in estimates.items()}}


def _text(estimate: dict[str, float]) -> str:
    return f"{estimate['value']:.3f} {estimate['low']:.3f}-{estimate['high']:.3f}"


def train(network: BlockListNetwork, arrays: StackArrays, options: argparse.Namespace) -> None:
    """A single cycle of the learning rate."""
    import numpy as np
    import torch

    rng = np.random.default_rng(options.seed)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=0.05)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, options.steps)
    for _ in range(options.steps):
        batch = arrays.batch(rng.integers(0, len(arrays), options.batch_size))
        loss = -network(batch["silhouette"], batch["counts"][:, None]).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()


if __name__ == "__main__":
    start(main)
