"""Weights that travel: safetensors plus a JSON card, found by name, by file, or inside our own checkpoints.

A card says how to build the network again (`kind`, `config`), which world it was trained in
(`catalogue`, `grid`, `max_blocks`), on what (`dataset`), and what was measured (`metrics`). Nothing
here unpickles: checkpoints are read with `weights_only=True`.
"""

from __future__ import annotations

import hashlib
import pickle
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from stackgen.errors import MALFORMED, StackgenError
from stackgen.io.files import open_bytes, read_bytes, write_atomically, write_json
from stackgen.io.text import read_json
from stackgen.world import World

FORMAT = "stackgen.weights/1"
FOLDER = Path(__file__).parents[1] / "assets" / "weights"
DEFAULTS = {"sampler": "taught-verdicts", "predictor": "taught-blocklist"}
"""What the name `default` stands for."""

CHECKPOINT_KEY = "stackgen"
"""Where a Lightning checkpoint holds the card of its model."""

_PREFIX = "model."  # of the network inside a LightningModule
_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, pickle.UnpicklingError),
    *(RuntimeError, EOFError, LookupError, ValueError, NotImplementedError),
)
"""What zipfile and torch raise at files that are not as they were written."""


def read_weights(
    weights: str | Path, role: str = "sampler", other_names: Sequence[str] = ()
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors and the card behind a name or path; see resolve.

    Raises:
        StackgenError: If there is no such thing or it is damaged.
    """
    path = resolve(weights, role, other_names)
    if path.suffix == ".ckpt":
        return _read_checkpoint(path)
    content = _read_bytes(path)
    card_path = path.with_suffix(".json")
    try:
        if not card_path.exists():
            raise StackgenError(f"{path} has no card: {card_path.name} must lie beside it")
        card = read_json(card_path)
        tensors = load(content)
    except (OSError, ValueError, SafetensorError) as error:
        raise StackgenError(f"{path} or its card {card_path.name} is damaged: {error}") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise StackgenError(f"{card_path} is not a {FORMAT} card")
    if not isinstance(card.get("kind"), str) or not isinstance(card.get("config"), dict):
        raise StackgenError(f"{card_path} is damaged: it does not say the kind of network, or its config")
    if card.get("sha256") != hashlib.sha256(content).hexdigest():
        raise StackgenError(f"{path} is not the file its card {card_path.name} was written for: the checksums differ")
    return tensors, card


def resolve(weights: str | Path, role: str = "sampler", other_names: Sequence[str] = ()) -> Path:
    """Find the file that weights stand for: a name in the package, a `.safetensors` or `.ckpt` file, or a run folder.

    Args:
        weights: Name or path.
        role: Meaning of the name `default`: `sampler` or `predictor`.
        other_names: Further names that the caller knows, for the message.

    Raises:
        StackgenError: If there is none; the message lists the names there are.
    """
    if str(weights) == "default":
        weights = DEFAULTS[role]
    path = Path(weights)
    if path.is_dir():
        return last_checkpoint(path)
    if path.suffix in (".safetensors", ".ckpt"):
        if path.is_file():
            return path
        raise StackgenError(f"no weights at {path}")
    shipped = FOLDER / f"{weights}.safetensors"
    if path.name == str(weights) and shipped.is_file():
        return shipped
    names = ", ".join(sorted([*(p.stem for p in FOLDER.glob("*.safetensors")), *other_names])) or "none are shipped"
    raise StackgenError(
        f"no weights called {weights}: give a .safetensors or .ckpt file, a run folder, or a name ({names})"
    )


def predictor_of(world: World) -> str:
    """Name the block-list network that ships for a world; the default one where none does."""
    default = DEFAULTS["predictor"]
    for name in (default, *sorted(path.stem for path in FOLDER.glob("*.json"))):
        card = read_json(FOLDER / f"{name}.json")
        if card["kind"] == "blocklist" and World.from_json(card) == world:
            return name
    return default


def last_checkpoint(folder: Path) -> Path:
    """Find the `last.ckpt` of a run, that of its highest version, or of one version.

    Raises:
        StackgenError: If there is none.
    """
    found = _last_checkpoints(folder)
    if not found:
        raise StackgenError(f"no checkpoint in {folder}: there is no version_*/checkpoints/last.ckpt in it")
    return found[0]


def _last_checkpoints(folder: Path) -> list[Path]:
    """List the `last.ckpt` of a run's versions, the highest first, or that of one version."""
    versions = [path for path in folder.glob("version_*") if path.name.removeprefix("version_").isdecimal()]
    versions.sort(key=lambda path: int(path.name.removeprefix("version_")), reverse=True)
    return [path for part in (folder, *versions) if (path := part / "checkpoints" / "last.ckpt").is_file()]


def write_weights(path: Path, tensors: dict[str, Tensor], card: dict[str, Any]) -> None:
    """Write `<path>.safetensors` and its card `<path>.json`; the card gets format and checksum."""
    content = save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()})
    full = {"format": FORMAT, "name": path.stem, **card, "sha256": hashlib.sha256(content).hexdigest()}
    write_atomically(path, content)
    write_json(path.with_suffix(".json"), full)


def export_checkpoint(
    checkpoint: Path, out: Path, metrics: dict[str, Any] | None = None, half: bool = False
) -> dict[str, Any]:
    """Write a checkpoint's weights (the averaged ones, where EMA ran) as safetensors with a card; returns the card.

    Args:
        checkpoint: Checkpoint of a training.
        out: The .safetensors file to write; the card goes beside it.
        metrics: Metrics to quote in the card.
        half: Whether matrices are stored as 16-bit floats: half the size; they are computed with as 32-bit ones.

    Raises:
        StackgenError: If the checkpoint is not ours, or `out` is not a `.safetensors` path.
    """
    tensors, card = _read_checkpoint(checkpoint)
    if metrics:
        card["metrics"] = metrics
    export_weights(tensors, card, out, half=half)
    return card


def export_weights(tensors: dict[str, Tensor], card: dict[str, Any], out: Path, half: bool = False) -> None:
    """Write weights as :func:`export_checkpoint` does.

    Raises:
        StackgenError: If `out` is not a `.safetensors` path.
    """
    if out.suffix != ".safetensors":
        raise StackgenError(f"weights are exported to a .safetensors file, not {out.name}")
    if half:  # vectors, schedules among them, are small and may need every digit
        tensors = {k: v.half() if v.is_floating_point() and v.ndim > 1 else v for k, v in tensors.items()}
    write_weights(out, tensors, card)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint of a training: tensors and plain values, and nothing else is unpickled.

    Raises:
        StackgenError: If it is none or is damaged; the line names an older one that is whole, if there is one.
    """
    try:
        if not _is_whole(path):
            raise zipfile.BadZipFile
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise StackgenError(f"no checkpoint at {path}") from error
    except OSError as error:
        raise StackgenError(f"{path} cannot be read: {error.strerror or error}") from error
    except _DAMAGED as error:
        older = next(filter(_is_whole, _older(path)), None)
        offer = f"; {older} is older and whole" if older else ""
        raise StackgenError(f"{path} is not a checkpoint of stackgen, or is damaged{offer}") from error
    return checkpoint if isinstance(checkpoint, dict) else {}


def _is_whole(path: Path) -> bool:
    """Compare the checksums of a checkpoint, which torch does not."""
    try:
        with open_bytes(path) as file, zipfile.ZipFile(file) as archive:
            return archive.testzip() is None
    except _DAMAGED:
        return False


def _older(path: Path) -> list[Path]:
    """List what may be older checkpoints of the same run: those beside it, then the last of other versions."""
    beside = sorted(path.parent.glob("*.ckpt"), key=lambda other: other.stat().st_mtime, reverse=True)
    return [
        other
        for other in [*beside, *_last_checkpoints(path.absolute().parent.parent.parent)]
        if other.resolve() != path.resolve()
    ]


def _read_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    parts = load_checkpoint(path)
    card, state = parts.get(CHECKPOINT_KEY), parts.get("state_dict")
    if not isinstance(card, dict) or not isinstance(state, dict):
        raise StackgenError(f"{path} is a checkpoint, but not one of stackgen's models")
    tensors = {k.removeprefix(_PREFIX): v for k, v in state.items() if k.startswith(_PREFIX)}
    trained = {"steps": parts.get("global_step"), "epochs": parts.get("epoch")}
    return tensors, {**card, "trained": trained}


def _read_bytes(path: Path) -> bytes:
    try:
        return read_bytes(path)
    except OSError as error:
        raise StackgenError(f"{path} cannot be read: {error.strerror}") from error


Maker = Callable[[dict[str, Any], World], tuple[nn.Module, Callable[..., Any]]]
"""From configuration and world of a card to an empty network, and the class of its sampler or predictor."""


def build(weights: str | Path, card: dict[str, Any], tensors: dict[str, Tensor], maker: Maker) -> Any:
    """Make the sampler or predictor that a card and its tensors describe.

    Args:
        weights: Where they come from, for messages.
        card: What is known about them.
        tensors: State of the network.
        maker: Maker of the card's kind.

    Raises:
        StackgenError: If card and tensors do not fit each other.
    """
    try:
        world = World.from_json(card)
        network, wrap = maker(card["config"], world)
        network.load_state_dict(tensors)
    except (StackgenError, *MALFORMED, RuntimeError) as error:
        raise StackgenError(f"{weights}: card and weights do not fit together: {str(error).splitlines()[0]}") from error
    return wrap(network, world, card)
