"""`stacks.json`, the file that all commands that make, check, draw or build stacks exchange.

The format is published as a JSON Schema beside this file, `stacks.schema.json`. Only `format` and
`stacks` must be there; a file written by hand may stop at shapes and positions, in the paper's world.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.io.schemas import require_valid
from stackgen.io.text import decode_text, parse_json, read_text
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD, Catalogue, Grid, Mask, World

FORMAT = "stackgen.stacks/1"
MATCHES = 0.9
"""Front IoU from which on a stack that stands is said to match what was asked for."""

SCHEMA_PATH = Path(__file__).with_name("stacks.schema.json")


@dataclass(frozen=True)
class Weights:
    """Which weights made the stacks.

    Args:
        name: Name or path as given to `stackgen.load`.
        sha256: Checksum of the file, in hexadecimal.
    """

    name: str
    sha256: str


@dataclass(frozen=True)
class StackEntry:
    """One stack of a file and what is known about it.

    Args:
        stack: The stack as sampled or written.
        verdict: Verdict of a simulation.
        front_iou: IoU of the settled stack's front silhouette with the target.
        comment: Words for people.
    """

    stack: Stack
    verdict: Verdict | None = None
    front_iou: float | None = None
    comment: str = ""

    @property
    def matches(self) -> bool | None:
        """Whether it stands and its front IoU is at least `MATCHES`; None where that is not known."""
        if self.verdict is None or self.front_iou is None:
            return None
        return self.verdict.stable and self.front_iou >= MATCHES


@dataclass(frozen=True)
class StacksFile:
    """All that a `stacks.json` holds.

    Args:
        entries: The stacks, all of the world's catalogue.
        world: Shapes of the stacks, design grid and scale of the target; `max_blocks` is not in the file.
        target: (H, W) front silhouette asked for.
        silhouette: File name of the picture it came from.
        block_list: (S,) counts asked for.
        block_list_source: Whether the network or the search chose the block list, or a person gave it.
        physics: Settings of the simulation behind the verdicts, as `Physics.to_json` gives them.
        seed: Seed of the sampling.
        weights: Weights that made the stacks.
        sampler: Settings that the stacks were sampled with.
        inventory: (S,) counts that the block list was chosen from; None where there was no limit.
        cell_size: Edge of a cube [m].
        comment: Words for people.
    """

    entries: tuple[StackEntry, ...]
    world: World
    target: Mask | None = None
    silhouette: str | None = None
    block_list: NDArray[np.int64] | None = None
    block_list_source: Literal["cnn", "search", "given"] | None = None
    physics: Mapping[str, Any] | None = None
    seed: int | None = None
    weights: Weights | None = None
    sampler: Mapping[str, Any] | None = None
    inventory: NDArray[np.int64] | None = None
    cell_size: float = 0.05
    comment: str = ""

    @property
    def stacks(self) -> list[Stack]:
        """The stacks without what is known about them."""
        return [entry.stack for entry in self.entries]

    def _repr_html_(self) -> str:
        """Show the stacks in a notebook, as a view that turns, with their verdicts."""
        from stackgen.viz.page import notebook_html

        return notebook_html(self.stacks, [entry.verdict for entry in self.entries], self.silhouette or "Stacks")


def read_stacks(path: str | Path) -> StacksFile:
    """Read and check a stacks file; `-` is standard input.

    Raises:
        StackgenError: If it is missing, not JSON, of another format, or says something impossible; the
            line names the place, as line and column or as JSON path.
    """
    data = parse_json(_read(Path(path)), path)
    try:
        return from_json(data)
    except StackgenError as error:
        raise StackgenError(f"{path}: {error}") from error


def write_stacks(path: str | Path, content: StacksFile) -> None:
    """Write a stacks file; `path` is replaced only once all is written.

    Raises:
        StackgenError: If it cannot be written.
    """
    write_atomically(path, (_pretty(to_json(content)) + "\n").encode())


def to_json(content: StacksFile) -> dict[str, Any]:
    """Turn a stacks file into its plain form; what is not known is left out, so that the rest stays readable.

    >>> cube = Stack([0], [[0, 0, 0.5, 0, 0, 0]])
    >>> to_json(StacksFile((StackEntry(cube),), PAPER_WORLD))["stacks"]
    [{'blocks': [{'shape': 'cube', 'position': [0.0, 0.0, 0.5], 'rotation': [0.0, 0.0, 0.0]}]}]
    """
    catalogue = content.world.catalogue
    plain = {
        "format": FORMAT,
        "comment": content.comment or None,
        "cell_size_m": float(content.cell_size),
        "silhouette": content.silhouette,
        "block_list": _counts_to_json(content.block_list, catalogue),
        "block_list_source": content.block_list_source,
        "inventory": _counts_to_json(content.inventory, catalogue),
        "seed": None if content.seed is None else int(content.seed),
        "weights": None if content.weights is None else asdict(content.weights),
        "sampler": None if content.sampler is None else dict(content.sampler),
        "stacks": [entry_to_json(entry) for entry in content.entries],
        "physics": None if content.physics is None else dict(content.physics),
        "grid": asdict(content.world.grid),
        "catalogue": catalogue.to_json(),
        "silhouette_packed": None if content.target is None else _pack(content.target),
    }
    return {key: value for key, value in plain.items() if value is not None}


def from_json(data: Any) -> StacksFile:
    """Inverse of :func:`to_json`, checked against the schema and for sense.

    Raises:
        StackgenError: Naming the JSON path of the first thing that is wrong.
    """
    _validate(data)
    world = World.from_json({**PAPER_WORLD.to_json(), **data})
    catalogue = world.catalogue
    physics = data.get("physics")
    cell_size = float(data.get("cell_size_m", (physics or {}).get("cell_size", 0.05)))
    if physics and not math.isclose(physics.get("cell_size", cell_size), cell_size):
        raise StackgenError(
            f"$.cell_size_m is {cell_size}, but $.physics.cell_size is {physics['cell_size']}; make them equal"
        )
    packed, weights = data.get("silhouette_packed"), data.get("weights")
    return StacksFile(
        entries=tuple(_entry_from_json(e, catalogue, f"$.stacks[{i}]") for i, e in enumerate(data["stacks"])),
        world=world,
        target=None if packed is None else _unpack(packed, world.grid),
        silhouette=data.get("silhouette"),
        block_list=_counts(data, "block_list", catalogue),
        block_list_source=data.get("block_list_source"),
        physics=physics,
        seed=data.get("seed"),
        weights=None if weights is None else Weights(**weights),
        sampler=data.get("sampler"),
        inventory=_counts(data, "inventory", catalogue),
        cell_size=cell_size,
        comment=data.get("comment", ""),
    )


def schema() -> dict[str, Any]:
    """The published JSON Schema."""
    return json.loads(SCHEMA_PATH.read_text(encoding="utf-8"))


def _read(path: Path) -> str:
    """Read the text of a file or of standard input."""
    text = decode_text(sys.stdin.buffer.read(), path) if path == Path("-") else read_text(path)
    if not text.strip():
        raise StackgenError(f"{path} is empty; a stacks file begins with {_BEGINNING}")
    return text


_BEGINNING = f'{{"format": "{FORMAT}", "stacks": [...]}}'


def _validate(data: Any) -> None:
    """Check the plain form against the schema."""
    if not isinstance(data, dict) or "format" not in data:
        raise StackgenError("is not a stacks file; it begins with " + _BEGINNING)
    if data["format"] != FORMAT:
        raise StackgenError(f"$.format is {_short(data['format'])}; this version reads {FORMAT!r}")
    require_valid(data, SCHEMA_PATH)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:50] + "..."


def entry_to_json(entry: StackEntry) -> dict[str, Any]:
    """Turn one stack into its plain form, as it stands under `stacks`."""
    stack, verdict = entry.stack, entry.verdict
    plain: dict[str, Any] = {"comment": entry.comment} if entry.comment else {}
    plain["blocks"] = [{"shape": name, **pose} for name, pose in zip(stack.names, _poses_to_json(stack), strict=True)]
    if verdict is not None:
        plain["verdict"] = {
            "stable": bool(verdict.stable),
            "at_rest": bool(verdict.at_rest),
            "fell": np.flatnonzero(verdict.fell).tolist(),
            "drop": np.asarray(verdict.drop, dtype=float).tolist(),
            "settled": _poses_to_json(verdict.settled),
        }
        if verdict.margin is not None:
            plain["verdict"]["margin"] = float(verdict.margin)
    if entry.front_iou is not None:
        plain["front_iou"] = float(entry.front_iou)
    if entry.matches is not None:
        plain["matches"] = entry.matches
    return plain


def _poses_to_json(stack: Stack) -> list[dict[str, list[float]]]:
    return [{"position": pose[:3], "rotation": pose[3:]} for pose in stack.poses.tolist()]


def _entry_from_json(item: Mapping[str, Any], catalogue: Catalogue, path: str) -> StackEntry:
    shapes = []
    for i, block in enumerate(item["blocks"]):
        if block["shape"] not in catalogue.names:
            known = ", ".join(catalogue.names)
            raise StackgenError(f"{path}.blocks[{i}].shape: unknown shape {_short(block['shape'])}; there are {known}")
        shapes.append(catalogue.index(block["shape"]))
    stack = Stack(np.array(shapes), _poses_from_json(item["blocks"]), catalogue)
    said = item.get("verdict")
    verdict = None if said is None else _verdict_from_json(said, stack, f"{path}.verdict")
    return StackEntry(stack, verdict, item.get("front_iou"), item.get("comment", ""))


def _poses_from_json(items: Sequence[Mapping[str, Any]]) -> NDArray[np.float64]:
    return np.array([[*item["position"], *item.get("rotation", (0, 0, 0))] for item in items], dtype=np.float64)


def _verdict_from_json(said: Mapping[str, Any], stack: Stack, path: str) -> Verdict:
    """Read a verdict, and see that it is one about this stack."""
    for key in ("drop", "settled"):
        if len(said[key]) != len(stack):
            raise StackgenError(
                f"{path}.{key}: {len(said[key])} values for {len(stack)} blocks; give one for each block"
            )
    if any(number >= len(stack) for number in said["fell"]):
        raise StackgenError(f"{path}.fell: blocks are numbered 0 to {len(stack) - 1}, got {_short(said['fell'])}")
    if said["stable"] == bool(said["fell"]):
        raise StackgenError(f"{path}: stable is {str(said['stable']).lower()}, but {len(said['fell'])} blocks fell")
    fell = np.zeros(len(stack), dtype=bool)
    fell[np.asarray(said["fell"], dtype=int)] = True
    settled = stack.with_poses(_poses_from_json(said["settled"]))
    drop = np.asarray(said["drop"], dtype=float)
    return Verdict(said["stable"], fell, drop, settled, said.get("at_rest", True), said.get("margin"))


def _counts_to_json(counts: NDArray[np.int64] | None, catalogue: Catalogue) -> dict[str, int] | None:
    """Turn counts (S,) into counts by name, without zeros."""
    return None if counts is None else {n: int(c) for n, c in zip(catalogue.names, counts, strict=True) if c}


def _counts(data: Mapping[str, Any], key: str, catalogue: Catalogue) -> NDArray[np.int64] | None:
    """Read the counts (S,) that stand under a key."""
    items = data.get(key)
    if items is None:
        return None
    for name in items:
        if name not in catalogue.names:
            raise StackgenError(f"$.{key}: unknown shape {_short(name)}; there are {', '.join(catalogue.names)}")
    return np.array([items.get(name, 0) for name in catalogue.names], dtype=np.int64)


def _pack(mask: Mask) -> dict[str, Any]:
    bits = np.packbits(np.asarray(mask, dtype=bool), axis=1)
    return {"size": list(mask.shape), "bits": base64.b64encode(bits.tobytes()).decode("ascii")}


def _unpack(packed: Mapping[str, Any], grid: Grid) -> Mask:
    height, width = packed["size"]
    if (height, width) != (grid.image_size,) * 2:
        raise StackgenError(
            f"$.silhouette_packed.size is {height} x {width}, but the grid's pictures are {grid.image_size} square"
        )
    try:
        data = base64.b64decode(packed["bits"], validate=True)
    except (binascii.Error, ValueError):
        raise StackgenError("$.silhouette_packed.bits: is not base64; write it again or leave it out") from None
    wanted = height * -(-width // 8)
    if len(data) != wanted:
        raise StackgenError(f"$.silhouette_packed.bits: {len(data)} bytes, but {height} x {width} pixels take {wanted}")
    rows = np.frombuffer(data, dtype=np.uint8).reshape(height, -1)
    return np.unpackbits(rows, axis=1, count=width).astype(bool)


def _pretty(value: Any, indent: int = 0) -> str:
    """Make JSON text for people: what fits on a line is on a line.

    >>> print(_pretty({"a": [1, 2]}))
    {"a": [1, 2]}
    """
    line = json.dumps(value, ensure_ascii=False, allow_nan=False)
    if len(line) + indent <= 160 or not isinstance(value, dict | list) or not value:
        return line
    pad = " " * (indent + 1)
    if isinstance(value, dict):
        inner = [f"{pad}{json.dumps(k, ensure_ascii=False)}: {_pretty(v, indent + 1)}" for k, v in value.items()]
    else:
        inner = [pad + _pretty(v, indent + 1) for v in value]
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    return f"{opening}\n" + ",\n".join(inner) + f"\n{' ' * indent}{closing}"
