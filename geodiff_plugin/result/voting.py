"""Place the depth edges of the result by a vote of prior, matches and colours of the image.

Beyond the paper, whose result is the decoded latent: the matches around every pixel vote on its depth.
Weighted medians after Ma et al., Constant Time Weighted Median Filtering for Stereo Matching and Beyond, ICCV
2013; large pictures after Kopf et al., Joint Bilateral Upsampling, SIGGRAPH 2007.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import launch_bound, use_kernel
from geodiff_plugin.algorithm.correction import highest, range_around
from geodiff_plugin.algorithm.edges import HALF, REACH, STRIP
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.geometry import image_size, resize_image, to_device_of
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.rows import RowMatches, grid_of_rows
from geodiff_plugin.types import PosedViews

#: Difference in brightness at which a neighbour's weight falls to a third.
BRIGHTNESS = 0.1
#: Offsets of the voters in samples: every second one of the window, which is as good as all of them.
WINDOW = [(v, u) for v in range(-HALF, HALF + 1) for u in range(-HALF, HALF + 1) if (v + u) % 2 == 0]
#: Pixels between samples of the window: it has to reach beyond the ragged border of a sweep's match.
SPACING = 4
#: Pixels that the window reaches to each side.
HALO = HALF * SPACING
#: Weight of a row match, and of a hidden strip, relative to a sure match of the sweep: they place edges on a
#: finer grid.
ROWS = 1.5
#: The same of a gap filled from the farther surface, which is a guess.
FILLED = 0.5
#: Error of a prior from which its map has the least vote.
WEAK_PRIOR = 0.2
#: That vote, as a share of a window full of sure matches. It grows as the cube of a smaller error: a good
#: prior knows where edges are.
MAP_VOTE = 0.03
#: A match that differs from the map by this many errors of the prior counts for a quarter.
DIFFERS = 2.0
#: The largest error of a prior that is used for this: a useless map would let every wrong match vote.
ERROR_OF_VOTES = 0.1
#: Reach in which a step of the map is looked for, pixels.
NEARBY = 4
#: Reach beyond which the step must not go on, pixels: it would be the slope of a wide surface.
WIDE = 12
#: The least step in log depth.
EDGE = 0.1
#: How much larger the step may be within the wider reach.
RISE = 2.2
#: Pixels that a crisp step takes.
STEP_PX = 2
#: The share of a crisp step within them: a decoded map never reaches 1.
CRISP = 0.8
#: The least share that is told apart from a slope.
LEAST_CRISP = 0.1
#: Power with which a soft map raises the error of its prior at edges.
SOFT = 4.0
#: Up to which error: the matches of a soft map are no better for it.
MOST_SOFT = 0.14
#: Least error of a prior that makes a difference.
LEAST_ERROR = 1e-3
#: Least depth whose logarithm is taken, metres.
LEAST_M = 1e-9
#: Votes within about this many pixels of the median make the mean.
NEAR_PX = 1.0
#: Halvings that find a weighted median.
ROUNDS = 7
#: As ``STRIP``, where a launch costs more than a cache gives: some 200 MB of votes.
STRIP_OF_DEVICE = 1 << 18
#: Fall of a vote's weight with its squared distance, pixels of the voting grid, where votes are enlarged.
NEAREST = 2.0
#: Side of the last median filter, pixels of the voting grid.
MEDIAN = 5


class Voters(NamedTuple):
    """Who votes on the depth of an image: maps ``(H, W)`` on the grid of the votes."""

    depth_m: Tensor  # metres, of the map
    inverse_depth: Tensor  # 1/m, of matches and known points
    confidence: Tensor  # of these
    known: Tensor  # their ``known_share``
    rows: RowMatches
    px: Tensor  # () on the CPU, shift between the views of a depth of 1 m


class _Votes(NamedTuple):
    """One vote per pixel of the grid, ``(h, w)`` pixels of shift, and its weight, ``(h, w)`` >= 0."""

    shift: Tensor
    weight: Tensor


@torch.no_grad()
def vote_depth(
    depth_m: Tensor, evidence: Evidence, target: Matches, known: Tensor, error: Tensor, spacing: float = 1.0
) -> Tensor:
    """Give every pixel the depth voted by the map and by the matches around it that have its colour.

    With ``d = f b / depth`` the shift between the views in pixels, ``d_i`` the votes in a pixel's window and
    ``w_i`` their weights, the surface is the weighted median ``m = argmin_d sum_i w_i |d_i - d|``. The result
    is the mean of the votes near it, ``sum_i v_i d_i / sum_i v_i``, ``v_i = w_i / (1 + (d_i - m)^2 /
    NEAR_PX^2)^2``. The map votes for its own ``d_0`` with a fixed weight, and a match of confidence ``c`` at
    the distance ``r`` in samples with ``w = k c exp(-r^2 / (2 REACH^2)) exp(-|I - I_i| / BRIGHTNESS) /
    (1 + (log d_i / d_0)^2 / (DIFFERS s)^2)^2``: less with another colour ``I``, and less the more standard
    deviations ``s``, of match and map together, it differs from the map. Where the matches of a place know
    little, as on a blank wall, all of them count less: ``k`` is their ``known_share``.

    Rows of a rectified view, matched at this resolution, place edges that the sweep's grid cannot resolve,
    and say which surface goes on behind an edge.
    Without them the map is returned unchanged. Pictures of more than ``rows.MOST_PIXELS`` vote on a smaller
    grid, whose depth is enlarged, guided by colour.

    Args:
        depth_m: ``(1, 1, H, W)`` metres, fitted to the matches.
        evidence: of the image, whose size ``(H, W)`` may differ.
        target: matches and known points, on any grid.
        known: their ``known_share``.
        error: ``(1, 1, 1, 1)`` of the prior in log depth: how much contradicting matches, and the map, count.
        spacing: pixels of the map per pixel of the grid that it was decoded on.

    Returns:
        As ``depth_m``, within its range.
    """
    rows = None if evidence.rows is None else evidence.rows.result()
    if rows is None:
        return depth_m
    full = image_size(depth_m)
    size = grid_of_rows(full)
    rows = _rows_on(size, rows)
    left, K = _resized(evidence.native, size)
    # Nearest: a mean across an edge is the depth of neither surface.
    small_m, inverse_depth, confidence, known = (
        F.interpolate(each.float(), size, mode="nearest-exact")[0, 0]
        for each in (depth_m, target.inverse_depth, target.confidence, known)
    )
    px = K[0, 0] * rows.baseline_m
    coarseness = max(1.0, size[1] / full[1] * spacing / STEP_PX)  # a coarse grid places no edge well
    given = Voters(small_m, inverse_depth, confidence, known, rows, px)
    voted = _voted(given, left, error, _crispness(small_m) / coarseness)
    if size != full:
        voted = _enlarged(voted, left, _resized(evidence.native, full)[0])
    out_m = (px / voted.clamp_min(1e-6))[None, None].clamp(*depth_m.aminmax())
    return out_m.to(depth_m.dtype)


def _voted(given: Voters, left: Tensor, error: Tensor, crispness: Tensor) -> Tensor:
    """``(H, W)`` pixels of shift that the voters agree on.

    ``left (3, H, W)`` is the image, ``error (1, 1, 1, 1)`` that of the prior, ``crispness ()`` of its map.
    """
    if use_kernel(left):
        from geodiff_plugin.result import kernels

        return kernels.voted(given, left, error, crispness)
    error = _error_at_edges(error, crispness)
    map_vote = MAP_VOTE * (WEAK_PRIOR / error).clamp_min(1.0) ** 3
    rows, shift = given.rows, given.px / given.depth_m
    of_rows = given.known * (ROWS * rows.certain + FILLED * rows.filled)
    # The confidence of a known point is a count.
    of_matches = given.known * given.confidence.clamp(0.0, 1.0)
    voters = (
        _weighed(_Votes(rows.shift, of_rows), shift, error),
        _weighed(_Votes(given.px * given.inverse_depth, of_matches), shift, error),
    )
    voted = _vote_in_windows(voters, left, shift, map_vote)
    # The median smooths ragged borders; a map that outvotes its matches has none, and known points stay.
    return torch.where((map_vote < 1.0) & (given.confidence <= 1.0), _median_filtered(voted), voted)


def _resized(native: PosedViews, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The left image ``(3, H, W)`` of a size, and its K."""
    return resize_image(native.left_01.float(), native.K_left.float(), size)


def _rows_on(size: tuple[int, int], rows: RowMatches) -> RowMatches:
    """Matches of rows on another grid: each pixel takes those of the nearest one."""
    if image_size(rows.shift) == size:
        return rows
    layers = torch.stack([rows.shift, rows.matched, rows.hidden, rows.filled])
    shift, matched, hidden, filled = F.interpolate(layers[None], size, mode="nearest-exact")[0]
    shift = shift * (size[1] / rows.shift.shape[1])
    return rows._replace(shift=shift, matched=matched, hidden=hidden, filled=filled)


def _median_filtered(values: Tensor) -> Tensor:
    """A map ``(H, W)``, each pixel the median of ``MEDIAN`` times ``MEDIAN`` pixels around it."""
    if launch_bound(values):
        return _median_of_windows(values)
    return torch.from_numpy(cv2.medianBlur(np.ascontiguousarray(values.numpy()), MEDIAN))  # much faster


def _median_of_windows(values: Tensor) -> Tensor:
    """As OpenCV's ``medianBlur``, which repeats the outermost pixels."""
    padded = F.pad(values[None, None], (MEDIAN // 2,) * 4, mode="replicate")
    return F.unfold(padded, MEDIAN)[0].median(0).values.view_as(values)


def _rows_at_once(like: Tensor) -> int:
    """Rows of a map ``(H, W)`` whose windows are worked on at once."""
    return max(1, (STRIP_OF_DEVICE if launch_bound(like) else STRIP) // like.shape[-1])


def _error_at_edges(error: Tensor, crispness: Tensor) -> Tensor:
    """``()`` the prior's error, larger for a map with soft edges."""
    error = error.flatten()[0].clamp_min(LEAST_ERROR)
    return torch.maximum(error, (error / crispness**SOFT).clamp_max(MOST_SOFT))


def _crispness(depth_m: Tensor) -> Tensor:
    """``()`` in (0, 1]: the share of a step in a map ``(H, W)`` that ``STEP_PX`` pixels take; 1 is crisp.

    The median over edges: pixels inside with a step nearby that is not the slope of a wide surface.
    """
    share = _step_shares(depth_m.contiguous())
    return (share.flatten().nanmedian().nan_to_num(1.0) / CRISP).clamp(LEAST_CRISP, 1.0)


def _step_shares(depth_m: Tensor) -> Tensor:
    """That share at every edge of a map ``(H, W)``, and NaN elsewhere and within ``WIDE`` of the rim."""
    if use_kernel(depth_m):
        from geodiff_plugin.result import kernels

        return kernels.step_shares(depth_m)
    log_depth = depth_m.clamp_min(LEAST_M).log()[None, None]
    across, down = ((log_depth - log_depth.roll(STEP_PX, axis)).abs() for axis in (-1, -2))
    near, wide = (range_around(log_depth, reach) for reach in (NEARBY, WIDE))
    at_edge = (near > EDGE) & (wide < RISE * near)
    step = highest(torch.maximum(across, down), NEARBY)
    return torch.where(at_edge, step / near, torch.nan)[0, 0, WIDE:-WIDE, WIDE:-WIDE]


def _weighed(votes: _Votes, shift: Tensor, error: Tensor) -> _Votes:
    """Votes with a lower weight where they differ from the map's ``shift (H, W)`` by more than the error."""
    noise = error.clamp_max(ERROR_OF_VOTES) ** 2 + 1.0 / shift**2  # of the map, and of a match (1 px)
    apart = (votes.shift.clamp_min(0.1) / shift).log() ** 2 / (DIFFERS**2 * noise)
    return votes._replace(weight=votes.weight / (1.0 + apart) ** 2)


def weighted_median(values: Tensor, weight: Tensor) -> Tensor:
    """Weighted median over the first axis, to within ``2**-ROUNDS`` of the values' range, by bisection.

    Where all weights are 0, about the least value.
    """
    low, high, half = values.amin(0), values.amax(0), weight.sum(0) / 2.0
    counted = torch.empty_like(weight)
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        torch.le(values, middle, out=counted)  # in place, ten times as fast as torch.where
        reached = counted.mul_(weight).sum(0) >= half
        high, low = torch.where(reached, middle, high), torch.where(reached, low, middle)
    return 0.5 * (low + high)


def _vote_in_windows(voters: Sequence[_Votes], left: Tensor, shift: Tensor, map_vote: Tensor) -> Tensor:
    """``(H, W)`` the mean of the votes near their weighted median, strip by strip.

    ``map_vote`` is the weight of the map's ``shift (H, W)`` as a share of a window full of sure matches;
    neighbours of another colour in ``left (3, H, W)`` count for less.
    """
    height, count = len(shift), len(voters)
    layers = torch.stack([*(each.shift for each in voters), *(each.weight for each in voters)])
    padded = F.pad(torch.cat([layers, left])[None], (HALO,) * 4, mode="replicate")[0]
    closeness = [math.exp(-(v**2 + u**2) / (2.0 * REACH**2)) for v, u in WINDOW]
    weight_of_map = map_vote * sum(closeness)
    of_window = to_device_of(shift, torch.tensor(closeness, dtype=shift.dtype, device="cpu"))[:, None, None]
    places = to_device_of(shift, torch.tensor(WINDOW, device="cpu").T + HALF)
    out = torch.empty_like(shift)
    rows_at_once = _rows_at_once(shift)
    for first in range(0, height, rows_at_once):
        rows = slice(first, min(height, first + rows_at_once))
        around = _windows(padded[:, rows.start : rows.stop + 2 * HALO], places)
        votes, weights, colours = around[:count], around[count : 2 * count], around[2 * count :]
        alike = (colours - left[:, None, rows]).abs_().mean(0).div_(-BRIGHTNESS).exp_() * of_window
        own = shift[rows][None]
        votes = torch.cat([own, votes.flatten(0, 1)])
        weights = torch.cat([weight_of_map.expand_as(own), (weights * alike).flatten(0, 1)])
        out[rows] = _mean_near_median(votes, weights)
    return out


def _windows(padded: Tensor, places: Tensor) -> Tensor:
    """``(C, n, h, w)`` the ``n`` values around every pixel, of layers ``(C, h + 2 HALO, w + 2 HALO)``.

    ``places (2, n)`` are rows and columns of the whole window of ``2 HALF + 1`` samples, from 0.
    """
    of_layer, of_row, _ = padded.stride()
    side, height, width = 2 * HALF + 1, padded.shape[1] - 2 * HALO, padded.shape[2] - 2 * HALO
    shape = len(padded), side, side, height, width
    strides = of_layer, SPACING * of_row, SPACING, of_row, 1
    down, right = places
    return padded.as_strided(shape, strides, padded.storage_offset())[:, down, right]


def _mean_near_median(votes: Tensor, weights: Tensor) -> Tensor:
    """``(...)`` the mean of votes ``(n, ...)`` within about ``NEAR_PX`` of their weighted median."""
    median = weighted_median(votes, weights)
    votes = votes - median
    weights = weights / (1.0 + (votes / NEAR_PX) ** 2) ** 2
    return median + (weights * votes).sum(0) / weights.sum(0).clamp_min(1e-9)


def _enlarged(voted: Tensor, left: Tensor, whole: Tensor) -> Tensor:
    """``(H, W)`` votes at the size of ``whole (3, H, W)``, from the 9 nearest ones of similar colour."""
    if use_kernel(voted):
        from geodiff_plugin.result import kernels

        return kernels.enlarged(voted, left, whole)
    (height, width), (rows, columns) = image_size(whole), image_size(left)
    out = voted.new_empty(height, width)
    x = (torch.arange(width, device=voted.device, dtype=voted.dtype) + 0.5) * (columns / width) - 0.5
    count = _rows_at_once(out)
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
                weights.append(torch.exp(-unlike - NEAREST * away))
        out[part] = _mean_near_median(torch.stack(votes), torch.stack(weights))
    return out
