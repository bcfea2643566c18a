"""Stacks for the tests of statics, written by hand or from the frozen test set."""

from __future__ import annotations

from itertools import islice

import numpy as np
from scipy.spatial.transform import Rotation

from stackgen.data.dataset import TESTSET, Dataset
from stackgen.sim.statics.checker import StaticsChecker
from stackgen.stack import Stack

CUBE, RECTANGLE, LONG, TRIANGLE = range(4)
FREE = StaticsChecker(safety=0)
"""Takes all that could stand."""


def stack(*blocks: tuple[int, float, float], yaw: float = 0) -> Stack:
    """Blocks of (shape, x, z), turned about the vertical through the origin."""
    shapes = [shape for shape, _, _ in blocks]
    return turned(Stack(np.array(shapes), np.array([[x, 0, z, 0, 0, 0] for _, x, z in blocks], dtype=float)), yaw)


def turned(upright: Stack, yaw: float, shift: tuple[float, float] = (0, 0)) -> Stack:
    """The whole stack turned about the vertical and moved on the ground."""
    turn = Rotation.from_rotvec([0, 0, yaw])
    poses = upright.poses.copy()
    poses[:, :3] = turn.apply(poses[:, :3]) + [*shift, 0]
    poses[:, 3:] = (turn * Rotation.from_rotvec(upright.poses[:, 3:])).as_rotvec()
    return upright.with_poses(poses)


def settled_stacks(number: int, start: int = 0) -> list[Stack]:
    """Some of the frozen test set."""
    testset = Dataset.open(TESTSET)
    return [sample.stack(testset.world.catalogue) for sample in islice(testset.samples("test"), start, start + number)]


def without(whole: Stack, block: int) -> Stack:
    """A stack less one block."""
    keep = np.arange(len(whole)) != block
    return Stack(whole.shapes[keep], whole.poses[keep], whole.catalogue)


def shaken(number: int) -> list[Stack]:
    """Settled stacks, some whole, some less a block: both verdicts occur."""
    rng = np.random.default_rng(3)
    return [s if i % 3 else without(s, int(rng.integers(len(s)))) for i, s in enumerate(settled_stacks(number))]
