"""Methods by name: heuristics, the search, and the networks behind weights.

torch is imported only where weights are read, so that a heuristic needs none.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stackgen.baselines import HEURISTICS
from stackgen.errors import StackgenError
from stackgen.names import DEFAULT
from stackgen.protocols import BlockListPredictor, StackSampler
from stackgen.search.sampler import NAME, SearchBlockLists, SearchSampler
from stackgen.world import PAPER_WORLD, World

if TYPE_CHECKING:
    from stackgen.models.weights import Maker


def load_sampler(weights: str | Path = DEFAULT) -> StackSampler:
    """Load the sampler behind a name (`search`, a heuristic's, that of weights), a weights file or a run.

    Raises:
        StackgenError: If there is no such thing, or it holds something else.
    """
    if str(weights) in HEURISTICS:
        return HEURISTICS[str(weights)](PAPER_WORLD)
    if str(weights) == NAME:
        return SearchSampler()
    return _load(weights, "sampler", _samplers())


def load_predictor(weights: str | Path = DEFAULT, world: World = PAPER_WORLD) -> BlockListPredictor:
    """Load the block-list predictor behind a name (`search`, or that of weights), a weights file or a run.

    Args:
        weights: What to load; `default` is what ships for the world.
        world: World of the sampler that it is for.

    Raises:
        StackgenError: If there is no such thing, or it holds something else.
    """
    if str(weights) == NAME:
        return SearchBlockLists(world)
    if str(weights) == DEFAULT:
        from stackgen.models.weights import predictor_of

        weights = predictor_of(world)
    return _load(weights, "block-list predictor", _predictors())


def role_of(weights: str | Path) -> str:
    """Say what a name, file or checkpoint holds: `predictor` for a block-list network, else `sampler`.

    Raises:
        StackgenError: If there is no such thing or it is damaged.
    """
    from stackgen.models.weights import read_weights

    return "predictor" if read_weights(weights)[1].get("kind") in _predictors() else "sampler"


def _load(weights: str | Path, what: str, makers: Mapping[str, Maker]) -> Any:
    from stackgen.models.weights import build, read_weights

    tensors, card = read_weights(
        weights, *(("sampler", (*HEURISTICS, NAME)) if what == "sampler" else ("predictor", (NAME,)))
    )
    if card.get("kind") not in makers:
        raise StackgenError(f"{weights} holds weights of kind {card.get('kind')!r}, not of a {what}")
    return build(weights, card, tensors, makers[card["kind"]])


def _samplers() -> dict[str, Maker]:
    from stackgen.baselines.tran_reg import make_tran_reg
    from stackgen.baselines.tran_vae import make_tran_vae
    from stackgen.models.diffusion.sampler import make_diffusion

    return {"ddpm": make_diffusion, "tran-reg": make_tran_reg, "tran-vae": make_tran_vae}


def _predictors() -> dict[str, Maker]:
    from stackgen.models.block_list.predictor import make_block_list

    return {"blocklist": make_block_list}
