"""One method, asked by name: `stackgen.load(...)`, `model.sample(...)`. The command line uses it too."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette_iou
from stackgen.io.stacks_file import StackEntry, StacksFile, Weights
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.names import DEFAULT, CheckerName
from stackgen.protocols import BlockListPredictor, StabilityChecker, StackSampler
from stackgen.sampling.alignment import AlignedSampler, as_shown
from stackgen.stack import Stack, check_block_list, parse_block_list
from stackgen.vision.reader import Reading, read_silhouette
from stackgen.world import Grid, Mask, World

if TYPE_CHECKING:
    from stackgen.sampling.inventory import Inventory
    from stackgen.sampling.verified import Budget
    from stackgen.sim.physics import Physics

Silhouette = str | Path | NDArray[Any] | Reading
"""An image file; a (H, W) array, boolean with True where the structure is, or grey; a colour (H, W, 3 or 4) one; or
what was read in a picture, which keeps its scale where that is known."""

BlockList = str | Mapping[str, int] | NDArray[np.int64]
"""`"cube=3,triangle=1"`, `{"cube": 3, "triangle": 1}` or counts (S,) in catalogue order."""

_LISTS_TRIED = 5  # block lists that verified sampling tries, at most


class Model:
    """Silhouettes to stacks.

    Args:
        sampler: Proposes poses; its world is the model's.
        predictor: Proposes the block list where none is given: the predictor, or what loads it once
            it is needed.
        weights: Where the sampler's weights came from, for the record.
        checker: Says which stacks stand; PyBullet by default.

    Raises:
        StackgenError: If the sampler does not say which world it knows.
    """

    def __init__(
        self,
        sampler: StackSampler,
        predictor: BlockListPredictor | Callable[[], BlockListPredictor] | None = None,
        *,
        weights: Weights | None = None,
        checker: StabilityChecker | None = None,
    ) -> None:
        if not isinstance(getattr(sampler, "world", None), World):
            raise StackgenError(f"the sampler {type(sampler).__name__} has no world: give it one, see StackSampler")
        self.sampler = sampler
        self.weights = weights
        self._predictor = predictor
        self._checker = checker

    @property
    def world(self) -> World:
        """The world that the sampler knows."""
        return self.sampler.world

    def sample(
        self,
        silhouette: Silhouette,
        num_samples: int = 3,
        seed: int = 0,
        blocks: BlockList | None = None,
        inventory: Inventory | None = None,
    ) -> list[Stack]:
        """Sample stacks whose front silhouette should match; the same seed gives the same stacks.

        Args:
            silhouette: Image file or array, of any size and either polarity.
            num_samples: Number of stacks.
            seed: Seed of the samples.
            blocks: The block list; the network's most likely one by default.
            inventory: Blocks that are available, in the same forms; the block list is then the most likely one that
                they allow.

        Raises:
            StackgenError: If there is nothing to see in the image, the block list is not possible, or the inventory
                allows none.
        """
        mask, lists = self._scene(silhouette, blocks, inventory)
        return self._draw(mask, lists[0], num_samples, seed)

    def sample_checked(
        self,
        silhouette: Silhouette,
        num_samples: int = 3,
        seed: int = 0,
        blocks: BlockList | None = None,
        on_step: Callable[[], None] = lambda: None,
        inventory: Inventory | None = None,
    ) -> StacksFile:
        """Sample as :meth:`sample` does, and check each stack.

        Args:
            silhouette, num_samples, seed, blocks, inventory: As in :meth:`sample`.
            on_step: Called `num_samples + 1` times: once the poses are there, and after each verdict.

        Returns:
            What `stacks.json` holds: target, block list, and for each stack the checker's verdict and the front IoU.
        """
        mask, lists = self._scene(silhouette, blocks, inventory)
        stacks = self._draw(mask, lists[0], num_samples, seed)
        on_step()
        entries = []
        for stack in stacks:
            entries.append(check(self.checker, stack, mask, self.world.grid))
            on_step()
        asked: dict[str, Any] = {"silhouette": silhouette, "seed": seed, "blocks": blocks, "inventory": inventory}
        file = self._file(entries, mask, lists[0], **asked)
        return replace(file, sampler=dict(self.sampler.settings))

    def sample_verified(
        self,
        silhouette: Silhouette,
        num_samples: int = 3,
        seed: int = 0,
        blocks: BlockList | None = None,
        inventory: Inventory | None = None,
        verify: CheckerName = "simulator",
        budget: Budget | None = None,
        on_step: Callable[[], None] = lambda: None,
    ) -> StacksFile:
        """Draw many stacks, check them, keep the best; see stackgen.sampling.verified.

        Where fewer valid stacks than asked for stand with the most likely block list, the next likely ones
        are tried; a list that was given is never changed.

        Args:
            silhouette, num_samples, seed, blocks, inventory: As in :meth:`sample`.
            verify: The checker that is asked while it draws: the `simulator`, or `statics`, which is faster.
            budget: What may be spent; 64 draws by default. With a budget of draws the same seed gives the
                same stacks, with one of time that depends on the machine.
            on_step: As in :meth:`sample_checked`.

        Returns:
            As :meth:`sample_checked`, the verdicts being the simulator's in any case, and each stack as it settled. Its
            comment says what was drawn and checked, that of a stack whether nothing stable was found for it.
        """
        from stackgen.sampling.clean import as_settled
        from stackgen.sampling.verified import Budget, VerifiedSampler, checker_named, choose_list

        self._check_draw(num_samples, seed)
        mask, lists = self._scene(silhouette, blocks, inventory, top=_LISTS_TRIED)
        checker = checker_named(verify, self.checker)
        sampler = VerifiedSampler(AlignedSampler(self.sampler), checker, budget or Budget(), verify)
        counts, choice, tried = choose_list(sampler, mask, lists, num_samples, seed)
        on_step()
        entries = []
        delivered = as_settled([found.stack for found in choice.chosen], self.checker)
        for stack, verdict in delivered:
            front_iou = silhouette_iou(verdict.settled, mask, self.world.grid) if verdict.stable else 0.0
            comment = "" if verdict.stable else "nothing stable was found for it"
            entries.append(StackEntry(stack, verdict, front_iou, comment=comment))
            on_step()
        asked: dict[str, Any] = {"silhouette": silhouette, "seed": seed, "blocks": blocks, "inventory": inventory}
        file = self._file(entries, mask, counts, **asked)
        comment = f"verified by {verify}: {choice.drawn} stacks drawn, {choice.checked} checked, {choice.stable} stable"
        comment += f", {tried} block lists tried" if tried > 1 else ""
        return replace(file, sampler=sampler.settings, comment=comment)

    def _file(
        self,
        entries: Sequence[StackEntry],
        mask: Mask,
        block_list: NDArray[np.int64],
        *,
        silhouette: Silhouette,
        seed: int,
        blocks: BlockList | None,
        inventory: Inventory | None,
    ) -> StacksFile:
        physics = self.checker.physics
        return StacksFile(
            tuple(entries),
            self.world,
            target=mask,
            silhouette=Path(silhouette).name if isinstance(silhouette, str | Path) else None,
            block_list=block_list,
            block_list_source="cnn" if blocks is None else "given",
            inventory=None if inventory is None else self.inventory(inventory),
            physics=physics.to_json(),
            seed=seed,
            weights=self.weights,
            cell_size=physics.cell_size,
        )

    def read(self, silhouette: Silhouette) -> Mask:
        """Read the (H, W) silhouette in an image, scaled and placed as the model knows them."""
        if isinstance(silhouette, Reading):
            return silhouette.silhouette(self.world.grid)
        return read_silhouette(silhouette, self.world.grid)

    def predict_blocks(self, silhouette: Silhouette, inventory: Inventory | None = None) -> NDArray[np.int64]:
        """Predict the most likely block list (S,) of a silhouette, of those that an inventory allows."""
        return self._scene(silhouette, None, inventory)[1][0]

    def inventory(self, inventory: Inventory) -> NDArray[np.int64]:
        """Count the blocks (S,) of an inventory in any of its forms.

        Raises:
            StackgenError: On an unknown shape, a negative number, or no block at all.
        """
        from stackgen.sampling.inventory import inventory_counts

        return inventory_counts(inventory, self.world.catalogue)

    def counts(self, blocks: BlockList) -> NDArray[np.int64]:
        """Count the blocks (S,) of a block list in any of its forms.

        Raises:
            StackgenError: On an unknown shape, a negative or too large number of blocks.
        """
        if isinstance(blocks, str):
            return parse_block_list(blocks, self.world.catalogue, self.world.max_blocks)
        if isinstance(blocks, Mapping):
            counts = np.zeros(len(self.world.catalogue), dtype=np.int64)
            for name, number in blocks.items():
                counts[self.world.catalogue.index(name)] = number
        else:
            counts = np.asarray(blocks, dtype=np.int64)
        if counts.shape != (len(self.world.catalogue),):
            raise StackgenError(
                f"block list: one count for each of {', '.join(self.world.catalogue.names)}, got {blocks!r}"
            )
        check_block_list(counts, self.world.max_blocks)
        return counts

    def _scene(
        self, silhouette: Silhouette, blocks: BlockList | None, inventory: Inventory | None = None, top: int = 1
    ) -> tuple[Mask, NDArray[np.int64]]:
        """Read the target (H, W); choose block lists (T, S), at most `top`, the most likely first, or the one given."""
        if blocks is not None and inventory is not None:
            raise StackgenError("give a block list or an inventory to choose it from, not both")
        mask = self.read(silhouette)
        if blocks is not None:
            return mask, self.counts(blocks)[None]
        shown, _ = as_shown(mask, self.sampler)
        if inventory is None:
            return mask, self.predictor.predict(shown[None], top=top)[0]
        from stackgen.sampling.inventory import allowed_lists

        ranks = None if self._predictor is None else lambda: self.predictor
        try:
            return mask, allowed_lists(shown, self.inventory(inventory), self.world, ranks, top)
        except StackgenError as error:
            name = f"{silhouette}: " if isinstance(silhouette, str | Path) else ""
            raise StackgenError(f"{name}{error}") from error

    @staticmethod
    def _check_draw(num_samples: int, seed: int) -> None:
        if num_samples < 1:
            raise StackgenError(f"the number of samples must be at least 1, got {num_samples}")
        if not 0 <= seed < 2**63:
            raise StackgenError(f"the seed must be a whole number of at least 0, got {seed}")

    def _draw(self, mask: Mask, counts: NDArray[np.int64], num_samples: int, seed: int) -> list[Stack]:
        self._check_draw(num_samples, seed)
        return AlignedSampler(self.sampler).sample_batch(mask[None], counts[None], num_samples, seed)[0]

    @cached_property
    def predictor(self) -> BlockListPredictor:
        """The network, or other predictor, that proposes block lists.

        Raises:
            StackgenError: If the model was made without one.
        """
        if self._predictor is None:
            raise StackgenError("this model predicts no block lists: give one, e.g. blocks='cube=3,triangle=1'")
        return self._predictor() if callable(self._predictor) else self._predictor

    @cached_property
    def checker(self) -> StabilityChecker:
        """The checker that says which stacks stand."""
        if self._checker is not None:
            return self._checker
        from stackgen.sim.checkers import SimulatorChecker  # training machines have no PyBullet

        return SimulatorChecker(self.physics)

    @property
    def physics(self) -> Physics:
        """Physics of the dataset that the sampler was trained on; the project's own where that is not known."""
        from stackgen.sim.physics import Physics

        dataset = self.sampler.card.get("dataset") or {}
        return Physics.recorded(dataset.get("physics"))


def check(checker: StabilityChecker, stack: Stack, target: Mask | None, grid: Grid) -> StackEntry:
    """Simulate a stack; compare what then stands with a target (H, W). What falls has IoU 0 (paper)."""
    verdict = checker.check(stack)
    if target is None:
        return StackEntry(stack, verdict)
    return StackEntry(stack, verdict, silhouette_iou(verdict.settled, target, grid) if verdict.stable else 0.0)


def load(
    weights: str | Path | StackSampler = DEFAULT,
    block_list_weights: str | Path = DEFAULT,
    sampler: SamplerConfig = SamplerConfig(),  # noqa: B008 - frozen
) -> Model:
    """Load a model from weights.

    Args:
        weights: Weights of the sampler: a name in the package (of weights, or of a heuristic such as
            `brute-force`), a `.safetensors` file, a `.ckpt` of our training, or the folder of a run; or
            a sampler itself.
        block_list_weights: Weights of the block-list network: a name in the package, a `.safetensors` file, a `.ckpt`
            of our training, or the folder of a run; by default those that ship for the sampler's world. They are read
            when they are first needed.
        sampler: Settings by which a diffusion model samples; what is null is as its weights have it.

    Raises:
        StackgenError: If there are no such weights, or they are not ours.
    """
    loaded, record = _sampler(weights, sampler)

    def predictor() -> BlockListPredictor:
        from stackgen.sampling.methods import load_predictor

        found = load_predictor(block_list_weights, loaded.world)
        if found.world != loaded.world:
            name = record.name if record else type(loaded).__name__
            raise StackgenError(
                f"the weights {name} and {block_list_weights} were trained with different shapes or grids: "
                "give both of one world"
            )
        return found

    return Model(loaded, predictor, weights=record)


def _sampler(weights: str | Path | StackSampler, settings: SamplerConfig) -> tuple[StackSampler, Weights | None]:
    """Load the sampler; give the name and the hash of its weights too (a heuristic's: of its settings)."""
    from stackgen.sampling.methods import load_sampler

    loaded = load_sampler(weights) if isinstance(weights, str | Path) else weights
    name, digest = loaded.card.get("name"), loaded.card.get("sha256")
    if isinstance(weights, str | Path) and not digest:  # a checkpoint's card knows neither
        from stackgen.models.weights import resolve

        file = resolve(weights)
        name, digest = name or file.name, hashlib.sha256(file.read_bytes()).hexdigest()
    record = Weights(name, digest) if name and digest else None
    return _configured(loaded, name or type(loaded).__name__, settings), record


def _configured(loaded: StackSampler, weights: str, settings: SamplerConfig) -> StackSampler:
    """Give the sampler these settings, if there are any."""
    if settings == SamplerConfig():
        return loaded
    if not hasattr(loaded, "configured"):
        raise StackgenError(f"{weights} is no diffusion model: leave the settings of the sampler out")
    return loaded.configured(settings)


def sample(
    silhouette: Silhouette,
    num_samples: int = 3,
    seed: int = 0,
    blocks: BlockList | None = None,
    weights: str | Path = DEFAULT,
) -> list[Stack]:
    """Call `load(weights).sample(...)`; keep a model instead where you sample more than once."""
    return load(weights).sample(silhouette, num_samples, seed, blocks)
