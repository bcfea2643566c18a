"""The compact form of a dataset: all arrays in one `.npz` file, for a machine that only trains."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stackgen.data.arrays import FIELDS, StackArrays
from stackgen.data.manifest import SPLITS, Manifest
from stackgen.data.sources import read_bytes
from stackgen.errors import MALFORMED, StackgenError
from stackgen.io.arrays import read_npz
from stackgen.io.files import write_atomically
from stackgen.io.text import parse_json


def save_npz(path: str | Path, splits: Mapping[Any, StackArrays], manifest: Manifest) -> None:
    """Write a whole dataset as one compressed file of plain arrays.

    Args:
        path: File to write, ending in `.npz`.
        splits: Any of train, validation, test; a split's place in that list is its number in the file.
        manifest: The dataset's manifest.

    Raises:
        StackgenError: If there is nothing to write, or it cannot be written.
    """
    names = [name for name in SPLITS if name in splits]
    if not names or len(names) != len(splits) or Path(path).suffix != ".npz":
        raise StackgenError(f"compact dataset: {path} must end in .npz and hold some of {', '.join(SPLITS)}")
    parts: dict[str, Any] = {
        field: np.concatenate([getattr(splits[name], field) for name in names]) for field in FIELDS
    }
    numbers, lengths = [SPLITS.index(name) for name in names], [len(splits[name]) for name in names]
    parts["split"] = np.repeat(np.array(numbers, np.uint8), lengths)
    parts["manifest"] = np.array(json.dumps(manifest.to_json()))
    write_npz(path, parts)


def write_npz(path: str | Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays as one compressed `.npz` file, whole or not at all."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomically(path, buffer.getvalue())


def load_npz(path: str) -> tuple[dict[str, StackArrays], Manifest]:
    """Read the splits that a compact file holds, and the manifest.

    Raises:
        StackgenError: If the file is missing, broken, or not a compact dataset.
    """
    try:
        file = read_npz(read_bytes(path))
        fields = {name: file[name] for name in FIELDS}
        split, plain = file["split"], parse_json(str(file["manifest"]), path)
    except (OSError, *MALFORMED) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise StackgenError(f"{path} is not a compact stackgen dataset: {reason}") from error
    manifest = Manifest.from_json(plain, path)
    if split.shape != fields["template"].shape:
        raise StackgenError(f"{path} is not a compact stackgen dataset: its parts do not fit each other")
    everything = StackArrays(**fields, num_shapes=len(manifest.world.catalogue))
    return {str(name): everything.select(split == i) for i, name in enumerate(SPLITS) if (split == i).any()}, manifest
