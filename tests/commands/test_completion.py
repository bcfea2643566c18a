"""Shell completion, and what every verb's command line has in common."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from stackgen.commands.cli import VERBS
from tests.conftest import Cli

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from stackgen.commands.completion import whole_parser

    folder = tmp_path_factory.mktemp("completion")
    (folder / "weights.ckpt").touch()
    path = folder / "stackgen.bash"
    path.write_text(whole_parser().get_completion_script("shtab-bash"))
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["sw"], ["sweep"]),
        (["fit", "--dashb"], ["--dashboard"]),
        (["fit", "--dashboard", "wandb-"], ["wandb-offline"]),
        (["dataset", "ver"], ["verify"]),
        (["sample", "--num_s"], ["--num_samples"]),
        (["sample", "--verify", "sim"], ["simulator"]),
        (["sample", "--weights", "wei"], ["weights.ckpt"]),
        (["check", "wei"], ["weights.ckpt"]),
    ],
)
def test_bash_completes_verbs_options_and_choices(script: Path, words: list[str], expected: list[str]) -> None:
    line = " ".join(["stackgen", *words])
    code = f"source {script}; COMP_WORDS=({line}); COMP_CWORD={len(words)}; _shtab_stackgen; echo ${{COMPREPLY[@]}}"
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=False, cwd=script.parent)
    assert done.stdout.split() == expected, done.stderr


@pytest.mark.parametrize("shell", ["zsh", "fish"])  # bash: above
def test_the_script_is_printed(cli: Cli, shell: str) -> None:
    answer = cli("completion", "--shell", shell)
    assert answer.code == 0, answer.err
    assert all(verb in answer.out for verb in VERBS)


def test_files_are_laid_over_each_other_and_an_option_over_both(cli: Cli, tmp_path: Path) -> None:
    """Left to right; what refers to another option follows the last word on it."""
    (tmp_path / "a.yaml").write_text(
        "name: a\nmodel: {class_path: stackgen.models.DDPM, init_args: {draws: 2,"
        " denoiser: {width: 64, feedforward: 128, heads: 4}}}\ndata: {path: x, batch_size: 8,"
        " eval_batch_size: '${data.batch_size}'}\n"
    )
    (tmp_path / "b.yaml").write_text("name: b\nmodel: {init_args: {denoiser: {width: 32}}}\n")
    files = ["--config", tmp_path / "a.yaml", "--config", tmp_path / "b.yaml"]
    answer = cli("fit", *files, "--data.batch_size", 16, "--model.denoiser.heads", 2, "--print_config")
    assert answer.code == 0, answer.err
    config = yaml.safe_load(answer.out)
    made = config["model"]["init_args"]
    assert (config["name"], made["draws"]) == ("b", 2)
    assert [made["denoiser"][name] for name in ("width", "feedforward", "heads")] == [32, 128, 2]
    printed = config["data"]["eval_batch_size"]
    assert config["data"]["batch_size"] == 16 and printed in (16, "${data.batch_size}", "${.batch_size}")
