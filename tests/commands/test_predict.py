"""stackgen predict: a stacks file for each scene, of the stacks that `stackgen test` measures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stackgen.evaluation.results import read_evaluation
from stackgen.io.stacks_file import read_stacks
from tests.conftest import Cli, TinyWeights


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs go below the test's own folder."""
    monkeypatch.chdir(tmp_path)


def test_predict_writes_a_stacks_file_for_each_scene(cli: Cli, tiny: TinyWeights, towers_dataset: Path) -> None:
    options = ["--test_set", towers_dataset, "--weights", tiny.sampler, "--num_samples", 2, "--batch_size", 5]
    answer = cli("predict", *options, "--runs", "out")
    assert answer.code == 0, answer.err
    files = sorted(Path("out/run/predict_0").glob("*-t*.json"))
    assert len(files) == 12
    content = read_stacks(files[1])
    assert content.target is not None and content.block_list is not None
    assert content.block_list.tolist() == [2, 0, 0, 0]
    assert [stack.names for stack in content.stacks] == [["cube", "cube"]] * 2


def test_the_stacks_are_those_that_a_test_measures(cli: Cli, tiny: TinyWeights, towers_dataset: Path) -> None:
    weights = ["--weights", tiny.sampler, "--block_list_weights", tiny.predictor]
    options = ["--test_set", towers_dataset, *weights, "--num_samples", 1, "--limit", 6, "--batch_size", 4]
    assert cli("test", *options).code == 0
    for lists, kind in (("false", "true"), ("true", "predicted")):
        answer = cli("predict", *options, "--predicted_lists", lists, "--name", kind)
        assert answer.code == 0, answer.err
        evaluation, _ = read_evaluation(Path(f"runs/run/test_0/evaluation-{kind}.json"))
        for scene in evaluation.scenes:
            content = read_stacks(Path(f"runs/{kind}/predict_0/{scene.name}.json"))
            assert np.allclose(content.stacks[0].poses, scene.stacks[0].poses, atol=1e-6)
            assert content.block_list_source == ("cnn" if lists == "true" else "given")


def test_other_splits_can_be_asked_about(cli: Cli, tiny: TinyWeights, towers_dataset: Path) -> None:
    options = ["--test_set", towers_dataset, "--weights", tiny.sampler, "--limit", 2]
    assert cli("predict", *options, "--split", "train").code == 0
    assert len(list(Path("runs/run/predict_0").glob("*-t*.json"))) == 2
    assert "split" in cli("predict", *options, "--split", "all").line
