"""The one door to calibration files: the format is recognised from the content.

Hop: a path or a pair of paths -> ``CALIBRATION_FORMATS`` -> ``Rig``.
Paper: S3.3 (known cameras).

A new format is a new file and one line in the table (docs/calibration.md).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from geodiff_plugin._checks import bad_type, bad_value
from geodiff_plugin.formats.booster import BOOSTER
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.files import read_text
from geodiff_plugin.formats.foundation_stereo import FOUNDATION_STEREO
from geodiff_plugin.formats.kitti_cam_to_cam import KITTI_CAM_TO_CAM
from geodiff_plugin.formats.kitti_projections import KITTI_PROJECTIONS
from geodiff_plugin.formats.middlebury import MIDDLEBURY
from geodiff_plugin.formats.mvsnet import MVSNET
from geodiff_plugin.formats.opencv import OPENCV
from geodiff_plugin.formats.stereodemo import STEREODEMO
from geodiff_plugin.types import Rig

__all__ = ["CALIBRATION_FORMATS", "read_calibration"]

#: Every format by name; exactly one recognises a well-formed file.
CALIBRATION_FORMATS: dict[str, CalibrationFormat] = {
    "middlebury": MIDDLEBURY,
    "kitti_cam_to_cam": KITTI_CAM_TO_CAM,
    "kitti_projections": KITTI_PROJECTIONS,
    "foundation_stereo": FOUNDATION_STEREO,
    "stereodemo": STEREODEMO,
    "opencv": OPENCV,
    "booster": BOOSTER,
    "mvsnet": MVSNET,
}

PathLike = str | os.PathLike[str]


def _paths(path: PathLike | Sequence[PathLike]) -> tuple[Path, ...]:
    paths = (path,) if isinstance(path, (str, os.PathLike)) else path
    if not isinstance(paths, (tuple, list)) or not all(isinstance(p, (str, os.PathLike)) for p in paths):
        bad_type("calibration", "a path, or a pair of paths (left, right)", path)
    if len(paths) not in (1, 2):
        bad_value("calibration", "one file, or a pair (left, right)", f"{len(paths)} files")
    return tuple(Path(p) for p in paths)


def _recognise(file: CalibrationFile) -> str:
    found = [name for name, known in CALIBRATION_FORMATS.items() if known.matches(file.text, file.path)]
    if not found:
        known = "; ".join(entry.summary for entry in CALIBRATION_FORMATS.values())
        bad_value(
            "calibration",
            f"in a known format ({known})",
            f"{file.path}, which is none of them",
            "Is this the right file? Otherwise give fx, fy, cx, cy and baseline, or K and E.",
        )
    return found[0]


def _check_cameras(cameras: tuple[int, int] | None, name: str) -> None:
    if cameras is None:
        return
    if not CALIBRATION_FORMATS[name].uses_cameras:
        bad_value("cameras", "left out for a file of two cameras", cameras, "It chooses among KITTI's four.")
    if (
        not isinstance(cameras, (tuple, list))
        or len(cameras) != 2
        or not all(type(c) is int for c in cameras)
    ):
        bad_value("cameras", "a pair of camera numbers, as (2, 3)", repr(cameras))


def read_calibration(
    path: PathLike | Sequence[PathLike],
    cameras: tuple[int, int] | None = None,
    image_folder_hint: str | None = None,
) -> Rig:
    """Read a calibration file, whatever its format.

    Args:
        path: one file, or a pair (left, right) for formats with one file a view.
        cameras: left and right camera of a KITTI file; ``None`` goes by the folder, then by the file.
        image_folder_hint: name or path of the left image's folder (or of the image): ``image_2`` means 2, 3.

    Returns:
        The rig: K in pixels of the images that the file is for, E in metres.

    Raises:
        FileNotFoundError, IsADirectoryError, PermissionError: no readable file.
        TypeError: not a path or a pair of paths.
        ValueError: empty, unknown format, cut off, lens distortion, cameras that are not there.

    Convention:
        A right camera 0.12 m to the right of the left one has ``E[0, 3] == +0.12``.
    """
    paths = _paths(path)
    if len(paths) == 2 and paths[0] == paths[1]:
        paths = paths[:1]
    files = tuple(CalibrationFile(p, read_text(p, "calibration", "a calibration file")) for p in paths)
    names = [_recognise(file) for file in files]
    if len(set(names)) > 1:
        bad_value("calibration", "two files of one format", " and ".join(names))
    known = CALIBRATION_FORMATS[names[0]]
    if len(files) not in known.file_counts:
        one = len(files) == 1
        bad_value(
            "calibration",
            f"{'two files' if one else 'one file'} ({known.summary})",
            " and ".join(str(file.path) for file in files),
            "Give --calib twice, for the left and the right view."
            if one
            else "It describes both cameras; give it once.",
        )
    _check_cameras(cameras, names[0])
    hint = None if image_folder_hint is None else str(image_folder_hint)
    return known.read(files, CameraChoice(tuple(cameras) if cameras else None, hint))
