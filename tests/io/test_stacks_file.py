"""What is written is read back, and what is wrong is named by its place."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.io import files
from stackgen.io.stacks_file import (
    FORMAT,
    StackEntry,
    StacksFile,
    Weights,
    from_json,
    read_stacks,
    schema,
    to_json,
    write_stacks,
)
from stackgen.protocols import Verdict
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_WORLD, Catalogue, Grid, Shape, World

EXAMPLES = Path(__file__).parents[2] / "examples" / "stacks"


def full() -> StacksFile:
    """A file that says all a file can say."""
    grid = Grid(width=5, image_size=70, pixels_per_cell=12.5, ground_margin=3)
    catalogue = Catalogue((*PAPER_CATALOGUE, Shape.box("plank", 3, 0.25, 0.5)))
    rng = np.random.default_rng(0)
    stacks = [Stack(rng.integers(0, 5, k), rng.normal(size=(k, 6)), catalogue) for k in (1, 4, 10)]
    fell = np.array([False, True, False, True])
    verdicts = [None, Verdict(False, fell, rng.normal(size=4), stacks[1].with_poses(rng.normal(size=(4, 6))), False)]
    verdicts.append(Verdict(True, np.zeros(10, bool), np.zeros(10), stacks[2], True, 0.125))
    entries = [
        StackEntry(s, v, i, c)
        for s, v, i, c in zip(stacks, verdicts, (None, 0.0, 0.875), ("", "é, <b>", "[ 1 ]"), strict=True)
    ]
    return StacksFile(
        tuple(entries),
        World(catalogue, grid, 10),
        silhouette(stacks[2], grid),
        "drawings/arch.png",
        np.array([3, 0, 1, 0, 2]),
        "cnn",
        Physics().to_json(),
        2**40,
        Weights("default", "0123456789abcdef" * 4),
        {"kind": "ddim", "steps": 8, "guided": [0.5, 1.0]},
        np.array([4, 0, 2, 0, 2]),
        0.05,
        "all of it",
    )


def same(a: StacksFile, b: StacksFile) -> bool:
    """Equality to the last bit."""
    return to_json(a) == to_json(b) and (a.target is None) == (b.target is None) and a.world == b.world


def test_a_full_file_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    content = full()
    write_stacks(tmp_path / "stacks.json", content)
    back = read_stacks(tmp_path / "stacks.json")
    assert same(content, back)
    assert (back.target == content.target).all()  # type: ignore[union-attr]
    assert back.world == content.world
    assert back.weights == content.weights
    assert back.physics == content.physics
    for a, b in zip(content.entries, back.entries, strict=True):
        assert (a.stack.shapes == b.stack.shapes).all()
        assert (a.stack.poses == b.stack.poses).all()
        if a.verdict is not None and b.verdict is not None:
            assert (a.verdict.settled.poses == b.verdict.settled.poses).all()
            assert (a.verdict.fell == b.verdict.fell).all()
            assert (a.verdict.drop == b.verdict.drop).all()
            assert (a.verdict.at_rest, a.verdict.margin) == (b.verdict.at_rest, b.verdict.margin)


numbers = st.floats(-1e6, 1e6)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.lists(numbers, min_size=6, max_size=6)), min_size=1, max_size=12))
def test_any_stack_survives_the_round_trip(blocks: list[tuple[int, list[float]]]) -> None:
    stack = Stack(np.array([s for s, _ in blocks]), np.array([p for _, p in blocks]))
    back = from_json(json.loads(json.dumps(to_json(StacksFile((StackEntry(stack),), PAPER_WORLD)))))
    assert (back.stacks[0].poses == stack.poses).all()
    assert (back.stacks[0].shapes == stack.shapes).all()


def test_what_is_written_follows_the_published_schema() -> None:
    jsonschema.Draft202012Validator.check_schema(schema())
    jsonschema.validate(to_json(full()), schema(), jsonschema.Draft202012Validator)


def test_a_file_by_hand_needs_only_the_format_and_the_blocks(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_text(
        '\ufeff{"format": "stackgen.stacks/1",\n"stacks": [{"blocks": [{"shape": "cube", "position": [0, 1, 0.5]}]}]}'
    )
    content = read_stacks(path)
    assert content.stacks[0].poses.tolist() == [[0, 1, 0.5, 0, 0, 0]]
    assert content.world == PAPER_WORLD
    assert content.cell_size == 0.05
    assert content.entries[0].verdict is None
    assert content.target is None
    assert content.seed is None


def test_the_file_is_laid_out_for_people(tmp_path: Path) -> None:
    write_stacks(tmp_path / "a.json", full())
    lines = (tmp_path / "a.json").read_text().splitlines()
    assert sum('"shape": ' in line for line in lines) >= 10  # the smallest stack may stand on one line
    assert max(map(len, lines)) < 2000


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.json")), ids=lambda path: path.name)
def test_the_examples_are_read(path: Path) -> None:
    assert all(len(stack) for stack in read_stacks(path).stacks)


def plain() -> dict[str, Any]:
    """A small file with a verdict."""
    pose = {"position": [0, 0, 0.5], "rotation": [0, 0, 0]}
    blocks = [{"shape": "cube", **pose}, {"shape": "triangle", "position": [0, 0, 1.5]}]
    verdict = {"stable": True, "at_rest": True, "fell": [], "drop": [0, 0.1], "settled": [pose, pose]}
    return {
        "format": FORMAT,
        "cell_size_m": 0.05,
        "stacks": [{"blocks": copy.deepcopy(blocks)}, {"blocks": blocks, "verdict": verdict}],
    }


WRONG: list[tuple[list[Any], Any, str]] = [
    (["format"], "stackgen.stacks/2", r"\$\.format is 'stackgen.stacks/2'; this version reads"),
    (["stacks"], [], r"\$\.stacks: has 0 items; at least 1"),
    (["stacks"], {}, r"\$\.stacks: "),
    (["stacks", 1, "blocks", 1, "shape"], "cub", r"\$\.stacks\[1\]\.blocks\[1\]\.shape: unknown shape 'cub'.*triangle"),
    (["stacks", 0, "blocks"], [], r"\$\.stacks\[0\]\.blocks: has 0 items"),
    (
        ["stacks", 0, "blocks"],
        plain()["stacks"][0]["blocks"] * 501,
        r"\$\.stacks\[0\]\.blocks: has 1002 items; at most 200",
    ),
    (
        ["stacks", 0, "blocks", 0, "position"],
        [0, 0],
        r"\$\.stacks\[0\]\.blocks\[0\]\.position: has 2 items; at least 3",
    ),
    (["stacks", 0, "blocks", 0, "position", 2], "high", r"\$\.stacks\[0\]\.blocks\[0\]\.position\[2\]: 'high' is not"),
    (["stacks", 0, "blocks", 0, "position", 2], True, r"position\[2\]: True is not"),
    (["stacks", 0, "blocks", 0, "position", 2], 10**400, r"position\[2\]: "),
    (["stacks", 0, "blocks", 0, "colour"], "red", r"\$\.stacks\[0\]\.blocks\[0\]: .*'colour' was unexpected"),
    (["stacks", 1, "verdict", "stable"], False, r"\$\.stacks\[1\]\.verdict: stable is false, but 0 blocks fell"),
    (["stacks", 1, "verdict", "fell"], [2], r"\$\.stacks\[1\]\.verdict\.fell: blocks are numbered 0 to 1"),
    (["stacks", 1, "verdict", "fell"], [1, 1], r"\$\.stacks\[1\]\.verdict\.fell: "),
    (["stacks", 1, "verdict", "drop"], [0], r"\$\.stacks\[1\]\.verdict\.drop: 1 values for 2 blocks"),
    (["stacks", 1, "verdict", "settled"], [], r"\$\.stacks\[1\]\.verdict\.settled: 0 values for 2 blocks"),
    (["stacks", 1, "front_iou"], 1.5, r"\$\.stacks\[1\]\.front_iou: "),
    (["cell_size_m"], 0, r"\$\.cell_size_m: "),
    (["physics"], {"cell_size": 0.1}, r"\$\.cell_size_m is 0.05, but \$\.physics\.cell_size is 0.1"),
    (["block_list"], {"cone": 1}, r"\$\.block_list: unknown shape 'cone'"),
    (["block_list"], {"cube": -1}, r"\$\.block_list\.cube: "),
    (["block_list_source"], "guess", r"\$\.block_list_source: "),
    (["weights"], {"name": "a", "sha256": "no"}, r"\$\.weights\.sha256: "),
    (["silhouette_packed"], {"size": [64, 64], "bits": "AAAA"}, r"\$\.silhouette_packed\.bits: 3 bytes, but"),
    (["silhouette_packed"], {"size": [64, 64], "bits": "%"}, r"\$\.silhouette_packed\.bits: is not base64"),
    (["silhouette_packed"], {"size": [8, 8], "bits": "AAAA"}, r"\$\.silhouette_packed\.size is 8 x 8"),
    (["catalogue"], [{"name": "cube", "outline": [[0, 0], [1, 0], [1, 1]]}], "must have its box centred"),
    (["catalogue"], PAPER_CATALOGUE.to_json() * 2, "distinct names"),
    (["typo"], 1, r"\$: .*'typo' was unexpected"),
]


@pytest.mark.parametrize(
    ("place", "value", "message"), WRONG, ids=[f"{'.'.join(map(str, w[0]))}-{i}" for i, w in enumerate(WRONG)]
)
def test_a_wrong_value_is_named_by_its_json_path(place: list[Any], value: Any, message: str, tmp_path: Path) -> None:
    data = copy.deepcopy(plain())
    spot: Any = data
    for key in place[:-1]:
        spot = spot[key]
    spot[place[-1]] = value
    path = tmp_path / "stacks.json"
    path.write_text(json.dumps(data))
    with pytest.raises(StackgenError, match=message) as caught:
        read_stacks(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    assert len(text) < 500


TEXTS = {
    "": "is empty",
    "  \n": "is empty",
    "hello": "not JSON at line 1, column 1",
    '{"format": "stackgen.stacks/1",\n "stacks": [,]}': "line 2, column 13",
    json.dumps(plain())[:200]: "cut short",
    "[]": "is not a stacks file",
    "{}": "is not a stacks file",
    '{"format": "stackgen.stacks/1", "seed": NaN}': "holds NaN",
    '{"format": "stackgen.stacks/1", "seed": 1e999}': "holds 1e999",
    '{"format": "stackgen.stacks/1", "format": 1}': "key 'format' twice",
    "[" * 100_000: "nested too deeply",
    '{"seed": ' + "9" * 5000 + "}": "5000 digits",
}


@pytest.mark.parametrize("text", TEXTS, ids=list(TEXTS.values()))
def test_a_damaged_file_is_named_by_its_line_or_its_kind(text: str, tmp_path: Path) -> None:
    path = tmp_path / "stacks.json"
    path.write_text(text)
    with pytest.raises(StackgenError, match=TEXTS[text]) as caught:
        read_stacks(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


def test_every_truncation_of_a_file_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "stacks.json"
    text = json.dumps(plain())
    for length in range(0, len(text) - 1, 7):
        path.write_text(text[:length])
        with pytest.raises(StackgenError):
            read_stacks(path)


def test_missing_folder_and_binary_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "picture").write_bytes(b"\x89PNG\xff")
    missing = [("no.json", "no such file"), (".", "Is a directory"), ("picture", "is not text in UTF-8")]
    for path, message in missing:
        with pytest.raises(StackgenError, match=message):
            read_stacks(tmp_path / path)


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "stacks.json"
    path.write_text("old")

    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full_disk)
    with pytest.raises(StackgenError, match=r"stacks\.json: cannot be written: No space left"):
        write_stacks(path, full())
    monkeypatch.setattr(files.os, "fsync", lambda descriptor: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_stacks(path, full())
    assert [p.name for p in tmp_path.iterdir()] == ["stacks.json"]
    assert path.read_text() == "old"
    monkeypatch.undo()
    with pytest.raises(StackgenError, match="cannot be written"):
        write_stacks(path / "stacks.json", full())
    write_stacks(tmp_path / "new" / "stacks.json", full())
