"""Whether a predicted block list can make (nearly) the best answer: what the search makes of it, beside its own best.

Drawings of a dataset of drawings, one answer of each, evenly spread over the validation split. A list follows the
drawing if the search, given it, finds a stack that stands within 0.02 IoU of the best that it finds on its own.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.common import argument_parser, percent, plain_table, report, start

if TYPE_CHECKING:
    from stackgen.world import Mask

NEAR = 0.02
COLUMNS = ("follows", "first_three", "front_iou")


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--weights", nargs="+", default=["default"], help="predictors: names, files or run folders")
    options.add_argument("--data", default="data/drawings", help="dataset of drawings")
    options.add_argument("--number", type=int, default=300, help="drawings")
    return options


def main() -> None:
    """Ask every predictor about the same drawings."""
    options = parser().parse_args()
    from stackgen.sampling.methods import load_predictor

    drawings = spread_drawings(options.data, options.number)
    rows = []
    for name in options.weights:
        predictor = load_predictor(name)
        rows.append({"method": name, **measured(drawings, [predictor.predict(one[None], 3)[0] for one in drawings])})
        print(name, *(percent(rows[-1][column]) for column in COLUMNS), flush=True)
    lines = [[row["method"], *(percent(row[column]) for column in COLUMNS)] for row in rows]
    headings = ("lists of", "can make nearly the best", "one of the first three can", "front IoU with the first")
    title = f"block lists of {len(drawings)} drawings, percent"
    report("taught_lists", {"number": len(drawings), "rows": rows}, [plain_table(title, headings, lines)], options.out)


def spread_drawings(path: str, number: int) -> list[Mask]:
    """Take silhouettes of distinct drawings, evenly spread over the validation split."""
    from stackgen.data.dataset import Dataset

    seen = {sample.meta["template"]: sample.silhouette for sample in Dataset.open(path).samples("validation")}
    masks = list(seen.values())
    return [masks[i] for i in np.linspace(0, len(masks) - 1, min(number, len(masks))).round().astype(int)]


def measured(drawings: list[Mask], lists: list[np.ndarray[Any, Any]]) -> dict[str, Any]:
    """Let the search build from the lists (3, S) of each drawing, and on its own; estimates as plain data."""
    from stackgen.evaluation.intervals import clustered_ratio
    from stackgen.search.solver import solve
    from stackgen.world import PAPER_WORLD

    def fit(drawing: Mask, block_list: np.ndarray[Any, Any] | None) -> float:
        return max((answer.iou for answer in solve(drawing, PAPER_WORLD, 1, block_list)), default=0.0)

    best = np.array([fit(drawing, None) for drawing in drawings])
    made = np.array(
        [[fit(drawing, one) for one in three] for drawing, three in zip(drawings, lists, strict=True)]
    )  # (drawings, 3)
    follows = made >= best[:, None] - NEAR
    values = {"follows": follows[:, 0], "first_three": follows.any(axis=1), "front_iou": made[:, 0]}
    estimates = {
        name: clustered_ratio(np.asarray(told, float), np.ones(len(drawings))) for name, told in values.items()
    }
    return {name: estimate and estimate.to_json() for name, estimate in estimates.items()}


if __name__ == "__main__":
    start(main)
