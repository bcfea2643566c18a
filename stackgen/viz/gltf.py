"""Stacks as binary glTF (GLB), and the mesh of a shape.

The file is written directly: a GLB of prisms is a page of code, where a mesh library costs most of a second to import.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import quaternions
from stackgen.io.files import write_atomically
from stackgen.stack import Stack
from stackgen.viz.render import Colour, shape_colour
from stackgen.world import Shape

_FLOAT, _UNSIGNED_INT, _VERTICES, _INDICES = 5126, 5125, 34962, 34963  # glTF's numbers for what is in a buffer


def write_glb(path: str | Path, stack: Stack, cell_size: float = 0.05) -> None:
    """Write a stack as binary glTF: metres, y up, one node for each block, one mesh and colour for each shape.

    A node is named by its block's number and shape, `3 cube`, and stands at the block's pose. World
    (x, y, z) becomes glTF's (x, z, -y): the front looks along +z, as glTF wants.

    Args:
        path: File to write.
        stack: The stack to write.
        cell_size: Edge of a cube [m].

    Raises:
        StackgenError: If it cannot be written.
    """
    write_atomically(path, glb_bytes(stack, cell_size))


def glb_bytes(stack: Stack, cell_size: float = 0.05) -> bytes:
    """Make the content of :func:`write_glb`'s file."""
    used = np.unique(stack.shapes).tolist()
    buffer = _Buffer()
    meshes, materials = [], []
    for material, index in enumerate(used):
        shape = stack.catalogue[index]
        points, normals, triangles = prism_mesh(shape)
        attributes = {
            "POSITION": buffer.add(_y_up(points) * cell_size, "VEC3"),
            "NORMAL": buffer.add(_y_up(normals), "VEC3"),
        }
        primitive = {"attributes": attributes, "indices": buffer.add(triangles.ravel(), "SCALAR"), "material": material}
        meshes.append({"name": shape.name, "primitives": [primitive]})
        materials.append(_material(shape.name, shape_colour(index)))
    rotations = quaternions(_y_up(stack.poses[:, 3:]))
    nodes: list[dict[str, Any]] = [
        {
            "name": f"{number} {name}",
            "mesh": used.index(int(shape)),
            "translation": (_y_up(pose[:3]) * cell_size).tolist(),
            "rotation": quaternion.tolist(),
        }
        for number, (name, shape, pose, quaternion) in enumerate(
            zip(stack.names, stack.shapes, stack.poses, rotations, strict=True)
        )
    ]
    nodes.append({"name": "stack", "children": list(range(len(stack)))})
    document = {
        "asset": {"version": "2.0", "generator": "stackgen"},
        "scene": 0,
        "scenes": [{"nodes": [len(stack)]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": materials,
        **buffer.tables(),
    }
    return _pack_glb(document, bytes(buffer.data))


def prism_mesh(shape: Shape) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint32]]:
    """Make a shape's mesh in the block frame [cell]: each face has corners of its own, with its normal.

    Returns:
        Points (n, 3), their normals (n, 3), and triangles (t, 3) of indices into the points.

    >>> points, _, triangles = prism_mesh(Shape.box("cube", 1))
    >>> points.shape, triangles.shape
    ((24, 3), (12, 3))
    """
    points: list[NDArray[np.float64]] = []
    normals: list[NDArray[np.float64]] = []
    triangles: list[tuple[int, int, int]] = []
    for face in shape.faces:
        corners, first = shape.vertices[face], sum(map(len, points))
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        points.append(corners)
        normals.append(np.tile(normal / np.linalg.norm(normal), (len(face), 1)))
        triangles += [(first, first + i, first + i + 1) for i in range(1, len(face) - 1)]
    return np.concatenate(points), np.concatenate(normals), np.array(triangles, dtype=np.uint32)


def _y_up(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn world vectors (..., 3), z up, into glTF's, y up: positions, normals and rotation vectors alike."""
    return np.stack([vectors[..., 0], vectors[..., 2], -vectors[..., 1]], axis=-1) + 0.0


def _material(name: str, colour: Colour) -> dict[str, Any]:
    """Make a matt surface; glTF wants linear light where pictures have sRGB."""
    c = np.array(colour) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return {
        "name": name,
        "pbrMetallicRoughness": {
            "baseColorFactor": [*linear.round(5).tolist(), 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": 0.85,
        },
    }


class _Buffer:
    """The binary part of a glTF file and the tables that say what lies where."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []

    def add(self, values: NDArray[Any], kind: str) -> int:
        """Append float vectors or whole-number indices, and return the accessor's number."""
        is_index = values.dtype.kind == "u"
        array = np.ascontiguousarray(values, dtype="<u4" if is_index else "<f4")
        rows = array.reshape(len(array), -1)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append({**view, "target": _INDICES if is_index else _VERTICES})
        self.accessors.append(
            {
                "bufferView": len(self.views) - 1,
                "componentType": _UNSIGNED_INT if is_index else _FLOAT,
                "count": len(array),
                "type": kind,
                "min": rows.min(axis=0).tolist(),
                "max": rows.max(axis=0).tolist(),
            }
        )
        self.data += array.tobytes()
        return len(self.accessors) - 1

    def tables(self) -> dict[str, Any]:
        """The parts of the document that describe the buffer."""
        return {"buffers": [{"byteLength": len(self.data)}], "bufferViews": self.views, "accessors": self.accessors}


def _pack_glb(document: dict[str, Any], data: bytes) -> bytes:
    """Put header, JSON chunk and binary chunk together, each padded to four bytes."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
