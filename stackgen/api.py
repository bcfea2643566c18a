"""The library's front door: `stackgen.load(...)`, `model.sample(...)`. The command line uses it too."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import PAPER_GRID, Grid, Mask, silhouette_iou
from stackgen.images import grid_offset, read_silhouette
from stackgen.protocols import BlockListPredictor, StabilityChecker, StackSampler
from stackgen.stack import (
    MAX_BLOCKS,
    PAPER_CATALOGUE,
    Catalogue,
    Stack,
    StackgenError,
    check_block_list,
    parse_block_list,
)
from stackgen.stacks_file import Entry, StacksFile, Weights

Silhouette = str | Path | NDArray[Any]
"""An image file; a (H, W) array, boolean with True where the structure is, or grey; or a colour (H, W, 3 or 4) one."""

BlockList = str | Mapping[str, int] | NDArray[np.int64]
"""`"cube=3,triangle=1"`, `{"cube": 3, "triangle": 1}` or counts (S,) in catalogue order."""

DEFAULT = "default"
"""Name of the weights in the package."""


class _Trained(Protocol):
    """What samplers and predictors read from files say of themselves."""

    catalogue: Catalogue
    grid: Grid
    max_blocks: int
    card: dict[str, Any]


class Model:
    """Silhouettes to stacks.

    Args:
        sampler: Proposes poses.
        predictor: Proposes the block list where none is given: the predictor, or what loads it once
            it is needed.
        catalogue, grid, max_blocks: The world the sampler was trained in.
        weights: Where the sampler's weights came from, for the record.
        checker: Judges; PyBullet by default.
    """

    def __init__(
        self,
        sampler: StackSampler,
        predictor: BlockListPredictor | Callable[[], BlockListPredictor] | None = None,
        *,
        catalogue: Catalogue = PAPER_CATALOGUE,
        grid: Grid = PAPER_GRID,
        max_blocks: int = MAX_BLOCKS,
        weights: Weights | None = None,
        checker: StabilityChecker | None = None,
    ) -> None:
        self.sampler = sampler
        self.catalogue = catalogue
        self.grid = grid
        self.max_blocks = max_blocks
        self.weights = weights
        self._predictor = predictor
        self._checker = checker

    def sample(
        self, silhouette: Silhouette, num_samples: int = 3, seed: int = 0, blocks: BlockList | None = None
    ) -> list[Stack]:
        """Stacks whose front silhouette should match; same seed, same stacks.

        Args:
            silhouette: Image file or array, of any size and either polarity.
            num_samples: How many stacks.
            seed: Of the noise.
            blocks: The block list; the network's most likely one by default.

        Raises:
            StackgenError: If there is nothing to see in the image, or the block list is not possible.
        """
        return self._draw(*self._scene(silhouette, blocks), num_samples, seed)

    def sample_checked(
        self,
        silhouette: Silhouette,
        num_samples: int = 3,
        seed: int = 0,
        blocks: BlockList | None = None,
        on_step: Callable[[], None] = lambda: None,
    ) -> StacksFile:
        """The stacks of :meth:`sample` with all that is known of them, as `stacks.json` holds it.

        Args:
            silhouette, num_samples, seed, blocks: As there.
            on_step: Called `num_samples + 1` times: once the poses are there, and after each verdict.

        Returns:
            Target, block list, and for each stack the simulator's verdict and the front IoU.
        """
        mask, counts = self._scene(silhouette, blocks)
        stacks = self._draw(mask, counts, num_samples, seed)
        on_step()
        entries = []
        for stack in stacks:
            entries.append(judge(self.checker, stack, mask, self.grid))
            on_step()
        physics = getattr(self.checker, "physics", None)
        return StacksFile(
            tuple(entries),
            self.catalogue,
            self.grid,
            target=mask,
            silhouette=Path(silhouette).name if isinstance(silhouette, str | Path) else None,
            block_list=counts,
            block_list_source="cnn" if blocks is None else "given",
            physics=physics.to_json() if physics else None,
            seed=seed,
            weights=self.weights,
            cell_size=physics.cell_size if physics else StacksFile.cell_size,
        )

    def read(self, silhouette: Silhouette) -> Mask:
        """The (H, W) silhouette in an image, scaled and placed as the model knows them."""
        return read_silhouette(silhouette, self.grid)

    def predict_blocks(self, silhouette: Silhouette) -> NDArray[np.int64]:
        """(S,) the network's most likely block list for a silhouette."""
        return self._scene(silhouette, None)[1]

    def counts(self, blocks: BlockList) -> NDArray[np.int64]:
        """(S,) counts of a block list in any of its forms.

        Raises:
            StackgenError: On an unknown shape, a negative or too large number of blocks.
        """
        if isinstance(blocks, str):
            return parse_block_list(blocks, self.catalogue, self.max_blocks)
        if isinstance(blocks, Mapping):
            counts = np.zeros(len(self.catalogue), dtype=np.int64)
            for name, number in blocks.items():
                counts[self.catalogue.index(name)] = number
        else:
            counts = np.asarray(blocks, dtype=np.int64)
        if counts.shape != (len(self.catalogue),):
            raise StackgenError(f"block list: one count for each of {', '.join(self.catalogue.names)}, got {blocks!r}")
        check_block_list(counts, self.max_blocks)
        return counts

    def _scene(self, silhouette: Silhouette, blocks: BlockList | None) -> tuple[Mask, NDArray[np.int64]]:
        """Target (H, W) and block list (S,)."""
        mask = self.read(silhouette)
        if blocks is not None:
            return mask, self.counts(blocks)
        aligned = np.roll(mask, grid_offset(mask, self.grid), axis=1)
        return mask, self.predictor.predict(aligned[None], top=1)[0, 0]

    def _draw(self, mask: Mask, counts: NDArray[np.int64], num_samples: int, seed: int) -> list[Stack]:
        if num_samples < 1:
            raise StackgenError(f"the number of samples must be at least 1, got {num_samples}")
        if not 0 <= seed < 2**63:
            raise StackgenError(f"the seed must be a whole number of at least 0, got {seed}")
        # The sampler sees the structure on the cells of its grid; what it answers moves back.
        offset = grid_offset(mask, self.grid)
        stacks = self.sampler.sample_batch(np.roll(mask, offset, axis=1)[None], counts[None], num_samples, seed)[0]
        back = np.array([-offset / self.grid.pixels_per_cell, 0, 0, 0, 0, 0])
        return [stack.with_poses(stack.poses + back) for stack in stacks]

    @cached_property
    def predictor(self) -> BlockListPredictor:
        """What proposes block lists.

        Raises:
            StackgenError: If the model was made without one.
        """
        if self._predictor is None:
            raise StackgenError("this model predicts no block lists: give one, e.g. blocks='cube=3,triangle=1'")
        return self._predictor() if callable(self._predictor) else self._predictor

    @cached_property
    def checker(self) -> StabilityChecker:
        """What judges the stacks."""
        if self._checker is not None:
            return self._checker
        from stackgen.sim.verdict import SimulatorChecker  # training machines have no PyBullet

        return SimulatorChecker(catalogue=self.catalogue)


def judge(checker: StabilityChecker, stack: Stack, target: Mask | None = None, grid: Grid = PAPER_GRID) -> Entry:
    """Simulate a stack; compare what then stands with a target (H, W). What falls has IoU 0 (SPEC, "IoU")."""
    verdict = checker.check(stack)
    if target is None:
        return Entry(stack, verdict)
    return Entry(stack, verdict, silhouette_iou(verdict.settled, target, grid=grid) if verdict.stable else 0.0)


def load(weights: str | Path = DEFAULT, block_list_weights: str | Path = DEFAULT) -> Model:
    """A model from weights.

    Args:
        weights: Of the sampler: a name in the package, a `.safetensors` file, a `.ckpt` of our
            training, or the folder of a run.
        block_list_weights: Of the block-list network, likewise; read when it is first needed.

    Raises:
        StackgenError: If there are no such weights, or they are not ours.
    """
    from stackgen.runs import resolve_weights
    from stackgen.weights import load_predictor, load_sampler  # imports torch

    file = resolve_weights(weights)
    sampler = load_sampler(file)
    about = cast(_Trained, sampler)

    def predictor() -> BlockListPredictor:
        loaded = load_predictor(resolve_weights(block_list_weights))
        other = cast(_Trained, loaded)
        if (other.catalogue, other.grid) != (about.catalogue, about.grid):
            raise StackgenError(
                f"the weights {weights} and {block_list_weights} were trained with different shapes or grids: "
                "give both of one world"
            )
        return loaded

    digest = about.card.get("sha256") or hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return Model(
        sampler,
        predictor,
        catalogue=about.catalogue,
        grid=about.grid,
        max_blocks=about.max_blocks,
        weights=Weights(about.card.get("name", Path(file).name), digest),
    )


def sample(
    silhouette: Silhouette,
    num_samples: int = 3,
    seed: int = 0,
    blocks: BlockList | None = None,
    weights: str | Path = DEFAULT,
) -> list[Stack]:
    """`load(weights).sample(...)` in one call; keep a model where you sample more than once."""
    return load(weights).sample(silhouette, num_samples, seed, blocks)
