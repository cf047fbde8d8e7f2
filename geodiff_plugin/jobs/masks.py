"""Reads the valid pixels of a pair: mask files, alpha channels and the empty borders of undistortion."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from geodiff_plugin.cameras import Camera
from geodiff_plugin.evidence.valid import (
    both,
    outside_borders,
    read_mask,
    undistorted_mask,
    without_overlays,
)
from geodiff_plugin.formats import Packing, is_as_stored, read_alpha
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.pose.overlays import reduced, static_pixels

#: Approximate number of samples of a video in which overlays are sought, from its first ``SPAN`` frames.
SAMPLES, SPAN = 16, 240


def read_masks(
    options: DepthOptions,
    images: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    *,
    from_files: bool,
    packing: Packing | None = None,
    overlays: np.ndarray | None = None,
) -> list[torch.Tensor | None]:
    """Read the valid pixels ``(H, W)`` bool of each view as stored, left one first; ``None`` for all.

    ``images (H, W, 3)`` are the raw ones, ``overlays (h, w)`` bool their static pixels. ``packing`` is how
    one image holds both views. Constant borders are detected here only if a lens bends them, or next to
    overlays.
    """
    flags = (("--mask", options.mask), ("--right-mask", options.right_mask))
    files = [*flags, *(("", None) for _ in images)]
    alphas = _alphas(options, packing) if from_files else []
    masks = []
    for i, image in enumerate(images):
        flag, path = files[i]
        valid = None if path is None else read_mask(path, flag, (image.shape[0], image.shape[1]))
        masks.append(both(valid, alphas[i] if i < len(alphas) else None))
    if overlays is not None or any(camera.lens is not None for camera in cameras):
        masks = outside_borders([torch.from_numpy(image).permute(2, 0, 1) for image in images], masks)
    if overlays is None:
        return masks
    sizes = [(image.shape[0], image.shape[1]) for image in images]
    return [without_overlays(mask, overlays, size) for mask, size in zip(masks, sizes, strict=True)]


def undistorted_masks(
    masks: Sequence[torch.Tensor | None], images: Sequence[np.ndarray], cameras: Sequence[Camera]
) -> list[np.ndarray | None]:
    """Return the valid pixels ``(H, W)`` bool of each view after undistortion; ``None`` for all."""
    found = list[np.ndarray | None]()
    for mask, image, camera in zip(masks, images, cameras, strict=True):
        valid = undistorted_mask(mask, camera, (image.shape[0], image.shape[1]))
        found.append(None if valid is None else valid.numpy())
    return found


def find_overlays(read: Callable[[int], Sequence[np.ndarray] | None]) -> np.ndarray | None:
    """Find ``static_pixels`` of a video of a rig.

    ``read`` returns both views of a frame by number, ``(H, W, 3)`` in [0, 1]; ``None`` after the last, and
    an empty sequence for a damaged frame.
    """
    samples = list[list[np.ndarray]]()
    step = 1
    for frame in range(SPAN):
        if frame % step:
            continue
        if (views := read(frame)) is None:
            break
        if not views:
            continue
        samples.append([reduced(np.rint(view.mean(-1) * 255).astype(np.uint8)) for view in views])
        if len(samples) == 2 * SAMPLES:
            samples = samples[::2]
            step = 2 * step
    return static_pixels([left for left, _ in samples], [right for _, right in samples])


def _alphas(options: DepthOptions, packing: Packing | None) -> list[torch.Tensor | None]:
    """Read the pixels ``(H, W)`` bool with an alpha above 0 of each view; ``None`` for all.

    A file with an image for each view has no alpha channel.
    """
    as_stored = bool(options.calib) and is_as_stored(options.calib)
    views = list[np.ndarray | None]()
    files = list(options.image_files().items())
    if options.both_in_one:
        of_both = None if packing is None else read_alpha(options.left, "LEFT", as_stored=as_stored)
        views += (None, None) if of_both is None or packing is None else packing.split(of_both, "LEFT")
    views += [read_alpha(path, name, as_stored=as_stored) for name, path in files[len(views) :]]
    return [None if alpha is None or alpha.all() else torch.from_numpy(alpha) for alpha in views]
