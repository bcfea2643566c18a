"""Weights that travel: safetensors plus a JSON card, found by name, by file, or inside our own checkpoints.

A card says how to build the network again (`kind`, `config`), which world it was trained in
(`catalogue`, `grid`, `max_blocks`), on what (`dataset`), and what was measured (`metrics`). Nothing
here unpickles: checkpoints are read with `weights_only=True`.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from stackgen.baselines import HEURISTICS
from stackgen.baselines.tran_reg import PoseRegression
from stackgen.baselines.tran_vae import PoseVAE, VAEConfig
from stackgen.baselines.transformer import RegressionConfig, TransformerSampler
from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.models.block_list.network import BlockListNetwork, CNNConfig, CNNPredictor
from stackgen.models.diffusion.denoiser import DenoiserConfig
from stackgen.models.diffusion.network import DiffusionConfig, DiffusionSampler, PoseDiffusion
from stackgen.models.diffusion.schedules import ScheduleConfig
from stackgen.protocols import BlockListPredictor, StackSampler
from stackgen.world import Catalogue, Grid

FORMAT = "stackgen.weights/1"
FOLDER = Path(__file__).parents[1] / "assets" / "weights"
DEFAULTS = {"sampler": "ddpm-verdicts", "predictor": "blocklist-small"}
"""What the name `default` stands for."""

_CHECKPOINT_CARD = "stackgen"  # stackgen.models.module.CHECKPOINT_KEY, which this module must not import Lightning for
_PREFIX = "model."  # of the network inside a LightningModule
_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, pickle.UnpicklingError),
    *(RuntimeError, EOFError, LookupError, ValueError, NotImplementedError),
)
"""What zipfile and torch raise at files that are not as they were written."""


def load_sampler(weights: str | Path = "default") -> StackSampler:
    """The sampler that a name (of weights or of a heuristic), a `.safetensors` file or a `.ckpt` of ours stands for.

    Raises:
        StackgenError: If there is no such thing, or it holds something else.
    """
    if str(weights) in HEURISTICS:
        return HEURISTICS[str(weights)]()
    tensors, card = read_weights(weights, "sampler")
    return _build(weights, card, tensors, _SAMPLERS, "sampler")


def load_predictor(weights: str | Path = "default") -> BlockListPredictor:
    """The block-list predictor that a name, a `.safetensors` file or a `.ckpt` of ours stands for.

    Raises:
        StackgenError: If there is no such thing, or it holds something else.
    """
    tensors, card = read_weights(weights, "predictor")
    return _build(weights, card, tensors, _PREDICTORS, "block-list predictor")


def role_of(weights: str | Path) -> str:
    """`predictor` where a name, file or checkpoint of ours holds a block-list network, else `sampler`.

    Raises:
        StackgenError: If there is no such thing or it is damaged.
    """
    return "predictor" if read_weights(weights)[1].get("kind") in _PREDICTORS else "sampler"


def read_weights(weights: str | Path, role: str = "sampler") -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and card behind a name or path; `role` says what `default` means.

    Raises:
        StackgenError: If there is no such thing or it is damaged.
    """
    path = resolve(weights, role)
    if path.suffix == ".ckpt":
        return _read_checkpoint(path)
    content = _read_bytes(path)
    card_path = path.with_suffix(".json")
    try:
        card = json.loads(card_path.read_text())
        tensors = load(content)
    except FileNotFoundError as error:
        raise StackgenError(f"{path} has no card: {card_path.name} must lie beside it") from error
    except (OSError, ValueError, SafetensorError) as error:
        raise StackgenError(f"{path} or its card {card_path.name} is damaged: {error}") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise StackgenError(f"{card_path} is not a {FORMAT} card")
    if card.get("sha256") != hashlib.sha256(content).hexdigest():
        raise StackgenError(f"{path} is not the file its card {card_path.name} was written for: the checksums differ")
    return tensors, card


def resolve(weights: str | Path, role: str = "sampler") -> Path:
    """The file that a name or path stands for.

    Raises:
        StackgenError: If there is none; the message lists the names there are.
    """
    if str(weights) == "default":
        weights = DEFAULTS[role]
    path = Path(weights)
    if path.suffix in (".safetensors", ".ckpt"):
        if path.is_file():
            return path
        raise StackgenError(f"no weights at {path}")
    shipped = FOLDER / f"{weights}.safetensors"
    if path.name == str(weights) and shipped.is_file():
        return shipped
    shipped_names = [p.stem for p in FOLDER.glob("*.safetensors")]
    names = ", ".join(sorted([*shipped_names, *(HEURISTICS if role == "sampler" else ())])) or "none are shipped"
    raise StackgenError(f"no weights called {weights}: give a .safetensors or .ckpt file, or a name ({names})")


def write_weights(path: Path, tensors: dict[str, Tensor], card: dict[str, Any]) -> None:
    """Write `<path>.safetensors` and its card `<path>.json`; the card gets format and checksum."""
    content = save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()})
    full = {"format": FORMAT, "name": path.stem, **card, "sha256": hashlib.sha256(content).hexdigest()}
    write_atomically(path, content)
    write_atomically(path.with_suffix(".json"), (json.dumps(full, indent=1) + "\n").encode())


def export_checkpoint(
    checkpoint: Path, out: Path, metrics: dict[str, Any] | None = None, half: bool = False
) -> dict[str, Any]:
    """Write a checkpoint's weights (the averaged ones, where EMA ran) as safetensors with a card; returns the card.

    Args:
        checkpoint: Of a training.
        out: The .safetensors file; the card goes beside it.
        metrics: To be quoted in the card.
        half: Store matrices as 16-bit floats: half the size, computed with as 32-bit ones.

    Raises:
        StackgenError: If the checkpoint is not ours, or `out` is not a `.safetensors` path.
    """
    if out.suffix != ".safetensors":
        raise StackgenError(f"weights are exported to a .safetensors file, not {out.name}")
    tensors, card = _read_checkpoint(checkpoint)
    if metrics:
        card["metrics"] = metrics
    if half:  # vectors, schedules among them, are small and may need every digit
        tensors = {k: v.half() if v.is_floating_point() and v.ndim > 1 else v for k, v in tensors.items()}
    write_weights(out, tensors, card)
    return card


def _read_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    try:
        with zipfile.ZipFile(path) as archive:  # torch checks no checksums
            if archive.testzip() is not None:
                raise zipfile.BadZipFile
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise StackgenError(f"{path} cannot be read: {error.strerror or error}") from error
    except _DAMAGED as error:
        raise StackgenError(f"{path} is not a checkpoint of stackgen, or is damaged") from error
    parts = checkpoint if isinstance(checkpoint, dict) else {}
    card, state = parts.get(_CHECKPOINT_CARD), parts.get("state_dict")
    if not isinstance(card, dict) or not isinstance(state, dict):
        raise StackgenError(f"{path} is a checkpoint, but not one of stackgen's models")
    tensors = {k.removeprefix(_PREFIX): v for k, v in state.items() if k.startswith(_PREFIX)}
    trained = {"steps": parts.get("global_step"), "epochs": parts.get("epoch")}
    return tensors, {**card, "trained": trained}


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise StackgenError(f"{path} cannot be read: {error.strerror}") from error


def _build(
    weights: str | Path, card: dict[str, Any], tensors: dict[str, Tensor], makers: dict[str, Any], what: str
) -> Any:
    if card.get("kind") not in makers:
        raise StackgenError(f"{weights} holds weights of kind {card.get('kind')!r}, not of a {what}")
    try:
        catalogue, grid, max_blocks = (
            Catalogue.from_json(card["catalogue"]),
            Grid(**card["grid"]),
            int(card["max_blocks"]),
        )
        network, wrap = makers[card["kind"]](card["config"], catalogue, grid, max_blocks)
        network.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise StackgenError(f"{weights}: card and weights do not fit together: {str(error).splitlines()[0]}") from error
    return wrap(network, catalogue, grid, max_blocks, card)


Maker = Callable[[dict[str, Any], Catalogue, Grid, int], tuple[nn.Module, Callable[..., Any]]]


def _diffusion(config: dict[str, Any], catalogue: Catalogue, grid: Grid, max_blocks: int) -> tuple[nn.Module, Any]:
    network = PoseDiffusion(
        DenoiserConfig(**config["denoiser"]),
        ScheduleConfig(**config["schedule"]),
        DiffusionConfig(**config["diffusion"]),
        len(catalogue),
        grid.image_size,
        max_blocks,
    )
    return network, DiffusionSampler


def _regression(config: dict[str, Any], catalogue: Catalogue, grid: Grid, max_blocks: int) -> tuple[nn.Module, Any]:
    parts = DenoiserConfig(**config["transformer"]), RegressionConfig(**config["regression"])
    return PoseRegression(*parts, len(catalogue), grid.image_size, max_blocks), TransformerSampler


def _vae(config: dict[str, Any], catalogue: Catalogue, grid: Grid, max_blocks: int) -> tuple[nn.Module, Any]:
    parts = DenoiserConfig(**config["transformer"]), RegressionConfig(**config["regression"])
    vae = VAEConfig(**config["vae"])
    return PoseVAE(*parts, vae, len(catalogue), grid.image_size, max_blocks), TransformerSampler


def _cnn(config: dict[str, Any], catalogue: Catalogue, grid: Grid, max_blocks: int) -> tuple[nn.Module, Any]:
    return BlockListNetwork(CNNConfig(**config["cnn"]), catalogue, max_blocks, grid), CNNPredictor


_SAMPLERS: dict[str, Maker] = {"ddpm": _diffusion, "tran-reg": _regression, "tran-vae": _vae}
_PREDICTORS: dict[str, Maker] = {"blocklist": _cnn}


def last_checkpoint(folder: Path) -> Path:
    """The newest `last.ckpt` of a run (all its versions) or of one version.

    Raises:
        StackgenError: If there is none.
    """
    found = [*folder.glob("checkpoints/last.ckpt"), *folder.glob("version_*/checkpoints/last.ckpt")]
    if not found:
        raise StackgenError(f"no checkpoint in {folder}: there is no version_*/checkpoints/last.ckpt in it")
    return max(found, key=lambda path: path.stat().st_mtime)


def resolve_weights(name: str | Path) -> str:
    """The last checkpoint where the name is a run's folder; else the name as it is."""
    return str(last_checkpoint(Path(name))) if Path(name).is_dir() else str(name)
