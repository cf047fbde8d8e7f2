"""``geodiff depth --estimate-pose``: photographs without known cameras.

Data flow: ``DepthArguments`` -> images, K from options or EXIF -> estimated poses -> ``Inputs``.
Paper: none; it takes known cameras for granted (S3.3).
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from geodiff_plugin._camera_checks import check_intrinsics
from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.checks import check_positive
from geodiff_plugin.cli.inputs import Inputs, read_known
from geodiff_plugin.cli.lenses import lenses_of, pinhole
from geodiff_plugin.cli.messages import say
from geodiff_plugin.cli.settings import Settings
from geodiff_plugin.cli.start import intrinsics_way
from geodiff_plugin.formats import read_image, read_matrix
from geodiff_plugin.formats.distortion import undistorted_pixels
from geodiff_plugin.formats.exif import intrinsics_from_exif, intrinsics_from_fov
from geodiff_plugin.formats.rigs import intrinsics
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.types import Distortion

__all__ = ["known_length", "read_photographs"]


def known_length(text: str | None) -> tuple[float, float, float, float, float] | None:
    """``X1,Y1,X2,Y2,METRES`` as typed.

    Raises:
        ValueError: not five numbers.
    """
    if text is None:
        return None
    try:
        x1, y1, x2, y2, metres = (float(part) for part in text.split(","))
    except ValueError:  # not numbers, or not five of them
        cure = "Two pixels of LEFT and the distance of the two places, such as 100,200,400,210,1.5."
        bad_value("--known-length", "X1,Y1,X2,Y2,METRES", repr(text), cure)
    return x1, y1, x2, y2, metres


def _intrinsics(arguments: DepthArguments, path: Path, i: int, size: tuple[int, int]) -> np.ndarray:
    """K of photograph ``i``, 0 being the left one, from the options, else from its EXIF."""
    way = intrinsics_way(arguments)
    if i > 1 and arguments.view_k:
        path = arguments.view_k[i - 2]
        return check_intrinsics(read_matrix(path, "--view-K"), f"--view-K {path}")
    if way == "matrices":
        option, own = "--K", arguments.k
        if i > 0 and arguments.k_right is not None:
            option, own = "--K-right", arguments.k_right
        assert own is not None
        return check_intrinsics(read_matrix(own, option), option)
    if way == "parameters":
        return intrinsics(*(getattr(arguments, name) for name in ("fx", "fy", "cx", "cy")))
    if arguments.fov is not None:
        return intrinsics_from_fov(arguments.fov, size)
    K, notes = intrinsics_from_exif(path, path.name)
    for note in notes:
        say(note)
    return K


def _straight_length(
    typed: tuple[float, float, float, float, float] | None, K: np.ndarray, lens: Distortion | None
) -> tuple[float, float, float, float, float] | None:
    """A known length of LEFT as it was taken, its ends where the image without lens distortion has them."""
    if typed is None or lens is None:
        return typed
    *ends, metres = typed
    straight = undistorted_pixels(np.reshape(ends, (2, 2)), K, lens)
    if not np.isfinite(straight).all():
        got = f"{ends}, of which the lens model has no ray"
        cure = "Choose ends nearer to the middle of LEFT, or check --distortion."
        bad_value("--known-length", "between two pixels that the lens shows", got, cure)
    (x1, y1), (x2, y2) = straight.tolist()
    return x1, y1, x2, y2, metres


def read_photographs(arguments: DepthArguments, settings: Settings) -> Inputs:
    """Read the photographs and estimate their cameras.

    Raises:
        OSError, TypeError, ValueError: naming the option, the file or the package that is missing, or why
            there is no pose to be had.
    """
    if arguments.baseline is not None:
        check_positive(arguments.baseline, "--baseline", "metres")
    images, Ks, lenses = [], [], lenses_of(arguments)
    paths = [path for path in (arguments.left, arguments.right, *arguments.view) if path is not None]
    for i, path in enumerate(paths):
        image, notes = read_image(path, ("LEFT", "RIGHT")[i] if i < 2 else f"--view {path}")
        for note in notes:
            warnings.warn(note, stacklevel=2)
        Ks.append(_intrinsics(arguments, path, i, (image.shape[1], image.shape[0])))
        images.append(pinhole(image, Ks[-1], lenses[i], settings.config))
    sizes = [(image.shape[1], image.shape[0]) for image in images[:2]]
    guidance = GeometryGuidance.from_photographs(
        images,
        K=Ks,
        baseline_m=arguments.baseline,
        known_length=_straight_length(known_length(arguments.known_length), Ks[0], lenses[0]),
        points=read_known(arguments, Ks[0], lenses[0], sizes[0]),
        matcher=arguments.matcher or "sift",
        cropped=arguments.cropped,
        config=settings.config,
    )
    rig = replace(guidance.rigs[0], size_left=sizes[0], size_right=sizes[1], source="estimated")
    return Inputs(images[0], rig, guidance, any(lens is not None for lens in lenses))
