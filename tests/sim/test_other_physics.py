"""Data of another world: training on them warns of the physics that they were made with."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from stackgen.data.dataset import Dataset
from stackgen.sim.other_physics import physics_differences, warn_of_other_physics
from tests.conftest import Cli


def test_other_physics_are_named_once(recwarn: pytest.WarningsRecorder) -> None:
    here = {"engine": "pybullet 3.2.7", "friction": 0.5, "watch": 2.0}
    made = {**here, "friction": 0.25, "engine": "pybullet 3.2.6"}
    for _ in range(2):
        warn_of_other_physics("dataset x", made, here)
    lines = [str(warning.message) for warning in recwarn]
    assert lines == [
        "dataset x was made with other physics than are used here: "
        "engine pybullet 3.2.6 instead of pybullet 3.2.7, friction 0.25 instead of 0.5"
    ]
    for same in (here, None, {"engine": "pybullet absent", "new": 1}):
        warn_of_other_physics("dataset y", same, here)
    assert len(recwarn) == 1
    assert physics_differences({"engine": "other 1"}, here) == ["engine other 1 instead of pybullet 3.2.7"]


TINY = """
trainer: {max_steps: 1, logger: false, enable_checkpointing: false, enable_progress_bar: false,
          enable_model_summary: false, limit_val_batches: 0}
model:
  class_path: stackgen.models.DDPM
  init_args: {denoiser: {width: 32, layers: 1, heads: 2, feedforward: 64}}
"""


@pytest.mark.filterwarnings("ignore::UserWarning:lightning.*", "ignore::FutureWarning")
def test_fit_says_so_once_if_the_data_are_of_other_physics(
    cli: Cli, towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(towers_dataset, "data")
    manifest = Dataset.open("data").manifest
    replace(manifest, physics={**manifest.physics, "watch": 3.0}).save(Path("data"))
    Path("tiny.yaml").write_text(TINY)
    with pytest.warns(UserWarning, match="other physics") as caught:
        answer = cli("fit", "--config", "tiny.yaml", "--data.path", "data")
    assert answer.code == 0, answer.err
    lines = [str(warning.message) for warning in caught if "physics" in str(warning.message)]
    assert lines == ["dataset data was made with other physics than are used here: watch 3.0 instead of 2.0"]
