"""Compute statistics of the matches and the depth of one image, which several checks use.

On CUDA two kernels compute all statistics (``kernels.match_statistics``).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin._internal.statistics import MAX_SORTED
from geodiff_plugin.geometry import constant_like
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.matches import RELIABLE
from geodiff_plugin.trust.constants import RANGE_QUANTILES


def where_known(values: Tensor, known: Tensor) -> Tensor:
    """Replace values outside a mask by NaN. Indexing by the mask would synchronise with the device."""
    return torch.where(known, values, torch.nan)


def match_statistics(matches: Matches, depth_m: Tensor) -> dict[str, Tensor]:
    """Compute tensors ``()`` on the device of ``depth_m (1, 1, H, W)``.

    Returns:
        ``matched``: fraction of the grid with a confident match. ``in_front``: number of confident matches
        with positive disparity. ``log_range``: log ratio of the ``RANGE_QUANTILES`` of the matched depths.
        ``range_planes``: difference of these quantiles in planes of the sweep. ``median_m``: median matched
        depth. ``log_deviation``: median absolute log ratio of the depth to the matched depths.
        ``compared``: number of matches used for ``log_deviation``.
    """
    return _of_grid(matches, F.interpolate(depth_m.float(), matches.size, mode="nearest-exact")[0])


def _stride(depth_m: Tensor) -> int:
    """Return the stride of the pixels that are sorted."""
    return max(1, depth_m.numel() // MAX_SORTED)


@has_kernel("trust.kernels.match_statistics.of_grid", when=lambda matches, depth_m: _stride(depth_m) == 1)
def _of_grid(matches: Matches, depth_m: Tensor) -> dict[str, Tensor]:
    """Compute ``match_statistics`` for ``depth_m (1, H, W)`` on the grid of the matches."""
    confident = matches.confidence > RELIABLE
    step = matches.plane_step
    in_front = confident & (matches.inverse_depth > 0)
    sample = where_known(matches.inverse_depth, in_front).flatten()[:: _stride(depth_m)]
    low, high = torch.nanquantile(sample, constant_like(sample, *RANGE_QUANTILES)).unbind()
    compared = confident & (matches.inverse_depth > step)
    deviation = where_known((depth_m * matches.inverse_depth).log().abs(), compared)
    return {
        "matched": confident.float().mean(),
        "in_front": in_front.sum(),
        "log_range": (high / low.clamp_min(1e-9)).log(),
        "range_planes": (high - low) / step,
        "median_m": 1.0 / sample.nanmedian(),
        "log_deviation": deviation.flatten().nanmedian(),
        "compared": compared.sum(),
    }
