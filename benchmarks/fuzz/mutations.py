"""Inputs for the fuzzer: valid files of every kind that stackgen reads, and seeded mutations of them."""

from __future__ import annotations

import copy
import hashlib
import io
import json
import os
import random
import shutil
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

ROOT = Path(__file__).parents[2]
BEFORE = ROOT / "tests" / "assets" / "before"

NASTY: list[Any] = [
    *(None, True, False, 0, -1, 1, 2, 10**9, 10**18, 2**63, 10**40, -(10**18), 1e17, 1e308, -0.0, 0.5, 1e-320),
    *(float("nan"), float("inf"), float("-inf"), "", " ", "x", "../x", "/etc/passwd", "a\x00b", "\x1b[2J", "[/red]"),
    *("\u202e", "é" * 50, "x" * 5000, "${oc.env:HOME}", "pipe:touch pwned", "https://0.0.0.0:9/x", "a\n  movej([0])"),
    *("1e400", "nan", "077", "1_0", "2026-01-01", "!!python/object:x", "True", "null", "-", "--help"),
    *([], {}, [[]], [None], [1] * 2000, {"class_path": "os.system"}),
    {"class_path": "stackgen.models.DDPM", "init_args": {"draws": 10**12}},
]
TOKENS = [
    *("&a ", "*a", "<<: ", "- ", ": ", "{", "}", "[", "]", "!!int ", "|", ">", "\t", "\x00", "\xff", "# ", "'", '"'),
    *("...", "---", "%", "@", "`", ", ", "\r", "\ufeff", "🧱", "1e17", "-1", "null", "~", "\n\n", "\x85"),
]


def mutated_bytes(content: bytes, rng: random.Random) -> bytes:
    """Flip, cut, repeat, insert or remove bytes."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(len(data) + 1)
        length = rng.choice((1, 1, 4, 100))
        kind = rng.randrange(6)
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            data[at:at] = data[at : at + length]
        elif kind == 3:
            data[at:at] = rng.randbytes(length)
        elif kind == 4:
            del data[at : at + length]
        elif data:
            data[at : at + length] = bytes(min(length, len(data) - at))
    return bytes(data)


def mutated_value(value: Any, rng: random.Random, times: int | None = None) -> Any:
    """Replace, remove, rename, repeat or nest parts of plain data."""
    value = copy.deepcopy(value)
    for _ in range(times or rng.choice((1, 1, 1, 2, 4))):
        places = list(_places(value))
        if not places:
            return copy.deepcopy(rng.choice(NASTY))
        holder, key = rng.choice(places)
        kind = rng.randrange(8)
        if kind == 0:
            del holder[key]
        elif kind == 1 and isinstance(holder, dict):
            name = rng.choice(["", "x", "__class__", "class_path", f"{key}x", "a.b", "é"])
            holder[name] = holder.pop(key)
        elif kind == 2:
            holder[key] = [holder[key]] * rng.choice((1, 2, 300))
        elif kind == 3 and isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
            holder[key] = holder[key] * rng.choice((-1, 0, 1e9, 0.5, 10**9, 1.0))
        elif kind == 4 and len(places) > 1:
            other, name = rng.choice(places)
            holder[key] = copy.deepcopy(other[name])
        else:
            holder[key] = copy.deepcopy(rng.choice(NASTY))
    return value


def _places(value: Any) -> Any:
    for key in list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield value, key
        yield from _places(value[key])


def mutated_text(text: str, rng: random.Random) -> bytes:
    """Change lines and insert what means something to a parser; sometimes in another encoding."""
    lines = text.splitlines(keepends=True)
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = rng.randrange(len(lines) + 1)
        kind = rng.randrange(5)
        if kind == 0 and lines:
            del lines[at % len(lines)]
        elif kind == 1 and lines:
            lines.insert(at, lines[at % len(lines)])
        elif kind == 2 and lines:
            line = lines[at % len(lines)]
            place = rng.randrange(len(line) + 1)
            lines[at % len(lines)] = line[:place] + rng.choice(TOKENS) + line[place:]
        elif kind == 3 and lines:
            lines[at % len(lines)] = " " * rng.randrange(5) + lines[at % len(lines)].lstrip()
        else:
            lines.insert(at, rng.choice(TOKENS) * rng.choice((1, 3, 2000)))
    encoding = rng.choice(["utf-8"] * 12 + ["latin-1", "utf-16", "utf-8-sig"])
    return "".join(lines).encode(encoding, "replace")


def mutated_json(content: Any, rng: random.Random) -> bytes:
    """Change plain data, or its text, or its bytes."""
    kind = rng.randrange(5)
    if kind < 3:
        return json.dumps(mutated_value(content, rng)).encode()
    text = json.dumps(content, indent=1)
    return mutated_text(text, rng) if kind == 3 else mutated_bytes(text.encode(), rng)


def mutated_yaml(text: str, rng: random.Random) -> bytes:
    """Change plain data or text of YAML."""
    if rng.random() < 0.5:
        return mutated_text(text, rng)
    changed = mutated_value(yaml.safe_load(text), rng)
    return yaml.safe_dump(changed, allow_unicode=True).encode("utf-8", "replace")


def dataset(folder: Path, rng: random.Random) -> Path:
    """Make a dataset with a changed manifest, or with a changed shard that the manifest names rightly or wrongly."""
    source = ROOT / "out" / "fuzz" / "towers"
    shutil.copytree(source, target := folder / "data")
    path = target / "dataset.json"
    manifest = json.loads(path.read_text())
    if rng.random() < 0.6:
        path.write_bytes(mutated_json(manifest, rng))
        return target
    entry = rng.choice(manifest["shards"])
    before = (target / entry["file"]).read_bytes()
    content = mutated_bytes(before, rng) if rng.random() < 0.3 else mutated_tar(before, rng)
    (target / entry["file"]).write_bytes(content)
    if rng.random() < 0.8:
        entry["sha256"] = hashlib.sha256(content).hexdigest()
        path.write_text(json.dumps(manifest))
    return target


def weights(folder: Path, rng: random.Random, source: Path) -> Path:
    """Make weights with a changed card, or changed tensors that the card names rightly or wrongly."""
    path = folder / "weights.safetensors"
    content, card = source.read_bytes(), json.loads(source.with_suffix(".json").read_text())
    if rng.random() < 0.6:
        path.write_bytes(content)
        path.with_suffix(".json").write_bytes(mutated_json(card, rng))
        return path
    changed = mutated_bytes(content[:4096], rng) + content[4096:] if rng.random() < 0.7 else mutated_bytes(content, rng)
    path.write_bytes(changed)
    if rng.random() < 0.8:
        card["sha256"] = hashlib.sha256(changed).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(card))
    return path


def mutated_array(array: NDArray[Any], rng: random.Random) -> NDArray[Any]:
    """Change numbers, shape or kind of an array."""
    kind = rng.randrange(7)
    if kind == 0:
        other = rng.choice(["f8", "f4", "i8", "u1", "i1", "?", "U3", "c16", ">f4", "M8[s]"])
        return np.zeros(array.shape, other) if array.dtype.kind == "U" else array.astype(other)  # text is no number
    if kind == 1:
        return array[: rng.randrange(len(array) + 1)] if array.ndim else array
    if kind == 2:
        return array.reshape(-1) if array.ndim > 1 else array[None]
    if kind == 3:
        return np.concatenate([array, array]) if array.ndim else np.array([array, array])
    if kind == 4:
        return np.zeros(rng.choice([(), (0,), (0, 3), (1, 1, 1), (7,)]), array.dtype)
    changed = array.copy().reshape(-1)
    if changed.size and changed.dtype.kind in "fiu":
        extreme = [0, -1, 255, 2**31, 1e38, float("nan"), float("inf")]
        with np.errstate(all="ignore"):
            changed[rng.randrange(changed.size)] = np.array(rng.choice(extreme)).astype(changed.dtype)
    return changed.reshape(array.shape)


def _as_npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def mutated_npz(content: bytes, rng: random.Random) -> bytes:
    """Change an array in a file of arrays whose checksums are right, or leave it out."""
    with np.load(io.BytesIO(content)) as file:
        arrays = dict(file)
    name = rng.choice(sorted(arrays))
    if rng.random() < 0.1:
        del arrays[name]
    elif name == "manifest" and rng.random() < 0.8:
        text = mutated_json(json.loads(str(arrays[name])), rng).decode("utf-8", "replace").replace("\0", "")
        arrays[name] = np.array(text)
    else:
        arrays[name] = mutated_array(arrays[name], rng)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def mutated_tar(content: bytes, rng: random.Random) -> bytes:
    """Change members of an archive, their names or their kinds; the archive itself is right."""
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        members = [(info, ((file := archive.extractfile(info)) and file.read()) or b"") for info in archive]
    for _ in range(rng.choice((1, 1, 3))):
        at = rng.randrange(len(members))
        info, data = members[at]
        kind = rng.randrange(6)
        if kind == 0:
            del members[at]
        elif kind == 1:
            info.name = rng.choice([f"../{info.name}", f"/tmp/{info.name}", "x", ".json", "a.b.c.npy", info.name * 9])
        elif kind == 2:
            info.type, info.linkname = rng.choice([tarfile.SYMTYPE, tarfile.DIRTYPE, tarfile.FIFOTYPE]), "/etc/passwd"
        elif kind == 3:
            members[at] = info, mutated_bytes(data, rng)
        else:
            members[at] = info, _mutated_member(info.name, data, rng)
    buffer = io.BytesIO()
    packed = rng.random() < 0.1
    with tarfile.open(fileobj=buffer, mode="w:gz" if packed else "w") as archive:
        for info, data in members:
            info.size = len(data) if info.type == tarfile.REGTYPE else 0
            archive.addfile(info, io.BytesIO(data))
    return buffer.getvalue()


def _mutated_member(name: str, data: bytes, rng: random.Random) -> bytes:
    """Change an array or plain data within its format, if it is still of one."""
    try:
        if name.endswith(".npy"):
            return _as_npy(mutated_array(np.load(io.BytesIO(data)), rng))
        return mutated_json(json.loads(data), rng)
    except (ValueError, EOFError, UnicodeDecodeError):
        return mutated_bytes(data, rng)


def mutated_checkpoint(content: bytes, rng: random.Random) -> bytes:
    """Change plain values or tensors of a checkpoint; the file itself is right."""
    import torch

    state = torch.load(io.BytesIO(content), weights_only=True)
    if rng.random() < 0.5:
        part = rng.choice([key for key in state if key != "state_dict"])
        changed = mutated_value({part: state[part]}, rng)
        state[part] = changed.get(part) if isinstance(changed, dict) else changed
    else:
        name = rng.choice(sorted(state["state_dict"]))
        tensor = state["state_dict"].pop(name)
        others = [tensor.flatten(), tensor.double(), tensor * float("nan"), tensor[:0] if tensor.ndim else tensor[None]]
        if rng.random() < 0.8:
            state["state_dict"][name] = rng.choice([*others, rng.choice(NASTY)])
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def picture(folder: Path, rng: random.Random) -> Path:
    """Make a picture of any format, mode and size, drawn or of noise; or a depth frame; or one that is damaged."""
    width, height = (rng.choice((1, 7, 40, 64, *[200] * 6)) for _ in range(2))
    seeded = np.random.default_rng(rng.randrange(2**32))
    canvas = np.full((height, width, 4), rng.choice((0, 255)), np.uint8)
    if rng.random() < 0.2:
        canvas = seeded.integers(0, 256, canvas.shape, np.uint8)
    for _ in range(rng.choice((0, 1, 1, 1, 2, 5))):
        (x, right), (y, lower) = sorted(rng.choices(range(width + 1), k=2)), sorted(rng.choices(range(height + 1), k=2))
        canvas[y:lower, x:right] = seeded.integers(0, 256, 4)
    if rng.random() < 0.15:
        depth = (canvas[..., 0] * rng.choice((1.0, 4.0, 0.01))).astype(rng.choice(["u2", "f4", "f8", "i4"]))
        path = folder / "frame.npy"
        array = mutated_array(depth, rng) if rng.random() < 0.5 else depth
        path.write_bytes(_as_npy(array) if rng.random() < 0.7 else mutated_bytes(_as_npy(array), rng))
        return path
    kinds = {
        "PNG": ["1", "L", "P", "LA", "RGB", "RGBA", "I;16"], "BMP": ["1", "L", "P", "RGB"], "GIF": ["L", "P"],
        "TIFF": ["1", "L", "RGBA", "CMYK", "F", "I;16", "LAB"], "WEBP": ["RGB", "RGBA"],
        "JPEG": ["L", "RGB", "CMYK"], "EPS": ["L", "RGB"], "PPM": ["L", "RGB"], "PDF": ["L", "RGB"],
    }  # fmt: skip
    name = rng.choice([*kinds, *["PNG", "BMP", "GIF", "TIFF", "WEBP", "JPEG"] * 3])
    mode = rng.choice(kinds[name])
    image = Image.fromarray(canvas, "RGBA")
    image = image.convert("L").convert(mode) if mode in ("F", "I;16") else image.convert("RGB").convert(mode)
    path = folder / f"picture.{rng.choice([name.lower(), 'png', 'jpg'])}"
    image.save(buffer := io.BytesIO(), name)
    content = buffer.getvalue()
    path.write_bytes(mutated_bytes(content, rng) if rng.random() < 0.4 else content)
    return path


def stranger(folder: Path, rng: random.Random) -> Path:
    """Give a file or a folder of any kind, right or of no kind at all."""
    towers = ROOT / "out" / "fuzz" / "towers"
    files = [
        ROOT / "LICENSE", ROOT / "docs" / "demo.png", BEFORE / "towers.npz", BEFORE / "expected.json",
        BEFORE / "ddpm" / "version_0" / "config.yaml", BEFORE / "blocklist" / "version_0" / "checkpoints" / "last.ckpt",
        ROOT / "stackgen" / "assets" / "weights" / "blocklist-small.json", towers / "dataset.json",
        ROOT / "examples" / "extending" / "shape.yaml", ROOT / "configs" / "model" / "blocklist-small.yaml",
    ]  # fmt: skip
    kind = rng.randrange(7)
    if kind == 0:
        return rng.choice([Path("/dev/null"), folder, folder / "gone", folder / ("x" * 300), Path(".")])
    source = rng.choice(files)
    suffix = rng.choice([source.suffix, ".json", ".yaml", ".png", ".ckpt", ".safetensors", ".npz", ".tar", ""])
    path = folder / f"stranger{suffix}"
    if kind == 1:
        path.mkdir()
    elif kind == 2:
        os.mkfifo(path)
    elif kind == 3:
        path.write_bytes(rng.choice([b"", b"\0" * 9, b"\xff\xfe{\0}\0", rng.randbytes(200), b"[" * 9999, b"{}", b"[]"]))
    elif kind == 4:
        path.write_bytes(mutated_bytes(source.read_bytes(), rng))
    else:
        path.write_bytes(source.read_bytes())
    return path


def options(known: list[str], rng: random.Random) -> list[str]:
    """Make a command line of a verb's options, some with values that make no sense."""
    words: list[str] = []
    for _ in range(rng.choice((1, 2, 4))):
        option = rng.choice(known) if rng.random() < 0.9 else rng.choice(["--x", "-", "--", "x", "--config", "-c"])
        value = rng.choice(NASTY)
        text = value if isinstance(value, str) else json.dumps(value)
        words += [f"{option}={text}"] if rng.random() < 0.5 else [option, text]
    return [word.replace("\x00", "") for word in words]
