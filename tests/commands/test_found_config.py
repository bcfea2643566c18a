"""What is found beside a checkpoint names no code, no command, no place afar and no folder to write to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from stackgen.commands.found_config import taken_from
from stackgen.errors import StackgenError
from tests.conftest import Cli

SECTIONS = ("name", "model", "data", "trainer")
EVIL = "evil_module.Evil"
SAVED: dict[str, Any] = {
    "name": "tiny",
    "model": {"class_path": "stackgen.models.DDPM", "init_args": {"denoiser": {"conditioning": "cross"}}},
    "data": {"path": "data/paper.npz", "mode": "auto"},
    "trainer": {
        "precision": "16-mixed",
        "max_time": "00:00:10:00",
        "default_root_dir": "runs",
        "callbacks": [
            {"class_path": "stackgen.training.StartFrom", "init_args": {"weights": "runs/ddpm.safetensors"}},
            {"class_path": "stackgen.training.Compile", "init_args": {"parts": ["model.denoiser"]}},
        ],
    },
    "ckpt_path": None,
}
HOSTILE: list[tuple[str, Any]] = [
    ("model.class_path", EVIL),
    ("model.dict_kwargs", {"x": 1}),
    ("model.init_args.denoiser", EVIL),
    ("model.init_args.optimizer", {"class_path": EVIL}),
    ("data.path", "pipe:touch pwned"),
    ("data.path", ["data/paper", "pipe:touch pwned"]),
    ("data.path", "https://host/data"),
    ("data.path", "simplecache::s3://host/data"),
    ("data.test_path", "pipe:touch pwned"),
    ("data.path", "${oc.env:SECRET}"),
    ("trainer.default_root_dir", "/etc"),
    ("trainer.default_root_dir", "../elsewhere"),
    ("trainer.logger", EVIL),
    ("trainer.logger", {"class_path": "lightning.pytorch.loggers.CSVLogger", "init_args": {"save_dir": "/"}}),
    ("trainer.plugins", [EVIL]),
    ("trainer.strategy", EVIL),
    ("trainer.callbacks", EVIL),
    ("trainer.callbacks", [EVIL]),
    ("trainer.callbacks", [{"class_path": "stackgen.training.SampleQuality", "init_args": {"checker": EVIL}}]),
    ("trainer.callbacks", [{"class_path": "lightning.pytorch.callbacks.ModelCheckpoint",
                            "init_args": {"dirpath": "/root"}}]),
    ("trainer.callbacks", [{"class_path": "lightning.pytorch.callbacks.ModelCheckpoint",
                            "init_args": {"filename": "../../x"}}]),
]  # fmt: skip


def with_value(place: str, value: Any) -> dict[str, Any]:
    changed = yaml.safe_load(yaml.safe_dump(SAVED))
    *parents, key = place.split(".")
    inner = changed
    for parent in parents:
        inner = inner[parent]
    inner[key] = value
    return changed


def test_a_configuration_of_our_own_is_taken_whole() -> None:
    assert taken_from(SAVED, Path("x/config.yaml"), (), SECTIONS) == {name: SAVED[name] for name in SECTIONS}


@pytest.mark.parametrize(("place", "value"), HOSTILE)
def test_what_is_foreign_is_refused_in_one_line_and_may_be_typed_instead(place: str, value: Any) -> None:
    found = with_value(place, value)
    with pytest.raises(StackgenError, match=r"found beside the checkpoint.*--config x/config.yaml") as refused:
        taken_from(found, Path("x/config.yaml"), (), SECTIONS)
    assert str(refused.value).isprintable()
    taken = taken_from(found, Path("x/config.yaml"), {place}, SECTIONS)
    assert str(value) not in str(taken)


@pytest.mark.parametrize("content", [None, [], "x", {}, {"model": EVIL}])
def test_what_is_no_configuration_of_a_run_is_refused(content: Any) -> None:
    with pytest.raises(StackgenError, match="no configuration of a run"):
        taken_from(content, Path("x/config.yaml"), (), SECTIONS)


def test_a_file_s_name_is_no_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The parser takes the name of a file for a group of options, and reads it."""
    monkeypatch.chdir(tmp_path)
    Path("cross").write_text("class_path: evil")
    with pytest.raises(StackgenError, match="conditioning"):
        taken_from(SAVED, Path("x/config.yaml"), (), SECTIONS)


@pytest.mark.parametrize("verb", ["fit", "validate"])
def test_a_downloaded_run_runs_nothing(verb: str, cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("evil_module.py").write_text("from pathlib import Path\nPath('imported').touch()\nclass Evil: ...\n")
    run = Path("downloaded/version_0")
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints" / "last.ckpt").write_bytes(b"PK")
    for place, value in HOSTILE[:8]:
        (run / "config.yaml").write_text(yaml.safe_dump(with_value(place, value)))
        for named in (run / "checkpoints" / "last.ckpt", run, run.parent):
            answer = cli(verb, "--ckpt_path", named)
            assert answer.code == 2 and "found beside the checkpoint" in answer.err, answer.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["downloaded", "evil_module.py"]
