"""Sharpens depth edges: pixels on the ramp between two surfaces get the depth of one of them.

An autoencoder blurs an edge over one or two pixels, and upsampling a map widens the ramp. Weighted median
after Ma et al., Constant Time Weighted Median Filtering for Stereo Matching and Beyond, ICCV 2013.
"""

from __future__ import annotations

from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin._internal.strips import row_strips
from geodiff_plugin.algorithm.constants import (
    HALF_WINDOW,
    MIN_STEEPNESS,
    MIN_STEP,
    RAMP_BRIGHTNESS,
    SLOPE,
    SURFACE_DISTANCE,
    WINDOW_SIGMA,
)
from geodiff_plugin.geometry import image_size
from geodiff_plugin.scale.points import weighted_quantile

#: Directions to two opposite neighbours: horizontal, vertical and both diagonals.
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
#: Number of windows processed at once, limited by the CPU cache.
STRIP = 1 << 13


@torch.no_grad()
@has_kernel("algorithm.kernels.edges.sharpen_edges")
def sharpen_edges(depth_m: Tensor, left_01: Tensor, spacing: int = 1) -> Tensor:
    """Give every pixel on the ramp between two surfaces the depth of one; other pixels are unchanged.

    A pixel is on a ramp if its inverse depth is between the values at two opposite neighbours, with a step to
    each, and if the ramp is steeper than the surfaces at its ends. A plane at any angle has constant slope in
    inverse depth, so it has no ramps. The new depth is a median over a window in which neighbours that are on
    the ramp, differ in colour or are distant have a lower weight. ``depth_m (B, 1, H, W)`` and ``left_01``
    are on one grid; ``spacing`` is the number of its pixels per pixel of the grid that the map was decoded
    on.
    """
    height, width = image_size(depth_m)
    halo = (SURFACE_DISTANCE + 1) * spacing
    out = depth_m.clone()
    for index in range(len(depth_m)):
        for rows in row_strips(height, width):
            part = slice(max(0, rows.start - halo), min(height, rows.stop + halo))
            missing = halo, halo, halo - rows.start + part.start, halo - part.stop + rows.stop
            depth, image = (
                F.pad(whole[index : index + 1, :, part].float(), missing, mode="replicate")[0]
                for whole in (depth_m, left_01)
            )
            strip = _Strip(depth[0], image, spacing)
            v, u = strip.on_ramp().nonzero(as_tuple=True)
            target = out[index, 0, rows]
            for at in zip(v.split(STRIP), u.split(STRIP), strict=True):
                target[at] = strip.median(*at).to(target)
    return out


class _Strip:
    """Rows of a map ``(h, w)`` and its image, with a halo of ``SURFACE_DISTANCE + 1`` spacings."""

    def __init__(self, depth_m: Tensor, image_01: Tensor, spacing: int) -> None:
        self.depth_m, self.image, self.spacing = depth_m, image_01, spacing
        self.inverse = 1.0 / depth_m
        self.halo = (SURFACE_DISTANCE + 1) * spacing

    def _along(self, direction: tuple[int, int], steps: int) -> Tensor:
        """Return the inverse depth ``(h, w)`` of pixels that are ``steps`` spacings away in a direction."""
        height, width = (side - 2 * self.halo for side in self.inverse.shape)
        top, first = (self.halo + self.spacing * steps * way for way in direction)
        return self.inverse[top : top + height, first : first + width]

    def on_ramp(self) -> Tensor:
        """Return a bool mask ``(h, w)`` of the pixels whose depth is between two surfaces."""
        centre = self._along((0, 0), 0)
        on_ramp = torch.zeros_like(centre, dtype=torch.bool)
        for way in DIRECTIONS:
            ahead = self._along(way, 1) - centre
            behind = centre - self._along(way, -1)
            discontinuity = torch.minimum(ahead.abs(), behind.abs()) > MIN_STEP * centre
            ends = [
                (self._along(way, k + 1) - self._along(way, k - 1)).abs()
                for k in (-SURFACE_DISTANCE, SURFACE_DISTANCE)
            ]
            steep = (ahead + behind).abs() > MIN_STEEPNESS * torch.maximum(*ends)
            on_ramp |= (ahead * behind > 0) & discontinuity & steep
        return on_ramp

    def median(self, v: Tensor, u: Tensor) -> Tensor:
        """Return the weighted median ``(n,)``, metres, in the windows of pixels ``(v, u)``, ``(n,)`` each."""
        width = self.depth_m.shape[1]
        steps = torch.arange(-HALF_WINDOW, HALF_WINDOW + 1, device=v.device)
        down, right = (each.flatten() for each in torch.meshgrid(steps, steps, indexing="ij"))
        centre = (v + self.halo) * width + u + self.halo
        window = centre[:, None] + self.spacing * (down * width + right)  # (n, samples), into flat maps
        image = self.image.flatten(1)
        unlike = (image[:, window] - image[:, centre, None]).abs().mean(0) / RAMP_BRIGHTNESS
        away = (down**2 + right**2).float() / (2.0 * WINDOW_SIGMA**2)
        flat = 1.0 / (1.0 + (self._slope.flatten()[window] / SLOPE) ** 2)
        return weighted_quantile(self.depth_m.flatten()[window], flat * torch.exp(-unlike - away), 0.5)

    @cached_property
    def _slope(self) -> Tensor:
        """Change of log depth over one spacing, with the halo; 0 along its border, which is not read."""
        s = self.spacing
        across = self.inverse[s:-s, 2 * s :] - self.inverse[s:-s, : -2 * s]
        down = self.inverse[2 * s :, s:-s] - self.inverse[: -2 * s, s:-s]
        return F.pad(torch.hypot(across, down) / 2.0 * self.depth_m[s:-s, s:-s], (s,) * 4)
