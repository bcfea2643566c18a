"""3-D files hold the same blocks, in metres, with y up."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stackgen.errors import StackgenError
from stackgen.geometry import block_vertices
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.viz.export import glb_bytes, html_page, prism_mesh, write_glb, write_html
from stackgen.viz.render import SHAPE_COLOURS
from stackgen.world import PAPER_CATALOGUE, Catalogue, Shape

RNG = np.random.default_rng(0)
STACK = Stack(np.array([3, 0, 2, 0, 1]), RNG.normal(size=(5, 6)))
Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # world to glTF


def read_back(path: Path) -> trimesh.Scene:
    return trimesh.load_scene(path)


def test_a_glb_holds_each_block_by_name_at_its_place_in_metres_with_y_up(tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", STACK, cell_size=0.04)
    scene = read_back(tmp_path / "a.glb")
    assert sorted(scene.graph.nodes_geometry) == sorted(f"{i} {n}" for i, n in enumerate(STACK.names))
    for number, (name, corners) in enumerate(zip(STACK.names, block_vertices(STACK), strict=True)):
        transform, geometry = scene.graph[f"{number} {name}"]
        placed = trimesh.transform_points(scene.geometry[geometry].vertices, transform)
        for corner in corners @ Y_UP.T * 0.04:
            assert np.linalg.norm(placed - corner, axis=1).min() < 1e-6


def test_the_meshes_are_closed_face_outwards_and_have_the_shapes_volume(tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", STACK, cell_size=1)
    scene = read_back(tmp_path / "a.glb")
    assert len(scene.geometry) == 4  # one for each shape, not for each block
    for name, mesh in scene.geometry.items():
        shape = PAPER_CATALOGUE[PAPER_CATALOGUE.index(name)]
        merged = trimesh.Trimesh(mesh.vertices, mesh.faces)
        merged.merge_vertices(merge_norm=True)
        assert merged.is_watertight
        assert merged.volume == pytest.approx(shape.volume, rel=1e-5)
        assert mesh.face_normals == pytest.approx(mesh.vertex_normals[mesh.faces[:, 0]], abs=1e-5)


def test_colours_are_the_pictures_colours(tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", STACK)
    for name, mesh in read_back(tmp_path / "a.glb").geometry.items():
        linear = np.array(mesh.visual.material.baseColorFactor[:3]) / 255.0
        srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        assert srgb * 255 == pytest.approx(SHAPE_COLOURS[PAPER_CATALOGUE.index(name)], abs=2.5)


def test_the_container_is_as_the_standard_says() -> None:
    data = glb_bytes(STACK)
    magic, version, length, json_length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + json_length])
    assert json_length % 4 == 0
    assert len(data) % 4 == 0
    (binary_length,) = struct.unpack_from("<I", data, 20 + json_length)
    assert 28 + json_length + binary_length == len(data)
    assert 0 <= binary_length - document["buffers"][0]["byteLength"] < 4
    for accessor in document["accessors"]:
        assert document["bufferViews"][accessor["bufferView"]]["byteOffset"] % 4 == 0
    assert glb_bytes(STACK) == data


def test_any_convex_shape_becomes_a_closed_mesh() -> None:
    hexagon = Shape("hexagon", tuple((np.cos(a), np.sin(a)) for a in np.arange(6) * np.pi / 3), 0.7)
    points, normals, triangles = prism_mesh(hexagon)
    mesh = trimesh.Trimesh(points, triangles)
    mesh.merge_vertices(merge_norm=True)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(hexagon.volume)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    catalogue = Catalogue((hexagon,))
    assert len(glb_bytes(Stack(np.zeros(2, int), np.zeros((2, 6)), catalogue))) > 1000


FALLS = Verdict(False, np.arange(5) == 1, np.linspace(0, 1, 5), STACK.with_poses(STACK.poses + 1))


def page_data(page: str) -> dict:
    found = re.search(r"^const data = (.*);$", page, re.MULTILINE)
    assert found
    return json.loads(found.group(1))


def test_the_page_asks_for_nothing_from_outside(tmp_path: Path) -> None:
    write_html(tmp_path / "a.html", [STACK, STACK], [FALLS, None], "two")
    page = (tmp_path / "a.html").read_text()
    for way_out in (
        r"https?:",
        r"\bsrc\s*=",
        r"\bhref\s*=",
        r"@import",
        r"\burl\(",
        r"\bfetch\(",
        r"\bimport\b",
        "XMLHttp",
    ):
        assert not re.search(way_out, page), way_out
    assert "/*DATA*/" not in page


def test_the_page_holds_the_stacks_their_verdicts_and_where_the_blocks_ended() -> None:
    data = page_data(html_page([STACK, STACK], [FALLS, None], "two"))
    judged, plain = data["stacks"]
    assert data["title"] == "two"
    assert [s["name"] for s in data["shapes"]] == list(PAPER_CATALOGUE.names)
    assert judged["shapes"] == STACK.shapes.tolist()
    assert judged["fell"] == [1]
    assert judged["stable"] is False
    assert np.array(judged["sampled"])[:, :3] == pytest.approx(STACK.poses[:, :3], abs=1e-5)
    assert np.array(judged["settled"])[:, :3] == pytest.approx(STACK.poses[:, :3] + 1, abs=1e-5)
    assert "stable" not in plain
    assert "settled" not in plain


def test_the_pages_edges_are_the_prisms_edges() -> None:
    for shape in page_data(html_page([STACK]))["shapes"]:
        size = np.array(PAPER_CATALOGUE[PAPER_CATALOGUE.index(shape["name"])].size)
        points = np.array(shape["points"])
        lengths = [np.linalg.norm(points[a] - points[b]) for a, b in shape["edges"]]
        n = len(lengths) // 3
        assert lengths[:n] == pytest.approx(lengths[n : 2 * n])
        assert lengths[2 * n :] == pytest.approx([size[1]] * n)


def test_a_title_cannot_break_out_of_the_page() -> None:
    title = "</script><script>alert(1)</script>"
    page = html_page([STACK], title=title)
    assert title not in page
    assert page_data(page)["title"] == title


def test_stacks_that_do_not_fit_together_are_refused() -> None:
    other = Stack(np.zeros(1, int), np.zeros((1, 6)), Catalogue((Shape.box("brick", 2),)))
    for arguments in ([], [STACK, other]):
        with pytest.raises(StackgenError, match="one catalogue"):
            html_page(arguments)
