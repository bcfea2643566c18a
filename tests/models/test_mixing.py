"""Mixed weights: a weighted sum of what fits together, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from stackgen.errors import StackgenError
from stackgen.models.mixing import mix_weights
from stackgen.models.weights import read_weights, write_weights
from stackgen.sampling.methods import load_sampler
from tests.conftest import TinyWeights


@pytest.fixture
def pair(tiny: TinyWeights, tmp_path: Path) -> tuple[Path, Path]:
    """Two weights of one architecture."""
    tensors, card = read_weights(tiny.sampler)
    paths = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    for number, path in enumerate(paths):
        changed = {k: v + number * torch.rand_like(v) if v.is_floating_point() else v for k, v in tensors.items()}
        write_weights(path, changed, {**card, "name": path.stem, "trained": {"steps": 5}, "metrics": {"m": 1.0}})
    return paths


def test_shares_are_shares_and_equal_where_none_are_given(pair: tuple[Path, Path]) -> None:
    (first, _), (second, _) = map(read_weights, pair)
    for shares, wanted in ((None, (0.5, 0.5)), ([1.5, -0.5], (1.5, -0.5)), ([0, 1], (0, 1))):
        mixed, _ = mix_weights(pair, shares)
        assert mixed.keys() == first.keys()
        for name, tensor in mixed.items():
            torch.testing.assert_close(tensor, wanted[0] * first[name] + wanted[1] * second[name])


def test_weights_mixed_with_themselves_are_themselves(tiny: TinyWeights) -> None:
    tensors, _ = read_weights(tiny.sampler)
    mixed, _ = mix_weights([tiny.sampler, tiny.sampler, tiny.sampler], [2.0, -3.0, 2.0])
    for name, tensor in mixed.items():
        torch.testing.assert_close(tensor, tensors[name], atol=1e-5, rtol=1e-5)


def test_the_card_tells_of_what_it_is_mixed_and_claims_nothing_else(pair: tuple[Path, Path]) -> None:
    _, card = mix_weights(pair, [0.25, 0.75])
    assert [(part["name"], part["share"]) for part in card["mixed"]] == [("a", 0.25), ("b", 0.75)]
    assert [part["sha256"] for part in card["mixed"]] == [read_weights(path)[1]["sha256"] for path in pair]
    assert not {"name", "trained", "metrics", "sha256"} & card.keys()


@pytest.mark.parametrize(
    ("shares", "words"), [([0.5], "as many"), ([1, 1], "1 together, not 2"), ([float("nan"), 0.5], "1 together")]
)
def test_shares_that_cannot_be_are_refused(pair: tuple[Path, Path], shares: list[float], words: str) -> None:
    with pytest.raises(StackgenError, match=words):
        mix_weights(pair, shares)


@pytest.mark.parametrize("change", [{"kind": "tran-reg"}, {"max_blocks": 11}])
def test_weights_of_another_kind_or_world_are_refused(pair: tuple[Path, Path], change: dict[str, Any]) -> None:
    tensors, card = read_weights(pair[1])
    write_weights(pair[1], tensors, {**card, **change})
    with pytest.raises(StackgenError, match=r"b\.safetensors is not of the same"):
        mix_weights(pair)


def test_weights_of_another_architecture_are_refused(tiny: TinyWeights, pair: tuple[Path, Path]) -> None:
    tensors, card = read_weights(pair[1])
    name = next(iter(tensors))
    write_weights(pair[1], {**tensors, name: torch.zeros(3, 3)}, card)
    with pytest.raises(StackgenError, match="is not of the same"):
        mix_weights(pair)
    with pytest.raises(StackgenError, match="is not of the same"):
        mix_weights([tiny.sampler, tiny.predictor])


@pytest.mark.parametrize(("part", "change"), [("diffusion", {"prediction": "v"}), ("denoiser", {"heads": 1})])
def test_equal_sizes_do_not_make_an_architecture(pair: tuple[Path, Path], part: str, change: dict[str, Any]) -> None:
    tensors, card = read_weights(pair[1])
    assert all(card["config"][part][name] != value for name, value in change.items())
    config = {**card["config"], part: {**card["config"][part], **change}}
    write_weights(pair[1], tensors, {**card, "config": config})
    with pytest.raises(StackgenError, match="is not of the same"):
        mix_weights(pair)


def test_how_weights_are_sampled_may_differ_and_is_that_of_the_first(pair: tuple[Path, Path]) -> None:
    tensors, card = read_weights(pair[0])
    older = {k: v for k, v in card["config"]["diffusion"].items() if k != "guidance"}
    for path, diffusion in zip(pair, ({**older, "temperature": 0.3}, older), strict=True):
        write_weights(path, tensors, {**card, "config": {**card["config"], "diffusion": diffusion}})
    assert mix_weights(pair)[1]["config"]["diffusion"]["temperature"] == 0.3


def test_the_verb_writes_weights_that_sample(cli: Any, pair: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "mixed.safetensors"
    answer = cli("mix", *pair, "--shares", "[1.5, -0.5]", "--out", out, "--half")
    assert answer.code == 0 and "mixed.json" in answer.out
    assert json.loads(out.with_suffix(".json").read_text())["name"] == "mixed"
    loaded: Any = load_sampler(out)
    assert loaded.card["mixed"][0]["share"] == 1.5
    assert out.stat().st_size < 0.7 * pair[0].stat().st_size


def test_the_verb_refuses_in_one_line_and_writes_nothing(cli: Any, pair: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "mixed.safetensors"
    assert "at least two" in cli("mix", pair[0], "--out", out).line
    assert "1 together" in cli("mix", *pair, "--shares", "[2, 2]", "--out", out).line
    assert ".safetensors file" in cli("mix", *pair, "--out", tmp_path / "mixed.txt").line
    assert not list(tmp_path.glob("mixed*"))
