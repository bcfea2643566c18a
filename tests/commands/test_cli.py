"""The command line does what its help says, and leaves whole files only."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from stackgen.api import Model
from stackgen.commands.cli import VERBS
from stackgen.commands.parsing import own_sections
from stackgen.errors import StackgenError
from stackgen.io.stacks_file import read_stacks
from stackgen.models.weights import last_checkpoint
from stackgen.training.runs import new_run
from tests.conftest import CHILD, Cli, draw_tower, stacks_json

FILES = ["overlay.png", "silhouette.png", "stack-1.glb", "stack-2.glb", "stacks.json", "stacks.png"]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_a_help_with_an_example(verb: str, cli: Cli) -> None:
    answer = cli(verb, "--help")
    assert answer.code == 0
    assert f"example:\n  stackgen {verb}" in answer.out


def test_help_lists_every_verb(cli: Cli) -> None:
    for flag in ("--help", "-h"):
        answer = cli(flag)
        assert answer.code == 0
        assert all(f"  {verb} " in answer.out for verb in VERBS)


ARCH = str(Path(__file__).parents[2] / "examples" / "stacks" / "arch.json")


@pytest.mark.parametrize("arguments", [["--help"], ["check", ARCH]])
def test_a_reader_that_has_gone_ends_a_command_without_a_word(arguments: list[str]) -> None:
    """Not with 0 or 1, which are verdicts: nobody has read one."""
    process = subprocess.Popen(
        [sys.executable, "-m", "stackgen", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=CHILD
    )
    assert process.stdout is not None
    process.stdout.close()
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (141, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("arguments", [["--help"], ["check", ARCH]])
def test_a_full_output_is_one_line(arguments: list[str]) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "stackgen", *arguments], stdout=full, stderr=subprocess.PIPE, env=CHILD, text=True
        )
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr


@pytest.mark.parametrize("redirection", [">&-", "2>&-", ">&- 2>&-"])
def test_a_closed_output_changes_no_verdict(redirection: str) -> None:
    command = f"{sys.executable} -m stackgen check {ARCH} {redirection}"
    assert subprocess.run(["sh", "-c", command], env=CHILD, capture_output=True).returncode == 0


def test_no_text_moves_the_cursor_or_is_too_much_for_a_terminal() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "stackgen", "check", "b\u00fccher\x1b[2J\r\n.json"],
        capture_output=True,
        env={**CHILD, "PYTHONIOENCODING": "ascii"},
    )
    assert done.returncode == 2
    assert done.stderr == b"stackgen check: b\\xfccher\\x1b[2J .json: no such file\n"


@pytest.mark.parametrize("name", ["LOCAL_RANK", "RANK", "SLURM_PROCID", "WORLD_SIZE"])
def test_what_a_launcher_left_is_a_number(name: str, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "text")
    answer = cli("fit", "--config", "any.yaml")
    assert answer.code == 2
    assert answer.line == f"stackgen fit: the environment variable {name} must be a whole number, got 'text'; unset it"


def test_sigterm_ends_a_command_with_143(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.getsignal(signal.SIGTERM)

    def killed(argv: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(10)

    monkeypatch.setattr("stackgen.commands.check.COMMAND", SimpleNamespace(run=killed))
    answer = cli("check", ARCH)
    assert (answer.code, answer.err) == (143, "stackgen check: terminated; no half-written file is left behind\n")
    assert signal.getsignal(signal.SIGTERM) is before


def test_sample_leaves_file_picture_and_one_glb_per_stack(
    cli: Cli, towers: Model, tower_image: Path, tmp_path: Path
) -> None:
    answer = cli("sample", tower_image, "--one_shot", "--num_samples", 2, "--out", tmp_path / "out")
    assert answer.code == 0
    assert names(tmp_path / "out") == FILES
    content = read_stacks(tmp_path / "out" / "stacks.json")
    assert content.silhouette == "tower.png"
    assert content.block_list_source == "cnn"
    assert content.block_list is not None
    assert content.block_list.tolist() == [3, 0, 0, 0]
    assert all(entry.verdict and entry.verdict.stable and entry.front_iou for entry in content.entries)
    assert answer.out.count("stands") == 2


def test_a_network_is_asked_at_the_height_that_is_given(
    cli: Cli, towers: Model, tower_image: Path, tmp_path: Path
) -> None:
    for cells, size in (("2", (28, 28 / 3)), ("3x2", (28, 42))):
        out = tmp_path / cells
        assert cli("sample", tower_image, "--one_shot", "--cells", cells, "--out", out).code == 0
        target = read_stacks(out / "stacks.json").target
        assert target is not None
        assert (target.any(axis=1).sum(), target.any(axis=0).sum()) == pytest.approx(size, abs=1.5)
    answer = cli("sample", tower_image, "--one_shot", "--cells", 6, "--out", tmp_path / "out")
    assert answer.code == 2 and "the grid 4 x 4" in answer.err and not (tmp_path / "out").exists()


def test_same_seed_same_bytes_other_seed_others(cli: Cli, towers: Model, tower_image: Path, tmp_path: Path) -> None:
    for folder, seed in (("a", 5), ("b", 5), ("c", 6)):
        assert cli("sample", tower_image, "--one_shot", "--seed", seed, "--out", tmp_path / folder).code == 0
    for name in ("stacks.json", "stacks.png", "stack-1.glb"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
        assert (tmp_path / "a" / name).read_bytes() != (tmp_path / "c" / name).read_bytes()


def test_the_best_stacks_of_a_drawing_stand_and_match_at_its_own_scale(cli: Cli, tmp_path: Path) -> None:
    Image.fromarray(np.pad(np.zeros((60, 60), dtype=np.uint8), 40, constant_values=255)).save(tmp_path / "cube.png")
    answer = cli("sample", tmp_path / "cube.png", "--out", tmp_path / "out")
    assert answer.code == 0 and "yes" in answer.out
    content = read_stacks(tmp_path / "out" / "stacks.json")
    assert content.block_list_source == "search" and content.stacks[0].names == ["cube"]
    assert (
        content.entries[0].matches
        and json.loads((tmp_path / "out" / "stacks.json").read_text())["stacks"][0]["matches"]
    )
    answer = cli("sample", tmp_path / "cube.png", "--cells", "2x6", "--out", tmp_path / "out")
    content = read_stacks(tmp_path / "out" / "stacks.json")
    assert answer.code == 0 and content.world.grid.height == 6
    assert len(content.stacks[0]) == 6 and content.entries[0].matches


def test_a_given_block_list_is_used(cli: Cli, towers: Model, tower_image: Path, tmp_path: Path) -> None:
    cli("sample", tower_image, "--one_shot", "--blocks", "cube=1,triangle=1", "--out", tmp_path / "out")
    content = read_stacks(tmp_path / "out" / "stacks.json")
    assert content.block_list_source == "given"
    assert all(stack.names == ["cube", "triangle"] for stack in content.stacks)


def test_images_of_one_name_do_not_overwrite_each_other(cli: Cli, towers: Model, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    images = [draw_tower(tmp_path / name) for name in ("a.png", "other/a.png", "b.jpg")]
    assert cli("sample", *images, "--one_shot", "--num_samples", 2, "--out", tmp_path / "out").code == 0
    assert names(tmp_path / "out") == ["a", "a-2", "b", "overview.png"]
    assert all(names(tmp_path / "out" / name) == FILES for name in ("a", "a-2", "b"))


def test_a_smaller_result_leaves_no_glb_of_a_larger_one(
    cli: Cli, towers: Model, tower_image: Path, tmp_path: Path
) -> None:
    for number in (3, 2):
        assert cli("sample", tower_image, "--one_shot", "--num_samples", number, "--out", tmp_path / "out").code == 0
    assert names(tmp_path / "out") == FILES


def test_interrupted_sample_leaves_the_finished_images_only(
    cli: Cli, towers: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = [draw_tower(tmp_path / f"{name}.png") for name in "abc"]
    checked, check = [], towers.checker.check

    def check_until_ctrl_c(stack: object) -> object:
        checked.append(stack)
        if len(checked) == 3:
            raise KeyboardInterrupt
        return check(stack)  # type: ignore[arg-type]

    monkeypatch.setattr(towers.checker, "check", check_until_ctrl_c)
    answer = cli("sample", *images, "--one_shot", "--num_samples", 2, "--out", tmp_path / "out")
    assert answer.code == 130
    assert "interrupted; 1 of 3 images are finished" in answer.line
    assert names(tmp_path / "out") == ["a"]
    assert names(tmp_path / "out" / "a") == FILES


def test_check_answers_by_its_exit_code_and_names_what_fell(cli: Cli, stands: Path, tmp_path: Path) -> None:
    answer = cli("check", stands)
    assert answer.code == 0
    assert "stands" in answer.out
    falls = tmp_path / "falls.json"
    falls.write_text(json.dumps(stacks_json([("cube", 0, 0.5)], [("cube", 0, 0.5), ("triangle", 1.5, 3.5)])))
    answer = cli("check", falls, "--out", tmp_path / "checked.json")
    assert answer.code == 1
    assert "block 1 (triangle) 3.0 cells" in answer.out
    verdicts = [entry.verdict for entry in read_stacks(tmp_path / "checked.json").entries]
    assert [verdict and verdict.stable for verdict in verdicts] == [True, False]
    assert verdicts[1] is not None
    np.testing.assert_allclose(verdicts[1].settled.poses[1, 2], 0.5, atol=0.02)


def test_check_of_a_sample_finds_the_same_verdicts(cli: Cli, towers: Model, tower_image: Path, tmp_path: Path) -> None:
    cli("sample", tower_image, "--one_shot", "--out", tmp_path / "out")
    file = tmp_path / "out" / "stacks.json"
    assert cli("check", file, "--out", tmp_path / "again.json").code == 0
    before, after = read_stacks(file), read_stacks(tmp_path / "again.json")
    for old, new in zip(before.entries, after.entries, strict=True):
        assert old.verdict is not None
        assert new.verdict is not None
        np.testing.assert_array_equal(old.verdict.settled.poses, new.verdict.settled.poses)
        assert old.front_iou == new.front_iou


def test_show_writes_picture_and_page(cli: Cli, stands: Path, tmp_path: Path) -> None:
    assert cli("show", stands).code == 0
    assert cli("show", stands, "--out", tmp_path / "other.jpg").code == 0
    assert (tmp_path / "stands.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "other.jpg").read_bytes().startswith(b"\xff\xd8")
    for page in ("stands.html", "other.html"):
        assert "triangle" in (tmp_path / page).read_text()


def test_each_verb_reads_its_own_section_of_a_shared_file(tmp_path: Path) -> None:
    shared = tmp_path / "quick.yaml"
    shared.write_text("sample: {seed: 3}\nfit: {name: quick}\n")
    assert own_sections("sample", ["--config", str(shared)]) == ["--config", "seed: 3\n"]
    assert own_sections("fit", ["-c", str(shared)]) == ["-c", "name: quick\n"]
    assert own_sections("fit", [f"--config={shared}"]) == ["--config=name: quick\n"]
    assert own_sections("check", ["--config", str(shared)]) == ["--config", str(shared)]


def test_a_section_is_used(cli: Cli, towers: Model, tower_image: Path, tmp_path: Path) -> None:
    shared = tmp_path / "quick.yaml"
    shared.write_text(f"sample: {{seed: 3, num_samples: 2, out: {tmp_path / 'out'}}}\nfit: {{name: quick}}\n")
    assert cli("sample", tower_image, "--config", shared, "--one_shot").code == 0
    content = read_stacks(tmp_path / "out" / "stacks.json")
    assert (content.seed, len(content.stacks)) == (3, 2)


def test_runs_never_share_a_folder_and_the_newest_checkpoint_wins(tmp_path: Path) -> None:
    first, second = new_run("x", tmp_path), new_run("x", tmp_path)
    assert (first.name, second.name) == ("version_0", "version_1")
    with pytest.raises(StackgenError, match="no checkpoint"):
        last_checkpoint(tmp_path / "x")
    for age, folder in ((100, first), (200, second)):
        (folder / "checkpoints").mkdir()
        (folder / "checkpoints" / "last.ckpt").touch()
        os.utime(folder / "checkpoints" / "last.ckpt", (age, age))
    assert last_checkpoint(tmp_path / "x") == second / "checkpoints" / "last.ckpt"
    assert last_checkpoint(first) == first / "checkpoints" / "last.ckpt"
    with pytest.raises(StackgenError, match="run name"):
        new_run("../x", tmp_path)
