"""Matches along the rows of a rectified pair at full resolution.

On a CPU by OpenCV's semi-global matcher, which is many times as fast there as the sweep's; where kernels run,
by the sweep's aggregation and left-right check, so that nothing has to come to the CPU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel
from geodiff_plugin.matching.alignment import AlignedView
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.matching.sweep import CostVolume, compare_views
from geodiff_plugin.types import CameraView

#: Parameters of OpenCV's matcher: keep what both views agree on, and drop speckles.
PARAMETERS = {
    "blockSize": 5,
    "uniquenessRatio": 10,
    "speckleWindowSize": 100,
    "speckleRange": 2,
    "disp12MaxDiff": 1,
}
#: Shifts below so many pixels are too small to measure depth.
MIN_SHIFT_PX = 0.3
#: No shift exceeds this share of the image's width, which bounds the time of the search.
MAX_SHIFT = 0.3

#: A match of the sweep's aggregation counts from this confidence on.
SURE = 0.5
#: Costs of a strip of rows that are held at once, at nine bytes each with their sums and the other view's.
STRIP_COSTS = 1 << 25
#: Rows above and below a strip that the paths run through before they reach it.
HALO = 32


def make_matcher(lowest: int, count: int, channels: int) -> Any:
    """OpenCV's matcher for ``count`` disparities from ``lowest`` on, of images with ``channels`` channels."""
    area = channels * PARAMETERS["blockSize"] ** 2
    return cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=count,
        P1=8 * area,
        P2=32 * area,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        **PARAMETERS,
    )


def pad_columns(image: np.ndarray, count: int) -> np.ndarray:
    """An image with its first column repeated ``count`` times: OpenCV leaves that many columns empty."""
    pads = ((0, 0), (count, 0), (0, 0))[: image.ndim]
    return np.ascontiguousarray(np.pad(image, pads, mode="edge"))


def fill_background(shift: Tensor) -> Tensor:
    """Fill holes with the farther of the two neighbours in the row, as KITTI's development kit does.

    ``shift (H, W)`` (pixels or 1/m) falls with depth and is NaN in holes. At a row's ends the only neighbour
    counts; an empty row copies the nearest filled one above, else below. NaN everywhere if all is unknown.
    """
    height, width = shift.shape
    known, columns = shift.isfinite(), torch.arange(width, device=shift.device)
    from_left = torch.where(known, columns, -1).cummax(1).values
    from_right = torch.where(known, columns, width).flip(1).cummin(1).values.flip(1)
    padded = F.pad(torch.where(known, shift, torch.inf), (1, 1), value=torch.inf)
    filled = torch.minimum(padded.gather(1, from_left + 1), padded.gather(1, from_right + 1))
    rows, full = torch.arange(height, device=shift.device), known.any(dim=1)
    above = torch.where(full, rows, -1).cummax(0).values
    below = torch.where(full, rows, height).flip(0).cummin(0).values.flip(0)
    filled = filled[torch.where(above >= 0, above, below.clamp_max(height - 1))]
    return torch.where(full.any(), filled, torch.nan)


@dataclass(frozen=True)
class _RowPair:
    """A rectified pair, the second view to the right of the first, with the shifts that are tried."""

    left: Tensor  # (H, W) grey in [0, 1]
    right: Tensor
    K: Tensor  # of the left one
    lowest: int  # the least shift that is tried, pixels from a column to the same one
    count: int  # of shifts, a pixel apart


def match_rows(
    left_01: Tensor, view: CameraView, K_left: Tensor, nearest_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Match a rectified pair of one size, ``left_01 (3, H, W)`` in [0, 1] and ``view`` on either side.

    ``nearest_px`` is the largest shift of the search.

    Returns:
        Three ``(H, W)``: the shift in pixels from where the point would be at infinity; 1 where both views
        agree, else 0; 1 in a gap between two matches, where the shift is that of the farther one.
    """
    left, right = (grey(image)[0] for image in (left_01, view.image_01))
    infinity = float(K_left[0, 2] - view.K[0, 2])
    mirrored = float(view.T_right_from_left[0, 3]) > 0
    if mirrored:  # mirrored, a view to the left becomes one to the right
        left, right, infinity = left.flip(1), right.flip(1), -infinity
    count = 16 * max(1, math.ceil(min(nearest_px + 4.0, MAX_SHIFT * left.shape[1]) / 16))
    pair = _RowPair(left, right, K_left, math.floor(infinity), count)
    matched = _by_paths(pair) if use_kernel(left_01) else _by_opencv(pair)
    shift = matched.nan_to_num(-torch.inf) - infinity
    known = shift >= MIN_SHIFT_PX
    between = (known.cumsum(1) > 0) & (known.flip(1).cumsum(1).flip(1) > 0) & ~known
    filled = fill_background(torch.where(known, shift, torch.nan)).nan_to_num()
    maps = [each.flip(1) if mirrored else each for each in (filled, known.float(), between.float())]
    return maps[0], maps[1], maps[2]


def _by_opencv(pair: _RowPair) -> Tensor:
    """Shifts ``(H, W)`` in pixels; NaN where the views do not agree."""
    pad = max(0, pair.lowest + pair.count)
    left, right = (
        pad_columns((image * 255.0).round().byte().cpu().numpy(), pad) for image in (pair.left, pair.right)
    )
    raw = make_matcher(pair.lowest, pair.count, 1).compute(left, right)[:, pad:]
    shift = np.where(raw > 16 * (pair.lowest - 1), raw.astype(np.float32) / 16.0, np.float32(np.nan))
    return torch.from_numpy(shift).to(pair.left.device)


def _by_paths(pair: _RowPair) -> Tensor:
    """``_by_opencv`` by the aggregation of the sweep, whose planes are the shifts; in strips of rows."""
    height, width = pair.left.shape
    shifts = torch.arange(pair.lowest, pair.lowest + pair.count, dtype=torch.float64, device="cpu")
    moved = torch.stack([-shifts, torch.zeros_like(shifts)], dim=1)
    rows = max(HALO, STRIP_COSTS // (width * pair.count) - 2 * HALO)
    found = torch.empty_like(pair.left)
    for first in range(0, height, rows):
        begin, last = max(0, first - HALO), min(height, first + rows)
        strip = slice(begin, min(height, last + HALO))
        left = pair.left[None, strip]
        view = AlignedView(pair.right[strip], None, torch.ones_like(shifts), moved)
        costs = compare_views(left, [view])
        matches = match_volume(CostVolume(*costs, shifts.float(), pair.K, left, (), (view,)))
        position = torch.where(matches.confidence > SURE, matches.inverse_depth, torch.nan)
        found[first:last] = position[0, first - begin : last - begin]
    return found
