"""A pair of MVSNet ``cam.txt`` files, one a view (DTU, BlendedMVS, Tanks and Temples as MVS code ships it).

Data flow: ``extrinsic`` (world-to-camera 4x4), ``intrinsic`` (3x3), twice -> ``Rig``.
Paper: S5.1 (Tanks and Temples).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.rigs import check_rigid, make_rig, pose_from_world_to_camera
from geodiff_plugin.types import Rig

__all__ = ["MVSNET", "matches", "read"]

MARK = re.compile(r"^\s*extrinsic\s*$", re.MULTILINE)


def matches(text: str, path: Path) -> bool:
    """Whether a line is the word ``extrinsic``."""
    return MARK.search(text) is not None


def _numbers(words: list[str], count: int, name: str) -> np.ndarray:
    try:
        values = np.array([float(word) for word in words[:count]])
    except ValueError:
        values = np.empty(0)
    if values.size != count:
        bad_value(name, f"{count} numbers", f"{' '.join(words[:count])!r}", "Is the file cut off?")
    return values


def _camera(file: CalibrationFile) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera transform and K; the line of depth range behind them is never looked at."""
    _, _, rest = file.text.partition("extrinsic")
    extrinsic, mark, intrinsic = rest.partition("intrinsic")
    if not mark:
        bad_value(
            f"{file.path}", "an MVSNet cam.txt with extrinsic and intrinsic", "no intrinsic", "Is it cut off?"
        )
    T = _numbers(extrinsic.split(), 16, f"extrinsic in {file.path}").reshape(4, 4)
    K = _numbers(intrinsic.split(), 9, f"intrinsic in {file.path}").reshape(3, 3)
    # The rotations of hand-held sets are rigid to a few 1e-4 only; inverting them as they are would shear E.
    return check_rigid(T, f"extrinsic in {file.path}"), K


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of two views, in the unit of the files (metres in most sets, millimetres in DTU).

    Raises:
        ValueError: an entry is missing or malformed, or a rotation is none.
    """
    (T_left_from_world, K_left), (T_right_from_world, K_right) = (_camera(file) for file in files)
    E = pose_from_world_to_camera(T_left_from_world, T_right_from_world)
    return make_rig(K_left, K_right, E, " and ".join(str(file.path) for file in files))


MVSNET = CalibrationFormat("a pair of MVSNet cam.txt (extrinsic, intrinsic)", matches, read, file_counts=(2,))
