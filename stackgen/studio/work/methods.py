"""The methods that the studio can ask, by name; imports no network."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

from stackgen.baselines import HEURISTICS
from stackgen.io.text import parse_json
from stackgen.search.sampler import NAME as SEARCH
from stackgen.world import PAPER_WORLD, World

BEST = "best"
"""Search and network together, as `stackgen sample` asks them."""

_TITLES = {
    "taught-verdicts": "Diffusion, taught by the search",
    "taught-small": "Diffusion, taught, without verdicts",
    "ddpm-verdicts": "Diffusion, with verdicts",
    "ddpm-small": "Diffusion, without verdicts",
    "ddpm-paper-small": "Diffusion, the paper's recipe",
    "tran-reg": "Tran-Reg: regression",
    "taught-tran-reg": "Tran-Reg, taught by the search",
    "tran-vae": "Tran-VAE",
    "taught-tran-vae": "Tran-VAE, taught by the search",
    SEARCH: "Search alone",
    "brute-force": "Brute-Force",
    "greedy-random": "Greedy-Random",
    "random-placement": "Random placement",
}


@cache
def methods() -> tuple[dict[str, Any], ...]:
    """List the methods of the paper's world: the name, a title, and the number of steps of those that denoise."""
    steps: dict[str, int | None] = {}
    for file in files("stackgen").joinpath("assets/weights").iterdir():
        if file.name.endswith(".json"):
            card = parse_json(file.read_text(encoding="utf-8"), file.name)
            if card["kind"] != "blocklist" and World.from_json(card) == PAPER_WORLD:
                steps[card["name"]] = card["config"].get("schedule", {}).get("steps")
    for name in (SEARCH, *HEURISTICS):
        steps[name] = None
    order = {name: place for place, name in enumerate(_TITLES)}
    names = sorted(steps, key=lambda name: (order.get(name, len(order)), name))
    first = {"name": BEST, "title": "Best: search and network", "steps": None}
    return (first, *({"name": name, "title": _TITLES.get(name, name), "steps": steps[name]} for name in names))
