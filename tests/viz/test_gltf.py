"""GLB files hold the same blocks, in metres, with y up."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stackgen.geometry import block_vertices
from stackgen.stack import Stack
from stackgen.viz.gltf import glb_bytes, prism_mesh, write_glb
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
