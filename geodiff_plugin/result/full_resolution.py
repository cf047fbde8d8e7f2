"""The last stage: place the depth edges of the result by prior, matches and colours of the image.

Beyond the paper, whose result is the decoded latent. Ramps between two surfaces are made steep, the map is
fitted to its matches (``correction.fit_depth``), and the matches around every pixel vote on its depth.
Weighted medians after Ma et al., Constant Time Weighted Median Filtering for Stereo Matching and Beyond, ICCV
2013; large pictures after Kopf et al., Joint Bilateral Upsampling, SIGGRAPH 2007.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.correction import highest
from geodiff_plugin.formats.depth import row_strips
from geodiff_plugin.geometry import image_size, is_rectified, resize_intrinsics
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.rows import match_rows
from geodiff_plugin.scale.points import weighted_quantile
from geodiff_plugin.types import CameraView

#: Samples of a window to each side of its centre.
HALF = 2
#: Difference in brightness at which a neighbour's weight falls to a third; deviation of a Gaussian, samples.
BRIGHTNESS, REACH = 0.1, 1.5
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
#: Upper bound on the pixels of the voting grid; larger pictures upsample its depth, guided by colour.
MOST_PIXELS = 600_000
#: Offsets of the voters in samples (every second one of the window); pixels between samples.
WINDOW = [(v, u) for v in range(-HALF, HALF + 1) for u in range(-HALF, HALF + 1) if (v + u) % 2 == 0]
SPACING = 4
#: Weight of a row match, and of a gap filled from the farther surface, relative to a sure sweep match.
ROWS, FILLED = 1.5, 0.5
#: Vote of the map itself, as a share of a window full of sure matches, for a prior whose measured error is
#: ``WEAK_PRIOR`` or more. It grows as the cube of a smaller one: a good prior knows where edges are.
MAP_VOTE, WEAK_PRIOR = 0.03, 0.2
#: A match that differs from the map by this many errors of the prior counts for a quarter; the error used
#: here is at most the second number.
DIFFERS, ERROR_OF_VOTES = 2.0, 0.1
#: Reach in which a step is looked for, and that beyond which it must not go on as a slope, pixels; the least
#: step in log depth, and how much larger it may be within the wider reach.
NEARBY, WIDE, EDGE, RISE = 4, 12, 0.1, 2.2
#: Pixels that a crisp step takes, the share of the step within them, and the least share that is told apart;
#: power with which a soft map raises the error of its prior at edges, and up to which error.
STEP_PX, CRISP, LEAST_CRISP, SOFT, MOST_SOFT = 2, 0.8, 0.1, 4.0, 0.14
#: Votes within about this many pixels of the median make the mean.
NEAR_PX = 1.0
#: Side of the last median filter, pixels of the voting grid.
MEDIAN = 5


@torch.no_grad()
def sharpen_edges(depth_m: Tensor, left_01: Tensor, spacing: int = 1) -> Tensor:
    """Give every pixel on the ramp between two surfaces the depth of one of them; leave others bit for bit.

    A pixel is on a ramp if its inverse depth lies between those of two opposite neighbours, with a step to
    each, and the ramp is steeper than the surfaces at its ends. A plane, however oblique, has the same slope
    everywhere in inverse depth, so it is no ramp. The new depth is a median over a window; neighbours on
    the ramp, of another colour or far away count for less. ``depth_m (B, 1, H, W)`` and ``left_01`` lie on
    one grid; ``spacing`` is its pixels per pixel of the grid that the map was decoded on.
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


@torch.no_grad()
def vote_depth(
    depth_m: Tensor,
    left_01: Tensor,
    K_left: Tensor,
    views: Sequence[CameraView],
    target: Matches,
    error: Tensor,
    spacing: float = 1.0,
) -> Tensor:
    """Give every pixel the depth voted by the map and by the matches around it that have its colour.

    The weighted median of the votes chooses a surface; the mean of those near it is the depth. Rows of a
    rectified view are matched again at this resolution, for edges that the sweep's grid cannot resolve;
    without one of the left image's size the map is returned unchanged. ``depth_m (1, 1, H, W)`` is fitted to
    the matches; left image, K and views are native; the prior's ``error (1, 1, 1, 1)``, and its ``spacing``
    as in ``sharpen_edges``, decide how much contradicting matches, and the map itself, count. The result
    stays within the range of ``depth_m``.
    """
    native = image_size(left_01)
    rectified = [v for v in views if is_rectified(K_left, v.K, v.T_right_from_left)]
    view = next((v for v in rectified if image_size(v.image_01) == native), None)
    if view is None:
        return depth_m
    full = image_size(depth_m)
    share = min(1.0, math.sqrt(MOST_PIXELS / (full[0] * full[1])))
    size = max(1, round(full[0] * share)), max(1, round(full[1] * share))
    left, right = (_resized(image.float(), size) for image in (left_01, view.image_01[None]))
    K, K_right = (resize_intrinsics(each[None].float(), native, size)[0] for each in (K_left, view.K))
    # Nearest: a mean across an edge is the depth of neither surface.
    small_m, inverse_depth, confidence = (
        F.interpolate(each.float(), size, mode="nearest-exact")[0, 0]
        for each in (depth_m, target.inverse_depth, target.confidence)
    )
    px = (K[0, 0] * view.T_right_from_left[0, 3]).abs()  # shift of a depth of 1 m
    shift = px / small_m
    nearest = torch.maximum(inverse_depth.amax(), 1.0 / small_m.amin()) * px
    of_rows, matched, filled = match_rows(
        left[0], CameraView(right[0], K_right, view.T_right_from_left), K, float(nearest)
    )
    error = error.flatten()[0].clamp_min(1e-3)
    crispness = _crispness(small_m) / max(1.0, share * spacing / STEP_PX)  # a coarse grid places no edge well
    error = torch.maximum(error, (error / crispness**SOFT).clamp_max(MOST_SOFT))
    # The confidence of a known point is a count.
    votes = (
        _weigh_votes(of_rows, ROWS * matched + FILLED * filled, shift, error),
        _weigh_votes(px * inverse_depth, confidence.clamp(0.0, 1.0), shift, error),
    )
    map_vote = MAP_VOTE * (WEAK_PRIOR / error).clamp_min(1.0) ** 3
    voted = _vote_in_windows(votes, left[0], shift, map_vote)
    # The median smooths ragged borders; a map that outvotes its matches has none, and known points stay.
    smooth = torch.from_numpy(cv2.medianBlur(np.ascontiguousarray(voted.cpu().numpy()), MEDIAN))
    voted = torch.where((map_vote < 1.0) & (confidence <= 1.0), smooth.to(voted.device), voted)
    if size != full:
        voted = _enlarged(voted, left[0], _resized(left_01.float(), full)[0])
    out_m = (px / voted.clamp_min(1e-6))[None, None].clamp(depth_m.amin(), depth_m.amax())
    return out_m.to(depth_m.dtype)


def _resized(image_01: Tensor, size: tuple[int, int]) -> Tensor:
    if image_size(image_01) == size:
        return image_01
    return F.interpolate(image_01, size, mode="bilinear", antialias=True)


def _crispness(depth_m: Tensor) -> Tensor:
    """``()`` in (0, 1]: the share of a step in a map ``(H, W)`` that ``STEP_PX`` pixels take; 1 is crisp.

    The median over edges: pixels inside with a step nearby that is not the slope of a wide surface.
    """
    log_depth = depth_m.clamp_min(1e-9).log()[None, None]
    across, down = ((log_depth - log_depth.roll(STEP_PX, axis)).abs() for axis in (-1, -2))
    near, wide = (highest(log_depth, reach) + highest(-log_depth, reach) for reach in (NEARBY, WIDE))
    at_edge = (near > EDGE) & (wide < RISE * near)
    step = highest(torch.maximum(across, down), NEARBY)
    share = torch.where(at_edge, step / near, torch.nan)[..., WIDE:-WIDE, WIDE:-WIDE]
    return (share.flatten().nanmedian().nan_to_num(1.0) / CRISP).clamp(LEAST_CRISP, 1.0)


def _weigh_votes(votes: Tensor, weight: Tensor, shift: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
    """Votes ``(H, W)`` and their weights, lower where they differ from the map by more than the error."""
    noise = error.clamp_max(ERROR_OF_VOTES) ** 2 + 1.0 / shift**2  # of the map, and of a match (1 px)
    apart = (votes.clamp_min(0.1) / shift).log() ** 2 / (DIFFERS**2 * noise)
    return votes, weight / (1.0 + apart) ** 2


def weighted_median(values: Tensor, weight: Tensor, rounds: int = 7) -> Tensor:
    """Weighted median over the first axis, to within ``2**-rounds`` of the values' range, by bisection.

    Where all weights are 0, about the least value.
    """
    low, high, half = values.amin(0), values.amax(0), weight.sum(0) / 2.0
    counted = torch.empty_like(weight)
    for _ in range(rounds):
        middle = 0.5 * (low + high)
        torch.le(values, middle, out=counted)  # in place, ten times as fast as torch.where
        reached = counted.mul_(weight).sum(0) >= half
        high, low = torch.where(reached, middle, high), torch.where(reached, low, middle)
    return 0.5 * (low + high)


def _vote_in_windows(
    voters: Sequence[tuple[Tensor, Tensor]], left: Tensor, shift: Tensor, map_vote: Tensor
) -> Tensor:
    """``(H, W)`` the mean of the votes near their weighted median, strip by strip.

    ``voters`` are pairs of votes and their weights, ``map_vote`` is the weight of the map's ``shift`` as a
    share of a window full of sure matches; neighbours of another colour in ``left`` count for less.
    """
    height, width = shift.shape
    halo = HALF * SPACING
    padded = [
        F.pad(each.view(1, -1, height, width), (halo,) * 4, mode="replicate")[0]
        for each in (*(values for pair in voters for values in pair), left)
    ]
    closeness = [math.exp(-(v**2 + u**2) / (2.0 * REACH**2)) for v, u in WINDOW]
    out = torch.empty_like(shift)
    count = max(1, STRIP // width)
    for first in range(0, height, count):
        rows = slice(first, min(height, first + count))
        around = [
            [each[:, rows.start + v : rows.stop + v, u : u + width] for each in padded]
            for v, u in ((halo + SPACING * v, halo + SPACING * u) for v, u in WINDOW)
        ]
        unlike = torch.stack([colours for *_, colours in around]).sub_(left[:, rows]).abs_().mean(1)
        alike = unlike.div_(-BRIGHTNESS).exp_() * shift.new_tensor(closeness)[:, None, None]
        votes, weights = [shift[rows][None]], [(map_vote * sum(closeness)).expand_as(shift[rows])[None]]
        for k in range(len(voters)):
            votes.append(torch.cat([each[2 * k] for each in around]))
            weights.append(torch.cat([each[2 * k + 1] for each in around]).mul_(alike))
        out[rows] = _mean_near_median(torch.cat(votes), torch.cat(weights))
    return out


def _mean_near_median(votes: Tensor, weights: Tensor) -> Tensor:
    """``(...)`` the mean of votes ``(n, ...)`` within about ``NEAR_PX`` of their weighted median."""
    median = weighted_median(votes, weights)
    votes = votes - median
    weights = weights / (1.0 + (votes / NEAR_PX) ** 2) ** 2
    return median + (weights * votes).sum(0) / weights.sum(0).clamp_min(1e-9)


def _enlarged(voted: Tensor, left: Tensor, whole: Tensor) -> Tensor:
    """``(H, W)`` votes at the size of ``whole (3, H, W)``, from the 9 nearest ones of similar colour."""
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
                unlike = (left[:, row, column] - whole[:, part]).abs().mean(0) / BRIGHTNESS
                away = (v - y)[:, None] ** 2 + (u - x) ** 2
                votes.append(voted[row, column])
                weights.append(torch.exp(-unlike - 2.0 * away))
        out[part] = _mean_near_median(torch.stack(votes), torch.stack(weights))
    return out
