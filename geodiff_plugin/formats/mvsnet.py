"""A pair of MVSNet ``cam.txt``, one a view: DTU, BlendedMVS, Tanks and Temples as MVS code has it (S5.1)."""

from __future__ import annotations

import re

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import CalibrationFormat, Camera, CameraChoice, RawRig, array_of, rigid

__all__ = ["MVSNET", "read_cam"]

MARK = re.compile(r"^\s*extrinsic\s*$", re.MULTILINE)


def read_cam(text: str) -> tuple[np.ndarray, Camera]:
    """World-to-camera transform and camera; the line of depth range behind them is never looked at."""
    _, _, rest = text.partition("extrinsic")
    extrinsic, mark, intrinsic = rest.partition("intrinsic")
    if not mark:
        bad_value(
            "the file", "an MVSNet cam.txt with extrinsic and intrinsic", "no intrinsic", "Is it cut off?"
        )
    # The rotations of hand-held sets are rigid to a few 1e-4 only; inverting them as they are would shear E.
    T = rigid(array_of(extrinsic.split()[:16], (16,), "extrinsic"), "extrinsic")
    return T, Camera(array_of(intrinsic.split()[:9], (3, 3), "intrinsic"))


def _read(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """In the unit of the files: metres in most sets, millimetres in DTU."""
    (T_left_from_world, left), (T_right_from_world, right) = (read_cam(text) for text in texts)
    return RawRig(left, right, T_left_from_world @ np.linalg.inv(T_right_from_world))


MVSNET = CalibrationFormat(
    "a pair of MVSNet cam.txt (extrinsic, intrinsic)",
    lambda text: MARK.search(text) is not None,
    _read,
    file_counts=(2,),
)
