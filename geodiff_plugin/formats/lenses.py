"""Cameras as calibrations describe them: intrinsics, lens and resolution of each.

Data flow: ``FactoryCamera`` of both sides and their pose -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import is_distorted, make_rig
from geodiff_plugin.types import Distortion, Rig

__all__ = ["COUNTS", "NO_MODEL", "FactoryCamera", "lens_of", "rig_of_cameras", "scaled_to"]

#: How many coefficients OpenCV's functions take.
COUNTS = {"opencv": (4, 5, 8, 12, 14), "fisheye": (4,)}
ORDERS = {
    "opencv": "k1, k2, p1, p2, k3, ... of OpenCV's model",
    "fisheye": "k1 to k4 of OpenCV's fisheye model",
}
#: Cure for a lens of a model that OpenCV cannot undistort.
NO_MODEL = "OpenCV does not have this model: undistort or rectify both images first."

#: Images of one sensor differ in their ratio of sides by rounding only; beyond this one of them was cropped.
RATIO_TOLERANCE = 0.01


@dataclass(frozen=True)
class FactoryCamera:
    """One camera of a factory's calibration.

    Attributes:
        K: ``(3, 3)`` pixels.
        size: ``(width, height)`` that ``K`` is for, or ``None``.
        lens: its distortion; ``None`` for none.
    """

    K: np.ndarray
    size: tuple[int, int] | None = None
    lens: Distortion | None = None


def lens_of(coefficients: np.ndarray, name: str, model: str = "opencv") -> Distortion | None:
    """The lens of a file's coefficients in OpenCV's order; ``None`` where they move no pixel.

    Args:
        coefficients: as many as OpenCV has.
        name: for the message.
        model: ``"opencv"`` or ``"fisheye"``.

    Raises:
        ValueError: another count, or NaN or infinity among them.
    """
    numbers = np.asarray(coefficients, np.float64).ravel()
    lens = Distortion(model, numbers)
    finite = bool(np.isfinite(numbers).all())
    if finite and not is_distorted(lens):
        return None
    if not finite or numbers.size not in COUNTS[model]:
        *fewer, most = map(str, COUNTS[model])
        counts = f"{', '.join(fewer)} or {most}" if fewer else most
        got = f"{numbers.size}: {np.array2string(numbers, precision=4, separator=', ')}"
        bad_value(name, f"{counts} finite coefficients ({ORDERS[model]})", got, "Check the calibration file.")
    return lens


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


def rig_of_cameras(
    left: FactoryCamera, right: FactoryCamera, E: np.ndarray, source: str, *, rectified: bool = False
) -> Rig:
    """The rig of two cameras and their lenses.

    Args:
        left: the left camera.
        right: the right camera.
        E: ``(4, 4)`` metres, pose of the right camera in the left camera's frame.
        source: the file, for messages.
        rectified: whether their images are rectified.

    Raises:
        ValueError: a matrix that is none.
    """
    return make_rig(
        left.K,
        right.K,
        E,
        source,
        size=left.size,
        size_right=right.size,
        distortion=(left.lens, right.lens),
        rectified=rectified,
    )
