"""What a user can get wrong gets one line that names it, exit code 2, and leaves nothing behind."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
import torch
from PIL import Image

from stackgen.api import Model
from stackgen.commands.cli import explain
from stackgen.data.dataset import TESTSET
from stackgen.errors import StackgenError
from tests.conftest import CHILD, Answer, Cli, TinyWeights, allow_interrupts, stacks_json


def assert_one_line(answer: Answer, *words: str) -> None:
    assert answer.code == 2
    assert answer.line.startswith("stackgen")
    for word in words:
        assert word in answer.line, answer.line


def files_below(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


# Verbs and options.


def test_unknown_verb_is_answered_with_the_nearest(cli: Cli) -> None:
    assert_one_line(cli("smaple"), "smaple", "did you mean 'sample'")
    assert_one_line(cli("xyz"), "xyz", "sample, check")


@pytest.mark.parametrize("verb", ["sample", "check", "show", "generate", "fit", "test", "export"])
def test_unknown_option_is_named(verb: str, cli: Cli) -> None:
    assert_one_line(cli(verb, "--no_such_option", 3), "no_such_option" if verb in ("fit", "test") else "")


def test_a_misspelt_option_is_answered_with_the_nearest(cli: Cli, tower_image: Path, tmp_path: Path) -> None:
    assert_one_line(cli("sample", tower_image, "--out", tmp_path, "--num_sample", 3), "did you mean --num_samples")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["sample"], "images"),
        (["sample", "a.png"], "out"),
        (["sample", "a.png", "--out", "x", "--num_samples", "many"], "num_samples"),
        (["check"], "file"),
        (["generate", "--out", "x"], "name"),
    ],
)
def test_missing_and_ill_typed_values_are_named(arguments: list[str], word: str, cli: Cli) -> None:
    assert_one_line(cli(*arguments), word, f"stackgen {arguments[0]} --help")


@pytest.mark.parametrize(
    ("verb", "text", "word"),
    [
        ("generate", "name: x\nstacks: 10\nsturdy: true\n", "sturdy"),
        ("generate", "name: x\nstacks: 10\nphysics: {frcition: 0.5}\n", "frcition"),
        ("generate", "name: [x\n", "config"),
        ("fit", "trainer: {max_epoch: 3}\n", "max_epoch"),
        ("fit", "model: {class_path: stackgen.models.DDPM, init_args: {layers: 3}}\n", "layers"),
        ("fit", "model: {class_path: stackgen.models.DDMP}\n", "DDMP"),
        ("fit", "model: {class_path: stackgen.models.DDPM}\ndata: {path: x, sise: 3}\n", "sise"),
    ],
)
def test_a_wrong_key_of_a_config_file_is_named(verb: str, text: str, word: str, cli: Cli, tmp_path: Path) -> None:
    config = tmp_path / "x.yaml"
    config.write_text(text)
    out = ["--out", tmp_path / "data"] if verb == "generate" else []
    assert_one_line(cli(verb, "--config", config, *out), word)
    assert files_below(tmp_path) == ["x.yaml"]


def test_a_missing_config_file_is_named(cli: Cli) -> None:
    assert_one_line(cli("fit", "--config", "no-such.yaml"), "no-such.yaml")


# Images.


def empty(path: Path) -> None:
    path.write_bytes(b"")


def text(path: Path) -> None:
    path.write_text("not a picture")


def truncated(path: Path) -> None:
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (99, 99, 3), dtype=np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:500])


def blank(path: Path) -> None:
    Image.fromarray(np.full((80, 80), 255, dtype=np.uint8)).save(path)


def black(path: Path) -> None:
    Image.fromarray(np.zeros((80, 80), dtype=np.uint8)).save(path)


@pytest.mark.parametrize("make", [empty, text, truncated, blank, black, Path.mkdir, lambda path: None])
def test_a_bad_image_is_named_and_the_good_ones_are_answered(
    make: object, cli: Cli, towers: Model, tower_image: Path, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.png"
    make(bad)  # type: ignore[operator]
    before = files_below(tmp_path)
    assert_one_line(cli("sample", bad, "--out", tmp_path / "out"), "bad.png")
    assert files_below(tmp_path) == before
    assert_one_line(cli("sample", tower_image, bad, "--one_shot", "--out", tmp_path / "out"), "bad.png")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["overview.png", "tower"]


# Block lists and numbers.


@pytest.mark.parametrize(
    ("blocks", "word"),
    [
        ("sphere=1", "sphere"),
        ("cube=-1", "cube=-1"),
        ("cube=1.5", "cube=1.5"),
        ("cube", "cube"),
        ("cube=41", "1 to 40"),
        ("cube=0", "1 to 40"),
        ("", "1 to 40"),
    ],
)
def test_an_impossible_block_list_is_explained(
    blocks: str, word: str, cli: Cli, towers: Model, tower_image: Path, tmp_path: Path
) -> None:
    assert_one_line(cli("sample", tower_image, "--blocks", blocks, "--out", tmp_path / "out"), word)
    assert files_below(tmp_path) == ["tower.png"]


@pytest.mark.parametrize(("option", "value"), [("--num_samples", 0), ("--num_samples", -3), ("--seed", -1)])
def test_numbers_out_of_range_are_explained(
    option: str, value: int, cli: Cli, towers: Model, tower_image: Path, tmp_path: Path
) -> None:
    assert_one_line(cli("sample", tower_image, option, value, "--out", tmp_path / "out"), str(value))
    assert files_below(tmp_path) == ["tower.png"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["predict", "--limit", 1],
        ["generate", "--name", "x", "--stacks", 1, "--out", "x"],
        ["dataset", "info", TESTSET, "--out", "x"],
    ],
)
def test_a_negative_seed_is_one_line(
    arguments: list[object], cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_one_line(cli(*arguments, "--seed", -1), "seed", "at least 0")
    assert files_below(tmp_path) == []


# Stacks files.


@pytest.mark.parametrize("verb", ["check", "show"])
@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("", "empty"),
        ("{", "line 1"),
        ("[1, 2]", "stacks"),
        ('{"format": "other/1"}', "other/1"),
        (json.dumps(stacks_json([("cube", 0, 0.5)]))[:-9], "line 1"),
        (json.dumps(stacks_json([("cone", 0, 0.5)])), "cone"),
        (json.dumps({"format": "stackgen.stacks/1", "stacks": [{"blocks": [{"shape": "cube"}]}]}), "position"),
        (json.dumps(stacks_json([("cube", float("nan"), 0.5)])), "NaN"),
    ],
)
def test_a_malformed_stacks_file_is_explained(verb: str, content: str, word: str, cli: Cli, tmp_path: Path) -> None:
    file = tmp_path / "bad.json"
    file.write_text(content)
    assert_one_line(cli(verb, file), "bad.json", word)
    assert files_below(tmp_path) == ["bad.json"]


def test_a_missing_stacks_file_is_named(cli: Cli, tmp_path: Path) -> None:
    assert_one_line(cli("check", tmp_path / "none.json"), "none.json")


# Weights and checkpoints.


def foreign_pickle(path: Path) -> None:
    torch.save({"state_dict": {}, "x": Path("x")}, path)


def foreign_tensors(path: Path) -> None:
    torch.save({"state_dict": {"w": torch.zeros(3)}}, path)


@pytest.mark.parametrize("make", [empty, text, foreign_pickle, foreign_tensors, lambda path: None])
def test_a_missing_or_foreign_checkpoint_is_named(
    make: object, cli: Cli, tower_image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "bad.ckpt"
    make(path)  # type: ignore[operator]
    before = files_below(tmp_path)
    assert_one_line(cli("sample", tower_image, "--weights", path, "--out", tmp_path / "out"), "bad.ckpt")
    assert_one_line(cli("export", path, "--out", tmp_path / "x.safetensors"), "bad.ckpt")
    fit = ["fit", "--model", "stackgen.models.DDPM", "--data.path", "x"]
    assert_one_line(cli(*fit, "--ckpt_path", path), "bad.ckpt")
    assert_one_line(cli("test", "--ckpt_path", path), "bad.ckpt")
    assert files_below(tmp_path) == before


def test_unknown_weights_are_named(cli: Cli, tower_image: Path, tmp_path: Path) -> None:
    answer = cli("sample", tower_image, "--weights", "no-such-name", "--out", tmp_path / "out")
    assert_one_line(answer, "no-such-name")


def test_weights_of_the_other_network_are_refused(
    cli: Cli, tiny: TinyWeights, tower_image: Path, tmp_path: Path
) -> None:
    answer = cli("sample", tower_image, "--weights", tiny.predictor, "--out", tmp_path / "out")
    assert_one_line(answer, "cnn.safetensors", "sampler")


def test_a_run_without_checkpoint_is_named(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    fit = ["fit", "--model", "stackgen.models.DDPM", "--data.path", "x", "--name", "new"]
    assert_one_line(cli(*fit, "--ckpt_path", "last"), "runs/new")
    assert_one_line(cli(*fit), "no dataset at x")
    assert files_below(tmp_path) == []


# The world around.


def test_an_output_that_is_no_folder_is_named(cli: Cli, towers: Model, tower_image: Path) -> None:
    assert_one_line(cli("sample", tower_image, "--out", tower_image), "tower.png", "not a folder")
    assert_one_line(cli("sample", tower_image, "--out", tower_image / "below"), "tower.png", "not a folder")


def test_a_full_disk_is_named_and_leaves_nothing(
    cli: Cli, towers: Model, tower_image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> NoReturn:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.fsync", full)
    answer = cli("sample", tower_image, "--out", tmp_path / "out")
    assert_one_line(answer, "No space left")
    assert files_below(tmp_path) == ["tower.png"]


def test_errors_of_the_system_are_one_line_and_bugs_are_not() -> None:
    assert "disk full" in (explain(OSError(errno.ENOSPC, "No space left", "x")) or "")
    assert explain(PermissionError(errno.EACCES, "Permission denied", "x")) == "Permission denied: x"
    assert explain(StackgenError("two\nlines")) == "two lines"
    assert explain(ModuleNotFoundError("No module named 'pybullet'", name="pybullet")) is not None
    for bug in (TypeError("x"), KeyError("x"), ModuleNotFoundError("x", name="stackgen.x"), RuntimeError("x")):
        assert explain(bug) is None


def test_ctrl_c_is_one_line_and_130(tmp_path: Path) -> None:
    out = tmp_path / "data"
    command = [sys.executable, "-m", "stackgen", "generate", "--name", "x", "--stacks", "100000"]
    process = subprocess.Popen(
        [*command, "--out", str(out), "--workers", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=CHILD,
        preexec_fn=allow_interrupts,
    )
    while not out.is_dir():
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert_one_line(Answer(2, "", err), "interrupted", str(out))
    assert not list(out.glob("*.tmp")) and not (out / "dataset.json").exists()


@pytest.mark.parametrize(
    "words", [["test", "--weights", "PIPE"], ["fit", "--config=PIPE"], ["dataset", "verify", "PIPE"]]
)
def test_a_pipe_is_not_waited_for(words: list[str], cli: Cli, tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "pipe")
    answer = cli(*(word.replace("PIPE", str(pipe)) for word in words))
    assert answer.code == 2 and str(pipe) in answer.line


@pytest.mark.parametrize("name", ["pipe", "/dev/zero", "folder"])
def test_a_pipe_that_a_file_of_options_names_is_not_waited_for_either(name: str, cli: Cli, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "x.yaml").write_text(f"name: x\nstacks: 4\nphysics: {name}\n")
    answer = cli("generate", "--config", tmp_path / "x.yaml", "--out", tmp_path / "out")
    assert answer.code == 2 and name in answer.line


@pytest.mark.parametrize("content", ["config: {a: 1}", "config: other.yaml", "check: {config: {a: 1}}"])
def test_a_file_of_options_names_no_other(content: str, cli: Cli, tmp_path: Path) -> None:
    (file := tmp_path / "c.yaml").write_text(content)
    answer = cli("check", "x.json", "--config", file)
    assert answer.code == 2 and "a file cannot name another one" in answer.line
