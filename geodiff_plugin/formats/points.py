"""Known depths in files: a sparse depth map, or a list of points.

Hop: file -> what ``GeometryGuidance(points=...)`` takes.
Paper: none (points go beyond it).
"""

from __future__ import annotations

import os

import numpy as np

from geodiff_plugin._checks import bad_value, check_map_in_metres
from geodiff_plugin.formats.depth import read_depth_mm_png, read_pfm
from geodiff_plugin.formats.files import check_file

__all__ = ["read_points"]


def read_points(path: str | os.PathLike[str], name: str = "points") -> np.ndarray:
    """Read depths that are known, of the left image.

    Args:
        path: 16-bit PNG of millimetres, PFM or two-dimensional ``.npy`` of metres (a map of the left image, 0
            or not finite where nothing is known); or ``.npy`` or text of ``N x 3`` metres in the left
            camera's frame (x right, y down, z forward).
        name: the argument that it came in, for messages.

    Returns:
        ``(H, W)`` float32 metres, 0 where unknown, or ``(N, 3)`` float32 metres.

    Raises:
        FileNotFoundError, IsADirectoryError, PermissionError: no readable file.
        ValueError: a file of another kind, or that does not decode.
    """
    found = check_file(path, name, "a file of known depths")
    kind = found.suffix.lower()
    if kind == ".png":
        return read_depth_mm_png(found, name)[0]
    if kind == ".pfm":
        values = read_pfm(found, name)
    else:
        expected = "a 16-bit PNG in millimetres, a PFM or .npy map in metres, or N x 3 metres as .npy or text"
        try:
            values = np.load(found, allow_pickle=False) if kind == ".npy" else np.loadtxt(found, ndmin=2)
        except (ValueError, EOFError, UnicodeDecodeError) as error:
            bad_value(name, expected, f"{found}, which does not read ({error})")
    if values.ndim != 2 or not np.issubdtype(values.dtype, np.number):
        bad_value(name, "a map (H, W) or points (N, 3) of numbers", f"{found} of shape {values.shape}")
    check_map_in_metres(values, name, f"{found} of {values.dtype}")
    values = values.astype(np.float32)
    return values if values.shape[1] == 3 else np.where(np.isfinite(values), values, np.float32(0))
