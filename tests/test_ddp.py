"""Two processes train as one does with the same global batch; a run goes on with another number of them."""

from __future__ import annotations

import csv
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from stackgen.data.datamodule import StackDataModule
from stackgen.data.loading.passes import exact_batches
from stackgen.models.diffusion.module import DDPM
from stackgen.models.transformer import TransformerConfig
from tests.conftest import CHILD, write_towers

pytestmark = pytest.mark.slow

# Tran-Reg draws no noise: two processes can differ from one by rounding alone.
CONFIG = """
name: many
trainer: {{max_epochs: 4, accelerator: cpu, log_every_n_steps: 1, enable_progress_bar: false,
          enable_model_summary: false, callbacks: [{{class_path: stackgen.training.EMA}},
          {{class_path: stackgen.training.SampleQuality, init_args: {{every_n_epochs: 2, num_scenes: 12}}}},
          {{class_path: lightning.pytorch.callbacks.ModelCheckpoint,
            init_args: {{every_n_epochs: 2, save_top_k: -1, save_last: true, filename: "{{epoch}}"}}}}]}}
model:
  class_path: stackgen.baselines.TranReg
  init_args:
    transformer: {{width: 32, layers: 1, heads: 2, feedforward: 64, conditioning: cross, mask_padding: true,
                  ordered: true}}
    regression: {{assignment: raster}}
    optimizer: {{learning_rate: 0.01, warmup: 2}}
data: {{path: {data}, mirror: true}}
"""


def command(folder: Path, name: str, batch: int, *options: str) -> list[str]:
    """Of a fit in `folder`."""
    fit = [sys.executable, "-m", "stackgen", "fit", "--config", str(folder / "many.yaml"), "--dashboard", "none"]
    return [*fit, "--data.batch_size", str(batch), "--name", name, *options]


def fit(folder: Path, processes: int, batch: int, *options: str) -> list[dict[str, str]]:
    """Train in `folder`; the rows of metrics.csv."""
    many = ["--trainer.strategy", "ddp"] if processes > 1 else []
    done = subprocess.run(
        command(folder, f"p{processes}", batch, "--trainer.devices", str(processes), *many, *options),
        cwd=folder, env=CHILD, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return rows(max((folder / "runs" / f"p{processes}").glob("version_*"), key=lambda path: int(path.name[8:])))


def fit_on_two_machines(folder: Path, batch: int, *options: str) -> None:
    """Train in `folder` as two machines of one process each do that share their disk; neither starts the other."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = {**CHILD, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
    settings = ["--trainer.devices", "1", "--trainer.num_nodes", "2", "--trainer.strategy", "ddp", *options]
    machines = [
        subprocess.Popen(
            command(folder, "machines", batch, *settings),
            cwd=folder, env={**place, "NODE_RANK": str(number)}, stderr=subprocess.PIPE, text=True,
        )
        for number in range(2)
    ]  # fmt: skip
    try:
        said = [machine.communicate(timeout=600)[1] for machine in machines]
    finally:
        for machine in machines:
            machine.kill()
    assert [machine.returncode for machine in machines] == [0, 0], said


def rows(run: Path) -> list[dict[str, str]]:
    with (run / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def column(rows: list[dict[str, str]], name: str) -> list[float]:
    return [float(row[name]) for row in rows if row.get(name)]


def weights(folder: Path, run: str) -> dict[str, torch.Tensor]:
    return torch.load(folder / "runs" / run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def test_two_processes_are_one_with_their_batches_together(tmp_path: Path) -> None:
    """45 samples, of which an epoch takes two steps of 20; 11 scenes to validate on, 6 and 5."""
    data = write_towers(tmp_path / "data", {"train": 45, "validation": 11})
    (tmp_path / "many.yaml").write_text(CONFIG.format(data=data))
    alone, together = fit(tmp_path, 1, 20), fit(tmp_path, 2, 10)
    sampled = ("stability", "front_iou_before_physics", "diversity")
    for name in ("validation/loss", *(f"sample/{name}" for name in sampled)):
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


SHORT = """
trainer: {{max_epochs: 2, accelerator: cpu, log_every_n_steps: 1, enable_progress_bar: false,
          enable_model_summary: false, accumulate_grad_batches: 2}}
model:
  class_path: stackgen.models.DDPM
  init_args: {{denoiser: {{width: 32, layers: 1, heads: 2, feedforward: 64}}}}
data: {{path: {data}, bucket_by_blocks: true, eval_batch_size: 2}}
"""


def test_machines_with_short_shares_wait_for_nobody_and_weigh_them_right(tmp_path: Path) -> None:
    """Of 14 towers, the 5, 5 and 4 of one height are short steps of 4, 2 + 2 on each machine; 3 scenes to validate on
    are one batch of two and one of one, and not every quarter of the noise steps occurs on either."""
    data = write_towers(tmp_path / "data", {"train": 14, "validation": 3})
    (tmp_path / "many.yaml").write_text(SHORT.format(data=data))
    fit_on_two_machines(tmp_path, 16)
    (run,) = (tmp_path / "runs" / "machines").iterdir()  # one folder for both
    found = rows(run)
    assert len(column(found, "train/loss")) == 2 * 2  # three batches, two steps an epoch
    losses, quarters = validated(run, data)
    assert column(found, "validation/loss")[-1] == pytest.approx(losses.mean().item(), rel=1e-4)
    for q in range(4):
        of_all = losses[quarters == q]
        if len(of_all):
            logged = column(found, f"validation/loss_t{q + 1}of4")[-1]
            assert logged == pytest.approx(of_all.mean().item(), rel=1e-4), q


def validated(run: Path, data: Path) -> tuple[torch.Tensor, torch.Tensor]:
    """Loss and quarter of the noise steps of each validation scene, as the machines of a run draw their noise."""
    content = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    module = DDPM(TransformerConfig(width=32, layers=1, heads=2, feedforward=64))
    module.on_load_checkpoint(content)
    module.load_state_dict(content["state_dict"])
    module.eval()
    split = StackDataModule(data).split("validation")
    losses, quarters = [], []
    for rank in range(2):
        for index, share in enumerate(exact_batches(len(split), 2, (rank, 2))):
            loss, t = module.model.loss(split.batch(share), 1, torch.Generator().manual_seed(index))
            losses.append(loss.detach())
            quarters.append((t - 1) * 4 // 50)
    return torch.cat(losses), torch.cat(quarters)
