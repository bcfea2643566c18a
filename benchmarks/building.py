"""What becomes of generated stacks that a simulated UR5 builds, with and without noise on where the blocks lie.

For each of a number of scenes of testset-v1 the shipped model draws stacks for the true block list until one stands
and can be planned: some need a temporary support on the way. That one is built once for each level of noise. Results
are kept in a file of lines as they come: the same command again continues where it was stopped. Intervals are 95 %,
by a bootstrap over scenes.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import argument_parser, plain_table, report, start
from stackgen.api import load
from stackgen.commands.progress_bar import progress_bar
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.errors import StackgenError
from stackgen.evaluation.intervals import clustered_ratio
from stackgen.evaluation.protocol import Scene, scenes_of
from stackgen.names import DEFAULT
from stackgen.robot.workcell import Workcell
from stackgen.sampling.alignment import AlignedSampler

TURN = 1.0
"""Noise on the turn of the blocks wherever there is noise on their place [deg]."""

DRAWS = 8
"""Stacks drawn for a scene, at most."""

Record = dict[str, Any]


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--number", type=int, default=100, help="number of scenes")
    options.add_argument(
        "--noise", type=float, nargs="*", default=[0.0, 1.0, 2.0], help="standard deviations of the places [mm]"
    )
    options.add_argument("--grasp", choices=("jaws", "fixed"), default="jaws", help="how blocks are held")
    options.add_argument("--seed", type=int, default=0, help="seed of the scenes, the stacks and the noise")
    options.add_argument("--weights", default=DEFAULT, help="weights of the sampler")
    options.add_argument("--workers", type=int, default=1, help="number of builds at a time")
    options.add_argument(
        "--lines", type=Path, default=Path("out/building.jsonl"), help="file for the results as they come"
    )
    return options


def main() -> None:
    """Draw, build, count."""
    options = parser().parse_args()
    if options.number < 1 or options.workers < 1:
        raise StackgenError("--number and --workers must be at least 1")
    asked = {key: getattr(options, key) for key in ("seed", "weights", "grasp")} | {"cell": asdict(Workcell())}
    records = read_lines(options.lines, asked)
    scenes = drawn(options.number, options.seed)
    jobs = [(scene, noise) for scene in scenes for noise in options.noise]
    open_jobs = [(scene, noise) for scene, noise in jobs if (scene.name, noise) not in records]
    options.lines.parent.mkdir(parents=True, exist_ok=True)
    with progress_bar("builds", len(jobs)) as (advance, _), options.lines.open("a") as lines:
        if not lines.tell():
            lines.write(json.dumps({"asked": asked}) + "\n")
        for record in performed(open_jobs, options):
            records[record["scene"], record["noise"]] = record
            lines.write(json.dumps(record, allow_nan=False) + "\n")
            lines.flush()
            advance(len(records))
    found = [records[scene.name, noise] for scene, noise in jobs]
    metrics: dict[str, Any] = {
        "scenes": len(scenes),
        "asked": asked,
        "levels": [level(noise, [record for record in found if record["noise"] == noise]) for noise in options.noise],
    }
    report("building", metrics, [summary_table(metrics["levels"])], options.out)


def read_lines(file: Path, asked: dict[str, Any]) -> dict[tuple[str, float], Record]:
    """Read the results that are there already.

    Raises:
        StackgenError: If they were made with other options.
    """
    if not file.exists() or not file.stat().st_size:
        return {}
    first, *others = [json.loads(line) for line in file.read_text().splitlines() if line.endswith("}")]
    if first.get("asked") != json.loads(json.dumps(asked)):
        raise StackgenError(f"{file} holds results of other options; name another file with --lines")
    return {(record["scene"], record["noise"]): record for record in others}


def drawn(number: int, seed: int) -> list[Scene]:
    """Draw scenes of the test set.

    Raises:
        StackgenError: If there are not so many.
    """
    test_set = Dataset.open(TESTSET)
    scenes = scenes_of(test_set.split("test"), test_set.world.catalogue)
    if number > len(scenes):
        raise StackgenError(f"--number: there are {len(scenes)} scenes")
    return [scenes[i] for i in np.sort(np.random.default_rng(seed).choice(len(scenes), number, replace=False))]


def performed(jobs: Sequence[tuple[Scene, float]], options: argparse.Namespace) -> Iterator[Record]:
    """Yield the results of some jobs, in their order."""
    work: Callable[[tuple[Scene, float]], Record] = partial(
        one, seed=options.seed, weights=options.weights, grasp=options.grasp
    )
    if options.workers == 1:
        yield from map(work, jobs)
        return
    with ProcessPoolExecutor(options.workers) as pool:
        yield from pool.map(work, jobs)


def one(job: tuple[Scene, float], seed: int, weights: str, grasp: Any) -> Record:
    """Draw a stack for a scene, build it, and say what became of it."""
    from stackgen.robot.build import build, plan_stack
    from stackgen.robot.simulated.arm import PickNoise

    scene, noise = job
    model, workcell = load(weights), Workcell()
    grid, sampler = model.world.grid, AlignedSampler(model.sampler)
    (stacks,) = sampler.sample_batch(scene.silhouette[None], scene.counts[None], DRAWS, seed)
    number = int(scene.name.partition("-")[0])
    picking = PickNoise(noise / 1e3, math.radians(TURN) if noise else 0.0, seed * 100_003 + number)
    record: Record = {"scene": scene.name, "noise": noise, "refused": [], "report": None}
    for stack in stacks:
        try:
            planned = plan_stack(stack, workcell, model.physics)
        except StackgenError as error:
            record["refused"].append(str(error))
            continue
        result = build(planned, grid, target=scene.silhouette, grasp=grasp, noise=picking)
        return record | {"report": result.to_json()}
    return record


def level(noise: float, records: Sequence[Record]) -> dict[str, Any]:
    """Count up one level of noise."""
    done = [record for record in records if record["report"]]
    reports = [record["report"] for record in done]
    reasons = [why for record in records for why in record["refused"]]
    fall, blocked = (sum(words in why for why in reasons) for words in ("does not stand", "no order is safe"))
    refused = {
        "scenes_without_a_build": len(records) - len(done),
        "stacks_that_fall": fall,
        "stacks_without_a_safe_order": blocked,
        "stacks_without_a_plan": len(reasons) - fall - blocked,
    }
    if not reports:
        return {"noise_mm": noise, "noise_deg": TURN if noise else 0.0, "builds": 0, "refused": refused}
    blocks = [report["blocks"] for report in reports]
    ones = np.ones(len(reports))
    shares = {
        "success": [report["success"] for report in reports],
        "unplanned_contact": [report["unplanned_contacts"] > 0 for report in reports],
        "iou_kept": [report["iou_target"] >= 0.95 * report["generated_iou_target"] for report in reports],
    }
    return {
        "noise_mm": noise,
        "noise_deg": TURN if noise else 0.0,
        "builds": len(reports),
        "refused": refused,
        "blocks": sum(map(len, blocks)),
        **{name: _json(clustered_ratio(np.array(values, float), ones)) for name, values in shares.items()},
        "iou_target": _json(clustered_ratio([report["iou_target"] for report in reports], ones)),
        "iou_of_generated": _json(clustered_ratio([report["generated_iou_target"] for report in reports], ones)),
        **{
            f"{when}_{key}": spread([[abs(block[when][key]) for block in some] for some in blocks])
            for when in ("released", "settled")
            for key in ("xy", "z", "yaw")
        },
        "disturbed": spread([[block["disturbed"] for block in some] for some in blocks]),
        "clearance": {"least_mm": min(block["clearance"] for some in blocks for block in some)},
        "ik_residual_mm": max(block["ik_distance"] for some in blocks for block in some),
        "seconds_per_block": spread([[block["seconds"] for block in some] for some in blocks]),
        "real_time_factor": _json(clustered_ratio([report["real_time_factor"] for report in reports], ones)),
        "tracking_error_deg": max(report["tracking_error"] for report in reports),
        "failures": [
            {
                "scene": record["scene"],
                "unplanned": [contact for block in record["report"]["blocks"] for contact in block["unplanned"]],
                "success": record["report"]["success"],
            }
            for record in done
            if not record["report"]["success"] or record["report"]["unplanned_contacts"]
        ],
    }


def _json(estimate: Any) -> dict[str, float] | None:
    return None if estimate is None else estimate.to_json()


def spread(clusters: Sequence[Sequence[float]], resamples: int = 1000) -> dict[str, dict[str, float]]:
    """Estimate median and 95th percentile of values that come in clusters, with intervals.

    >>> spread([[1.0, 1.0], [1.0]])["median"]
    {'value': 1.0, 'low': 1.0, 'high': 1.0}
    """
    arrays = [np.asarray(cluster, dtype=float) for cluster in clusters]
    rng = np.random.default_rng(0)
    draws = [np.concatenate([arrays[i] for i in rng.integers(len(arrays), size=len(arrays))]) for _ in range(resamples)]
    found = {}
    for name, q in (("median", 50), ("p95", 95)):
        low, high = np.percentile([np.percentile(draw, q) for draw in draws], [2.5, 97.5])
        value = np.percentile(np.concatenate(arrays), q)
        found[name] = {"value": float(value), "low": float(low), "high": float(high)}
    return found


def summary_table(levels: Sequence[dict[str, Any]]) -> Any:
    """Lay out one column for each level of noise."""
    lines: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("builds", lambda f: str(f["builds"])),
        ("stacks passed over: they fall", lambda f: str(f["refused"]["stacks_that_fall"])),
        ("they have no safe order", lambda f: str(f["refused"]["stacks_without_a_safe_order"])),
        ("no plan without collisions", lambda f: str(f["refused"]["stacks_without_a_plan"])),
        ("built and standing", lambda f: _share(f["success"])),
        ("with an unplanned contact", lambda f: _share(f["unplanned_contact"])),
        ("xy at release, median / 95 % [mm]", lambda f: _spread(f["released_xy"])),
        ("xy settled [mm]", lambda f: _spread(f["settled_xy"])),
        ("z settled [mm]", lambda f: _spread(f["settled_z"])),
        ("yaw settled [deg]", lambda f: _spread(f["settled_yaw"])),
        ("disturbed by later blocks [mm]", lambda f: _spread(f["disturbed"])),
        ("IoU with the target", lambda f: _share(f["iou_target"])),
        ("IoU of the generated stack", lambda f: _share(f["iou_of_generated"])),
        ("IoU at least 0.95 of that", lambda f: _share(f["iou_kept"])),
        ("least clearance planned [mm]", lambda f: f"{f['clearance']['least_mm']:.2f}"),
        ("arm's time for a block [s]", lambda f: _spread(f["seconds_per_block"])),
    ]
    some = [found for found in levels if found["builds"]]
    heading = ["", *(f"{found['noise_mm']:g} mm, {found['noise_deg']:g} deg" for found in some)]
    return plain_table("Stacks built", heading, [[name, *map(text, some)] for name, text in lines])


def _share(found: dict[str, float]) -> str:
    return f"{found['value']:.3f} [{found['low']:.3f}, {found['high']:.3f}]"


def _spread(found: dict[str, dict[str, float]]) -> str:
    return f"{found['median']['value']:.2f} / {found['p95']['value']:.2f}"


if __name__ == "__main__":
    start(main)
