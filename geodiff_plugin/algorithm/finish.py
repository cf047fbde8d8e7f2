"""The last stage: depth edges of the result follow the prior, the matches and the image's colours.

Beyond the paper, whose result is the decoded latent. Ramps between two surfaces are made steep, the map is
fitted to its matches (``correction.refine_depth``), and then the neighbours of every pixel vote on its depth.
Weighted medians after Ma et al., Constant Time Weighted Median Filtering for Stereo Matching and Beyond, ICCV
2013; large pictures after Kopf et al., Joint Bilateral Upsampling, SIGGRAPH 2007.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.evidence import as_fine_as
from geodiff_plugin.formats.depth import row_strips
from geodiff_plugin.geometry import plane_rays
from geodiff_plugin.geometry.cameras import image_size, resize_intrinsics
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.census import MARGIN_PX, census, census_cost, grey, grey_levels
from geodiff_plugin.matching.sweep import UNSEEN_LEVEL
from geodiff_plugin.scale.points import weighted_quantile
from geodiff_plugin.types import CameraView

__all__ = ["sharpen_edges", "vote_depth", "weighted_median"]

#: Samples of a window to each side of its centre, for both medians and for the mean.
HALF = 2
#: Difference in brightness at which a neighbour's weight falls to a third; a Gaussian over the window, in
#: samples, does the rest.
BRIGHTNESS, REACH = 0.1, 1.5
#: Where the surfaces beside a ramp are looked for, in pixels of the prior's grid; the least relative step in
#: inverse depth from a pixel on a ramp to each of two opposite neighbours; how many times steeper than the
#: surfaces on both sides it must be there; the slope in log depth at which a neighbour counts half.
BESIDE, STEP, STEEPER, SLOPE = 3, 0.02, 2.0, 0.04
#: Difference in brightness at which a neighbour's weight falls to a third, at ramps.
RAMP_BRIGHTNESS = 0.12
#: Two opposite neighbours: across, down, and both diagonals.
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
#: Pixels on ramps whose windows are in memory at once; pixels of a strip whose votes stay in a CPU's cache.
CHUNK, STRIP = 1 << 16, 1 << 13
#: Pixels of the grid of the votes at most: a larger picture takes its depth from there, by its colours.
MOST_PIXELS = 600_000
#: Distance between the samples of the median, and of the mean, in pixels of the grid of the matches. Side of
#: the window there whose mean confidence a match's vote is multiplied with, so that a speckle has none.
MEDIAN_STEP, MEAN_STEP, REGION = 3.0, 2.0, 9
#: Vote of the map itself, as a share of a window full of sure matches, for a prior whose measured error is
#: ``WEAK`` or more. It grows as the cube of a smaller one: a good prior knows where edges are.
MAP_VOTE, WEAK = 0.03, 0.2
#: A match counts for a quarter where it differs from the map by this many errors of the prior; a larger error
#: than the second number counts as that.
DIFFERS, MOST_ERROR = 1.5, 0.1
#: Votes within about this many planes of the median make the mean.
NEAR_PLANES = 3.0
#: Window in which the shifts of -1, 0 and 1 pixel are compared, and what a shift must gain, in cost levels.
WINDOW, LEAST_GAIN = 9, 2.0


@torch.no_grad()
def sharpen_edges(depth_m: Tensor, left_01: Tensor, spacing: int = 1) -> Tensor:
    """Give every pixel on the ramp between two surfaces the depth of one of them.

    A pixel is on a ramp if its inverse depth lies between those of two opposite neighbours, with a step to
    each, and the ramp is steeper than the surfaces at its ends. A plane, however oblique, has the same slope
    everywhere in inverse depth, and is none. The new depth is the median over a window. Neighbours that are
    on the ramp themselves, look different or are far away count for less in it.

    Args:
        depth_m: ``(B, 1, H, W)`` metres, > 0.
        left_01: ``(B, 3, H, W)`` in [0, 1], the left images on the same grid.
        spacing: pixels of this grid to one of the grid that the map was decoded on, >= 1.

    Returns:
        ``(B, 1, H, W)`` metres: on a ramp the depth of a pixel in the window, elsewhere what was given, bit
        for bit.
    """
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
            for at in zip(v.split(CHUNK), u.split(CHUNK), strict=True):
                target[at] = strip.median(*at).to(target)
    return out


class _Strip:
    """Some rows of a map and its image, with a halo of ``BESIDE + 1`` spacings on every side.

    Args:
        depth_m: ``(h + 2 halo, w + 2 halo)`` metres.
        image_01: ``(3, h + 2 halo, w + 2 halo)``.
        spacing: as ``sharpen_edges``.
    """

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
        """``(h, w)`` whether a pixel hangs between two surfaces."""
        centre = self._along((0, 0), 0)
        found = torch.zeros_like(centre, dtype=torch.bool)
        for way in DIRECTIONS:
            ahead, behind = self._along(way, 1) - centre, centre - self._along(way, -1)
            stepped = torch.minimum(ahead.abs(), behind.abs()) > STEP * centre
            ends = [(self._along(way, k + 1) - self._along(way, k - 1)).abs() for k in (-BESIDE, BESIDE)]
            steep = (ahead + behind).abs() > STEEPER * torch.maximum(*ends)
            found |= (ahead * behind > 0) & stepped & steep
        return found

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


@torch.no_grad()
def vote_depth(
    depth_m: Tensor,
    left_01: Tensor,
    target: Matches,
    error: Tensor,
    views: Sequence[CameraView] = (),
    K_left: Tensor | None = None,
) -> Tensor:
    """Give every pixel the depth that its matches, its neighbours of the same colour, and the map vote for.

    A local search in the photographs at this resolution first places each match to a fraction of a pixel.
    The weighted median of the votes then chooses a surface; matches that stand alone, look different or
    contradict a good prior hardly count. The mean of the votes near the median is the depth.

    Args:
        depth_m: ``(1, 1, H, W)`` metres, > 0, fitted to the matches.
        left_01: ``(1, 3, H, W)`` in [0, 1], the left image on the same grid.
        target: matches of one image on the grid of the sweep, ``(1, 1, h, w)``.
        error: ``(1, 1, 1, 1)`` of the prior in log depth, as ``correction.prior_error`` measures it.
        views: the further views; without any, matches stay where the sweep put them.
        K_left: ``(3, 3)`` pixels of ``left_01``; needed with ``views``.

    Returns:
        ``(1, 1, H, W)`` metres, within the range of ``depth_m``.
    """
    full = image_size(depth_m)
    share = min(1.0, math.sqrt(MOST_PIXELS / (full[0] * full[1])))
    size = max(1, round(full[0] * share)), max(1, round(full[1] * share))
    small = depth_m.float(), left_01.float()
    if size != full:
        small = (
            F.interpolate(small[0], size, mode="nearest-exact"),  # a mean across an edge is neither surface's
            F.interpolate(small[1], size, mode="bilinear", antialias=True),
        )
    log_map, left = -small[0][0, 0].log(), small[1][0]
    matches, weight = _ballots(log_map, left, target, error, views, K_left, full)
    strength = (WEAK / error.flatten()[0]).clamp_min(1.0) ** 3
    spacing = max(size) / max(image_size(target.confidence))
    noise = target.plane_step.flatten()[0] * NEAR_PLANES
    chosen = _median(
        matches, weight, left, log_map, MAP_VOTE * strength, max(1, round(MEDIAN_STEP * spacing))
    )
    step = max(1, round(MEAN_STEP * spacing))
    voted = _mean(matches, weight, left, log_map, MAP_VOTE * strength, step, chosen, noise)
    if size != full:
        voted = _enlarged(voted, left, left_01[0], noise)
    out = (-voted).exp()[None, None].clamp(depth_m.amin(), depth_m.amax())
    return out.to(depth_m.dtype)


def _ballots(
    log_map: Tensor,
    left: Tensor,
    target: Matches,
    error: Tensor,
    views: Sequence[CameraView],
    K_left: Tensor | None,
    full: tuple[int, int],
) -> tuple[Tensor, Tensor]:
    """Log inverse depth of the matches and the weight of their votes, ``(H, W)`` on the grid of the votes."""
    size, error = image_size(log_map[None]), error.flatten()[0].clamp_min(1e-3)
    confidence = target.confidence.float().clamp(0.0, 1.0)  # that of a known point is a count
    around = F.avg_pool2d(confidence, REGION, 1, REGION // 2, count_include_pad=False)
    confidence = confidence * around ** (2.0 * (WEAK / error).clamp_max(1.0))
    inverse_depth, confidence = (
        F.interpolate(values, size, mode="nearest-exact")[0, 0]
        for values in (target.inverse_depth.float(), confidence)
    )
    inverse_depth = inverse_depth.clamp_min(1e-9)
    if views and K_left is not None:
        inverse_depth = _placed(inverse_depth, left, views, resize_intrinsics(K_left[None], full, size)[0])
    noise = (target.plane_step.flatten()[0] / inverse_depth).clamp_max(1.0)
    matches = inverse_depth.log().clamp(log_map.amin(), log_map.amax())
    apart = (matches - log_map) ** 2 / (DIFFERS**2 * (error.clamp_max(MOST_ERROR) ** 2 + noise**2))
    return matches, confidence / (1.0 + apart) ** 2


def _placed(inverse_depth: Tensor, left: Tensor, views: Sequence[CameraView], K_left: Tensor) -> Tensor:
    """Matches moved by up to a pixel of the grid to where the views agree best, ``(H, W)`` 1/m.

    Every pixel of a window is shifted from its own depth: a window may lie on a slope or across an edge.
    """
    size, margin = image_size(left), (MARGIN_PX,) * 4
    own = census(grey_levels(F.pad(grey(left)[None], margin, mode="replicate")[0, 0]))
    room = torch.empty_like(own)
    costs = inverse_depth.new_zeros(3, *size)
    counts = inverse_depth.new_zeros(3, *size)
    step: Tensor | None = None
    for view in views:
        image, K = as_fine_as(grey(view.image_01), view.K.float(), K_left)
        rays = plane_rays(K_left[None].float(), K[None], view.T_right_from_left[None].float(), size)
        A, b = rays.A[0], rays.b[0]
        if step is None:  # the inverse depth that moves the median pixel by one of the right image's
            moved = torch.hypot(b[0] - A[0] / A[2] * b[2], b[1] - A[1] / A[2] * b[2])
            step = 1.0 / moved.median().clamp_min(1e-9)
        last = image.new_tensor([image.shape[-1] - 1.0, image.shape[-2] - 1.0])
        for k in range(3):
            p = A + (inverse_depth + (k - 1) * step).flatten() * b
            uv = (p[:2] / p[2].clamp_min(1e-9)).T
            seen = ((p[2] > 0) & (uv >= 0).all(1) & (uv <= last).all(1)).view(size)
            at = (uv * (2.0 / last.clamp_min(1.0)) - 1.0).view(1, *size, 2)
            warped = F.grid_sample(image[None], at, padding_mode="border", align_corners=True)
            other = census(grey_levels(F.pad(warped, margin, mode="replicate")[0, 0]), out=room)
            costs[k] += census_cost(other, own, out=other) * seen
            counts[k] += seen
    assert step is not None
    costs = torch.where(counts > 0, costs / counts.clamp_min(1.0), float(UNSEEN_LEVEL))
    for window in ((WINDOW, 1), (1, WINDOW)):
        padding = window[0] // 2, window[1] // 2
        costs = F.avg_pool2d(costs[None], window, 1, padding, count_include_pad=False)[0]
    near, middle, far = costs[0] + LEAST_GAIN, costs[1], costs[2] + LEAST_GAIN
    offset = (0.5 * (near - far) / (near + far - 2.0 * middle).clamp_min(1e-3)).clamp(-0.5, 0.5)
    beyond = torch.where(near < far, -torch.ones_like(near), torch.ones_like(near))
    offset = torch.where(torch.minimum(near, far) < middle, beyond, offset)
    return (inverse_depth + offset * step).clamp_min(1e-9)


def weighted_median(values: Tensor, weight: Tensor, rounds: int = 7) -> Tensor:
    """Weighted median over the first axis, to within ``2**-rounds`` of the values' range, by bisection.

    Args:
        values: ``(n, ...)``.
        weight: ``(n, ...)``, >= 0.
        rounds: halvings of the range.

    Returns:
        ``(...)``; where no value has weight, about the least.
    """
    low, high, half = values.amin(0), values.amax(0), weight.sum(0) / 2.0
    room = torch.empty_like(weight)
    for _ in range(rounds):
        middle = 0.5 * (low + high)
        torch.le(values, middle, out=room)  # in place: ten times as fast as a choice of two
        reached = room.mul_(weight).sum(0) >= half
        high, low = torch.where(reached, middle, high), torch.where(reached, low, middle)
    return 0.5 * (low + high)


def _windows(
    matches: Tensor, weight: Tensor, left: Tensor, step: int
) -> Iterator[tuple[slice, Tensor, Tensor, float]]:
    """Rows, the votes in the windows of their pixels, the weights of these, and those of a whole window.

    ``(n, h, W)`` each, strip by strip, with samples ``step`` pixels apart.
    """
    height, width = matches.shape
    halo = HALF * step
    padded = [
        F.pad(values[None], (halo,) * 4, mode="replicate")[0]
        for values in (matches[None], weight[None], left)
    ]
    steps = range(-HALF, HALF + 1)
    at = [(halo + step * down, halo + step * right) for down in steps for right in steps]
    close = [math.exp(-(down**2 + right**2) / (2.0 * REACH**2)) for down in steps for right in steps]
    closeness = matches.new_tensor(close)[:, None, None]
    count = max(1, STRIP // width)
    for first in range(0, height, count):
        rows = slice(first, min(height, first + count))
        votes, weights, colours = (
            torch.stack([values[:, rows.start + v : rows.stop + v, u : u + width] for v, u in at])
            for values in padded
        )
        unlike = (colours - left[:, rows]).abs().mean(1) / BRIGHTNESS
        yield rows, votes[:, 0], weights[:, 0] * closeness * torch.exp(-unlike), sum(close)


def _median(
    matches: Tensor, weight: Tensor, left: Tensor, log_map: Tensor, map_vote: Tensor, step: int
) -> Tensor:
    """``(H, W)`` the weighted median of the votes in a window and that of the map."""
    out = torch.empty_like(log_map)
    for rows, votes, weights, whole in _windows(matches, weight, left, step):
        own = (map_vote * whole).expand_as(log_map[rows])
        out[rows] = weighted_median(torch.cat([votes, log_map[rows][None]]), torch.cat([weights, own[None]]))
    return out


def _mean(
    matches: Tensor,
    weight: Tensor,
    left: Tensor,
    log_map: Tensor,
    map_vote: Tensor,
    step: int,
    centre: Tensor,
    noise: Tensor,
) -> Tensor:
    """``(H, W)`` the mean of the votes that lie near ``centre``, within about ``noise``, 1/m."""
    out = torch.empty_like(log_map)
    for rows, votes, weights, whole in _windows(matches, weight, left, step):
        at = centre[rows]
        votes = torch.cat([votes, log_map[rows][None]]) - at
        weights = torch.cat([weights, (map_vote * whole).expand_as(at)[None]])
        weights = weights / (1.0 + (votes * at.exp() / noise) ** 2) ** 2
        out[rows] = at + (weights * votes).sum(0) / weights.sum(0).clamp_min(1e-9)
    return out


def _enlarged(voted: Tensor, left: Tensor, whole: Tensor, noise: Tensor) -> Tensor:
    """``(H, W)`` votes at the size of ``whole (3, H, W)``, from the nine around that look like the pixel."""
    (height, width), (rows, columns) = image_size(whole), image_size(left)
    out = voted.new_empty(height, width)
    x = (torch.arange(width, device=voted.device, dtype=voted.dtype) + 0.5) * (columns / width) - 0.5
    count = max(1, STRIP // width)
    for first in range(0, height, count):
        part = slice(first, min(height, first + count))
        y = torch.arange(part.start, part.stop, device=voted.device, dtype=voted.dtype) + 0.5
        y = y * (rows / height) - 0.5
        votes, weights = [], []
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                v, u = y.round() + down, x.round() + right
                row, column = v.long().clamp(0, rows - 1)[:, None], u.long().clamp(0, columns - 1)
                unlike = (left[:, row, column] - whole[:, part].float()).abs().mean(0) / BRIGHTNESS
                away = (v - y)[:, None] ** 2 + (u - x) ** 2
                votes.append(voted[row, column])
                weights.append(torch.exp(-unlike - 2.0 * away))
        values, weight = torch.stack(votes), torch.stack(weights)
        at = weighted_median(values, weight)
        weight = weight / (1.0 + ((values - at) * at.exp() / noise) ** 2) ** 2
        out[part] = at + (weight * (values - at)).sum(0) / weight.sum(0).clamp_min(1e-9)
    return out
