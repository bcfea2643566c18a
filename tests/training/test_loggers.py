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
import wandb
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from stackgen.errors import StackgenError
from stackgen.training.loggers import log_picture, loggers
from tests.conftest import Cli
from tests.training.test_callbacks import trainer_for

pytestmark = pytest.mark.filterwarnings("ignore")

TINY = """
name: seen
trainer:
  max_epochs: 2
  log_every_n_steps: 1
  enable_progress_bar: false
  enable_model_summary: false
  callbacks:
    - class_path: stackgen.training.SampleQuality
      init_args: {{every_n_epochs: 2, num_scenes: 4, num_samples: 2, num_pictures: 3}}
    - class_path: stackgen.training.Throughput
      init_args: {{every_n_steps: 1}}
model:
  class_path: stackgen.models.DDPM
  init_args:
    denoiser: {{width: 32, layers: 1, heads: 2, feedforward: 64}}
data: {{path: {data}, batch_size: 16}}
"""

CURVES = {
    *("train/loss", "train/learning_rate", "train/gradient_norm", "train/samples_per_second"),
    *("validation/loss", *(f"validation/loss_t{q}of4" for q in (1, 2, 3, 4))),
    *("sample/stability", "sample/front_iou", "sample/diversity", "sample/valid_diversity"),
}


def test_pictures_go_to_every_logger(tmp_path: Path) -> None:
    both: list[Any] = [CSVLogger(tmp_path, "a", "b"), TensorBoardLogger(tmp_path, "t", "")]
    trainer = trainer_for(tmp_path, [], logger=both)
    picture = np.full((40, 60, 3), 7, np.uint8)
    log_picture(trainer, "sample/scenes", picture)
    with Image.open(tmp_path / "a/b/pictures/sample/scenes/000000.png") as image:
        assert np.array_equal(np.asarray(image), picture)
    both[1].experiment.flush()
    events = EventAccumulator(str(tmp_path / "t")).Reload()
    assert events.Tags()["images"] == ["sample/scenes"]


def test_tensorboard_that_is_not_installed_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    with pytest.raises(StackgenError, match=r"pip install 'stackgen\[tensorboard\]'"):
        loggers(tmp_path, "tensorboard")
    assert [type(logger) for logger in loggers(tmp_path, "none")] == [CSVLogger]


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
