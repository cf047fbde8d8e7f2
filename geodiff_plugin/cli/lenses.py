"""Lens distortion in ``geodiff depth``: the options, and undistorted images.

Data flow: ``--distortion``, ``--view-distortion``, the calibration -> one ``Distortion`` a photograph
    -> cleaned and undistorted images.
Paper: none; it takes pinhole cameras for granted.
"""

from __future__ import annotations

import numpy as np
import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.formats.distortion import distortion_from_text, undistorted
from geodiff_plugin.formats.rigs import is_distorted
from geodiff_plugin.guidance.posing import cleaned
from geodiff_plugin.types import Distortion, Rig

__all__ = ["Lenses", "lenses_of", "pinhole"]

Lenses = tuple[Distortion | None, ...]
"""One entry a photograph, or one a further view; ``None`` for a pinhole camera."""


def pinhole(
    image_01: np.ndarray, K: np.ndarray, lens: Distortion | None, config: GuidanceConfig
) -> np.ndarray:
    """The image as a pinhole camera would have taken it.

    Args:
        image_01: ``(H, W, 3)`` float32 in [0, 1].
        K: ``(3, 3)`` pixels.
        lens: what it was taken through; ``None`` for a lens without distortion.
        config: says whether photographs are cleaned. That comes first: once an image is resampled, the
            blocks of its compression are no longer found.

    Returns:
        The same shape; the array that was given where the lens has no distortion.
    """
    if lens is None:
        return image_01
    ready = cleaned(torch.from_numpy(image_01).permute(2, 0, 1), config)
    return undistorted(ready.permute(1, 2, 0).contiguous().numpy(), K, lens)


def lenses_of(arguments: DepthArguments, rig: Rig | None = None) -> Lenses:
    """Distortion of every photograph's lens, the left one first; ``None`` for a lens without distortion.

    Options take precedence over the calibration. A further view without ``--view-distortion`` has the left
    one's lens, as it has its K.

    Args:
        arguments: the options.
        rig: the calibration, with the lenses that it knows; ``None`` where there is none.

    Raises:
        ValueError: more than two lenses, malformed coefficients, lenses for rectified images, or a further
            view with a K of its own and a lens that is not given.
    """
    typed = [distortion_from_text(text) for text in arguments.distortion]
    if len(typed) > 2:
        bad_value("--distortion", "given once for both lenses, or twice", f"{len(typed)} times")
    if rig is not None and rig.rectified and any(is_distorted(lens) for lens in typed):
        bad_value(
            "--distortion",
            f"left out where the calibration is of rectified images ({rig.source})",
            " and ".join(arguments.distortion),
            "Drop it and give the rectified images. If its numbers are of the raw cameras, give them as "
            "--fx --fy --cx --cy --baseline (parallel cameras with one K), or as --K, --K-right and --E.",
        )
    own = (None, None) if rig is None else rig.distortion
    found = (typed[0], typed[-1]) if typed else own
    further: list[Distortion | None] = [
        distortion_from_text(text, "--view-distortion") for text in arguments.view_distortion
    ]
    if not further:
        if arguments.view_k and any(is_distorted(lens) for lens in found):
            cure = "A view with a K of its own has a lens of its own: 0,0,0,0 says that it is straight."
            bad_value("--view-distortion", "given for each --view", "none", cure)
        further = [found[0]] * len(arguments.view)
    return tuple(lens if is_distorted(lens) else None for lens in (*found, *further))
