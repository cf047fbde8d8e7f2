"""Writes cameras and cloud as a COLMAP text model, for Gaussian splatting and MVS.

Data flow: cameras with their poses, ``Cloud`` -> ``cameras.txt``, ``images.txt``, ``points3D.txt``.
Paper: none.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.atomic import atomic_path
from geodiff_plugin.formats.pointcloud import Cloud

__all__ = ["COLMAP_FILES", "check_colmap_names", "write_colmap"]

COLMAP_FILES = ("cameras.txt", "images.txt", "points3D.txt")
#: A start for other programs, not a copy of the cloud: text of a million points is 50 MB.
MOST_POINTS = 100_000


def check_colmap_names(names: Sequence[str]) -> None:
    """Refuse names of images that a model cannot hold.

    Raises:
        ValueError: a name with a blank.
    """
    for name in names:
        if any(letter.isspace() for letter in name):
            bad_value("the name of an image in a COLMAP model", "without blanks", repr(name), "Rename it.")


def write_colmap(
    folder: str | os.PathLike[str],
    views: Sequence[tuple[str, np.ndarray, np.ndarray, tuple[int, int]]],
    cloud: Cloud,
) -> None:
    """Write a model whose world is the left camera's frame, in metres.

    Args:
        folder: an existing one.
        views: ``(name, K, E, (width, height))`` of every image; K in pixels, E its pose in the left camera's
            frame. Names have no blanks, as COLMAP's text allows none.
        cloud: the points; at most 100 000 of them are written.

    Raises:
        ValueError: a name with a blank.
        OSError: the folder does not exist or is not writable.

    Convention:
        World-to-camera, and the centre of the first pixel at (0.5, 0.5), as COLMAP has it: cx and cy are
        half a pixel more than in K.
    """
    cameras, images = (
        ["#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"],
        [
            "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
            "#   POINTS2D[] as (X, Y, POINT3D_ID)",
        ],
    )
    check_colmap_names([name for name, *_ in views])
    for number, (name, K, E, (width, height)) in enumerate(views, 1):
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5
        cameras.append(f"{number} PINHOLE {width} {height} {fx:.9g} {fy:.9g} {cx:.9g} {cy:.9g}")
        T = np.linalg.inv(E)
        qx, qy, qz, qw = Rotation.from_matrix(T[:3, :3]).as_quat()
        numbers = " ".join(f"{value:.12g}" for value in (qw, qx, qy, qz, *T[:3, 3]))
        images += [f"{number} {numbers} {number} {name}", ""]
    thin = cloud.thinned(MOST_POINTS)
    points = ["#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    points += [
        f"{number} {x:.5f} {y:.5f} {z:.5f} {r} {g} {b} 0"
        for number, ((x, y, z), (r, g, b)) in enumerate(zip(thin.points_m, thin.colours, strict=True), 1)
    ]
    heads = ("# Camera list with", "# Image list with two", "# 3D point list with")
    for name, head, lines in zip(COLMAP_FILES, heads, (cameras, images, points), strict=True):
        head += " one line" if head.endswith("with") else " lines"
        with atomic_path(Path(folder) / name) as temporary:
            temporary.write_text("\n".join([f"{head} of data each:", *lines]) + "\n", encoding="utf-8")
