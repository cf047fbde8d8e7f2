"""A coloured cloud and its cameras as binary glTF, for browsers, Blender and the viewers of phones.

Data flow: ``Cloud``, cameras -> GLB: points, and one pyramid of lines a camera.
Paper: none.

glTF needs a header, one JSON chunk and one binary chunk, which is less to write than to import.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Sequence

import numpy as np

from geodiff_plugin.formats.atomic import atomic_path
from geodiff_plugin.formats.pointcloud import Cloud
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV

__all__ = ["write_glb"]

MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
ARRAY_BUFFER, ELEMENT_BUFFER, FLOAT, UNSIGNED_BYTE, UNSIGNED_INT = 34962, 34963, 5126, 5121, 5125
POINTS, LINES = 0, 1
#: A camera's pyramid is drawn to this share of the cloud's median depth.
PYRAMID_SHARE = 0.08
CAMERA_COLOURS = ((255, 255, 255), (255, 170, 0), (0, 200, 255), (160, 255, 120))
#: Centre to the four corners, and around them.
EDGES = np.array([0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1], dtype=np.uint32)


class _Buffer:
    """The binary chunk while it grows, with the accessors into it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, object]] = []

    def add(self, array: np.ndarray, kind: str, component: int, target: int, **more: object) -> int:
        """Append an array; returns the number of its accessor."""
        self.views.append(
            {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes, "target": target}
        )
        self.data += array.tobytes()
        self.data += b"\0" * (-len(self.data) % 4)
        self.accessors.append(
            {
                "bufferView": len(self.views) - 1,
                "componentType": component,
                "count": len(array),
                "type": kind,
                **more,
            }
        )
        return len(self.accessors) - 1

    def vertices(self, points_m: np.ndarray, colours: np.ndarray) -> dict[str, int]:
        """Attributes of coloured vertices given in the left camera's frame."""
        positions = (points_m @ OPENGL_FROM_OPENCV[:3, :3]).astype("<f4")
        opaque = np.full((len(colours), 1), 255, dtype=np.uint8)
        bounds = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
        rgba = np.ascontiguousarray(np.hstack([colours.astype(np.uint8), opaque]))
        return {
            "POSITION": self.add(positions, "VEC3", FLOAT, ARRAY_BUFFER, **bounds),
            "COLOR_0": self.add(rgba, "VEC4", UNSIGNED_BYTE, ARRAY_BUFFER, normalized=True),
        }


def _pyramid(K: np.ndarray, E: np.ndarray, size: tuple[int, int], length_m: float) -> np.ndarray:
    """``(5, 3)`` centre and corners of a camera's view at ``length_m``, in the left camera's frame."""
    (width, height), inverse = size, np.linalg.inv(K)
    corners = [(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)]
    rays = np.array([inverse @ (u, v, 1.0) for u, v in corners]) * length_m
    return np.vstack([np.zeros(3), rays]) @ E[:3, :3].T + E[:3, 3]


def write_glb(
    path: str | os.PathLike[str],
    cloud: Cloud,
    cameras: Sequence[tuple[np.ndarray, np.ndarray, tuple[int, int]]] = (),
) -> None:
    """Write a cloud and its cameras as GLB, whole or not at all.

    Args:
        path: the file.
        cloud: the points; an empty one is written as a scene without points.
        cameras: ``(K, E, (width, height))`` of every camera to draw, E its pose in the left camera's frame.

    Raises:
        OSError: the folder does not exist or is not writable.

    Convention:
        glTF's axes, in metres: a point 1 m to the right of, above and before the camera is (1, 1, -1).
    """
    buffer, meshes = _Buffer(), []
    unlit = {"material": 0}
    if len(cloud.points_m):
        attributes = buffer.vertices(cloud.points_m, cloud.colours)
        meshes.append({"name": "cloud", "primitives": [{"attributes": attributes, "mode": POINTS, **unlit}]})
    length_m = PYRAMID_SHARE * float(np.median(cloud.points_m[:, 2])) if len(cloud.points_m) else 1.0
    for number, (K, E, size) in enumerate(cameras):
        colour = np.tile(np.array(CAMERA_COLOURS[number % len(CAMERA_COLOURS)], dtype=np.uint8), (5, 1))
        attributes = buffer.vertices(_pyramid(np.asarray(K), np.asarray(E), size, length_m), colour)
        edges = buffer.add(EDGES, "SCALAR", UNSIGNED_INT, ELEMENT_BUFFER)
        lines = {"attributes": attributes, "indices": edges, "mode": LINES, **unlit}
        meshes.append({"name": f"camera {number}", "primitives": [lines]})
    scene = {
        "asset": {"version": "2.0", "generator": "geodiff-plugin"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))} if meshes else {}],
        "materials": [{"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": {}}],
    }
    if meshes:
        scene |= {
            "nodes": [{"name": mesh["name"], "mesh": i} for i, mesh in enumerate(meshes)],
            "meshes": meshes,
            "buffers": [{"byteLength": len(buffer.data)}],
            "bufferViews": buffer.views,
            "accessors": buffer.accessors,
        }
    with atomic_path(path) as temporary:
        temporary.write_bytes(_container(scene, bytes(buffer.data)))


def _container(scene: dict[str, object], data: bytes) -> bytes:
    """Header and chunks, each padded to 4 bytes: JSON with blanks, binary with zeros."""
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text
    if data:
        chunks += struct.pack("<II", len(data), BINARY_CHUNK) + data
    return struct.pack("<III", MAGIC, VERSION, 12 + len(chunks)) + chunks
