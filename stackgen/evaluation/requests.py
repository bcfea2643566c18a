"""What is tested and how: from weights, or a sampler without any, to the requests that are made of it.

A request's **question** is all that its answer depends on, as plain data: the hash in the card of the sampler (of its
code, where it has no weights), its settings, whose block lists, the scenes, the physics. Equal questions have equal
answers.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import inspect
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.util import resolve_name
from pathlib import Path
from typing import Any

from stackgen.api import Model, load
from stackgen.baselines.heuristic import Heuristic
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import BATCH, Request
from stackgen.evaluation.results import Question
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.models.weights import resolve
from stackgen.names import DEFAULT, CheckerName
from stackgen.protocols import StackSampler
from stackgen.sampling.verified import Budget, VerifiedSampler, checker_named
from stackgen.search.sampler import SearchMethod
from stackgen.world import World

PROTOCOL = 1
"""To be raised whenever the same question is answered differently: what was kept is then asked again."""


@dataclass(frozen=True)
class Method:
    """A method to be tested: weights, or a sampler without any, and how it samples.

    Args:
        weights: Weights of the sampler: a name, a .safetensors file, a .ckpt or a run folder; or class_path and
            init_args of any StackSampler.
        block_list_weights: Weights of the block-list network: a name, a .safetensors file, a .ckpt or a run folder;
            those that ship for the sampler's world by default.
        sampler: Settings of a diffusion model's sampler; what is null is as its weights have it.
        verify: Checker by which verified sampling chooses the best of many stacks; null measures single samples.
        draws: Stacks that verified sampling may draw for a scene.
    """

    weights: str | StackSampler = DEFAULT
    block_list_weights: str = DEFAULT
    sampler: SamplerConfig = SamplerConfig()  # noqa: RUF009 - frozen
    verify: CheckerName | None = None
    draws: int = 64


@dataclass(frozen=True)
class Loaded:
    """A method, loaded.

    Args:
        method: What was loaded.
        model: Samples, and predicts block lists.
        name: Its name in tables, where it is given no other.
        weights: Name of its weights, or of the class of a sampler without any.
    """

    method: Method
    model: Model
    name: str
    weights: str

    def requests(
        self,
        name: str | None = None,
        num_samples: int = 3,
        seed: int = 0,
        *,
        predicted_lists: bool = True,
        batch_size: int = BATCH,
        facts: Mapping[str, Any] | None = None,
    ) -> list[Request]:
        """Ask it with the true block lists and, where that is wanted, with the network's.

        Args:
            name: Its name in tables.
            num_samples: Stacks of each scene.
            seed: Seed of the sampler.
            predicted_lists: Whether the network's block lists are asked about too.
            batch_size: Scenes sampled at once.
            facts: What is to be quoted with the results.
        """
        sampler = self.model.sampler
        request = Request(
            name or self.name,
            self.model.world,
            sampler,
            num_samples=num_samples,
            seed=seed,
            batch_size=batch_size,
            facts={**(facts or {}), "weights": self.weights, **self._origin()},
            identity=self.identity(),
        )
        if not predicted_lists:
            return [request]
        predictor = self.model.predictor
        digest = predictor.card.get("sha256") or _file_hash(self.method.block_list_weights, "predictor")
        return [request, replace(request, predictor=predictor, predictor_sha256=str(digest))]

    def identity(self) -> dict[str, Any]:
        """Tell the sampler from all others: the hash of its weights or of its code, and its settings."""
        sampler, weights = _base(self.model.sampler), self.model.weights
        settings = dict(self.model.sampler.settings)
        if weights is not None and not isinstance(sampler, Heuristic | SearchMethod):
            return {"weights": weights.sha256, "settings": settings}
        name = sampler.card.get("name") or self.weights
        return {"weights": name, "settings": settings, "code": code_hash(type(sampler))}

    def _origin(self) -> dict[str, Any]:
        """Say what a reader should know: the hash of the weights, how they sample, what they were trained on."""
        weights, settings = self.model.weights, dict(self.model.sampler.settings)
        dataset = self.model.sampler.card.get("dataset") or {}
        return {
            **({"weights_sha256": weights.sha256} if weights else {}),
            **({"sampler": settings} if settings else {}),
            **({"trained_on": {name: dataset.get(name) for name in ("name", "sha256")}} if dataset else {}),
        }


def load_method(method: Method) -> Loaded:
    """Load what a method names.

    Raises:
        StackgenError: If there are no such weights, or a sampler lacks a part of the contract.
    """
    if not isinstance(method.weights, str):
        require_sampler(method.weights)
    elif method.weights.lstrip().startswith("{"):  # what is no sampler is left as text by the parser
        raise StackgenError(
            f"weights {method.weights}: class_path names a class whose `sample_batch` is annotated as that of"
            " stackgen.protocols.StackSampler, and init_args what it takes"
        )
    model = load(method.weights, method.block_list_weights, method.sampler)
    own = model.weights.name if model.weights else type(model.sampler).__name__
    weights = method.weights if isinstance(method.weights, str) else own
    if method.verify is None:
        return Loaded(method, model, own, weights)
    from stackgen.sim.checkers import SimulatorChecker  # machines that only train have no PyBullet

    simulator = SimulatorChecker(model.physics, until_fall=True)
    checker = checker_named(method.verify, simulator)
    model.sampler = VerifiedSampler(model.sampler, checker, Budget(method.draws), method.verify)
    return Loaded(method, model, f"{own}, verified by {method.verify}", weights)


def require_sampler(sampler: object) -> None:
    """See that an object is a StackSampler.

    Raises:
        StackgenError: If it lacks a part.
    """
    missing = [name for name in ("world", "settings", "card", "sample_batch") if not hasattr(sampler, name)]
    if missing:
        raise StackgenError(
            f"{type(sampler).__name__} has no {' and no '.join(missing)}: a sampler has `world`, `settings`, `card` and"
            " `sample_batch`, as stackgen.protocols.StackSampler says"
        )


def require_one_world(loaded: Loaded, world: World, dataset: str) -> None:
    """See that the scenes of a dataset can be put to a method.

    Raises:
        StackgenError: If the dataset's shapes or grid are not those that the method knows.
    """
    known = loaded.model.world
    other = [name for name in ("catalogue", "grid") if getattr(known, name) != getattr(world, name)]
    if other:
        raise StackgenError(
            f"dataset {dataset} has another {' and '.join(other)} than {loaded.weights} was trained with:"
            " give a dataset of its world"
        )


def question_of(request: Request, test_set: str, scenes: int, physics: Mapping[str, Any]) -> Question:
    """Name all that the answer to a request depends on.

    Args:
        request: Who is asked, and how.
        test_set: Hash of the test set's manifest.
        scenes: How many of its scenes are asked about, from the first.
        physics: Numbers that the verdicts depend on.
    """
    plain = {
        "protocol": PROTOCOL,
        "sampler": request.identity,
        "block_list": request.block_list,
        "predictor": request.predictor_sha256,
        "test_set": test_set,
        "scenes": scenes,
        "num_samples": request.num_samples,
        "seed": request.seed,
        "batch_size": request.batch_size,
        "physics": physics,
    }
    return json.loads(json.dumps(plain, sort_keys=True))  # as it will be read back


def code_hash(kind: type) -> str:
    """Hash the module of a class, and those modules of its package that it imports, directly or not."""
    package = kind.__module__.rpartition(".")[0]
    sources: dict[str, bytes] = {}
    names = [kind.__module__]
    while names:
        name = names.pop()
        if name not in sources:
            sources[name] = Path(inspect.getfile(importlib.import_module(name))).read_bytes()
            found = _imports(sources[name], name.rpartition(".")[0])
            names += [other for other in found if package and other.startswith(f"{package}.")]
    digest = hashlib.sha256()
    for name, source in sorted(sources.items()):
        digest.update(name.encode() + b"\0" + source)
    return digest.hexdigest()


def _imports(source: bytes, package: str) -> Iterator[str]:
    """Name the modules that a module of a package imports, by their full names."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            yield resolve_name("." * node.level + (node.module or ""), package)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def _base(sampler: StackSampler) -> StackSampler:
    """Give the sampler that draws where verified sampling chooses."""
    return sampler.sampler if isinstance(sampler, VerifiedSampler) else sampler


def _file_hash(weights: str, role: str) -> str:
    return hashlib.sha256(resolve(weights, role).read_bytes()).hexdigest()
