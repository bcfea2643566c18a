"""The command line that the page shows is one that `stackgen sample` takes, and makes the same stacks."""

from __future__ import annotations

import base64
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from stackgen.commands.cli import main
from stackgen.commands.sample import COMMAND, with_checker
from stackgen.io.text import read_json
from stackgen.models.weights import FOLDER
from stackgen.studio.requests import CELL, Drawing, Wish
from stackgen.studio.work.drawings import mask_of, pack, picture_of, reading_of
from stackgen.studio.work.generating import command_line
from stackgen.studio.work.methods import BEST, methods
from stackgen.world import PAPER_WORLD, World

ARCH = np.ones((4 * CELL, 4 * CELL), dtype=bool)
ARCH[CELL:, CELL:-CELL] = False
PARSER = COMMAND.parser("yaml")
DIFFUSION = [method["name"] for method in methods() if method["steps"]]
SINGLE = [(name, False) for name in DIFFUSION]
VERIFIED = [(method["name"], True) for method in methods()]


def test_the_methods_are_the_samplers_of_the_papers_world() -> None:
    cards = [read_json(path) for path in FOLDER.glob("*.json")]
    samplers = {card["name"]: World.from_json(card) for card in cards if card["kind"] != "blocklist"}
    named = {method["name"] for method in methods()}
    assert {name for name, world in samplers.items() if world == PAPER_WORLD} == named & set(samplers)


@pytest.mark.parametrize(("method", "verified"), VERIFIED + SINGLE)
def test_the_command_says_all_that_was_wished(method: str, verified: bool) -> None:
    sampler: dict[str, Any] = {"kind": "ddim", "steps": 3} if method in DIFFUSION else {}
    for blocks, inventory in (({"cube": 2, "triangle": 0, "long_rectangle": 1}, None), (None, {"cube": 9})):
        wish = Wish.model_validate(
            {
                **{"method": method, "number": 2, "seed": 7, "verified": verified},
                **{"sampler": sampler, "blocks": blocks, "inventory": inventory},
            }
        )
        mask = mask_of(Drawing(cells=4, bits=pack(ARCH)))
        words = shlex.split(command_line(wish, reading_of(picture_of(mask)), mask))
        assert words[:2] == ["stackgen", "sample"]
        asked = PARSER.parse_args(with_checker(words[2:]))
        assert (asked.num_samples, asked.seed) == (2, 7)
        assert asked.blocks == (None if blocks is None else "cube=2,long_rectangle=1")
        assert asked.inventory == (None if inventory is None else "cube=9")
        assert asked.one_shot is (not verified)
        if method != BEST:
            assert asked.weights == method
            assert asked.verify == ("simulator" if verified else None)
            assert (asked.sampler.kind, asked.sampler.steps) == (sampler.get("kind"), sampler.get("steps"))


@pytest.mark.slow
@pytest.mark.parametrize(("method", "verified"), VERIFIED + SINGLE)
def test_the_command_makes_the_same_stacks(
    studio: TestClient, method: str, verified: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wish = {"method": method, "number": 1 if verified else 2, "verified": verified}
    answer = studio.post("/api/generate", json={"drawing": {"cells": 4, "bits": pack(ARCH)}, "wish": wish})
    file = next(message for message in map(json.loads, answer.text.splitlines()) if message["kind"] == "file")
    monkeypatch.chdir(tmp_path)
    Path("silhouette.png").write_bytes(base64.b64decode(file["picture"]))
    assert main([*shlex.split(file["command"])[1:], "--quiet"]) in (0, 1)
    assert json.loads(Path("out/studio/stacks.json").read_text())["stacks"] == file["file"]["stacks"]
