"""The settings of a dataset: how its stacks are made, and what its manifest says of that."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any, Literal, get_type_hints

from stackgen.data.generation.designs import DesignSettings
from stackgen.data.generation.drawing.drawings import DrawingSettings
from stackgen.data.manifest import Manifest, Split, split_of
from stackgen.errors import MALFORMED, StackgenError
from stackgen.sim.checkers import AcceptLimits
from stackgen.sim.physics import Physics
from stackgen.sim.statics.plane import StaticsMargins
from stackgen.world import MAX_BLOCKS, PAPER_CATALOGUE, PAPER_GRID, Catalogue, Grid, World

Recipe = Literal["deconstruction", "drawings"]

REVISIONS: dict[Recipe, int] = {"deconstruction": 1, "drawings": 2}
"""Revision of each recipe: raised when equal settings begin to mean other stacks, so that the two are not mixed."""


@dataclass(frozen=True)
class GenerateSettings:
    """The settings of a dataset; `configs/generate/*.yaml` hold these.

    A template is a design that was drawn, displaced and settled; it has a number, and stacks are made from it. In the
    recipe `drawings` a drawing takes its place, and its answers that of the stacks.

    Args:
        name: Name of the dataset, kept in its manifest.
        recipe: `deconstruction`, the paper's, takes blocks out of settled designs; `drawings` makes silhouettes as
            people do, which the search answers.
        stacks: Number of stacks; the generator stops once they are stored.
        seed: Seed; the same one gives the same dataset.
        templates_per_shard: Templates whose stacks share a shard, and so a split.
        validation: Share of the templates that goes to the validation split.
        test: Share of the templates that goes to the test split; the rest is for training.
        draw: Number of stacks that are kept, drawn uniformly from all; 0 keeps all.
        max_removals: Largest number of blocks taken out of a template.
        max_blocks: Largest number of blocks of a stored stack; larger stacks are still deconstructed.
        settle_twice: Whether a settled stack must stand a second time, unless statics is certain that it does.
        exclude_testset: Whether to leave out the designs that `testset-v1` uses, its silhouettes (of drawings), and
            the mirror images of both.
        template: How designs are drawn and displaced.
        drawings: How drawings are made and answered.
        accept: How far a stack may settle.
        certificate: When statics is certain enough to spare the simulator a stack.
        physics: Physics of the simulator.
        grid: Design grid and scale of the silhouettes.
        catalogue: Shapes of the blocks.
    """

    name: str
    stacks: int
    seed: int = 0
    templates_per_shard: int = 250
    validation: float = 0.02
    test: float = 0.10
    draw: int = 0
    max_removals: int = 4
    max_blocks: int = MAX_BLOCKS
    settle_twice: bool = True
    exclude_testset: bool = True
    recipe: Recipe = "deconstruction"
    template: DesignSettings = field(default_factory=DesignSettings)
    drawings: DrawingSettings = field(default_factory=DrawingSettings)
    accept: AcceptLimits = field(default_factory=AcceptLimits)
    certificate: StaticsMargins = field(default_factory=StaticsMargins)
    physics: Physics = field(default_factory=Physics)
    grid: Grid = PAPER_GRID
    catalogue: Catalogue = PAPER_CATALOGUE

    def __post_init__(self) -> None:
        if self.stacks < 1 or self.templates_per_shard < 1 or self.max_blocks < 1 or self.max_removals < 0:
            raise StackgenError(
                "generate: stacks, templates_per_shard and max_blocks must be at least 1, max_removals 0"
            )
        if self.seed < 0:
            raise StackgenError(f"generate: seed must be at least 0, got {self.seed}")
        if self.validation < 0 or self.test < 0 or self.validation + self.test > 1:
            raise StackgenError("generate: validation and test are shares of the templates; their sum is at most 1")
        if not 0 <= self.draw <= self.stacks:
            raise StackgenError(f"generate: draw must lie in 0..stacks, got {self.draw}")
        if self.recipe == "deconstruction" and self.drawings != DrawingSettings():
            raise StackgenError("generate: settings of drawings belong to recipe drawings; set recipe to drawings")
        self.grid.require_room()
        self.template.check(self.world)
        thinnest = min(self.catalogue, key=lambda shape: shape.size[2])
        if self.physics.fall_height >= thinnest.size[2]:
            raise StackgenError(
                f"generate: a fall of shape {thinnest.name!r} would go unseen;"
                f" set physics.fall_height to {thinnest.size[2] / 2:g}, half its height"
            )

    def to_json(self) -> dict[str, Any]:
        """Give the plain form without what the manifest stores elsewhere."""
        elsewhere = ("name", "seed", "grid", "catalogue", "physics", "max_blocks")
        own = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in elsewhere}
        plain = {n: asdict(v) if is_dataclass(v) and not isinstance(v, type) else v for n, v in own.items()}
        if self.recipe == "deconstruction":  # as before there were others
            del plain["recipe"], plain["drawings"]
        else:
            plain["silhouette"] = "drawing"
        return {"revision": REVISIONS[self.recipe], **json.loads(json.dumps(plain))}

    @staticmethod
    def from_manifest(manifest: Manifest) -> GenerateSettings:
        """Give the settings that a dataset was made with.

        Raises:
            StackgenError: If its manifest does not hold them, or holds those of another generator.
        """
        plain = {**_BEFORE, **{key: value for key, value in manifest.settings.items() if key not in _FACTS}}
        physics = Physics.settings_of(manifest.physics)
        world = {"name": manifest.name, "seed": manifest.seed, **vars(manifest.world)}
        try:
            return _revived(GenerateSettings, {**plain, **world, "physics": physics})
        except MALFORMED as error:
            raise StackgenError(
                f"dataset {manifest.name!r} was not made by this version of `stackgen generate`: {error}"
            ) from error

    @property
    def world(self) -> World:
        """The world of its stacks."""
        return World(self.catalogue, self.grid, self.max_blocks)

    def split_of(self, shard: int) -> Split:
        """Choose the split of a shard."""
        return split_of(shard, self.validation, self.test)


_FACTS = ("revision", "silhouette")
"""What a manifest says among the settings that follows from them."""

_BEFORE = {"certificate": {"enabled": False}}
"""Settings that older manifests do not name, since they did not exist."""


def _revived(kind: type[Any], plain: Mapping[str, Any]) -> Any:
    """Make a dataclass of dataclasses from its plain form; values that are dataclasses already are kept."""
    hints = get_type_hints(kind)
    unknown = set(plain) - {item.name for item in fields(kind)}
    if unknown:
        raise TypeError(f"unknown settings {', '.join(sorted(unknown))}")
    values = {}
    for name, value in plain.items():
        if is_dataclass(hints[name]) and isinstance(value, Mapping):
            value = _revived(hints[name], value)
        values[name] = tuple(value) if isinstance(value, list) else value
    return kind(**values)
