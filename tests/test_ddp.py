"""Two processes train as one does with the same global batch; a run goes on with another number of them."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.conftest import CHILD

pytestmark = pytest.mark.slow

# Tran-Reg draws no noise: two processes can differ from one by rounding alone.
CONFIG = """
name: many
trainer: {{max_epochs: 4, accelerator: cpu, log_every_n_steps: 1, enable_progress_bar: false,
          enable_model_summary: false, callbacks: [{{class_path: stackgen.callbacks.EMA}},
          {{class_path: stackgen.callbacks.SampleQuality, init_args: {{every_n_epochs: 2, num_scenes: 12}}}},
          {{class_path: lightning.pytorch.callbacks.ModelCheckpoint,
            init_args: {{every_n_epochs: 2, save_top_k: -1, save_last: true, filename: "{{epoch}}"}}}}]}}
model:
  class_path: stackgen.baselines.tran_reg.TranReg
  init_args:
    transformer: {{width: 32, layers: 1, heads: 2, feedforward: 64, conditioning: cross, mask_padding: true,
                  ordered: true}}
    regression: {{assignment: raster}}
    optimizer: {{learning_rate: 0.01, warmup: 2}}
data: {{path: {data}, mirror: true}}
"""


def fit(folder: Path, processes: int, batch: int, *options: str) -> list[dict[str, str]]:
    """Train in `folder`; the rows of metrics.csv."""
    command = [sys.executable, "-m", "stackgen", "fit", "--config", str(folder / "many.yaml"), "--dashboard", "none"]
    command += [
        "--trainer.devices",
        str(processes),
        "--data.batch_size",
        str(batch),
        "--name",
        f"p{processes}",
        *options,
    ]
    strategy = ["--trainer.strategy", "ddp"] if processes > 1 else []
    done = subprocess.run(
        [*command, *strategy], cwd=folder, env=CHILD, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    last = max((folder / "runs" / f"p{processes}").glob("version_*"), key=lambda path: int(path.name[8:]))
    with (last / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def column(rows: list[dict[str, str]], name: str) -> list[float]:
    return [float(row[name]) for row in rows if row.get(name)]


def weights(folder: Path, run: str) -> dict[str, torch.Tensor]:
    return torch.load(folder / "runs" / run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def test_two_processes_are_one_with_their_batches_together(towers_dataset: Path, tmp_path: Path) -> None:
    """48 samples, of which an epoch takes two steps of 20; 12 scenes to validate on, shared between them."""
    (tmp_path / "many.yaml").write_text(CONFIG.format(data=towers_dataset))
    alone, together = fit(tmp_path, 1, 20), fit(tmp_path, 2, 10)
    for name in ("validation/loss", "sample/stability", "sample/front_iou_before_physics"):
        assert len(column(alone, name)) == (4 if name == "validation/loss" else 2)
        assert column(together, name) == pytest.approx(column(alone, name), rel=1e-3, abs=1e-5), name
    assert len(column(together, "train/loss")) == len(column(alone, "train/loss")) == 8  # equal epochs
    one, two = weights(tmp_path, "p1/version_0"), weights(tmp_path, "p2/version_0")
    assert all(torch.allclose(one[name], two[name], rtol=1e-3, atol=1e-4) for name in one)
    # Two epochs on two processes, two more on one: the same again.
    middle = next((tmp_path / "runs/p2/version_0/checkpoints").glob("*epoch=1*.ckpt"))
    resumed = fit(tmp_path, 1, 20, "--ckpt_path", str(middle))
    assert column(resumed, "validation/loss") == pytest.approx(column(alone, "validation/loss")[2:], rel=1e-3, abs=1e-5)
    last = weights(tmp_path, "p1/version_1")
    assert all(torch.allclose(one[name], last[name], rtol=1e-3, atol=1e-4) for name in one)
