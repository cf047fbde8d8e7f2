"""Factory calibrations: intrinsics, distortion and resolution of each camera.

Data flow: ``FactoryCamera`` of both sides and their pose -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import check_no_distortion, make_rig
from geodiff_plugin.types import Rig

__all__ = ["FactoryCamera", "rig_of_cameras", "scaled_to"]

#: Images of one sensor differ in their ratio of sides by rounding only; beyond this one of them was cropped.
RATIO_TOLERANCE = 0.01


@dataclass(frozen=True)
class FactoryCamera:
    """One camera of a factory's calibration.

    Attributes:
        K: ``(3, 3)`` pixels.
        distortion: coefficients of the lens in the order of the file; zeros where it was taken out.
        size: ``(width, height)`` that ``K`` is for, or ``None``.
    """

    K: np.ndarray
    distortion: np.ndarray
    size: tuple[int, int] | None = None


def scaled_to(camera: FactoryCamera, size: tuple[int, int] | None, name: str) -> FactoryCamera:
    """The same camera at another resolution of the whole sensor.

    Args:
        camera: as in the file.
        size: ``(width, height)`` of the image in use, or ``None`` to leave it.
        name: for the message.

    Raises:
        ValueError: another ratio of width and height, so that the image is a crop of the sensor.
    """
    if size is None or camera.size is None or size == camera.size:
        return camera
    s_x, s_y = size[0] / camera.size[0], size[1] / camera.size[1]
    if abs(s_x / s_y - 1) > RATIO_TOLERANCE:
        bad_value(
            "the left image",
            "of the shape of {}x{} pixels, as {} says".format(*camera.size, name),
            "{}x{}".format(*size),
            "It is a crop of the sensor: give --fx --fy --cx --cy --baseline of the cropped image.",
        )
    S = np.array([[s_x, 0, 0.5 * s_x - 0.5], [0, s_y, 0.5 * s_y - 0.5], [0, 0, 1]])
    return replace(camera, K=S @ camera.K, size=size)


def rig_of_cameras(left: FactoryCamera, right: FactoryCamera, E: np.ndarray, source: str) -> Rig:
    """The rig of two cameras whose images are those of a pinhole.

    Args:
        left: the left camera.
        right: the right camera.
        E: ``(4, 4)`` metres, pose of the right camera in the left camera's frame.
        source: the file, for messages.

    Raises:
        ValueError: lens distortion that is not zero, or a matrix that is none.
    """
    for side, camera in (("left", left), ("right", right)):
        check_no_distortion(camera.distortion, f"Lens distortion of the {side} camera in {source}")
    return make_rig(left.K, right.K, E, source, size=left.size, size_right=right.size)
