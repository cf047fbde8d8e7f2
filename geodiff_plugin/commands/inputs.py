"""Opens and checks what ``geodiff depth`` was given, before any weights load.

Hop: ``DepthArguments`` -> two images, a ``Rig`` and the ``GeometryGuidance`` made of them.
Paper: S3.3 (two views with known cameras).
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import (
    bad_value,
    check_baseline,
    check_calibrated_size,
    check_intrinsics,
    check_intrinsics_fit,
    check_number,
    check_pose,
)
from geodiff_plugin.commands.arguments import DepthArguments, Settings, check_positive
from geodiff_plugin.formats import read_calibration, read_image, read_matrix, read_points, rig_from_parameters
from geodiff_plugin.guidance import GeometryGuidance
from geodiff_plugin.types import Rig

__all__ = ["Inputs", "read_inputs", "read_rig"]

CALIBRATION_WAYS = "--calib FILE, or --fx --fy --cx --cy --baseline, or --K FILE --E FILE"
MOST_PIXELS = 1e6
PARAMETERS = ("fx", "fy", "cx", "cy", "baseline")


@dataclass(frozen=True)
class Inputs:
    """Two views, ready to be guided by.

    Attributes:
        left: ``(H, W, 3)`` float32 in [0, 1], EXIF orientation applied.
        right: likewise, of its own size.
        rig: cameras of both, in pixels of these images.
        guidance: the right view, and those beside it, with the settings of the preset.
    """

    left: np.ndarray
    right: np.ndarray
    rig: Rig
    guidance: GeometryGuidance


def _size(image: np.ndarray) -> tuple[int, int]:
    """``(width, height)``."""
    return image.shape[1], image.shape[0]


def _read_view(path: Path, name: str) -> np.ndarray:
    image, notes = read_image(path, name)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return image


def _check_one_calibration(arguments: DepthArguments) -> str:
    """Which of the three ways was taken: ``"file"``, ``"parameters"`` or ``"matrices"``."""
    ways = {
        "file": bool(arguments.calib),
        "parameters": any(getattr(arguments, name) is not None for name in PARAMETERS),
        "matrices": any(path is not None for path in (arguments.k, arguments.e, arguments.k_right)),
    }
    taken = [way for way, is_taken in ways.items() if is_taken]
    if not taken:
        bad_value(
            "calibration", f"given: {CALIBRATION_WAYS}", "none", "Without cameras two images carry no metres."
        )
    if len(taken) > 1:
        bad_value(
            "calibration", f"given in one way: {CALIBRATION_WAYS}", " and ".join(taken), "Drop the others."
        )
    if arguments.cameras is not None and taken != ["file"]:
        bad_value(
            "--cameras", "given with --calib only", "no --calib", "It chooses among the cameras of a file."
        )
    return taken[0]


def _rig_from_options(arguments: DepthArguments, size: tuple[int, int]) -> Rig:
    values = {name: getattr(arguments, name) for name in PARAMETERS}
    missing = [f"--{name}" for name, value in values.items() if value is None]
    if missing:
        centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
        bad_value(
            " ".join(missing),
            "given as well, with "
            + " ".join(f"--{name}" for name in PARAMETERS if f"--{name}" not in missing),
            "nothing",
            f"--fy is --fx where pixels are square; --cx, --cy are near the centre, here {centre[0]:g} and "
            f"{centre[1]:g}; --baseline is the distance of the cameras in metres.",
        )
    check_positive(values["fx"], "--fx", "pixels")
    check_positive(values["fy"], "--fy", "pixels")
    check_number(values["cx"], "--cx", -MOST_PIXELS, MOST_PIXELS)
    check_number(values["cy"], "--cy", -MOST_PIXELS, MOST_PIXELS)
    cure = "Two views from one place carry no scale; if the right camera is the left one, swap the images."
    check_positive(values["baseline"], "--baseline", "metres", cure)
    return rig_from_parameters(*values.values())


def _rig_from_matrices(arguments: DepthArguments) -> Rig:
    for option, path in (("--K", arguments.k), ("--E", arguments.e)):
        if path is None:
            bad_value(option, "given as well", "nothing", "--K and --E go together; --K-right is optional.")
    K = check_intrinsics(read_matrix(arguments.k, "--K"), "--K")
    K_right = K
    if arguments.k_right is not None:
        K_right = check_intrinsics(read_matrix(arguments.k_right, "--K-right"), "--K-right")
    return Rig(K, K_right, check_pose(read_matrix(arguments.e, "--E"), "--E"), source=str(arguments.k))


def read_rig(
    arguments: DepthArguments,
    cameras: tuple[int, int] | None,
    left_size: tuple[int, int],
    right_size: tuple[int, int],
) -> Rig:
    """The cameras, from whichever of the three ways was taken, for images of these sizes.

    Args:
        arguments: the options.
        cameras: numbers of the left and the right camera of the calibration, or ``None``.
        left_size: ``(width, height)`` of the left image.
        right_size: ``(width, height)`` of the right image.

    Raises:
        OSError, TypeError, ValueError: no calibration or more than one, a file that is none, K for images
            of another size.
    """
    way = _check_one_calibration(arguments)
    if way == "file":
        rig = read_calibration(arguments.calib, cameras, str(arguments.left))
    else:
        rig = (
            _rig_from_options(arguments, left_size) if way == "parameters" else _rig_from_matrices(arguments)
        )
    views = (
        ("left", rig.K_left, rig.size_left, left_size, arguments.left),
        ("right", rig.K_right, rig.size_right, right_size, arguments.right),
    )
    for side, K, calibrated_size, size, path in views:
        cure = "Use the images that it is for, or scale K with them and give --fx --fy --cx --cy."
        check_calibrated_size(size, calibrated_size, f"the {side} image {path}", rig.source, cure)
        check_intrinsics_fit(K, *size, f"K of the {side} camera ({rig.source})", f"the {side} image {path}")
    return replace(rig, size_left=left_size, size_right=right_size)


def _read_further_views(
    arguments: DepthArguments, K_left: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Image, K and pose of every ``--view``, checked under its own name."""
    images, poses, matrices = arguments.view, arguments.view_e, arguments.view_k
    for option, files, counts in (
        ("--view-E", poses, {len(images)}),
        ("--view-K", matrices, {0, len(images)}),
    ):
        if len(files) not in counts:
            bad_value(option, f"given once for each of {len(images)} --view", f"{len(files)} times")
    views = []
    for i, path in enumerate(images):
        option = f"--view {path}"
        image, K = _read_view(path, option), K_left
        if matrices:
            K = check_intrinsics(read_matrix(matrices[i], "--view-K"), f"--view-K {matrices[i]}")
        check_intrinsics_fit(K, *_size(image), f"K of {option}", "its image")
        E = check_pose(read_matrix(poses[i], "--view-E"), f"--view-E {poses[i]}")
        check_baseline(E, f"--view-E {poses[i]}")
        views.append((image, K, E))
    return views


def _make_guidance(
    arguments: DepthArguments, settings: Settings, right: np.ndarray, rig: Rig
) -> GeometryGuidance:
    if arguments.preset == "paper":
        bounds = {} if settings.depth_range is None else {"g_s_range": settings.depth_range}
        return GeometryGuidance.paper(right, (rig.K_left, rig.K_right), rig.E, **bounds | settings.knobs)
    views = [(None, rig.K_left, np.eye(4)), (right, rig.K_right, rig.E)]
    views += _read_further_views(arguments, rig.K_left)
    points = None if arguments.points is None else read_points(arguments.points, "--points")
    bounds = {"depth_range": settings.depth_range}
    return GeometryGuidance.from_views(views, points=points, **bounds | settings.knobs)


def read_inputs(arguments: DepthArguments, settings: Settings) -> Inputs:
    """Read both images and the calibration, and see that they fit each other.

    Raises:
        OSError, TypeError, ValueError: naming the option or the file.
    """
    left, right = _read_view(arguments.left, "LEFT"), _read_view(arguments.right, "RIGHT")
    photographs = {"LEFT": arguments.left, "RIGHT": arguments.right}
    photographs |= {f"--view {number}": path for number, path in enumerate(arguments.view, 1)}
    for (one, a), (other, b) in itertools.combinations(photographs.items(), 2):
        if a.exists() and b.exists() and a.samefile(b):
            bad_value(other, f"another photograph than {one}", f"{b} for both")
    rig = read_rig(arguments, settings.cameras, _size(left), _size(right))
    return Inputs(left, right, rig, _make_guidance(arguments, settings, right, rig))
