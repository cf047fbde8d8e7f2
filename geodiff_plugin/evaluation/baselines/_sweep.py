"""The plane sweep that two methods share.

Data flow: ``StereoSample`` -> ``CostVolume``; inverse depth on its grid
    -> depth at the left image's resolution.
Paper: none.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.matching import CostVolume, build_cost_volume

__all__ = ["native_depth", "sweep"]


def sweep(sample: StereoSample, device: str, views: int = 2) -> CostVolume:
    """Sweep planes from infinity to the package's default nearest one through the left view.

    Args:
        sample: any pose.
        device: where the work is done.
        views: the most views to compare, the left one counted.

    Returns:
        The volume, on a grid of at most 828 pixels a side.
    """

    def moved(x: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(x, dtype=torch.float32, device=device)

    given = ((sample.right, sample.K_right, sample.E), *sample.extra_views)[: views - 1]
    rights = [
        (as_image_01(image, "right").to(device), moved(K), moved(np.linalg.inv(E))) for image, K, E in given
    ]
    return build_cost_volume(as_image_01(sample.left, "left").to(device), rights, moved(sample.K_left))


def native_depth(
    inverse_depth: torch.Tensor, volume: CostVolume, size: tuple[int, int], mode: str
) -> np.ndarray:
    """Depth at the left image's resolution.

    Args:
        inverse_depth: ``(H, W)`` 1/m on the volume's grid, NaN in holes.
        volume: its planes; nothing is farther than half a step from infinity.
        size: ``(H, W)`` of the left image.
        mode: ``"nearest-exact"`` keeps holes as they are; ``"bilinear"`` for maps without.

    Returns:
        ``(H, W)`` float64, metres, NaN in holes.
    """
    farthest = 0.5 * float(volume.plane_step)
    options = {} if mode == "nearest-exact" else {"align_corners": False}
    full = F.interpolate(inverse_depth[None, None], size, mode=mode, **options)[0, 0]
    return 1.0 / np.maximum(full.cpu().numpy().astype(np.float64), farthest)
