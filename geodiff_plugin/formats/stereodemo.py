"""``stereodemo_calibration.json``.

Hop: ``fx fy cx0 cx1 cy baseline_meters width height`` -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

import json
from pathlib import Path

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.rigs import intrinsics, make_rig, pose_to_the_right, positive
from geodiff_plugin.types import Rig

__all__ = ["STEREODEMO", "matches", "read"]

KEYS = ("fx", "fy", "cx0", "cx1", "cy", "baseline_meters")


def matches(text: str, path: Path) -> bool:
    """Whether the text is a JSON object with ``"fx"`` in it (and not OpenCV's JSON)."""
    return text.lstrip().startswith("{") and '"fx"' in text and "opencv-matrix" not in text


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of one stereodemo file; its ``depth_range`` is not read.

    Raises:
        ValueError: not JSON, or a key is missing or not a number.
    """
    path = files[0].path
    try:
        data = json.loads(files[0].text)
    except json.JSONDecodeError as error:
        bad_value(f"{path}", "JSON", f"{error.msg} in line {error.lineno}", "Is the file cut off?")
    if "cx" in data:  # older files: one principal point for both images
        data = {"cx0": data["cx"], "cx1": data["cx"], **data}
    missing = [key for key in KEYS if key not in data]
    if missing:
        bad_value(f"{path}", f"a stereodemo calibration with {', '.join(KEYS)}", f"no {', '.join(missing)}")
    not_numbers = [
        key for key in KEYS if isinstance(data[key], bool) or not isinstance(data[key], (int, float))
    ]
    if not_numbers:
        bad_value(f"{not_numbers[0]} in {path}", "a number", repr(data[not_numbers[0]]))
    baseline_m = positive(data["baseline_meters"], f"baseline_meters in {path}")
    size = None
    if "width" in data and "height" in data:
        size = tuple(int(positive(data[key], f"{key} in {path}")) for key in ("width", "height"))
    K_left, K_right = (intrinsics(data["fx"], data["fy"], data[cx], data["cy"]) for cx in ("cx0", "cx1"))
    return make_rig(K_left, K_right, pose_to_the_right(baseline_m), path, size=size)


STEREODEMO = CalibrationFormat("stereodemo JSON (fx, fy, cx0, cx1, cy, baseline_meters)", matches, read)
