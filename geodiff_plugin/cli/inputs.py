"""Reads and checks the input files of ``geodiff depth``, before any weights load.

Data flow: ``DepthArguments`` -> images, a ``Rig`` and the ``GeometryGuidance`` made of them.
Paper: S3.3 (two views with known cameras).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geodiff_plugin._camera_checks import (
    check_baseline,
    check_calibrated_size,
    check_intrinsics,
    check_intrinsics_fit,
    check_pose,
)
from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.checks import check_positive
from geodiff_plugin.cli.lenses import Lenses, lenses_of, pinhole
from geodiff_plugin.cli.settings import Settings
from geodiff_plugin.cli.start import PARAMETERS, calibration_way
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.formats import read_calibration, read_image, read_matrix, read_points, rig_from_parameters
from geodiff_plugin.formats.distortion import undistorted_points
from geodiff_plugin.formats.exif import warn_of_other_lens
from geodiff_plugin.formats.rigs import intrinsics
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.types import Distortion, Rig

__all__ = ["Inputs", "read_inputs", "read_known", "read_rig"]

MOST_PIXELS = 1e6


@dataclass(frozen=True)
class Inputs:
    """The views, ready to be guided by.

    Attributes:
        left: ``(H, W, 3)`` float32 in [0, 1], EXIF orientation applied.
        rig: cameras of both, in pixels of these images; the left one's twice where there is no right one.
        guidance: the right view, and those beside it, with the settings of the preset.
        undistorted: whether lens distortion was taken out of the images.
    """

    left: np.ndarray
    rig: Rig
    guidance: GeometryGuidance
    undistorted: bool = False


def _size(image: np.ndarray) -> tuple[int, int]:
    """``(width, height)``."""
    return image.shape[1], image.shape[0]


def _read_view(path: Path, name: str) -> np.ndarray:
    image, notes = read_image(path, name)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return image


def _rig_from_options(arguments: DepthArguments, size: tuple[int, int], alone: bool) -> Rig:
    names = PARAMETERS[:-1] if alone else PARAMETERS
    values = {name: getattr(arguments, name) for name in names}
    missing = [f"--{name}" for name, value in values.items() if value is None]
    if missing:
        centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
        bad_value(
            " ".join(missing),
            "given as well, with " + " ".join(f"--{name}" for name in names if f"--{name}" not in missing),
            "nothing",
            f"--fy is --fx where pixels are square; --cx, --cy are near the centre, here {centre[0]:g} and "
            f"{centre[1]:g}; --baseline is the distance of the cameras in metres.",
        )
    check_positive(values["fx"], "--fx", "pixels")
    check_positive(values["fy"], "--fy", "pixels")
    check_number(values["cx"], "--cx", -MOST_PIXELS, MOST_PIXELS)
    check_number(values["cy"], "--cy", -MOST_PIXELS, MOST_PIXELS)
    if alone:
        K = intrinsics(*values.values())
        return Rig(K, K, np.eye(4))
    cure = (
        "Two views from one place do not tell the scale; "
        "if the right camera is the left one, swap the images."
    )
    check_positive(values["baseline"], "--baseline", "metres", cure)
    return rig_from_parameters(*values.values())


def _rig_from_matrices(arguments: DepthArguments, alone: bool) -> Rig:
    for option, path in (("--K", arguments.k), ("--E", arguments.e)):
        if path is None and not (alone and option == "--E"):
            bad_value(option, "given as well", "nothing", "--K and --E go together; --K-right is optional.")
    K = check_intrinsics(read_matrix(arguments.k, "--K"), "--K")
    if alone:
        return Rig(K, K, np.eye(4), source=str(arguments.k))
    K_right = K
    if arguments.k_right is not None:
        K_right = check_intrinsics(read_matrix(arguments.k_right, "--K-right"), "--K-right")
    E = check_pose(read_matrix(arguments.e, "--E"), "--E")
    return Rig(K, K_right, E, source=str(arguments.k), measured=False)


def read_rig(
    arguments: DepthArguments,
    cameras: tuple[int, int] | None,
    left_size: tuple[int, int],
    right_size: tuple[int, int] | None,
) -> Rig:
    """The cameras, from whichever of the three ways was taken, for images of these sizes.

    Args:
        arguments: the options.
        cameras: numbers of the left and the right camera of the calibration, or ``None``.
        left_size: ``(width, height)`` of the left image.
        right_size: ``(width, height)`` of the right image; ``None`` without one.

    Raises:
        OSError, TypeError, ValueError: no calibration or more than one, a file that is none, K for images
            of another size.
    """
    way = calibration_way(arguments)
    if way == "file":
        rig = read_calibration(
            arguments.calib,
            cameras,
            str(arguments.left),
            image_names=None if arguments.right is None else (str(arguments.left), str(arguments.right)),
            image_size=left_size,
            baseline_m=arguments.baseline,
            distorted=True,
        )
    else:
        alone = right_size is None  # not by RIGHT: a frame of two images side by side has none
        rig = (
            _rig_from_options(arguments, left_size, alone)
            if way == "parameters"
            else _rig_from_matrices(arguments, alone)
        )
    views = (
        ("left", rig.K_left, rig.size_left, left_size, arguments.left),
        ("right", rig.K_right, rig.size_right, right_size, arguments.right),
    )
    for side, K, calibrated_size, size, path in views:
        if size is None:
            continue
        cure = "Use the images that it is for, or scale K with them and give --fx --fy --cx --cy."
        check_calibrated_size(size, calibrated_size, f"the {side} image {path}", rig.source, cure)
        if not arguments.cropped:
            named = f"K of the {side} camera ({rig.source})", f"the {side} image {path}"
            check_intrinsics_fit(K, *size, *named)
    return replace(rig, size_left=left_size, size_right=right_size)


def _read_further_views(
    arguments: DepthArguments, K_left: np.ndarray, lenses: Lenses, config: GuidanceConfig
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Image without lens distortion, K and pose of every ``--view``, checked under its own name."""
    images, poses, matrices = arguments.view, arguments.view_e, arguments.view_k
    views = []
    for i, path in enumerate(images):
        option = f"--view {path}"
        image, K = _read_view(path, option), K_left
        if matrices:
            K = check_intrinsics(read_matrix(matrices[i], "--view-K"), f"--view-K {matrices[i]}")
        if not arguments.cropped:
            check_intrinsics_fit(K, *_size(image), f"K of {option}", "its image")
        E = check_pose(read_matrix(poses[i], "--view-E"), f"--view-E {poses[i]}")
        check_baseline(E, f"--view-E {poses[i]}")
        views.append((pinhole(image, K, lenses[i], config), K, E))
    return views


def read_known(
    arguments: DepthArguments, K: np.ndarray, lens: Distortion | None, size: tuple[int, int]
) -> np.ndarray | None:
    """The depths of ``--points`` as the left image without lens distortion has them; ``None`` for none.

    Points in the camera's frame stay as they are. The pixels of a map are those of the image as it was
    taken, so behind a lens with distortion its depths become points.

    Args:
        arguments: the options.
        K: ``(3, 3)`` pixels of the left image.
        lens: that it was taken through; ``None`` for a lens without distortion.
        size: ``(width, height)`` of the left image.

    Returns:
        ``(H, W)`` float32 metres, 0 where unknown, or ``(N, 3)`` float32 metres.

    Raises:
        OSError, ValueError: as ``read_points``; a map of another size than the image behind a lens.
    """
    if arguments.points is None:
        return None
    scale, calibration = arguments.points_scale, arguments.points_calib
    known = read_points(arguments.points, "--points", scale=scale, calibration=calibration)
    if lens is None or known.shape[1] == 3:
        return known
    if _size(known) != size:
        expected, got = ("{}x{}".format(*of) for of in (size, _size(known)))
        cure = "A map belongs to the image as it was taken, pixel by pixel; else give points (N, 3)."
        bad_value("--points", f"a map of the left image's {expected} pixels", got, cure)
    return undistorted_points(known, K, lens)


def _make_guidance(
    arguments: DepthArguments,
    settings: Settings,
    views: tuple[np.ndarray, np.ndarray | None],
    rig: Rig,
    lenses: Lenses,
) -> GeometryGuidance:
    (left, right), config, cropped = views, settings.config, arguments.cropped
    points = read_known(arguments, rig.K_left, lenses[0], _size(left))
    if right is None:
        return GeometryGuidance(None, rig.K_left, points=points, cropped=cropped, config=config)
    further = _read_further_views(arguments, rig.K_left, lenses[2:], config)
    posed = [(None, rig.K_left, np.eye(4)), (right, rig.K_right, rig.E), *further]
    lengths = {"unit": rig.unit, "measured_baseline": rig.measured}
    return GeometryGuidance.from_views(posed, points=points, cropped=cropped, **lengths, config=config)


def _compare_with_exif(arguments: DepthArguments, rig: Rig) -> None:
    """Warn of a K that the photographs' own EXIF contradicts."""
    warn_of_other_lens(arguments.left, rig.K_left, "LEFT")
    if arguments.right is not None:
        warn_of_other_lens(arguments.right, rig.K_right, "RIGHT")


def read_inputs(
    arguments: DepthArguments,
    settings: Settings,
    views: tuple[np.ndarray, np.ndarray] | None = None,
    rig_of: Callable[..., Rig] = read_rig,
) -> Inputs:
    """Read the images and the calibration, and see that they fit each other.

    Args:
        arguments: the options.
        settings: what was understood of them.
        views: left and right image, ``(H, W, 3)`` float32 in [0, 1], where they are no files of their own.
        rig_of: ``read_rig``, or what remembers its answer.

    Raises:
        OSError, TypeError, ValueError: naming the option or the file.
    """
    right: np.ndarray | None = None
    if views is not None:
        left, right = views
    else:
        left = _read_view(arguments.left, "LEFT")
        right = None if arguments.right is None else _read_view(arguments.right, "RIGHT")
    rig = rig_of(arguments, settings.cameras, _size(left), None if right is None else _size(right))
    if views is None:
        _compare_with_exif(arguments, rig)
    lenses = lenses_of(arguments, rig)
    left = pinhole(left, rig.K_left, lenses[0], settings.config)
    if right is not None:
        right = pinhole(right, rig.K_right, lenses[1], settings.config)
    guidance = _make_guidance(arguments, settings, (left, right), rig, lenses)
    return Inputs(left, rig, guidance, any(lens is not None for lens in lenses))
