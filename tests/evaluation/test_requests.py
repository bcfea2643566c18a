"""Who is tested: samplers told apart by weights, code and settings, and told off where they lack a part."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from stackgen.baselines import BruteForce, GreedyRandom, RandomPlacement
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import Request
from stackgen.evaluation.requests import (
    Method,
    code_hash,
    load_method,
    question_of,
    require_one_world,
    require_sampler,
)
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.world import PAPER_CATALOGUE, PAPER_WORLD, Grid, World
from tests.conftest import TinyWeights


def identity(method: Method) -> str:
    return json.dumps(load_method(method).identity(), sort_keys=True)


def test_a_sampler_is_known_by_its_weights_and_settings(tiny: TinyWeights) -> None:
    weights = str(tiny.sampler)
    same = [identity(Method(weights)), identity(Method(weights, str(tiny.predictor)))]
    others = [
        identity(Method(weights, sampler=SamplerConfig(steps=8))),
        identity(Method(weights, sampler=SamplerConfig("ddim"))),
        identity(Method(weights, verify="statics", draws=8)),
        identity(Method(weights, verify="statics", draws=9)),
        identity(Method("random-placement")),
        identity(Method("greedy-random")),
    ]
    assert len(set(same)) == 1 and len({*same, *others}) == 1 + len(others)


def test_a_heuristic_is_the_same_by_name_and_by_class() -> None:
    assert identity(Method("random-placement")) == identity(Method(RandomPlacement()))
    assert identity(Method("brute-force")) != identity(Method(BruteForce(sigma=0.1)))


def test_code_is_that_of_the_class_and_of_what_it_imports_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    package = tmp_path / "mine_code_hash"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "other.py").write_text("OTHER = 1\n")
    (package / "part.py").write_text("from .deep import DEEP\n\nPART = DEEP\n")
    (package / "deep.py").write_text("DEEP = 1\n")
    (package / "a.py").write_text("from mine_code_hash.part import PART\n\nclass A:\n    part = PART\n")
    from mine_code_hash.a import A  # type: ignore[import-not-found]

    before = code_hash(A)
    (package / "other.py").write_text("OTHER = 2\n")
    assert code_hash(A) == before
    (package / "deep.py").write_text("DEEP = 2\n")
    assert code_hash(A) != before
    assert len({code_hash(kind) for kind in (BruteForce, GreedyRandom, RandomPlacement)}) == 3


def test_requests_ask_with_both_lists_or_one(tiny: TinyWeights) -> None:
    loaded = load_method(Method(str(tiny.sampler), str(tiny.predictor)))
    true, predicted = loaded.requests(seed=3, facts={"code": "0"})
    assert (true.block_list, predicted.block_list, true.seed) == ("true", "predicted", 3)
    assert true.predictor_sha256 is None and len(str(predicted.predictor_sha256)) == 64
    assert true.facts["code"] == "0" and true.facts["weights"] == str(tiny.sampler)
    assert len(loaded.requests(predicted_lists=False)) == 1
    assert load_method(Method("greedy-random")).name == "greedy-random"
    assert load_method(Method("greedy-random", verify="statics")).name == "greedy-random, verified by statics"


PHYSICS = {"engine": "pybullet 3.2.7", "friction": 0.5}


@pytest.mark.parametrize(
    "changes",
    [
        {"identity": {"weights": "v"}}, {"identity": {"weights": "w", "settings": {"steps": 8}}},
        {"predictor_sha256": "q"}, {"num_samples": 1}, {"seed": 1}, {"batch_size": 8},
    ],
)  # fmt: skip
def test_another_request_is_another_question(changes: dict[str, Any]) -> None:
    usual: dict[str, Any] = {"identity": {"weights": "w"}, "predictor_sha256": "p"}
    first, other = (Request("m", PAPER_WORLD, None, **{**usual, **some}) for some in ({}, changes))
    asked = question_of(first, "t", 2, PHYSICS)
    assert asked == question_of(Request("another name", PAPER_WORLD, None, **usual), "t", 2, PHYSICS)
    assert asked != question_of(other, "t", 2, PHYSICS)
    assert asked != question_of(first, "u", 2, PHYSICS) and asked != question_of(first, "t", 3, PHYSICS)
    assert asked != question_of(first, "t", 2, {**PHYSICS, "friction": 0.4})


class Worldless:
    settings = None

    def sample_batch(self) -> None:
        """Nothing."""


def test_a_sampler_without_a_world_is_refused_in_one_line() -> None:
    for refuse in (require_sampler, lambda sampler: load_method(Method(sampler))):
        with pytest.raises(StackgenError, match="Worldless has no world and no card"):
            refuse(Worldless())
    with pytest.raises(StackgenError, match="sample_batch"):
        load_method(Method("{class_path: stackgen.stack.Stack}"))


def test_scenes_of_another_world_are_refused() -> None:
    loaded = load_method(Method("greedy-random"))
    require_one_world(loaded, World(PAPER_CATALOGUE, PAPER_WORLD.grid, 4), "towers")  # fewer blocks are no harm
    with pytest.raises(StackgenError, match="towers has another grid than greedy-random"):
        require_one_world(loaded, World(PAPER_CATALOGUE, Grid(width=3), 10), "towers")
