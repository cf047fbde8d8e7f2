"""Known depths of single points, in the left camera's frame or a sensor's, from the files that hold them."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._camera_checks import check_metres
from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.formats.depth import MILLIMETRES, read_depth_png
from geodiff_plugin.formats.files import PathLike, check_file, read_npy, read_rows
from geodiff_plugin.formats.maps import read_pfm

KINDS = "a 16-bit PNG (mm), a .pfm or .npy map, or points as .npy, text or .ply, in metres"
COLUMNS = (3, 4, 6)  # x y z, with an intensity, or with a colour
NUMBER = re.compile(r"[-+]?(\d.*|\..*|nan|inf)", re.IGNORECASE)


def read_points(path: PathLike, name: str = "points", *, scale: float | None = None) -> np.ndarray:
    """Read known depths of the left image: ``(H, W)`` float32 metres, 0 where unknown, or ``(N, 3)``.

    Points are in the left camera's frame: ``.npy`` or text of 3, 4 or 6 columns, or with a heading that names
    x, y and z; ``.ply``. ``scale`` is the units of the file in a metre: 1000 for millimetres, 256 for
    KITTI's PNG.
    """
    file = check_file(path, name, "a file of known depths")
    if scale is not None:
        check_number(scale, f"{name}-scale", 1e-9, 1e9)
    kind = file.suffix.lower()
    if kind == ".png":
        return read_depth_png(file, scale or MILLIMETRES, name)[0]
    if kind == ".npy":
        values = read_npy(file, name, KINDS)
    else:
        values = {".pfm": read_pfm, ".ply": read_ply_points}.get(kind, _table)(file, name)
    if values.ndim != 2 or 0 in values.shape:
        bad_value(name, "a map (H, W) or points (N, 3) of numbers", f"{file} of shape {values.shape}")
    if values.shape[1] in COLUMNS:
        values = values[:, :3]
    if scale is None:
        check_metres(values, name, f"{file} of {values.dtype}")
    with np.errstate(over="ignore"):
        values = (values / (scale or 1.0)).astype(np.float32)
    return values if values.shape[1] == 3 else np.where(np.isfinite(values), values, np.float32(0))


def _table(path: Path, name: str) -> np.ndarray:
    """Numbers of a text, one row a line, below one heading at most."""
    rows = read_rows(path, name, KINDS)
    heading = rows.pop(0) if rows and not NUMBER.fullmatch(rows[0][0]) else []
    lengths = {len(row) for row in rows}
    if lengths == {len(heading)}:  # a word a column
        words = [re.sub(r"([_ ]?m|[_ ]?[\[(]m[\])])$", "", word.lower()) for word in heading]
        if any(words.count(axis) != 1 for axis in "xyz"):
            cure = "Write the points as x, y and z of the left camera, or depths as a map of the left image."
            got = f"{path} with {', '.join(heading)}"
            bad_value(name, "points with columns x, y and z, in metres", got, cure)
        rows = [[row[words.index(axis)] for axis in "xyz"] for row in rows]
    with suppress(ValueError):  # words, or rows of several lengths
        return np.array(rows, dtype=np.float64).reshape(len(rows), -1)
    got = f"{path} with words, or rows of {sorted(lengths)} numbers"
    bad_value(name, "points in metres, one a line, below one heading at most", got)


def read_ply_points(path: Path, name: str = "points") -> np.ndarray:
    """The points ``(N, 3)`` float64 of a PLY file, ASCII or binary, in the file's unit and frame."""
    import trimesh

    count = re.search(rb"\nelement vertex (\d+)\s", path.read_bytes())
    try:
        how: dict[str, Any] = {"process": False, "skip_materials": True, "fix_texture": False}
        cloud: Any = trimesh.load(path, file_type="ply", **how)
        points = np.array(cloud.vertices, np.float64)
    except Exception:  # of any kind that a damaged file leads to
        points = np.empty((0, 3))
    if count is None or not 0 < int(count.group(1)) == len(points):
        expected = "a whole PLY file whose vertices have x, y and z"
        bad_value(name, expected, path, "Is it cut off, or another format?")
    return points
