"""Ways to give the cameras on the page: a calibration file, numbers, or photographs alone.

Paper: S3.3 (two views with known cameras).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from geodiff_plugin._camera_checks import check_calibrated_size
from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats import read_calibration, rig_from_parameters
from geodiff_plugin.formats.exif import warn_of_other_lens
from geodiff_plugin.guidance.guidance import GeometryGuidance, assume_same_centre
from geodiff_plugin.types import Rig


@dataclass(frozen=True)
class CameraFields:
    """What the page asks about cameras; ``None`` is an empty field.

    Attributes:
        calibration: path of a calibration file.
        second_calibration: path of the right camera's file, for formats with one file a view.
        fx: focal length, pixels.
        fy: the same for y; empty means ``fx``.
        cx: principal point, pixels; empty means the middle of the image.
        cy: likewise.
        cx_right: the right image's cx; empty means that it is the left one's.
        baseline_m: distance of the cameras, metres.
        third_pose: the third camera's pose in the left camera's frame, 12 or 16 numbers in rows.
    """

    calibration: str | None = None
    second_calibration: str | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    cx_right: float | None = None
    baseline_m: float | None = None
    third_pose: str | None = None


@dataclass(frozen=True)
class Views:
    """The photographs, ``(H, W, 3)`` float32 in [0, 1], and their names.

    Attributes:
        left: the one that gets the depth.
        right: the second view.
        third: a further one, or ``None``.
        names: paths of the left and the right one.
        third_name: path of the third one, or ``None``.
    """

    left: np.ndarray
    right: np.ndarray
    third: np.ndarray | None
    names: tuple[str, str]
    third_name: str | None = None

    @property
    def size(self) -> tuple[int, int]:
        """``(width, height)`` of the left one."""
        return self.left.shape[1], self.left.shape[0]


@dataclass(frozen=True)
class CameraWay:
    """One choice of the page.

    Attributes:
        label: what the page calls it.
        fields: names of the ``CameraFields`` that it asks for.
        guide: ``(views, fields, knobs) -> GeometryGuidance``.
    """

    label: str
    fields: tuple[str, ...]
    guide: Callable[[Views, CameraFields, dict[str, Any]], GeometryGuidance]


def _third_pose(text: str | None) -> np.ndarray:
    words = (text or "").replace(",", " ").replace(";", " ").split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.empty(0)
    if numbers.size not in (12, 16):
        cure = "Write the 4x4 pose of the third camera in the left camera's frame, row by row, in metres."
        bad_value("the third camera's pose", "12 or 16 numbers", f"{len(words)} words", cure)
    rows = numbers.reshape(-1, 4)
    return rows if len(rows) == 4 else np.vstack([rows, [0, 0, 0, 1]])  # a last row is checked with the pose


def _guidance_of_rig(views: Views, rig: Rig, fields: CameraFields, knobs: dict[str, Any]) -> GeometryGuidance:
    cure = "Use the photographs that the calibration is for, or give the numbers scaled to these."
    for image, path, K, size, name in (
        (views.left, views.names[0], rig.K_left, rig.size_left, "the left photograph"),
        (views.right, views.names[1], rig.K_right, rig.size_right, "the right photograph"),
    ):
        check_calibrated_size(image.shape[1::-1], size, name, Path(rig.source).name, cure)
        warn_of_other_lens(path, K, name)
    posed = [(views.left, rig.K_left, np.eye(4)), (views.right, rig.K_right, rig.E)]
    if views.third is not None:
        posed.append((views.third, rig.K_left, _third_pose(fields.third_pose)))
    return GeometryGuidance.from_views(posed, **knobs)


def _from_file(views: Views, fields: CameraFields, knobs: dict[str, Any]) -> GeometryGuidance:
    if fields.calibration is None:
        bad_value(
            "calibration", "a calibration file", "none", "Choose one, or give focal length and baseline."
        )
    paths = [path for path in (fields.calibration, fields.second_calibration) if path is not None]
    # The page keeps what is dropped in a folder of its own, so only the names themselves say something.
    names = Path(views.names[0]).name, Path(views.names[1]).name
    rig = read_calibration(paths, image_names=names, image_size=views.size, baseline_m=fields.baseline_m)
    if rig.unit is None:  # lengths are what the page is for
        cure = "This file has no unit: measure how far the two cameras were from each other, in metres."
        bad_value("the distance of the cameras", "given", "nothing", cure)
    return _guidance_of_rig(views, rig, fields, knobs)


def _intrinsics(views: Views, fields: CameraFields) -> np.ndarray:
    """K of fx and whatever else was filled in; square pixels and the middle of the image where it was not."""
    (width, height), fx = views.size, fields.fx
    fy = fx if fields.fy is None else fields.fy
    cx = (width - 1) / 2 if fields.cx is None else fields.cx
    cy = (height - 1) / 2 if fields.cy is None else fields.cy
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _from_numbers(views: Views, fields: CameraFields, knobs: dict[str, Any]) -> GeometryGuidance:
    missing = [
        label for label, value in (("fx", fields.fx), ("baseline", fields.baseline_m)) if value is None
    ]
    if missing:
        bad_value(" and ".join(missing), "given", "nothing", "fx is in pixels, the baseline in metres.")
    K = _intrinsics(views, fields)
    rig = rig_from_parameters(K[0, 0], K[1, 1], K[0, 2], K[1, 2], fields.baseline_m, cx_right=fields.cx_right)
    guidance = _guidance_of_rig(views, rig, fields, knobs)
    if fields.cx_right is None:
        assume_same_centre(guidance)
    return guidance


def _from_photographs(views: Views, fields: CameraFields, knobs: dict[str, Any]) -> GeometryGuidance:
    if fields.baseline_m is None:
        cure = (
            "Photographs alone have no unit: measure how far the two cameras were from each other, in metres."
        )
        bad_value("the distance of the cameras", "given", "nothing", cure)
    K = None  # of the EXIF of the photographs
    if fields.fx is not None:
        K = _intrinsics(views, fields)
    if K is not None and fields.cx_right is not None:
        knobs = knobs | {"K_right": np.array([[K[0, 0], 0, fields.cx_right], K[1], K[2]])}
    names = views.names if views.third_name is None else (*views.names, views.third_name)
    photographs = [ImageOps.exif_transpose(Image.open(name)) for name in names]
    return GeometryGuidance.from_photographs(photographs, baseline_m=fields.baseline_m, K=K, **knobs)


NUMBERS = ("fx", "fy", "cx", "cy", "cx_right", "baseline_m")
#: Every way by name, in the order of the page.
CAMERA_WAYS: dict[str, CameraWay] = {
    "file": CameraWay(
        "Calibration file",
        ("calibration", "second_calibration", "baseline_m", "third_pose"),
        _from_file,
    ),
    "numbers": CameraWay("Focal length and baseline", (*NUMBERS, "third_pose"), _from_numbers),
    "photographs": CameraWay("Estimate from the photographs", NUMBERS, _from_photographs),
}
