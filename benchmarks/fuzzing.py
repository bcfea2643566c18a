"""Inputs for the fuzzer: valid files of every kind that stackgen reads, and seeded mutations of them."""

from __future__ import annotations

import copy
import hashlib
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
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
    content = mutated_bytes((target / entry["file"]).read_bytes(), rng)
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


def options(known: list[str], rng: random.Random) -> list[str]:
    """Make a command line of a verb's options, some with values that make no sense."""
    words: list[str] = []
    for _ in range(rng.choice((1, 2, 4))):
        option = rng.choice(known) if rng.random() < 0.9 else rng.choice(["--x", "-", "--", "x", "--config", "-c"])
        value = rng.choice(NASTY)
        text = value if isinstance(value, str) else json.dumps(value)
        words += [f"{option}={text}"] if rng.random() < 0.5 else [option, text]
    return [word.replace("\x00", "") for word in words]


Maker = Callable[[Path, random.Random], Any]
