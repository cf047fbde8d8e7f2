"""Places the depth edges of the result by weighted median filtering of prior, matches and image colours.

Beyond the paper, whose result is the decoded latent: the matches around every pixel vote on its depth.
Weighted medians after Ma et al., Constant Time Weighted Median Filtering for Stereo Matching and Beyond, ICCV
2013; large images after Kopf et al., Joint Bilateral Upsampling, SIGGRAPH 2007.
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

from geodiff_plugin._internal.kernels import has_kernel, launch_bound
from geodiff_plugin.algorithm.constants import HALF_WINDOW, WINDOW_SIGMA
from geodiff_plugin.algorithm.edges import STRIP
from geodiff_plugin.algorithm.match_fitting import highest, range_around
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.geometry import image_size, to_device_of
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.rows import RowMatches, grid_of_rows
from geodiff_plugin.result.constants import (
    BRIGHTNESS,
    DISTANCE_DECAY,
    FILLED_WEIGHT,
    MAP_VOTE,
    MAX_RISE,
    MAX_SOFT_ERROR,
    MAX_VOTE_ERROR,
    MEDIAN,
    MIN_DEPTH_M,
    MIN_EDGE,
    MIN_ERROR,
    NEAR_PX,
    NEAR_RADIUS,
    OUTLIER_ERRORS,
    ROUNDS,
    ROW_WEIGHT,
    SOFTNESS_POWER,
    SPACING,
    STEP_PX,
    WEAK_PRIOR,
    WIDE_RADIUS,
    WINDOW,
)
from geodiff_plugin.result.records import Voters

#: Radius of the window, pixels.
HALO = HALF_WINDOW * SPACING
#: Relative height of a sharp edge within ``STEP_PX``; a decoded map never reaches 1.
EDGE_SHARPNESS = 0.8
#: Minimum relative height that can be distinguished from a slope.
MIN_EDGE_SHARPNESS = 0.1
#: ``STRIP`` for devices on which a launch costs more than a cache saves: about 200 MB of values.
STRIP_OF_DEVICE = 1 << 18


class _WeightedValues(NamedTuple):
    """One value per pixel of the grid, ``(h, w)`` pixels of shift, and its weight, ``(h, w)`` >= 0."""

    shift: Tensor
    weight: Tensor


@torch.no_grad()
def filter_depth(
    depth_m: Tensor, evidence: Evidence, target: Matches, known: Tensor, error: Tensor, spacing: float = 1.0
) -> Tensor:
    """Filter a map with the weighted median of its own depth and of matches around each pixel, by colour.

    With ``d = f b / depth`` the shift between the views in pixels, ``d_i`` the values in a pixel's window and
    ``w_i`` their weights, the surface is the weighted median ``m = argmin_d sum_i w_i |d_i - d|``. The result
    is the mean of the values near it, ``sum_i v_i d_i / sum_i v_i``, ``v_i = w_i / (1 + (d_i - m)^2 /
    NEAR_PX^2)^2``.

    The map's own ``d_0`` has a fixed weight. A match of confidence ``c`` at the distance ``r``
    in samples has weight ``w = k c exp(-r^2 / (2 WINDOW_SIGMA^2)) exp(-|I - I_i| / BRIGHTNESS) / (1 + (log
    d_i / d_0)^2 / (DIFFERS s)^2)^2``. Its weight is lower for another colour ``I``, and the more it differs
    from the map in combined standard deviations ``s`` of match and map. All matches weigh less where they
    have little data support, as on a textureless wall: ``k`` is their ``known_fraction``.

    Rows of a rectified view, matched at this resolution, place edges that the sweep's grid cannot resolve,
    and determine which surface continues behind an edge. Without them the map is returned unchanged. Images
    of more than ``rows.MAX_PIXELS`` vote on a smaller grid, whose depth is upsampled, guided by colour.

    Args:
        depth_m: ``(1, 1, H, W)`` metres, fitted to the matches.
        evidence: evidence of the image, whose size ``(H, W)`` may differ.
        target: matches and known points, on any grid.
        known: their ``known_fraction``.
        error: ``(1, 1, 1, 1)`` prior error in log depth, which sets the weights of contradicting matches and
            of the map.
        spacing: pixels of the map per pixel of the grid that it was decoded on.

    Returns:
        Map like ``depth_m``, within its range.
    """
    rows = evidence.rows
    if rows is None:
        return depth_m
    full = image_size(depth_m)
    size = grid_of_rows(full)
    rows = _rows_on(size, rows)
    left = evidence.native.left.resized(size)
    # Nearest: a mean across an edge would be the depth of neither surface.
    small_m, inverse_depth, confidence, known = (
        F.interpolate(each.float(), size, mode="nearest-exact")[0, 0]
        for each in (depth_m, target.inverse_depth, target.confidence, known)
    )
    px = rows.baseline_m * float(left.camera.K[0, 0])
    coarseness = max(1.0, size[1] / full[1] * spacing / STEP_PX)  # a coarse grid places edges less accurately
    given = Voters(small_m, inverse_depth, confidence, known, rows, px)
    filtered = _filtered(given, left.image_01, error, _edge_sharpness(small_m) / coarseness)
    if size != full:
        filtered = _upsampled(filtered, left.image_01, evidence.native.left.resized(full).image_01)
    out_m = (px / filtered.clamp_min(1e-6))[None, None].clamp(*depth_m.aminmax())
    return out_m.to(depth_m.dtype)


@has_kernel("result.kernels.median.filtered")
def _filtered(given: Voters, left: Tensor, error: Tensor, sharpness: Tensor) -> Tensor:
    """Compute the filtered shift ``(H, W)``, pixels.

    ``left (3, H, W)`` is the image, ``error (1, 1, 1, 1)`` the prior's, ``sharpness ()`` the edge sharpness
    of its map.
    """
    error = _error_at_edges(error, sharpness)
    map_vote = MAP_VOTE * (WEAK_PRIOR / error).clamp_min(1.0) ** 3
    rows = given.rows
    shift = given.px / given.depth_m
    of_rows = given.known * (ROW_WEIGHT * rows.certain + FILLED_WEIGHT * rows.filled)
    # The confidence of a known point is a pixel count.
    of_matches = given.known * given.confidence.clamp(0.0, 1.0)
    voters = (
        _downweight(_WeightedValues(rows.shift, of_rows), shift, error),
        _downweight(_WeightedValues(given.px * given.inverse_depth, of_matches), shift, error),
    )
    filtered = _vote_in_windows(voters, left, shift, map_vote)
    # The median smooths ragged borders. A map that outweighs its matches has none, and known points are kept.
    return torch.where((map_vote < 1.0) & (given.confidence <= 1.0), _median_filtered(filtered), filtered)


def _rows_on(size: tuple[int, int], rows: RowMatches) -> RowMatches:
    """Resample row matches to another grid by nearest neighbour."""
    if image_size(rows.shift) == size:
        return rows
    layers = torch.stack([rows.shift, rows.matched, rows.occluded, rows.filled])
    shift, matched, occluded, filled = F.interpolate(layers[None], size, mode="nearest-exact")[0]
    shift = shift * (size[1] / rows.shift.shape[1])
    return rows._replace(shift=shift, matched=matched, occluded=occluded, filled=filled)


def _median_filtered(values: Tensor) -> Tensor:
    """Apply a median filter of ``MEDIAN`` x ``MEDIAN`` pixels to a map ``(H, W)``."""
    if launch_bound(values):
        return _median_of_windows(values)
    return torch.from_numpy(cv2.medianBlur(np.ascontiguousarray(values.numpy()), MEDIAN))  # much faster


def _median_of_windows(values: Tensor) -> Tensor:
    """Compute OpenCV's ``medianBlur``, which replicates the border, on any device."""
    padded = F.pad(values[None, None], (MEDIAN // 2,) * 4, mode="replicate")
    return F.unfold(padded, MEDIAN)[0].median(0).values.view_as(values)


def _rows_at_once(like: Tensor) -> int:
    """Return the number of rows of a map ``(H, W)`` whose windows are processed at once."""
    return max(1, (STRIP_OF_DEVICE if launch_bound(like) else STRIP) // like.shape[-1])


def _error_at_edges(error: Tensor, sharpness: Tensor) -> Tensor:
    """Return the prior's error ``()``, increased for a map with soft edges."""
    error = error.flatten()[0].clamp_min(MIN_ERROR)
    return torch.maximum(error, (error / sharpness**SOFTNESS_POWER).clamp_max(MAX_SOFT_ERROR))


def _edge_sharpness(depth_m: Tensor) -> Tensor:
    """Measure edge sharpness ``()`` in (0, 1]: the fraction of a depth edge within ``STEP_PX`` pixels.

    This is the median over inner pixels near an edge that is not the slope of a wide surface.
    """
    fraction = _step_fractions(depth_m.contiguous())
    return (fraction.flatten().nanmedian().nan_to_num(1.0) / EDGE_SHARPNESS).clamp(MIN_EDGE_SHARPNESS, 1.0)


@has_kernel("result.kernels.median.step_fractions")
def _step_fractions(depth_m: Tensor) -> Tensor:
    """Compute that fraction at the edges of a map ``(H, W)``; NaN elsewhere and near the border."""
    log_depth = depth_m.clamp_min(MIN_DEPTH_M).log()[None, None]
    across, down = ((log_depth - log_depth.roll(STEP_PX, axis)).abs() for axis in (-1, -2))
    near, wide = (range_around(log_depth, radius) for radius in (NEAR_RADIUS, WIDE_RADIUS))
    at_edge = (near > MIN_EDGE) & (wide < MAX_RISE * near)
    step = highest(torch.maximum(across, down), NEAR_RADIUS)
    fractions = torch.full_like(depth_m, torch.nan)
    inner = slice(WIDE_RADIUS, -WIDE_RADIUS)
    fractions[inner, inner] = torch.where(at_edge, step / near, torch.nan)[0, 0, inner, inner]
    return fractions


def _downweight(values: _WeightedValues, shift: Tensor, error: Tensor) -> _WeightedValues:
    """Reduce the weight of values that differ from the map's ``shift (H, W)`` by more than the error."""
    noise = error.clamp_max(MAX_VOTE_ERROR) ** 2 + 1.0 / shift**2  # of the map, and of a match (1 px)
    difference = (values.shift.clamp_min(0.1) / shift).log() ** 2 / (OUTLIER_ERRORS**2 * noise)
    return values._replace(weight=values.weight / (1.0 + difference) ** 2)


def weighted_median(values: Tensor, weight: Tensor) -> Tensor:
    """Compute the weighted median over the first axis, to ``2**-ROUNDS`` of the value range, by bisection.

    If all weights are 0, the result is about the minimum.
    """
    low = values.amin(0)
    high = values.amax(0)
    half = weight.sum(0) / 2.0
    counted = torch.empty_like(weight)
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        torch.le(values, middle, out=counted)  # in place, ten times as fast as torch.where
        reached = counted.mul_(weight).sum(0) >= half
        high, low = torch.where(reached, middle, high), torch.where(reached, low, middle)
    return 0.5 * (low + high)


def _vote_in_windows(
    voters: Sequence[_WeightedValues], left: Tensor, shift: Tensor, map_vote: Tensor
) -> Tensor:
    """Average the values near their weighted median, ``(H, W)``, strip by strip.

    ``map_vote`` is the weight of the map's ``shift (H, W)`` as a fraction of a window full of certain
    matches. Neighbours with another colour in ``left (3, H, W)`` weigh less.
    """
    height, count = len(shift), len(voters)
    layers = torch.stack([*(each.shift for each in voters), *(each.weight for each in voters)])
    padded = F.pad(torch.cat([layers, left])[None], (HALO,) * 4, mode="replicate")[0]
    closeness = [math.exp(-(v**2 + u**2) / (2.0 * WINDOW_SIGMA**2)) for v, u in WINDOW]
    weight_of_map = map_vote * sum(closeness)
    of_window = to_device_of(shift, torch.tensor(closeness, dtype=shift.dtype, device="cpu"))[:, None, None]
    places = to_device_of(shift, torch.tensor(WINDOW, device="cpu").T + HALF_WINDOW)
    out = torch.empty_like(shift)
    rows_at_once = _rows_at_once(shift)
    for first in range(0, height, rows_at_once):
        rows = slice(first, min(height, first + rows_at_once))
        around = _windows(padded[:, rows.start : rows.stop + 2 * HALO], places)
        values = around[:count]
        weights = around[count : 2 * count]
        colours = around[2 * count :]
        colour_weight = (colours - left[:, None, rows]).abs_().mean(0).div_(-BRIGHTNESS).exp_() * of_window
        own = shift[rows][None]
        values = torch.cat([own, values.flatten(0, 1)])
        weights = torch.cat([weight_of_map.expand_as(own), (weights * colour_weight).flatten(0, 1)])
        out[rows] = _mean_near_median(values, weights)
    return out


def _windows(padded: Tensor, places: Tensor) -> Tensor:
    """Return ``n`` values around each pixel, ``(C, n, h, w)``, of layers ``(C, h + 2 HALO, w + 2 HALO)``.

    ``places (2, n)`` are rows and columns of the whole window of ``2 HALF_WINDOW + 1`` samples, from 0.
    """
    of_layer, of_row, _ = padded.stride()
    side = 2 * HALF_WINDOW + 1
    height = padded.shape[1] - 2 * HALO
    width = padded.shape[2] - 2 * HALO
    shape = len(padded), side, side, height, width
    strides = of_layer, SPACING * of_row, SPACING, of_row, 1
    down, right = places
    return padded.as_strided(shape, strides, padded.storage_offset())[:, down, right]


def _mean_near_median(values: Tensor, weights: Tensor) -> Tensor:
    """Average values ``(n, ...)`` within about ``NEAR_PX`` of their weighted median."""
    median = weighted_median(values, weights)
    values = values - median
    weights = weights / (1.0 + (values / NEAR_PX) ** 2) ** 2
    return median + (weights * values).sum(0) / weights.sum(0).clamp_min(1e-9)


@has_kernel("result.kernels.median.upsampled")
def _upsampled(filtered: Tensor, left: Tensor, whole: Tensor) -> Tensor:
    """Upsample values to the size of ``whole (3, H, W)``, from the 9 nearest ones weighted by colour."""
    (height, width), (rows, columns) = image_size(whole), image_size(left)
    out = filtered.new_empty(height, width)
    x = (torch.arange(width, device=filtered.device, dtype=filtered.dtype) + 0.5) * (columns / width) - 0.5
    count = _rows_at_once(out)
    for first in range(0, height, count):
        part = slice(first, min(height, first + count))
        y = torch.arange(part.start, part.stop, device=filtered.device, dtype=filtered.dtype) + 0.5
        y = y * (rows / height) - 0.5
        values, weights = [], []
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                v, u = y.round() + down, x.round() + right
                row = v.long().clamp(0, rows - 1)[:, None]
                column = u.long().clamp(0, columns - 1)
                colour_distance = (left[:, row, column] - whole[:, part]).abs().mean(0) / BRIGHTNESS
                away = (v - y)[:, None] ** 2 + (u - x) ** 2
                values.append(filtered[row, column])
                weights.append(torch.exp(-colour_distance - DISTANCE_DECAY * away))
        out[part] = _mean_near_median(torch.stack(values), torch.stack(weights))
    return out
