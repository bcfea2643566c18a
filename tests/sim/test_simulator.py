"""What the simulator must do: the textbook cases, and the same for the same stack."""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from stackgen.geometry import mirror, tilt
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Pull, Rollout, Simulator
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, Catalogue, Shape
from tests.sim.engines import ENGINES

CUBE, RECTANGLE, LONG, TRIANGLE = range(4)


@pytest.fixture(scope="module", params=ENGINES)
def physics(request: pytest.FixtureRequest) -> Physics:
    """The project's numbers, with each engine."""
    return Physics(engine=request.param)


@pytest.fixture(scope="module")
def simulator(physics: Physics) -> Iterator[Simulator]:
    """The project's physics, with each engine."""
    with Simulator(physics) as simulator:
        yield simulator


def stack_of(*blocks: tuple[int, float, float]) -> Stack:
    """Upright blocks: (shape, x, z)."""
    return Stack(np.array([b[0] for b in blocks]), np.array([[x, 0, z, 0, 0, 0] for _, x, z in blocks]))


TOWER = stack_of((CUBE, 0, 0.5), (CUBE, 0.1, 1.5), (RECTANGLE, 0, 2.5), (TRIANGLE, 0.2, 3.5))
BRIDGE = stack_of((CUBE, -1, 0.5), (CUBE, 1, 0.5), (LONG, 0, 1.5), (CUBE, -1, 2.5), (CUBE, 1, 2.5), (LONG, 0, 3.5))
RUIN = stack_of((CUBE, 0, 0.5), (LONG, 0.9, 1.5), (CUBE, 0.4, 2.5), (CUBE, 1.5, 2.5), (TRIANGLE, 0.45, 3.5))
"""Falls down in a way that depends on every contact."""


def moved(rollout: Rollout) -> float:
    """Farthest way of any block along any axis [cell]."""
    return float(np.abs(rollout.end.poses - rollout.start.poses)[:, :3].max())


def same(a: Rollout, b: Rollout, order: NDArray[np.int64] | slice = slice(None)) -> bool:
    """Bit for bit, blocks of `b` in another order."""
    assert a.trajectory is not None and b.trajectory is not None
    return (
        (a.end.poses[order] == b.end.poses).all()
        and a.trajectory[:, order].tobytes() == b.trajectory.tobytes()
        and (a.at_rest, a.time) == (b.at_rest, b.time)
    )


# Textbook cases.


@pytest.mark.parametrize("shape", [CUBE, RECTANGLE, LONG, TRIANGLE])
def test_a_block_on_the_ground_rests_where_it_is(simulator: Simulator, shape: int) -> None:
    """The reference of a pose is the centre of the box, also of the triangle, whose centre of mass is lower."""
    rollout = simulator.rollout(stack_of((shape, 0.7, 0.5)))
    assert rollout.at_rest and moved(rollout) < 0.01
    assert np.abs(rollout.end.poses[:, 3:]).max() < 0.01
    assert rollout.time < simulator.physics.watch


@pytest.mark.parametrize("stack", [TOWER, BRIDGE], ids=["tower", "bridge"])
def test_what_is_supported_stands(simulator: Simulator, stack: Stack) -> None:
    rollout = simulator.rollout(stack)
    assert rollout.at_rest and moved(rollout) < 0.03


def test_a_block_in_the_air_falls_to_the_ground_as_galileo_says(simulator: Simulator) -> None:
    height = 8.0
    rollout = simulator.rollout(stack_of((CUBE, 0, 0.5 + height)), record_every=1)
    assert rollout.at_rest and rollout.drop[0] == pytest.approx(height, abs=0.02)
    assert rollout.trajectory is not None
    time = np.arange(len(rollout.trajectory)) * simulator.physics.step
    flight = time < 0.25
    assert flight.sum() > 100
    fallen = simulator.physics.gravity * time[flight] ** 2 / 2 / simulator.physics.cell_size
    assert rollout.start.poses[0, 2] - rollout.trajectory[flight, 0, 2] == pytest.approx(fallen, rel=0.03, abs=0.02)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("shape", [CUBE, RECTANGLE, LONG, TRIANGLE])
def test_a_block_stands_until_its_centre_of_mass_passes_the_edge(simulator: Simulator, shape: int, side: int) -> None:
    inside = simulator.rollout(stack_of((CUBE, 0, 0.5), (shape, side * 0.4, 1.5)))
    beyond = simulator.rollout(stack_of((CUBE, 0, 0.5), (shape, side * 0.6, 1.5)))
    assert inside.at_rest and moved(inside) < 0.05
    assert tilt(beyond.end.poses)[1] > 0.3 or beyond.drop[1] > 0.5  # a long one leans on its foot and the edge


def test_a_weight_on_the_far_end_holds_an_overhang(simulator: Simulator) -> None:
    overhang = [(CUBE, 0.0, 0.5), (LONG, 0.7, 1.5)]
    assert tilt(simulator.rollout(stack_of(*overhang)).end.poses)[1] > 0.3
    held = simulator.rollout(stack_of(*overhang, (RECTANGLE, -0.3, 2.5)))
    assert held.at_rest and moved(held) < 0.05


@pytest.mark.parametrize(("friction", "holds"), [(0.4, True), (0.2, False)])
def test_a_block_on_a_slope_holds_if_friction_exceeds_the_slope(physics: Physics, friction: float, holds: bool) -> None:
    """Coulomb: the roof rises 1 in 4, so blocks hold on it above a coefficient of 0.25 between the two."""
    roof = Shape("roof", ((-2, -0.25), (2, -0.25), (0, 0.25)))
    angle = np.arctan(0.25)
    normal = np.array([np.sin(angle), 0, np.cos(angle)])
    place = np.array([1, 0, 0.25]) + 0.125 * normal
    stack = Stack(
        np.array([0, 1]),
        np.array([[0, 0, 0.25, 0, 0, 0], [*place, 0, angle, 0]]),
        Catalogue((roof, Shape.box("tile", 0.5, 0.25))),
    )
    with Simulator(replace(physics, friction=friction)) as simulator:
        rollout = simulator.rollout(stack)
    assert (np.linalg.norm(rollout.end.poses[1, :3] - place) < 0.02) == holds
    assert (rollout.drop[1] < 0.02) == holds


@pytest.mark.parametrize("stack", [TOWER, BRIDGE, RUIN], ids=["tower", "bridge", "ruin"])
def test_the_mirrored_stack_meets_the_mirrored_fate(simulator: Simulator, stack: Stack) -> None:
    """What falls, falls; exact places after a collapse are chaos."""
    limit = simulator.physics.fall_height
    assert ((simulator.rollout(stack).drop > limit) == (simulator.rollout(mirror(stack)).drop > limit)).all()


def test_cell_size_is_a_matter_of_scale_where_verdicts_are_clear(physics: Physics) -> None:
    for size in (0.03, 0.1):
        with Simulator(replace(physics, cell_size=size)) as simulator:
            assert moved(simulator.rollout(BRIDGE)) < 0.05
            assert moved(simulator.rollout(RUIN)) > 0.5


# The same for the same stack.


@pytest.mark.parametrize("stack", [TOWER, BRIDGE, RUIN], ids=["tower", "bridge", "ruin"])
def test_a_rollout_does_not_depend_on_what_was_simulated_before(simulator: Simulator, stack: Stack) -> None:
    with Simulator(simulator.physics) as fresh:
        first = fresh.rollout(stack, record_every=10)
    for before in (RUIN, TOWER, BRIDGE):
        simulator.rollout(before)
    assert same(first, simulator.rollout(stack, record_every=10))
    slippery = replace(simulator.physics, friction=0.1)
    if slippery.engine == "bullet":
        slippery = replace(slippery, contact_threshold=0.02)
    with Simulator(slippery) as other:
        other.rollout(RUIN)
        assert same(first, simulator.rollout(stack, record_every=10))


@pytest.mark.parametrize("stack", [TOWER, BRIDGE, RUIN], ids=["tower", "bridge", "ruin"])
def test_a_rollout_does_not_depend_on_the_order_of_the_blocks(simulator: Simulator, stack: Stack) -> None:
    first = simulator.rollout(stack, record_every=10)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(len(stack))
        shuffled = Stack(stack.shapes[order], stack.poses[order])
        assert same(first, simulator.rollout(shuffled, record_every=10), order)


def test_a_closed_simulator_opens_again(physics: Physics) -> None:
    again = Simulator(physics)
    first = again.rollout(RUIN, record_every=10)
    again.close()
    again.close()
    assert same(first, again.rollout(RUIN, record_every=10))
    again.close()


def test_who_drops_a_simulator_gives_its_client_back() -> None:
    bullet = pytest.importorskip("pybullet")
    dropped = Simulator(Physics(engine="bullet"))
    dropped.rollout(TOWER)
    number = dropped._engine.number  # type: ignore[union-attr]
    assert bullet.isConnected(number)
    del dropped
    gc.collect()
    assert not bullet.isConnected(number)


def test_the_engine_s_greeting_is_not_heard(physics: Physics) -> None:
    """Command lines answer with lines of their own alone."""
    command = [sys.executable, "-c", f"import stackgen.sim.{physics.engine}_engine; print('ours')"]
    answer = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2], check=True)
    assert (answer.stdout, answer.stderr) == ("ours\n", "")


# What is recorded, and when a rollout ends.


def test_a_trajectory_begins_at_the_start_and_ends_at_the_end(simulator: Simulator) -> None:
    rollout = simulator.rollout(RUIN, record_every=1)
    steps = round(rollout.time / simulator.physics.step)
    assert rollout.trajectory is not None and rollout.trajectory.shape == (steps + 1, len(RUIN), 6)
    assert (rollout.trajectory[0] == RUIN.poses).all()
    assert (rollout.trajectory[-1] == rollout.end.poses).all()
    assert simulator.rollout(RUIN).trajectory is None


def test_a_short_watch_ends_before_rest(physics: Physics) -> None:
    with Simulator(replace(physics, watch=0.05)) as simulator:
        rollout = simulator.rollout(BRIDGE)
    assert not rollout.at_rest and rollout.time == pytest.approx(0.05, abs=1 / 480)


def test_until_fall_ends_at_the_first_fall_and_leaves_what_stands_alone(simulator: Simulator) -> None:
    whole, short = simulator.rollout(RUIN), simulator.rollout(RUIN, until_fall=True)
    assert short.time < whole.time and not short.at_rest
    assert short.drop.max() > simulator.physics.fall_height
    assert (simulator.rollout(BRIDGE, until_fall=True).end.poses == simulator.rollout(BRIDGE).end.poses).all()


def test_until_moved_ends_as_soon_as_a_block_is_away(simulator: Simulator) -> None:
    rollout = simulator.rollout(RUIN, until_moved=0.2)
    assert 0.2 < moved(rollout) < 0.5 and not rollout.at_rest


@pytest.mark.parametrize("stack", [RUIN, TOWER], ids=["ruin", "tower"])
@pytest.mark.parametrize("until", [{"until_fall": True}, {"until_moved": 0.2}, {"until_moved": 0.9}])
def test_a_rollout_is_cut_off_where_the_whole_one_first_says_so(
    simulator: Simulator, stack: Stack, until: dict[str, float]
) -> None:
    """It is looked at five times a window; what is found then must not depend on how carefully one looks."""
    look = round(simulator.physics.rest_window / simulator.physics.step) // 5
    whole = simulator.rollout(stack, record_every=look)
    assert whole.trajectory is not None
    away = np.abs(whole.trajectory[..., :3] - stack.poses[:, :3]).max(axis=(1, 2)) > until.get("until_moved", np.inf)
    if "until_fall" in until:
        away |= (stack.poses[:, 2] - whole.trajectory[..., 2]).max(axis=1) > simulator.physics.fall_height
    cut = simulator.rollout(stack, **until)  # type: ignore[arg-type]
    if away.any():
        assert round(cut.time / simulator.physics.step) == look * int(away.argmax())
        assert (cut.end.poses == whole.trajectory[away.argmax()]).all()
    else:
        assert (cut.end.poses == whole.end.poses).all() and cut.at_rest == whole.at_rest


def test_nothing_is_a_stack_that_rests(simulator: Simulator) -> None:
    rollout = simulator.rollout(Stack(np.zeros(0, int), np.zeros((0, 6))))
    assert rollout.at_rest and len(rollout.drop) == 0


def test_blocks_inside_each_other_are_pushed_apart_and_stay_finite(simulator: Simulator) -> None:
    rollout = simulator.rollout(stack_of((CUBE, 0, 0.5), (CUBE, 0, 0.5), (LONG, 0.1, 0.6)))
    assert np.isfinite(rollout.end.poses).all() and moved(rollout) > 0.2


def test_heaps_that_burst_apart_spinning_are_simulated_too(simulator: Simulator) -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        poses = np.concatenate([rng.normal(size=(10, 3)) * 0.1, rng.normal(size=(10, 3))], axis=1)
        poses[:, 2] = np.abs(poses[:, 2]) + 0.5
        assert moved(simulator.rollout(Stack(rng.integers(0, 4, 10), poses))) > 0.2


def test_the_catalogue_s_other_shapes_are_simulated_too(physics: Physics) -> None:
    corners = tuple((float(np.cos(a)), float(np.sin(a))) for a in np.arange(8) * np.pi / 4)
    plank, coin = Shape.box("plank", 3, 0.25), Shape("coin", corners)
    catalogue = Catalogue((plank, coin, *PAPER_CATALOGUE))
    with Simulator(physics) as simulator:
        stack = Stack(np.array([2, 0]), np.array([[0, 0, 0.5, 0, 0, 0], [0.1, 0, 1.125, 0, 0, 0]]), catalogue)
        assert moved(simulator.rollout(stack)) < 0.03
        turned = Stack(np.array([1]), np.array([[0, 0, np.cos(np.pi / 8), 0, np.pi / 8, 0]]), catalogue)
        assert moved(simulator.rollout(turned)) < 0.03  # on one of its sides


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_a_pull_slides_a_block_where_it_exceeds_friction_and_a_tilt_is_a_pull_on_all(
    simulator: Simulator, share: float
) -> None:
    flat = Stack(np.array([2, 0]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 5, 0.5, 0, 0, 0]]))  # too flat to tip
    forces = np.array([[share, 0, 0], [0, 0, 0]])
    rollout = simulator.rollout(flat, pull=Pull(lambda time: forces * min(1, time / 0.5), 0.5))  # at rest at first
    assert rollout.time > 0.5
    moved = np.linalg.norm(rollout.end.poses[:, :3] - flat.poses[:, :3], axis=1)
    assert (moved[0] > 0.5) == (share > simulator.physics.friction)
    assert moved[1] < 0.01
    angle = np.arctan(share)
    tilted = simulator.rollout(flat, pull=Pull(lambda time: np.tile([np.sin(angle), 0, 1 - np.cos(angle)], (2, 1)), 0))
    assert (np.abs(tilted.end.poses[0, 0]) > 0.5) == (share > simulator.physics.friction)
