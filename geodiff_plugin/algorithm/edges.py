"""Steep depth edges: pixels on the ramp between two surfaces get the depth of one of them.

An autoencoder blurs an edge over a pixel or two, and enlarging a map widens it. Weighted median after Ma et
al., Constant Time Weighted Median Filtering for Stereo Matching and Beyond, ICCV 2013.
"""

from __future__ import annotations

from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel
from geodiff_plugin._strips import row_strips
from geodiff_plugin.geometry import image_size
from geodiff_plugin.scale.points import weighted_quantile

#: Samples of a window to each side of its centre.
HALF = 2
#: Standard deviation of the Gaussian weight of a neighbour, samples: the rim of the window still counts.
REACH = 1.5
#: Distance from a ramp to the surfaces beside it, in pixels of the prior's grid.
BESIDE = 3
#: The least relative step in inverse depth from a pixel on a ramp to each of two opposite neighbours.
STEP = 0.02
#: How many times steeper than the surfaces on both sides a ramp must be.
STEEPER = 2.0
#: The slope in log depth at which a neighbour of a ramp counts half.
SLOPE = 0.04
#: Difference in brightness at which a neighbour's weight falls to a third, at ramps.
RAMP_BRIGHTNESS = 0.12
#: Two opposite neighbours: across, down, and both diagonals.
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
#: Pixels whose windows are worked on at once: more do not fit into a CPU's cache.
STRIP = 1 << 13


@torch.no_grad()
def sharpen_edges(depth_m: Tensor, left_01: Tensor, spacing: int = 1) -> Tensor:
    """Give every pixel on the ramp between two surfaces the depth of one of them; leave others bit for bit.

    A pixel is on a ramp if its inverse depth lies between those of two opposite neighbours, with a step to
    each, and the ramp is steeper than the surfaces at its ends. A plane, however oblique, has the same slope
    everywhere in inverse depth, so it is no ramp. The new depth is a median over a window; neighbours on
    the ramp, of another colour or far away count for less. ``depth_m (B, 1, H, W)`` and ``left_01`` lie on
    one grid; ``spacing`` is its pixels per pixel of the grid that the map was decoded on.
    """
    if use_kernel(depth_m):
        from geodiff_plugin.algorithm import edge_kernels

        return edge_kernels.sharpened(depth_m, left_01, spacing)
    height, width = image_size(depth_m)
    halo = (BESIDE + 1) * spacing
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
    """Some rows of a map ``(h, w)`` and its image, with a halo of ``BESIDE + 1`` spacings on every side."""

    def __init__(self, depth_m: Tensor, image_01: Tensor, spacing: int) -> None:
        self.depth_m, self.image, self.spacing = depth_m, image_01, spacing
        self.inverse = 1.0 / depth_m
        self.halo = (BESIDE + 1) * spacing

    def _along(self, direction: tuple[int, int], steps: int) -> Tensor:
        """``(h, w)`` inverse depth of the pixel so many spacings away from every pixel in a direction."""
        height, width = (side - 2 * self.halo for side in self.inverse.shape)
        top, first = (self.halo + self.spacing * steps * way for way in direction)
        return self.inverse[top : top + height, first : first + width]

    def on_ramp(self) -> Tensor:
        """``(h, w)`` bool: pixels whose depth lies between that of two surfaces."""
        centre = self._along((0, 0), 0)
        on_ramp = torch.zeros_like(centre, dtype=torch.bool)
        for way in DIRECTIONS:
            ahead, behind = self._along(way, 1) - centre, centre - self._along(way, -1)
            stepped = torch.minimum(ahead.abs(), behind.abs()) > STEP * centre
            ends = [(self._along(way, k + 1) - self._along(way, k - 1)).abs() for k in (-BESIDE, BESIDE)]
            steep = (ahead + behind).abs() > STEEPER * torch.maximum(*ends)
            on_ramp |= (ahead * behind > 0) & stepped & steep
        return on_ramp

    def median(self, v: Tensor, u: Tensor) -> Tensor:
        """``(n,)`` metres, the weighted median in the windows of the pixels ``(v, u)``, ``(n,)`` each."""
        width = self.depth_m.shape[1]
        steps = torch.arange(-HALF, HALF + 1, device=v.device)
        down, right = (each.flatten() for each in torch.meshgrid(steps, steps, indexing="ij"))
        centre = (v + self.halo) * width + u + self.halo
        window = centre[:, None] + self.spacing * (down * width + right)  # (n, samples), into flat maps
        image = self.image.flatten(1)
        unlike = (image[:, window] - image[:, centre, None]).abs().mean(0) / RAMP_BRIGHTNESS
        away = (down**2 + right**2).float() / (2.0 * REACH**2)
        flat = 1.0 / (1.0 + (self._slope.flatten()[window] / SLOPE) ** 2)
        return weighted_quantile(self.depth_m.flatten()[window], flat * torch.exp(-unlike - away), 0.5)

    @cached_property
    def _slope(self) -> Tensor:
        """Change of log depth over one spacing, with the halo; 0 along its rim, where none is read."""
        s = self.spacing
        across = self.inverse[s:-s, 2 * s :] - self.inverse[s:-s, : -2 * s]
        down = self.inverse[2 * s :, s:-s] - self.inverse[: -2 * s, s:-s]
        return F.pad(torch.hypot(across, down) / 2.0 * self.depth_m[s:-s, s:-s], (s,) * 4)
