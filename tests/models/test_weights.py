"""Weights that travel: found by name, checked, never unpickled, and every mistake one line."""

from __future__ import annotations

import json
import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from stackgen.errors import StackgenError
from stackgen.models import weights as module
from stackgen.models.weights import export_checkpoint, read_weights, resolve, write_weights
from stackgen.sampling.methods import load_predictor, load_sampler
from stackgen.world import PAPER_WORLD, World
from tests.conftest import TinyWeights


@pytest.fixture
def copies(tiny: TinyWeights, tmp_path: Path) -> TinyWeights:
    """The tiny weights where a test may spoil them."""
    for path in tiny:
        for suffix in (".safetensors", ".json"):
            (tmp_path / path.name).with_suffix(suffix).write_bytes(path.with_suffix(suffix).read_bytes())
    return TinyWeights(*(tmp_path / path.name for path in tiny))


def refused(path: str | Path, *parts: str, load: Any = load_sampler) -> None:
    """The loader says why, in one line."""
    with pytest.raises(StackgenError) as caught:
        load(path)
    message = str(caught.value)
    assert "\n" not in message and all(re.search(part, message) for part in parts), message


def edit_card(path: Path, **changes: Any) -> None:
    card = path.with_suffix(".json")
    card.write_text(json.dumps({**json.loads(card.read_text()), **changes}))


def checkpoint(path: Path, tiny: TinyWeights) -> Path:
    """What Lightning would have saved of the tiny model."""
    tensors, card = read_weights(tiny.sampler)
    state = {f"model.{name}": tensor for name, tensor in tensors.items()}
    torch.save({"state_dict": state, "stackgen": card, "global_step": 5, "epoch": 1}, path)
    return path


# What is written is what is read.


def test_weights_are_read_back_as_written(tmp_path: Path) -> None:
    tensors = {"a": torch.randn(3, 4), "b": torch.arange(5), "c": torch.randn(4, 4).t()}
    write_weights(tmp_path / "x.safetensors", tensors, {"kind": "test", "config": {}, "metrics": {"m": 0.1}})
    found, card = read_weights(tmp_path / "x.safetensors")
    assert found.keys() == tensors.keys() and all(torch.equal(found[k], tensors[k]) for k in tensors)
    assert card["kind"] == "test" and card["metrics"] == {"m": 0.1} and card["name"] == "x"
    assert load_file(tmp_path / "x.safetensors")["b"].tolist() == [0, 1, 2, 3, 4]  # plain safetensors, for anyone


def test_loaded_weights_carry_their_world(tiny: TinyWeights) -> None:
    for made in (load_sampler(tiny.sampler), load_predictor(tiny.predictor)):
        loaded: Any = made
        assert loaded.world == PAPER_WORLD and loaded.card["format"] == module.FORMAT
    picture = np.zeros((1, 64, 64), bool)
    scenes = load_sampler(tiny.sampler).sample_batch(picture, np.array([[2, 0, 0, 1]]), 2, 0)
    assert [stack.counts.tolist() for stack in scenes[0]] == [[2, 0, 0, 1]] * 2
    assert load_predictor(tiny.predictor).predict(picture, top=3).shape == (1, 3, 4)


def test_a_checkpoint_and_its_export_are_the_same_weights(tiny: TinyWeights, tmp_path: Path) -> None:
    source = checkpoint(tmp_path / "run.ckpt", tiny)
    export_checkpoint(source, tmp_path / "out.safetensors", {"stability": 0.9})
    original, _ = read_weights(tiny.sampler)
    exported, card = read_weights(tmp_path / "out.safetensors")
    assert all(torch.equal(original[name], exported[name]) for name in original)
    assert card["metrics"] == {"stability": 0.9} and card["trained"] == {"steps": 5, "epochs": 1}
    load_sampler(source)
    load_sampler(tmp_path / "out.safetensors")


def test_half_the_size_is_nearly_the_same_network(tiny: TinyWeights, tmp_path: Path) -> None:
    source = checkpoint(tmp_path / "run.ckpt", tiny)
    export_checkpoint(source, tmp_path / "whole.safetensors")
    export_checkpoint(source, tmp_path / "half.safetensors", half=True)
    assert (tmp_path / "half.safetensors").stat().st_size < 0.7 * (tmp_path / "whole.safetensors").stat().st_size
    whole, half = (read_weights(tmp_path / f"{name}.safetensors")[0] for name in ("whole", "half"))
    assert all(torch.equal(whole[k], half[k]) for k in whole if whole[k].ndim < 2)
    assert all(torch.allclose(whole[k], half[k].float(), rtol=1e-3, atol=1e-4) for k in whole if whole[k].ndim > 1)
    network: Any = load_sampler(tmp_path / "half.safetensors")
    assert {tensor.dtype for tensor in network.model.parameters()} == {torch.float32}


def test_names_are_found_in_the_package(copies: TinyWeights, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FOLDER", copies.sampler.parent)
    monkeypatch.setattr(module, "DEFAULTS", {"sampler": "ddpm", "predictor": "cnn"})
    assert resolve("ddpm") == copies.sampler and resolve("default") == copies.sampler
    assert resolve("default", "predictor") == copies.predictor == resolve(copies.predictor)
    load_sampler()
    load_predictor()
    refused("dpm", r"dpm", r"cnn, ddpm")
    refused("../x", r"\.\./x")


def test_the_default_block_lists_are_those_of_the_sampler_s_world(
    copies: TinyWeights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FOLDER", tmp_path)
    monkeypatch.setattr(module, "DEFAULTS", {"sampler": "ddpm", "predictor": "cnn"})
    tensors, card = read_weights(copies.predictor)
    longer = replace(PAPER_WORLD, grid=replace(PAPER_WORLD.grid, height=5, image_size=80))
    write_weights(tmp_path / "a.safetensors", tensors, {**card, **longer.to_json(), "name": "a"})
    assert load_predictor("default", longer).card["name"] == "a"
    assert load_predictor("default", PAPER_WORLD).card["name"] == "cnn"
    assert load_predictor("default", replace(PAPER_WORLD, max_blocks=9)).card["name"] == "cnn"


def test_each_network_that_ships_has_block_lists_of_its_world() -> None:
    for path in module.FOLDER.glob("*.json"):
        world = World.from_json(json.loads(path.read_text()))
        assert load_predictor("default", world).world == world


# What is not there, or is something else.


def test_missing_weights_are_named(tmp_path: Path) -> None:
    for name in ("gone.safetensors", "gone.ckpt"):
        refused(tmp_path / name, r"no weights at .*gone")
    refused("nothing-of-that-name", "nothing-of-that-name")
    (tmp_path / "folder.safetensors").mkdir()
    refused(tmp_path / "folder.safetensors", "folder")


def test_one_role_is_not_another(tiny: TinyWeights) -> None:
    refused(tiny.predictor, "'blocklist'", "not of a sampler")
    refused(tiny.sampler, "'ddpm'", "block-list predictor", load=load_predictor)


def test_foreign_safetensors_are_refused(tmp_path: Path) -> None:
    save_file({"w": torch.zeros(3)}, tmp_path / "foreign.safetensors")
    refused(tmp_path / "foreign.safetensors", "no card", r"foreign\.json")
    for text in ("{}", "[]", '{"format": "other/1"}'):
        (tmp_path / "foreign.json").write_text(text)
        refused(tmp_path / "foreign.safetensors", r"not a stackgen\.weights/1 card")
    for text in ("", "{", "\xff"):
        (tmp_path / "foreign.json").write_text(text, encoding="latin-1")
        refused(tmp_path / "foreign.safetensors", "not (JSON|text)")


def test_a_changed_file_does_not_fit_its_card(copies: TinyWeights) -> None:
    content = bytearray(copies.sampler.read_bytes())
    content[-1] ^= 1
    copies.sampler.write_bytes(content)
    refused(copies.sampler, "checksums differ")


@pytest.mark.parametrize("length", [0, 4, 8, 100, -1])
def test_a_truncated_file_is_refused(copies: TinyWeights, length: int) -> None:
    copies.sampler.write_bytes(copies.sampler.read_bytes()[:length])
    refused(copies.sampler, "damaged|checksums")


@pytest.mark.parametrize(
    "changes",
    [
        {"config": {}}, {"config": None}, {"catalogue": []}, {"catalogue": 3}, {"grid": {"widht": 4}}, {"grid": None},
        {"max_blocks": None}, {"kind": None}, {"kind": "gpt"},
        {"config": {"denoiser": {"width": 64}, "schedule": {}, "diffusion": {}}},
        {"config": {"denoiser": {"wide": 64}, "schedule": {}, "diffusion": {}}},
    ],
)  # fmt: skip
def test_a_card_that_does_not_fit_is_refused(copies: TinyWeights, changes: dict[str, Any]) -> None:
    edit_card(copies.sampler, **changes)
    refused(copies.sampler, "fit together|catalogue|kind")


@pytest.mark.parametrize(
    "content",
    [[1, 2], torch.zeros(3), {"a": 1}, {"state_dict": {}}, {"stackgen": 1, "state_dict": {}}, {"stackgen": {}}],
)
def test_a_foreign_checkpoint_is_refused(tmp_path: Path, content: Any) -> None:
    torch.save(content, tmp_path / "x.ckpt")
    refused(tmp_path / "x.ckpt", "not one of stackgen's models")


# Files that lie.


class Bomb:
    """A pickle that runs code when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("form", ["torch", "pickle", "old torch"])
def test_code_in_a_checkpoint_is_not_run(tmp_path: Path, form: str) -> None:
    target, path = tmp_path / "it ran", tmp_path / "bomb.ckpt"
    content = {"stackgen": {"kind": "ddpm"}, "state_dict": {"model.x": Bomb(target)}}
    if form == "pickle":
        path.write_bytes(pickle.dumps(content))
        pickle.loads(path.read_bytes())  # the bomb is live
        assert target.exists()
        target.unlink()
    else:
        torch.save(content, path, _use_new_zipfile_serialization=form == "torch")
    for load in (load_sampler, load_predictor, lambda p: export_checkpoint(p, tmp_path / "x.safetensors")):
        refused(path, "not a checkpoint of stackgen, or is damaged", load=load)
    assert not target.exists() and not (tmp_path / "x.safetensors").exists()


def test_no_damage_of_a_checkpoint_is_overlooked_or_a_traceback(tmp_path: Path, tiny: TinyWeights) -> None:
    """One bit, or the end: one line, or the very same weights (some bytes of a zip file mean nothing)."""
    small = {"state_dict": {"model.w": torch.arange(40.0)}, "stackgen": {"kind": "ddpm"}, "global_step": 5, "epoch": 1}
    path = tmp_path / "x.ckpt"
    torch.save(small, path)
    content, places = path.read_bytes(), np.random.default_rng(0)
    tensors, card = read_weights(path)
    refusals = 0
    for place in places.integers(0, len(content), 250):
        broken = bytearray(content)
        broken[place] ^= 1 << int(places.integers(8))
        path.write_bytes(broken)
        try:
            found, about = read_weights(path)
        except StackgenError:
            refusals += 1
            continue
        assert torch.equal(found["w"], tensors["w"]) and about == card
    for length in places.integers(0, len(content), 30):
        path.write_bytes(content[:length])
        refused(path, "damaged")
    assert refusals > 50


def test_noise_is_no_checkpoint(tmp_path: Path) -> None:
    path, random = tmp_path / "noise.ckpt", np.random.default_rng(0)
    for length in (0, 1, 10, 500):
        path.write_bytes(b"\x80\x02" + random.bytes(length))
        refused(path, "not a checkpoint of stackgen")


def test_weights_are_exported_to_safetensors_alone(tmp_path: Path, tiny: TinyWeights) -> None:
    source = checkpoint(tmp_path / "run.ckpt", tiny)
    for name in ("out.pt", "out", "out.json"):
        with pytest.raises(StackgenError, match=r"\.safetensors"):
            export_checkpoint(source, tmp_path / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.ckpt"]
