"""docs/extending.md: what it shows is in examples/extending, short, and works."""

from __future__ import annotations

import importlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from stackgen.commands.generate import COMMAND as GENERATE
from stackgen.data.dataset import Dataset
from stackgen.data.generation.settings import GenerateSettings
from stackgen.evaluation.metrics import METRICS, SampleScore, SceneScore
from stackgen.models.weights import last_checkpoint
from tests.conftest import Cli, TinyWeights

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples" / "extending"
PAGE = ROOT / "docs" / "extending.md"


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a user works: in a folder of their own, their files on the path."""
    monkeypatch.syspath_prepend(str(ROOT))
    monkeypatch.setenv("WANDB_MODE", "disabled")
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("path", sorted(EXAMPLES.iterdir()), ids=lambda path: path.name)
def test_an_example_is_short_and_on_the_page(path: Path) -> None:
    if path.suffix not in (".py", ".yaml"):
        pytest.skip("no example")
    assert len(path.read_text().splitlines()) < 60
    assert f"../examples/extending/{path.name}" in PAGE.read_text()


def test_a_model_of_one_s_own_is_trained_watched_and_measured(
    cli: Cli, outside: None, no_new_metrics: None, towers_dataset: Path, tiny: TinyWeights
) -> None:
    small = ["--model.width", 8, "--trainer.max_steps", 4, "--trainer.log_every_n_steps", 1]
    quiet = ["--trainer.enable_progress_bar", "false", "--trainer.enable_model_summary", "false"]
    data = ["--data.path", towers_dataset, "--data.batch_size", 24]
    answer = cli("fit", "--config", EXAMPLES / "model.yaml", *data, *small, *quiet)
    assert answer.code == 0, answer.err
    text = Path("runs/silhouette-mlp/version_0/metrics.csv").read_text()
    assert "sample/best_of_all" in text and "validation/loss" in text
    weights = "{class_path: examples.extending.sampler.MLPSampler, init_args: {trained: CKPT}}"
    weights = weights.replace("CKPT", str(last_checkpoint(Path("runs/silhouette-mlp"))))
    row = measured(cli, weights, towers_dataset, tiny)
    assert row["method"] == "MLPSampler" and "best_of_all" in row["metrics"]


def test_a_method_that_learns_nothing_is_measured(
    cli: Cli, outside: None, towers_dataset: Path, tiny: TinyWeights
) -> None:
    row = measured(cli, "{class_path: examples.extending.columns.Columns}", towers_dataset, tiny)
    assert row["metrics"]["stability"]["value"] > 0.9 and row["metrics"]["front_iou"]["value"] > 0.5


def measured(cli: Cli, weights: str, dataset: Path, tiny: TinyWeights) -> dict[str, Any]:
    """The first row of `stackgen test`."""
    options = ["--block_list_weights", tiny.predictor, "--predicted_lists", "false", "--test_set", dataset]
    answer = cli("test", "--weights", weights, *options)
    assert answer.code == 0, answer.err
    return json.loads(Path("runs/run/test_0/metrics.json").read_text())["rows"][0]


def test_a_metric_of_one_s_own_is_measured_with_the_others(no_new_metrics: None) -> None:
    good, bad = (SampleScore(stable, {"front": 0.9 * stable}, 0.9, ()) for stable in (True, False))
    before = set(METRICS)
    importlib.import_module("examples.extending.metric")
    assert set(METRICS) == {*before, "best_of_all"}
    assert [METRICS["best_of_all"](SceneScore(samples)) for samples in ((good, bad), (bad, bad))] == [(1, 1), (0, 1)]


def test_a_shape_of_one_s_own_is_data(tmp_path: Path) -> None:
    content = yaml.safe_load(io.StringIO((EXAMPLES / "shape.yaml").read_text()))
    parser = GENERATE.parser()
    values = parser.instantiate(parser.parse_args(["--config", str(EXAMPLES / "shape.yaml"), "--out", str(tmp_path)]))
    settings = GenerateSettings(**{name: values[name] for name in GenerateSettings.__dataclass_fields__})
    assert settings.catalogue.names[-1] == "trapezoid" == content["template"]["top_row_only"][0]
    assert settings.catalogue[-1].volume == pytest.approx(0.75)
    assert np.ptp(np.array(settings.catalogue[-1].outline)[:, 0]) == 1


def test_a_shape_of_one_s_own_is_generated_and_repaired(cli: Cli, tmp_path: Path) -> None:
    """Settings are checked against their own catalogue, wherever they are written down and read back."""
    out = tmp_path / "trapezoids"
    words = ["--stacks", 6, "--templates_per_shard", 1, "--workers", 1, "--out", out]
    answer = cli("generate", "--config", EXAMPLES / "shape.yaml", *words)
    assert answer.code == 0, answer.err
    dataset = Dataset.open(out)
    settings = GenerateSettings.from_manifest(dataset.manifest)
    assert settings.template.top_row_only == ("trapezoid",) and settings.world == dataset.world
    victim = out / dataset.manifest.shards[0]["file"]
    whole = victim.read_bytes()
    victim.unlink()
    answer = cli("dataset", "repair", out, "--workers", 1)
    assert answer.code == 0 and victim.read_bytes() == whole
    assert cli("dataset", "verify", out).code == 0
