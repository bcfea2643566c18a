"""What every verb's command line has in common: documented, printed and read back, and mended where it was mistyped."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from jsonargparse import ArgumentParser

from stackgen.api import Model
from stackgen.commands.cli import VERBS
from stackgen.commands.completion import parsers_of
from stackgen.commands.hints import options_of
from stackgen.io.stacks_file import read_stacks
from tests.conftest import Cli
from tests.test_readme import examples

ROOT = Path(__file__).parents[2]


def verbs() -> Iterator[tuple[str, ...]]:
    """Each verb as it is typed; of a verb that has parts, each of these."""
    for verb in VERBS:
        found = parsers_of(verb) if verb == "dataset" else verb  # the others' are made where they are wanted
        yield from [(verb, part) for part in found] if isinstance(found, dict) else [(verb,)]


def parser_of(words: tuple[str, ...]) -> ArgumentParser:
    found = parsers_of(words[0])
    parser = found[words[1]] if isinstance(found, dict) else found
    assert isinstance(parser, ArgumentParser)
    return parser


every_verb = pytest.mark.parametrize("verb", list(verbs()), ids=" ".join)


@every_verb
def test_every_option_is_documented(verb: tuple[str, ...]) -> None:
    silent = [action.option_strings or action.dest for action in parser_of(verb)._actions if not action.help]
    assert silent == []


@every_verb
def test_what_is_printed_is_read_back_as_it_was(
    verb: tuple[str, ...], cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the longest example of the help, and of no option at all."""
    monkeypatch.chdir(ROOT)
    lines = [shlex.split(line.partition(" > ")[0])[1:] for line in examples()]
    longest = max((line[len(verb) :] for line in lines if tuple(line[: len(verb)]) == verb), key=len)
    for options in (longest, []):
        printed = cli(*verb, *options, "--print_config")
        assert printed.code == 0, printed.err
        (tmp_path / "again.yaml").write_text(printed.out)
        again = cli(*verb, "--config", tmp_path / "again.yaml", "--print_config")
        assert again.code == 0, again.err
        assert yaml.safe_load(again.out) == yaml.safe_load(printed.out)


@every_verb
def test_a_misspelt_option_of_any_verb_is_answered_with_the_nearest(verb: tuple[str, ...], cli: Cli) -> None:
    option = max(options_of(parser_of(verb)), key=len)
    answer = cli(*verb, option[:3] + option[4:], 1)
    assert answer.code == 2
    assert f"did you mean {option}?" in answer.line


@pytest.mark.parametrize(
    ("text", "nearest"),
    [
        ("trainer: {max_epoch: 3}", "trainer.max_epochs"),
        ("data: {batchsize: 3}", "data.batch_size"),
        ("model: {init_args: {denoiser: {widht: 3}}}", "denoiser.width"),
        ("model: {init_args: {drawz: 3}}", "draws"),
        ("model: {class_path: stackgen.models.DDMP}", "DDPM"),
        ("trainer: {callbacks: [{class_path: stackgen.training.EMA, init_args: {decya: 0.9}}]}", "decay"),
    ],
)
def test_a_misspelt_key_of_a_file_is_answered_with_the_nearest(
    text: str, nearest: str, cli: Cli, tmp_path: Path
) -> None:
    (tmp_path / "wrong.yaml").write_text(text)
    base = ["--config", ROOT / "configs" / "model" / "ddpm-small.yaml", "--data.path", "x"]
    answer = cli("fit", *base, "--config", tmp_path / "wrong.yaml")
    assert answer.code == 2
    assert f"(did you mean {nearest}?); see `stackgen fit --help`" in answer.line


def test_nothing_is_meant_where_nothing_is_near(cli: Cli) -> None:
    assert "did you mean" not in cli("check", "x.json", "--zzz", 1).line


def test_files_are_laid_over_each_other_for_every_verb(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("name: a\nstacks: 10\nphysics: {friction: 0.4, watch: 1.0}\n")
    (tmp_path / "b.yaml").write_text("stacks: 20\nphysics: {friction: 0.3}\n")
    files = ["--config", tmp_path / "a.yaml", "--config", tmp_path / "b.yaml", "--physics.watch", 3, "--out", "x"]
    made = yaml.safe_load(cli("generate", *files, "--print_config").out)
    assert (made["name"], made["stacks"]) == ("a", 20)
    assert (made["physics"]["friction"], made["physics"]["watch"]) == (0.3, 3)


def test_what_refers_to_another_option_follows_the_command_line(
    cli: Cli, towers: Model, tower_image: Path, tmp_path: Path
) -> None:
    (tmp_path / "a.yaml").write_text(
        f"seed: ${{num_samples}}\nnum_samples: 1\none_shot: true\nout: {tmp_path / 'out'}\n"
    )
    assert cli("sample", tower_image, "--config", tmp_path / "a.yaml", "--num_samples", 2).code == 0
    content = read_stacks(tmp_path / "out" / "stacks.json")
    assert (content.seed, len(content.stacks)) == (2, 2)


def test_a_verb_is_helped_either_way(cli: Cli) -> None:
    assert cli("help", "show").out == cli("show", "--help").out
    assert cli("help", "dataset", "info").out == cli("dataset", "info", "--help").out
    assert "did you mean 'show'" in cli("help", "shwo").line
