"""A layout is seen if the set of training layouts, made one by one, holds it; and when in doubt, it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stackgen.data.arrays import StackArrays
from stackgen.data.generation.designs import Design
from stackgen.data.inspection.seen_layouts import layout_codes, seen_layouts
from stackgen.data.shards import Sample
from stackgen.geometry import mirror
from stackgen.stack import Stack, layout
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD

Samples = dict[str, list[Sample]]


def some(stacks: list[Stack]) -> StackArrays:
    """Arrays of stacks, with noise that leaves their designs what they are."""
    rng = np.random.default_rng(1)
    samples = []
    for stack in stacks:
        poses = (stack.poses + rng.uniform(-0.2, 0.2, (len(stack), 1)) * [1, 1, 0, 0, 0, 1]).astype(np.float32)
        samples.append(Sample("", stack.shapes.astype(np.uint8), poses, np.zeros((64, 64), bool), {"template": 0}))
    return StackArrays.from_samples(samples, PAPER_WORLD)


@pytest.fixture(scope="module")
def stacks(samples: Samples) -> list[Stack]:
    return [sample.stack(PAPER_CATALOGUE) for those in samples.values() for sample in those]


def test_layouts_are_those_of_the_metrics(stacks: list[Stack]) -> None:
    """With few blocks left, so that layouts do meet by chance."""
    few = [Stack(stack.shapes[:5], stack.poses[:5]) for stack in stacks]
    train, test = few[:60], few[60:]
    known = {layout(stack, PAPER_GRID) for stack in train}
    seen = seen_layouts(some(train), some(test), PAPER_WORLD, mirror=False)
    assert seen.tolist() == [layout(stack, PAPER_GRID) in known for stack in test]
    assert 0 < seen.sum() < len(seen)
    known |= {layout(mirror(stack), PAPER_GRID) for stack in train}
    mirrored = seen_layouts(some(train), some(test), PAPER_WORLD)
    assert mirrored.tolist() == [layout(stack, PAPER_GRID) in known for stack in test]
    assert mirrored.sum() > seen.sum()


def test_designs_are_those_of_the_metadata(samples: Samples, stacks: list[Stack]) -> None:
    """Equal codes, equal texts, displaced and settled or not."""
    keys = [sample.meta["layout"] for those in samples.values() for sample in those]
    codes = [tuple(row) for row in layout_codes(some(stacks), PAPER_WORLD, positions=True).tolist()]
    assert len(set(zip(keys, codes, strict=True))) == len(set(keys)) == len(set(codes))


def test_a_shift_by_a_cell_is_another_design_but_no_other_layout() -> None:
    here, there = Design.from_key("0@0,1@1"), Design.from_key("0@1,1@2")

    def built(design: Design) -> StackArrays:
        poses = [[left - 2 + (1, 2)[shape] / 2, 0, 0.5, 0, 0, 0] for shape, left in design.rows[0]]
        return some([Stack([shape for shape, _ in design.rows[0]], poses)])  # type: ignore[arg-type]

    assert seen_layouts(built(here), built(there), PAPER_WORLD).all()
    assert not seen_layouts(built(here), built(there), PAPER_WORLD, positions=True).any()
    assert seen_layouts(built(here), built(here), PAPER_WORLD, positions=True).all()


def test_the_order_of_the_blocks_does_not_matter(stacks: list[Stack]) -> None:
    turned = [Stack(stack.shapes[::-1], stack.poses[::-1]) for stack in stacks]
    for positions in (False, True):
        assert (
            layout_codes(some(stacks), PAPER_WORLD, positions=positions)
            == layout_codes(some(turned), PAPER_WORLD, positions=positions)
        ).all()


def test_padding_is_no_block(stacks: list[Stack]) -> None:
    train = some(stacks)
    first = train.select(slice(20))
    shorter = replace(first, shapes=first.shapes[:, :9], poses=first.poses[:, :9])
    whole = train.lengths[:20] <= 9
    assert seen_layouts(train, shorter, PAPER_WORLD)[whole].all() and whole.any()
