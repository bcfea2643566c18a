"""Mending: which blocks lie in others, where they go, and what of a sample changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stackgen.data.arrays import StackArrays
from stackgen.geometry import silhouette, silhouette_iou
from stackgen.models.diffusion.mending import CONFLICT, mended, misplaced, pushed_apart, relocated
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.sim.statics.fit import overlaps_and_gaps
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD
from tests.models.diffusion.test_network import Oracle, generator, model_for, normalised


def stack_of(shapes: list[int], places: list[tuple[float, float]]) -> Stack:
    """Upright blocks at places across and up."""
    return Stack(np.array(shapes), np.array([[x, 0, z, 0, 0, 0] for x, z in places]), PAPER_CATALOGUE)


ROW = stack_of([0, 0, 0, 1], [(-1.5, 0.5), (-0.5, 0.5), (0.5, 0.5), (0, 1.5)])
"""Three cubes, and a rectangle on two of them."""
SIZES = torch.tensor([[shape.size[0], shape.size[2]] for shape in PAPER_CATALOGUE], dtype=torch.float32)


def moved(stack: Stack, block: int, x: float, z: float) -> Stack:
    poses = stack.poses.copy()
    poses[block, [0, 2]] = x, z
    return stack.with_poses(poses)


def test_stacks_that_can_be_are_left_alone(arrays: StackArrays) -> None:
    batch = arrays.batch(range(len(arrays)))
    rows, poses = mended(batch["poses"], batch["shapes"], batch["mask"], batch["silhouette"], PAPER_WORLD)
    assert rows == [] and len(poses) == 0


@pytest.mark.parametrize("block", range(3))
def test_a_cube_that_lies_in_another_goes_back_to_the_empty_place(block: int) -> None:
    target = silhouette(ROW, PAPER_GRID)
    broken = moved(ROW, block, -0.5 if block == 0 else -1.4, 0.5)
    whole = relocated(broken, target, PAPER_GRID)
    assert whole is not None and misplaced(whole) == []
    assert silhouette_iou(broken, target, PAPER_GRID) < 0.85 < 0.97 < silhouette_iou(whole, target, PAPER_GRID)


def test_of_two_blocks_in_one_place_the_smaller_goes_and_of_equals_the_later() -> None:
    assert misplaced(moved(ROW, 3, 0.0, 0.5)) == [1, 2]  # both cubes lie in the rectangle
    assert misplaced(moved(ROW, 0, -0.5, 0.5)) == [1]
    assert misplaced(moved(ROW, 0, -1.5 + CONFLICT - 0.01, 0.5)) == []  # the simulator pushes these apart


def test_the_lowest_of_equal_places_is_taken() -> None:
    pile = stack_of([0] * 3, [(0, 0.5)] * 3)
    tower = stack_of([0] * 4, [(0, 0.5), (0, 1.5), (0, 2.5), (0, 3.5)])
    whole = relocated(pile, silhouette(tower, PAPER_GRID), PAPER_GRID)
    assert whole is not None and np.sort(whole.poses[:, 2]) == pytest.approx([0.5, 1.5, 2.5])


def test_equal_blocks_are_numbered_anew_whatever_the_order_of_shapes() -> None:
    """A cube that moves behind another in the order takes its slot, and each slot keeps its shape."""
    shapes = torch.tensor([[1, 0, 0, 0, -1]])
    poses = torch.zeros(1, 5, 6)
    poses[0, :4] = torch.from_numpy(moved(ROW, 0, 0.45, 0.5).poses[[3, 0, 1, 2]]).float()
    target = torch.from_numpy(silhouette(ROW, PAPER_GRID))[None].float()
    rows, found = mended(poses, shapes, shapes >= 0, target, PAPER_WORLD)
    assert rows == [0]
    expected = ROW.poses[[3, 0, 1, 2]]
    assert found[0, :4, [0, 2]].numpy() == pytest.approx(expected[:, [0, 2]], abs=0.1)  # a pixel is 0.07


def test_pushing_parts_overlapping_boxes_and_leaves_the_rest() -> None:
    poses = torch.from_numpy(
        np.stack([ROW.poses, moved(ROW, 0, -0.5, 0.5).poses, moved(ROW, 3, 0.1, 0.9).poses])
    ).float()
    shapes = torch.from_numpy(ROW.shapes).expand(3, -1)
    mask = torch.ones(3, 4, dtype=torch.bool)
    found = pushed_apart(poses, shapes, mask, SIZES)
    assert (found[0] == poses[0]).all()
    for before, after in zip(poses[1:], found[1:], strict=True):
        depths = [overlaps_and_gaps(ROW.with_poses(p.double().numpy())).largest_overlap for p in (before, after)]
        assert depths[1] < 0.7 * depths[0]
    assert found[..., [1, 3, 4, 5]].equal(poses[..., [1, 3, 4, 5]])
    assert found.mean(1) == pytest.approx(poses.mean(1), abs=1e-6)  # each gives way as much as the other
    mask[1, 0] = False  # padding pushes nothing
    assert pushed_apart(poses, shapes, mask, SIZES)[1].equal(poses[1])


def test_only_samples_in_conflict_are_denoised_anew(arrays: StackArrays) -> None:
    """The others are those of a sampler that does not mend, number by number."""
    batch = arrays.batch([0, 1, 2])
    model = model_for("v")
    clean = normalised(model, batch)
    clean[1, 1] = clean[1, 0]  # two blocks of the second scene in one place
    model.denoiser = Oracle(model, clean)  # type: ignore[assignment]
    scene = batch["silhouette"], batch["shapes"], batch["mask"]
    plain = model.sample(*scene, generator())
    model.denoiser = Oracle(model, clean)  # type: ignore[assignment]
    encode, asked = model.denoiser.encode, []

    def encoded(silhouettes: torch.Tensor) -> torch.Tensor:
        asked.append(len(silhouettes))
        if len(silhouettes) == 1:
            model.denoiser.clean = clean[1:2]
        return encode(silhouettes)

    model.denoiser.encode = encoded  # type: ignore[assignment]
    found = model.sample(*scene, generator(), SamplerConfig(mend=1))
    assert asked == [3, 1] and model.denoiser.calls == 50 + 20
    assert (found[[0, 2]] == plain[[0, 2]]).all()
    apart = [(poses[1, 0] - poses[1, 1]).abs().max() for poses in (plain, found)]
    assert apart[0] < 0.01 and apart[1] > 0.1  # the oracle says the same again, and it is pushed apart


def test_a_model_that_mends_does_so_unless_told_not_to(arrays: StackArrays) -> None:
    model = model_for("v")
    model.config = replace(model.config, mend=2)
    assert model.complete(SamplerConfig()).mend == 2
    assert model.complete(SamplerConfig(mend=0)).given()["mend"] == 0
    assert "mend" not in model_for("v").complete(SamplerConfig()).given()
