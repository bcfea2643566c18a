"""Whether what is delivered is clean: how far its blocks overlap or float, and whether both engines say the same of it.

Scenes of testset-v1, evenly spread, as they are and disturbed (as in `benchmarks.out_of_distribution`), and pictures
that people drew are asked for as `stackgen sample` asks. Intervals are 95 %, clustered by picture.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.common import argument_parser, percent, plain_table, report, start
from benchmarks.out_of_distribution import DISTURBANCES, scenes_of_kind
from stackgen.errors import StackgenError
from stackgen.evaluation.intervals import clustered_ratio
from stackgen.io.files import write_json
from stackgen.io.stacks_file import StackEntry, StacksFile
from stackgen.sim.statics.fit import CLEAN, overlaps_and_gaps
from stackgen.world import Mask

if TYPE_CHECKING:
    from stackgen.protocols import StabilityChecker

Picture = Path | Mask
Deliver = Callable[[Picture], StacksFile]
"""Function that answers a picture."""

AS_IT_IS = "as it is"


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--scenes", type=int, default=50, help="scenes, evenly spread over the test set")
    kinds = [AS_IT_IS, "turned by 5 degrees", "drawn by hand"]
    options.add_argument("--kinds", nargs="*", choices=DISTURBANCES, default=kinds, help="how scenes are disturbed")
    drawn = [Path("examples/silhouettes")]
    options.add_argument("--pictures", nargs="*", type=Path, default=drawn, help="folders of pictures")
    options.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS), help="ways to ask")
    options.add_argument("--num_samples", type=int, default=3, help="stacks of each picture")
    options.add_argument("--seed", type=int, default=0, help="seed of disturbances and of the network")
    return options


def _together(options: argparse.Namespace) -> Deliver:
    from stackgen.api import best

    return lambda picture: best(picture, options.num_samples, options.seed)


def _verified(options: argparse.Namespace) -> Deliver:
    from stackgen.api import load

    model = load()
    return lambda picture: model.sample_verified(picture, options.num_samples, options.seed)


WAYS: Mapping[str, Callable[[argparse.Namespace], Deliver]] = {"together": _together, "verified": _verified}
"""Search and network together, as `stackgen sample` asks by default, and the network alone with `--verify`."""


def pictures_of(options: argparse.Namespace, checker: StabilityChecker) -> dict[str, list[Picture]]:
    """The pictures, by the set that they belong to."""
    from stackgen.data.dataset import TESTSET
    from stackgen.evaluation.protocol import load_scenes

    everything, _ = load_scenes(TESTSET)
    number = min(options.scenes, len(everything))
    scenes = [everything[i] for i in np.linspace(0, len(everything) - 1, number).round().astype(int)]
    sets: dict[str, list[Picture]] = {}
    for kind in options.kinds:
        asked = scenes_of_kind(kind, scenes, checker, options.seed)
        sets[f"test scenes, {kind}"] = [scene.silhouette for scene in asked]
    for folder in options.pictures:
        sets[f"pictures of {folder}"] = sorted(path for path in folder.iterdir() if path.is_file())
    return sets


def measured(entry: StackEntry, second: StabilityChecker) -> dict[str, Any]:
    """How clean a stack is [cell], and what both engines say."""
    fit, verdict = overlaps_and_gaps(entry.stack), entry.verdict
    assert verdict is not None
    return {
        "overlap": fit.largest_overlap,
        "gap": fit.largest_gap,
        "clean": max(fit.largest_overlap, fit.largest_gap) <= CLEAN,
        "stands": verdict.stable,
        "same_in_both": verdict.stable == second.check(entry.stack).stable,
        "front_iou": entry.front_iou,
    }


def row_of(pictures: Sequence[Picture], deliver: Deliver, second: StabilityChecker) -> dict[str, Any]:
    """Ask for each picture and measure what is delivered; a picture for which nothing is delivered is counted."""
    stacks: list[list[dict[str, Any]]] = []
    refused, seconds = [], 0.0
    for picture in pictures:
        began = time.process_time()
        try:
            entries = deliver(picture).entries
        except StackgenError as error:
            refused.append(f"{picture.name}: {error}" if isinstance(picture, Path) else str(error))
            continue
        finally:
            seconds += time.process_time() - began
        stacks.append([measured(entry, second) for entry in entries])
    shares = {name: clustered_ratio([sum(s[name] for s in some) for some in stacks], [len(some) for some in stacks])
              for name in ("clean", "stands", "same_in_both", "front_iou")}  # fmt: skip
    return {
        "pictures": len(pictures),
        "stacks": sum(map(len, stacks)),
        "refused": refused,
        **{
            f"largest_{name}": max((s[name] for some in stacks for s in some), default=0.0)
            for name in ("overlap", "gap")
        },
        **{name: share and share.to_json() for name, share in shares.items()},
        "cpu_seconds_per_picture": seconds / max(1, len(pictures)),
        "differ": [[i, j] for i, some in enumerate(stacks) for j, s in enumerate(some) if not s["same_in_both"]],
    }


def main() -> None:
    """Ask for everything in every way."""
    options = parser().parse_args()
    if min(options.scenes, options.num_samples) < 1:
        raise StackgenError("--scenes and --num_samples must be at least 1")
    from stackgen.sim.checkers import SimulatorChecker
    from stackgen.sim.physics import Physics

    first, second = (SimulatorChecker(Physics(engine=engine), until_fall=True) for engine in ("bullet", "mujoco"))
    rows: list[dict[str, Any]] = []
    metrics = {
        "num_samples": options.num_samples,
        "seed": options.seed,
        "clean_cells": CLEAN,
        "physics": first.physics.to_json(),
        "second_engine": second.physics.to_json(),
        "rows": rows,
    }
    sets = pictures_of(options, first)
    for way in options.ways:
        deliver = WAYS[way](options)
        for name, pictures in sets.items():
            rows.append({"set": name, "way": way, **row_of(pictures, deliver, second)})
            print(f"{name}, {way}: {rows[-1]}", flush=True)
            if options.out is not None:
                options.out.parent.mkdir(parents=True, exist_ok=True)
                write_json(options.out, metrics)
    report("delivered", metrics, [table(rows)], options.out)


def table(rows: Sequence[Mapping[str, Any]]) -> Any:
    """A line for each set and way."""
    headings = ("asked", "stacks", "stand", "overlap", "gap", "clean", "same in both")
    lines = [
        [
            f"{row['set']}, {row['way']}", str(row["stacks"]), percent(row["stands"]), f"{row['largest_overlap']:.4f}",
            f"{row['largest_gap']:.4f}", percent(row["clean"]), percent(row["same_in_both"]),
        ]
        for row in rows
    ]  # fmt: skip
    return plain_table("Largest overlap and gap [cell], shares in percent", headings, lines)


if __name__ == "__main__":
    start(main)
