"""stackgen prefer: pairs for a model and a dataset of one world, checked with the physics of that dataset."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stackgen.data.dataset import read_manifest
from stackgen.data.preferences import Preferences
from stackgen.errors import StackgenError
from stackgen.protocols import StabilityChecker
from stackgen.world import Grid
from tests.conftest import Cli, TinyWeights


def test_failures_are_paired_with_stacks_that_stand(
    cli: Cli, tiny: TinyWeights, towers_dataset: Path, tmp_path: Path
) -> None:
    options = ["--data", towers_dataset, "--weights", tiny.sampler, "--workers", 1]
    answer = cli("prefer", *options, "--scenes", 2, "--num_samples", 1, "--out", tmp_path / "pairs.npz")
    assert answer.code == 0, answer.err
    assert 1 <= len(Preferences.load(tmp_path / "pairs.npz")) <= 2


def test_scenes_of_several_datasets(cli: Cli, tiny: TinyWeights, towers_dataset: Path, tmp_path: Path) -> None:
    options = ["--weights", tiny.sampler, "--workers", 1, "--scenes", 1, "--out", tmp_path / "pairs.npz"]
    both = f"[{towers_dataset}, {towers_dataset}]"
    assert cli("prefer", "--data", both, *options).code == 0

    other = shutil.copytree(towers_dataset, tmp_path / "slippery")
    content = json.loads((other / "dataset.json").read_text())
    content["physics"]["friction"] = 0.25
    (other / "dataset.json").write_text(json.dumps(content))
    assert "different physics" in cli("prefer", "--data", f"[{towers_dataset}, {other}]", *options).line


def test_stacks_fall_as_they_do_in_the_world_of_the_dataset(
    cli: Cli, tiny: TinyWeights, towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def prefer(sampler: object, checker: StabilityChecker, *args: object, **options: object) -> Preferences:
        raise StackgenError(f"friction {checker.physics.to_json()['friction']}")

    monkeypatch.setattr("stackgen.data.preferences.prefer", prefer)
    slippery = shutil.copytree(towers_dataset, tmp_path / "slippery")
    content: dict[str, Any] = json.loads((slippery / "dataset.json").read_text())
    content["physics"] = {**content["physics"], "friction": 0.25}
    (slippery / "dataset.json").write_text(json.dumps(content))
    options = ["--data", slippery, "--weights", tiny.sampler, "--workers", 1, "--out", tmp_path / "pairs.npz"]
    assert cli("prefer", *options).line == "stackgen prefer: friction 0.25"


@pytest.mark.parametrize("option", [("--seed", -1), ("--workers", 0), ("--scenes", 0)])
def test_numbers_out_of_range_are_one_line(
    option: tuple[str, int], cli: Cli, towers_dataset: Path, tmp_path: Path
) -> None:
    answer = cli("prefer", "--data", towers_dataset, *option, "--out", tmp_path / "pairs.npz")
    assert answer.code == 2 and option[0] in answer.line


def test_another_world_is_refused(cli: Cli, tiny: TinyWeights, towers_dataset: Path, tmp_path: Path) -> None:
    wide = shutil.copytree(towers_dataset, tmp_path / "wide")
    manifest = read_manifest(wide)
    replace(manifest, world=replace(manifest.world, grid=Grid(width=8, height=4))).save(wide)
    options = ["--data", wide, "--weights", tiny.sampler, "--out", tmp_path / "pairs.npz"]
    assert "has another grid than" in cli("prefer", *options).line
