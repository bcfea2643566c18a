"""Pairs of stacks for one silhouette and block list, one better than the other: what verdicts teach.

A sampler's own failures say what its training data cannot: which stacks it is tempted by and must leave.
Each is paired with a stack that stands and matches.

Legend: P pairs, N blocks at most, n samples a scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stackgen.data.arrays import PADDING, StackArrays
from stackgen.data.compact import write_npz
from stackgen.errors import MALFORMED, StackgenError
from stackgen.geometry import silhouette_iou
from stackgen.io.arrays import read_npz
from stackgen.io.files import read_bytes
from stackgen.protocols import StabilityChecker, StackSampler

_SCENES_AT_ONCE = 128


@dataclass(frozen=True)
class Preferences:
    """P pairs; a pair's two stacks have the same blocks in the same order, and one silhouette.

    Args:
        better: Stacks that stand and match.
        worse: Stacks that fall, or do not match.

    Raises:
        StackgenError: If they do not belong together.
    """

    better: StackArrays
    worse: StackArrays

    def __post_init__(self) -> None:
        if len(self) == 0 or not np.array_equal(self.better.shapes, self.worse.shapes):
            raise StackgenError("preferences: there must be pairs, each of two stacks of the same blocks")

    def __len__(self) -> int:
        return len(self.better)

    def save(self, path: Path) -> None:
        """Write as `.npz`, whole or not at all.

        Raises:
            StackgenError: If it cannot be written.
        """
        if path.suffix != ".npz":
            raise StackgenError(f"preferences are written to a .npz file, not {path.name}")
        shared = {name: getattr(self.better, name) for name in ("shapes", "silhouettes", "template", "num_shapes")}
        write_npz(path, {"better": self.better.poses, "worse": self.worse.poses, **shared})

    @staticmethod
    def load(path: str | Path) -> Preferences:
        """Read what :meth:`save` wrote.

        Raises:
            StackgenError: If the file is missing, broken, or not such a file.
        """
        try:
            file = read_npz(read_bytes(path))
            shapes, silhouettes, template = (file[name] for name in ("shapes", "silhouettes", "template"))
            number = int(file["num_shapes"])
            better, worse = (
                StackArrays(shapes, file[name], silhouettes, template, number) for name in ("better", "worse")
            )
        except FileNotFoundError as error:
            raise StackgenError(f"no preferences at {path}: make them with `stackgen prefer`") from error
        except (OSError, *MALFORMED) as error:
            raise StackgenError(f"{path} is not a file of preferences: make one with `stackgen prefer`") from error
        return Preferences(better, worse)


def prefer(
    sampler: StackSampler,
    checker: StabilityChecker,
    stacks: StackArrays,
    *,
    num_samples: int = 3,
    seed: int = 0,
    iou: float = 0.95,
    progress: Callable[[int], None] = lambda scenes: None,
) -> Preferences:
    """Sample for the silhouettes and block lists of some stacks, check, and pair each failure with a success.

    The success is another sample of the same scene in about half of the pairs, where there is one: what the
    sampler can do already. Otherwise it is the true stack, so that no way of standing is forgotten.

    Args:
        sampler: The sampler that is to learn.
        checker: Says which samples stand.
        stacks: Stacks of the training split, of the sampler's world.
        num_samples: Samples for each stack, n.
        seed: The same seed gives the same pairs.
        iou: Least match of a success: it stands, and its settled front silhouette has this share of the IoU that
            the dataset's own stack has with the target, which is 1 unless the target is a drawing.
        progress: Called with the number of scenes done.

    Raises:
        StackgenError: If no sample failed.
    """
    rng = np.random.default_rng(seed)
    order = np.argsort(stacks.lengths, kind="stable")  # equal numbers of blocks together: no padding is computed
    rows: list[int] = []
    better: list[NDArray[np.float64]] = []
    worse: list[NDArray[np.float64]] = []
    for start in range(0, len(order), _SCENES_AT_ONCE):
        part = order[start : start + _SCENES_AT_ONCE]
        targets = stacks.images(part)
        samples = sampler.sample_batch(targets, stacks.counts[part], num_samples, seed * 1_000_003 + start)
        verdicts = iter(checker.check_all([stack for drawn in samples for stack in drawn]))
        for row, target, drawn in zip(part.tolist(), targets, samples, strict=True):
            successes: list[NDArray[np.float64]] = []
            failures: list[NDArray[np.float64]] = []
            truth = _truth(stacks, row)
            least = iou * silhouette_iou(drawn[0].with_poses(truth), target, sampler.world.grid)
            for stack in drawn:
                verdict = next(verdicts)
                good = verdict.stable and silhouette_iou(verdict.settled, target, sampler.world.grid) >= least
                (successes if good else failures).append(stack.poses)
            for poses in failures:
                own = bool(successes) and rng.random() < 0.5
                rows.append(row)
                better.append(successes[rng.integers(len(successes))] if own else truth)
                worse.append(poses)
        progress(min(start + _SCENES_AT_ONCE, len(order)))
    if not rows:
        raise StackgenError("prefer: every sample stands and matches, so there is nothing to learn from them")
    scenes = stacks.select(np.array(rows))
    shapes = np.sort(scenes.shapes, axis=1)  # as samplers have them; padding is the largest number
    pair = [
        StackArrays(shapes, _padded(poses, shapes), scenes.silhouettes, scenes.template, stacks.num_shapes)
        for poses in (better, worse)
    ]
    return Preferences(*pair)


def _truth(stacks: StackArrays, row: int) -> NDArray[np.float64]:
    """(k, 6) poses of a stack, its blocks sorted by shape."""
    length = stacks.lengths[row]
    order = np.argsort(stacks.shapes[row, :length], kind="stable")
    return stacks.poses[row, order].astype(np.float64)


def _padded(poses: list[NDArray[np.float64]], shapes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(P, N, 6) poses, zero after the last block of each stack."""
    out = np.zeros((*shapes.shape, 6), np.float32)
    for row, found in zip(out, poses, strict=True):
        row[: len(found)] = found
    assert ((shapes != PADDING).sum(axis=1) == [len(found) for found in poses]).all()
    return out
