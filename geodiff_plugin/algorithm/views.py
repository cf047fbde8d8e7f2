"""The views of a chunk of samples, stacked: here batches begin."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.geometry import resize_image
from geodiff_plugin.types import CameraView, PosedViews


def chunk_views(evidence: Sequence[Evidence]) -> PosedViews:
    """The views of every sample of a chunk on the grid of the evidence, images and K of one size.

    An image with fewer views than another repeats its first one: the terms take the best view of each pixel,
    so repetition changes nothing.
    """
    grids = [image.grid for image in evidence]
    further = []
    for v in range(max(len(grid.views) for grid in grids)):
        views = [grid.views[v if v < len(grid.views) else 0] for grid in grids]
        height, width = (max(view.image_01.shape[axis] for view in views) for axis in (-2, -1))
        sized = [CameraView(*resize_image(image, K, (height, width)), T) for image, K, T in views]
        further.append(CameraView(*map(torch.stack, zip(*sized, strict=True))))
    left, K_left = torch.stack([grid.left_01 for grid in grids]), torch.stack([grid.K_left for grid in grids])
    return PosedViews(left, tuple(further), K_left)
