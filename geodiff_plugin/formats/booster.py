"""Calibration files of the Booster data set (XML).

Data flow: ``proj_matL``, ``proj_matR``, ``baselineLR`` (mm) -> ``Rig``.
Paper: S5.1 (Booster).
"""

from __future__ import annotations

from pathlib import Path

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.opencv_storage import is_storage, parse_storage
from geodiff_plugin.formats.rigs import make_rig, pose_to_the_right, positive
from geodiff_plugin.types import Rig

__all__ = ["BOOSTER", "matches", "read"]

KEYS = ("proj_matL", "proj_matR", "baselineLR")


def matches(text: str, path: Path) -> bool:
    """Whether OpenCV wrote it and it has ``proj_matL``."""
    return is_storage(text) and "proj_matL" in text


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of one Booster scene, for its images at full resolution, which are rectified.

    Raises:
        ValueError: an entry is missing or malformed.
    """
    path = files[0].path
    entries = parse_storage(files[0].text, path)
    missing = [key for key in KEYS if key.lower() not in entries]
    if missing:
        bad_value(f"{path}", f"a Booster calibration with {', '.join(KEYS)}", f"no {', '.join(missing)}")
    K_left, K_right = (entries[key.lower()][:, :3] for key in KEYS[:2])
    baseline_m = positive(entries["baselinelr"].ravel()[0], f"baselineLR in {path}") / 1000.0
    return make_rig(K_left, K_right, pose_to_the_right(baseline_m), path, rectified=True)


BOOSTER = CalibrationFormat("Booster xml (proj_matL, proj_matR, baselineLR)", matches, read)
