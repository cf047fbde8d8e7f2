"""``stereodemo_calibration.json``, the calibration of the stereodemo project.

Data flow: ``fx fy cx0 cx1 cy baseline_meters width height`` -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

from pathlib import Path

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.nerf import MARK as NERF_MARK
from geodiff_plugin.formats.rigs import (
    finite,
    intrinsics,
    make_rig,
    pose_to_the_right,
    positive,
    whole_pixels,
)
from geodiff_plugin.formats.structured import parse_json
from geodiff_plugin.types import Rig

__all__ = ["STEREODEMO", "matches", "read"]

KEYS = ("fx", "fy", "cx0", "cx1", "cy", "baseline_meters")


def matches(text: str, path: Path) -> bool:
    """Whether the text is a JSON object with ``"fx"`` in it, and nothing of another format's JSON."""
    others = ("opencv-matrix", '"ppx"', NERF_MARK)
    return text.lstrip().startswith("{") and '"fx"' in text and not any(mark in text for mark in others)


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of one stereodemo file; its ``depth_range`` is not read.

    Raises:
        ValueError: not JSON, or a key is missing or not a number.
    """
    path = files[0].path
    data = parse_json(files[0].text, path)
    if not isinstance(data, dict):
        bad_value(f"{path}", "a JSON object", type(data).__name__)
    if "cx" in data:  # older files: one principal point for both images
        data = {"cx0": data["cx"], "cx1": data["cx"], **data}
    missing = [key for key in KEYS if key not in data]
    if missing:
        bad_value(f"{path}", f"a stereodemo calibration with {', '.join(KEYS)}", f"no {', '.join(missing)}")
    numbers = {key: finite(data[key], f"{key} in {path}") for key in KEYS}
    baseline_m = positive(numbers["baseline_meters"], f"baseline_meters in {path}")
    size = None
    if "width" in data and "height" in data:
        width, height = (whole_pixels(data[key], f"{key} in {path}") for key in ("width", "height"))
        size = (width, height)
    focal, cy = (numbers["fx"], numbers["fy"]), numbers["cy"]
    K_left, K_right = (intrinsics(*focal, numbers[cx], cy) for cx in ("cx0", "cx1"))
    return make_rig(K_left, K_right, pose_to_the_right(baseline_m), path, size=size)


STEREODEMO = CalibrationFormat("stereodemo JSON (fx, fy, cx0, cx1, cy, baseline_meters)", matches, read)
