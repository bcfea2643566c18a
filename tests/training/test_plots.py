"""What a person sees while a model trains: curves, pictures and what made them, on every dashboard."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import wandb
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from stackgen._lightning import pl
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import Scene
from stackgen.geometry import silhouette
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.training.plots import StepFigures, log_picture, silhouette_sheet
from stackgen.training.sweeps.telling import METRICS_FILE, TellSweep
from stackgen.viz.render import FALLEN
from tests.conftest import Cli
from tests.training.test_callbacks import Module, batches, trainer_for

pytestmark = pytest.mark.filterwarnings("ignore")

TINY = """
name: seen
trainer:
  max_epochs: 2
  log_every_n_steps: 1
  enable_progress_bar: false
  enable_model_summary: false
  callbacks:
    - class_path: stackgen.training.callbacks.SampleQuality
      init_args: {{every_n_epochs: 2, num_scenes: 4, num_samples: 2, num_pictures: 3}}
    - class_path: stackgen.training.callbacks.Throughput
      init_args: {{every_n_steps: 1}}
model:
  class_path: stackgen.models.diffusion.module.DDPM
  init_args:
    denoiser: {{width: 32, layers: 1, heads: 2, feedforward: 64}}
data: {{path: {data}, batch_size: 16}}
"""

CURVES = {
    *("train/loss", "train/learning_rate", "train/gradient_norm", "train/samples_per_second"),
    *("validation/loss", *(f"validation/loss_t{q}of4" for q in (1, 2, 3, 4))),
    *("sample/stability", "sample/front_iou", "sample/diversity", "sample/valid_diversity"),
}


def cube(z: float = 0.5) -> Stack:
    return Stack(np.array([0]), np.array([[0.0, 0, z, 0, 0, 0]]))


def test_the_norm_is_that_of_all_gradients_before_they_are_clipped(tmp_path: Path) -> None:
    trainer = trainer_for(tmp_path, [StepFigures(every_n_steps=1)], gradient_clip_val=0.1)
    trainer.fit(Module(), batches(3))
    figures = trainer.callback_metrics
    assert float(figures["train/gradient_norm"]) == pytest.approx(2**0.5)  # of a loss -(w1 + w2)
    assert float(figures["train/learning_rate"]) == 1.0
    with pytest.raises(StackgenError, match="at least 1"):
        StepFigures(0)


def test_a_column_shows_target_generated_and_settled() -> None:
    scenes = [Scene("a", silhouette(cube()), np.array([1, 0, 0, 0]))] * 2
    fell = Verdict(False, np.array([True]), np.array([2.0]), cube())
    sheet = silhouette_sheet(scenes, [cube(), cube(2.5)], [None, fell])
    red = (sheet == FALLEN).all(axis=-1)
    assert red[:, : sheet.shape[1] // 2].sum() == 0  # no verdict, no settled silhouette
    settled = int(silhouette(cube()).sum()) * 4
    assert settled <= red.sum() <= settled + 400  # and the words below it
    targets = (sheet[: sheet.shape[0] // 3] == (40, 42, 48)).all(axis=-1)
    assert targets.sum() >= 2 * settled


def test_scenes_that_do_not_fit_beside_each_other_go_below(tmp_path: Path) -> None:
    scene = Scene("a", silhouette(cube()), np.array([1, 0, 0, 0]))
    sheets = [silhouette_sheet([scene] * n, [cube()] * n, [None] * n) for n in (4, 5, 8)]
    four, five, eight = (sheet.shape for sheet in sheets)
    assert four[1] == five[1] == eight[1] and four[0] < five[0] == eight[0]
    ink = [int((sheet[:, 122:] == (40, 42, 48)).all(axis=-1).sum()) for sheet in sheets]
    assert ink[0] // 4 == ink[1] // 5 == ink[2] // 8 == 8 * int(silhouette(cube()).sum())


def test_pictures_go_to_every_logger(tmp_path: Path) -> None:
    loggers: list[Any] = [CSVLogger(tmp_path, "a", "b"), TensorBoardLogger(tmp_path, "t", "")]
    trainer = trainer_for(tmp_path, [], logger=loggers)
    picture = np.full((40, 60, 3), 7, np.uint8)
    log_picture(trainer, "sample/scenes", picture)
    with Image.open(tmp_path / "a/b/pictures/sample/scenes/000000.png") as image:
        assert np.array_equal(np.asarray(image), picture)
    loggers[1].experiment.flush()
    events = EventAccumulator(str(tmp_path / "t")).Reload()
    assert events.Tags()["images"] == ["sample/scenes"]


def test_tensorboard_has_all_curves_pictures_and_the_configuration(
    cli: Cli, towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tiny.yaml").write_text(TINY.format(data=towers_dataset))
    answer = cli("fit", "--config", "tiny.yaml", "--dashboard", "tensorboard")
    assert answer.code == 0, answer.err
    events = EventAccumulator("runs/seen/version_0", size_guidance={"images": 0}).Reload()
    tags = events.Tags()
    assert set(tags["scalars"]) >= CURVES
    assert tags["images"] == ["sample/scenes"]
    (text,) = events.Tensors("configuration/text_summary")
    assert b"width: 32" in text.tensor_proto.string_val[0] and b"sha256" in text.tensor_proto.string_val[0]
    assert len(events.Scalars("train/gradient_norm")) == 6
    assert all(0 <= event.value <= 1 for event in events.Scalars("sample/stability"))
    assert "width: 32" in Path("runs/seen/version_0/hparams.yaml").read_text()


def records_of(run: Path) -> list[dict[str, Any]]:
    """What wandb's own reader finds in an offline run; none while the file has just been begun."""
    command = [str(Path(sys.executable).with_name("wandb")), "leet", "inspect", "--json", str(run)]
    done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=120)
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.slow
def test_wandb_offline_writes_a_run_that_can_be_synced(
    cli: Cli, towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_API_KEY", "x" * 40)
    wandb.finish()  # the run of another test of this process
    wandb.teardown()  # and what writes it, in the folder where it began
    Path("tiny.yaml").write_text(TINY.format(data=towers_dataset))
    answer = cli("fit", "--config", "tiny.yaml", "--dashboard", "wandb-offline")
    assert answer.code == 0, answer.err
    wandb.finish()  # as at the end of the process
    folder = Path("runs/seen/version_0/wandb")
    (run,) = folder.glob("offline-run-*/*.wandb")
    until = time.monotonic() + 60  # wandb's own process writes it
    records: list[dict[str, Any]] = []
    while "exit" not in {record["type"] for record in records}:
        assert time.monotonic() < until, "wandb does not end"
        time.sleep(0.2)
        records = records_of(run)
    rows = [record["history"]["item"] for record in records if record["type"] == "history"]
    assert {name for row in rows for name in row} >= CURVES
    (picture,) = [row for row in rows if "sample/scenes.filenames" in row]
    assert picture["trainer/global_step"] == 6
    (media,) = run.parent.glob("files/media/images/sample/scenes_*.png")
    assert media.read_bytes() == Path("runs/seen/version_0/pictures/sample/scenes/000006.png").read_bytes()
    (artifact,) = [record["artifact"] for record in records if record["type"] == "artifact"]
    (file,) = artifact["manifest"]["contents"]
    assert artifact["type"] == "model" and file["path"] == "model.ckpt"
    kept = Path(file["local_path"])
    assert kept.parent == (tmp_path / "runs/seen/version_0/checkpoints").resolve() and kept.is_file()
    (config,) = [json.dumps(record) for record in records if record["type"] == "config"]
    assert "width" in config and "sha256" in config


def test_a_sweep_is_told_after_each_validation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Logging(Module):
        def validation_step(self, batch: Any, batch_idx: int) -> None:
            self.log("score", self.weight[0])

    told = tmp_path / "told.jsonl"
    monkeypatch.setenv(METRICS_FILE, str(told))
    trainer = trainer_for(tmp_path, [TellSweep()], max_epochs=3, num_sanity_val_steps=1)
    trainer.fit(Logging(), batches(2), batches(1))
    lines = [json.loads(line) for line in told.read_text().splitlines()]
    assert [(line["step"], line["score"]) for line in lines] == [(2, 2), (4, 4), (6, 6)]
    assert isinstance(trainer, pl.Trainer) and torch.is_tensor(trainer.callback_metrics["score"])
