"""Matches along the rows of a rectified pair at full resolution, by OpenCV's semi-global matcher."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.geometry import image_size, is_rectified, resize_image, size_within
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.consistency import known_share
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.occlusion import occlusion_order
from geodiff_plugin.matching.uprights import certain_shear, upright_lines
from geodiff_plugin.types import CameraView, PosedViews

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
#: Most pixels of the pictures that are matched; larger ones are made smaller.
MOST_PIXELS = 600_000
#: The least step of shift that hides a strip of the farther surface, pixels: below it, matches differ by
#: chance.
LEAST_STEP_PX = 2.0
#: How much wider than its step of shift a hidden strip may seem, pixels: matches end before an edge.
SLACK_PX = 2.0
#: Confidence of what is put into a hidden strip where the matches around it know enough: it is a guess that
#: the farther surface goes on, and on a blank wall the end of the strip is one as well.
HIDDEN_CONFIDENCE = 0.8
#: A match in a hidden strip is kept from this confidence on.
LEAST_KEPT = 0.05


class RowMatches(NamedTuple):
    """Matches along the rows of a rectified pair; maps ``(H, W)`` on the grid that they were sought on."""

    shift: Tensor  # pixels from where the point would be at infinity, >= 0
    matched: Tensor  # 1 where both views agree, else 0
    hidden: Tensor  # 1 in a gap between two that the right view cannot see (``hidden_gaps``)
    filled: Tensor  # 1 in another gap between two; the shift of a gap is that of its farther end
    baseline_m: Tensor  # () distance of the cameras, metres, on the CPU
    shear: float = math.nan  # of the right picture along its rows, pixels per row, as far as it is certain
    occlusion: float = math.nan  # [-1, 1], below 0 where what is matched as far hides what is near

    @property
    def certain(self) -> Tensor:
        """1 where the shift is matched, or that of the surface which goes on behind a nearer one, else 0."""
        return self.matched + self.hidden


class RowPictures(NamedTuple):
    """A rectified pair as its rows are matched; mirrored if its second view is on the left."""

    left: np.ndarray  # (H, W) uint8, grey levels
    right: np.ndarray
    lines: np.ndarray  # (N, 4), ``upright_lines`` of the left one
    infinity_px: float  # disparity of a point at infinity
    focal_px: float  # of the left one, along the rows
    shift_m: np.float32  # of left points into the right camera's frame, along the rows; above 0: mirrored
    device: torch.device  # of the matches

    def shift_px(self, inverse_depth: float) -> float:
        """The shift of points at an inverse depth, 1/m."""
        return inverse_depth * (self.focal_px * abs(float(self.shift_m)))


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


def _nearest_known(known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns of the nearest known pixels of the row to the left and to the right, ``(H, W)`` each.

    Of a known pixel both are its own; where there is none, -1 and the width.
    """
    columns, width = np.arange(known.shape[1])[None], known.shape[1]
    from_left = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    from_right = np.minimum.accumulate(np.where(known, columns, width)[:, ::-1], axis=1)[:, ::-1]
    return from_left, from_right


def hidden_gaps(shift: np.ndarray, known: np.ndarray) -> np.ndarray:
    """``(H, W)`` bool: gaps between matches that a view to the right cannot see.

    A surface hides a strip of what is behind its left edge, and the strip is as wide as the shift of the near
    surface exceeds that of the far one. A wider gap, or one without such a step, has another reason.

    Args:
        shift: ``(H, W)`` pixels; it falls with depth.
        known: ``(H, W)`` bool, where it is matched.
    """
    from_left, from_right = _nearest_known(known)
    padded = np.pad(np.where(known, shift, np.nan), ((0, 0), (1, 1)), constant_values=np.nan)
    rows = np.arange(shift.shape[0])[:, None]
    step = padded[rows, from_right + 1] - padded[rows, from_left + 1]
    return ~known & (step > LEAST_STEP_PX) & (from_right - from_left - 1 <= step + SLACK_PX)


def fill_background(shift: np.ndarray) -> np.ndarray:
    """Fill holes with the farther of the two neighbours in the row, as KITTI's development kit does.

    ``shift (H, W)`` (pixels or 1/m) falls with depth and is NaN in holes. At a row's ends the only neighbour
    counts; an empty row copies the nearest filled one above, else below. NaN everywhere if all is unknown.
    """
    known = np.isfinite(shift)
    from_left, from_right = _nearest_known(known)
    rows = np.arange(shift.shape[0])[:, None]
    padded = np.pad(np.where(known, shift, np.inf), ((0, 0), (1, 1)), constant_values=np.inf)
    filled = np.minimum(padded[rows, from_left + 1], padded[rows, from_right + 1])
    full_rows = np.flatnonzero(known.any(axis=1))
    if full_rows.size == 0:
        return np.full_like(shift, np.nan)
    above = np.searchsorted(full_rows, rows[:, 0], side="right") - 1
    return filled[full_rows[np.maximum(above, 0)]].astype(shift.dtype)


def grid_of_rows(size: tuple[int, int]) -> tuple[int, int]:
    """``(H, W)`` of the grid for a picture or map of a size: the same, within ``MOST_PIXELS``."""
    return size_within(size, MOST_PIXELS)


def _row_shifts(
    left: np.ndarray, right: np.ndarray, infinity_px: float, nearest_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Shifts of grey levels ``(H, W)`` uint8 from infinity, float32 px, and where both views agree on one.

    A point at infinity has the disparity ``infinity_px``; the search goes from there to ``nearest_px`` more.
    """
    lowest = int(np.floor(infinity_px))
    count = 16 * max(1, int(np.ceil(min(nearest_px + 4.0, MAX_SHIFT * left.shape[1]) / 16)))
    pad = max(0, lowest + count)
    matcher = make_matcher(lowest, count, 1)
    raw = matcher.compute(pad_columns(left, pad), pad_columns(right, pad))[:, pad:]
    shift = raw.astype(np.float32) / 16.0 - np.float32(infinity_px)
    return shift, (raw > 16 * (lowest - 1)) & (shift >= MIN_SHIFT_PX)


def rectified_pictures(native: PosedViews) -> RowPictures | None:
    """The left image and the first view that is rectified with it and of its size, if there is one.

    ``native`` are the image and its right views, at their own sizes.
    """
    rectified = [v for v in native.views if is_rectified(native.K_left, v.K, v.T_right_from_left)]
    view = next((v for v in rectified if image_size(v.image_01) == native.size), None)
    if view is None:
        return None
    size = grid_of_rows(native.size)
    left, K = resize_image(native.left_01.float(), native.K_left.float(), size)
    right = CameraView(*resize_image(view.image_01.float(), view.K.float(), size), view.T_right_from_left)
    return row_pictures(left, right, K)


def row_pictures(left_01: Tensor, view: CameraView, K_left: Tensor) -> RowPictures:
    """A rectified pair of one size, ``left_01 (3, H, W)`` in [0, 1] and ``view`` on either side."""
    levels = grey(torch.stack([left_01, view.image_01]))[:, 0] * 255.0
    images = list(levels.round().byte().cpu().numpy())
    K, K_right, T = (each.numpy(force=True) for each in (K_left, view.K, view.T_right_from_left))
    infinity = float(K[0, 2] - K_right[0, 2])
    if T[0, 3] > 0:  # mirrored, a view to the left becomes one to the right
        images, infinity = [image[:, ::-1] for image in images], -infinity
    left, right = map(np.ascontiguousarray, images)
    return RowPictures(left, right, upright_lines(left), infinity, float(K[0, 0]), T[0, 3], left_01.device)


def match_rows(pictures: RowPictures, nearest_px: float) -> RowMatches:
    """Match the rows of a pair; ``nearest_px`` is the largest shift of the search."""
    shift, known = _row_shifts(pictures.left, pictures.right, pictures.infinity_px, nearest_px)
    hidden = hidden_gaps(shift, known)
    between = np.logical_or.accumulate(known, 1) & np.logical_or.accumulate(known[:, ::-1], 1)[:, ::-1]
    filled = between & ~known & ~hidden
    shear = certain_shear(pictures.lines, shift, known)
    order = occlusion_order(pictures.left, shift, known)
    shift = np.nan_to_num(fill_background(np.where(known, shift, np.float32(np.nan))))
    maps = np.stack([shift, known, hidden, filled])
    maps = np.ascontiguousarray(maps[..., ::-1] if pictures.shift_m > 0 else maps)
    shift_on, matched, hidden_on, filled_on = torch.from_numpy(maps).to(pictures.device)
    baseline_m = torch.tensor(abs(pictures.shift_m), device="cpu")
    return RowMatches(shift_on, matched, hidden_on, filled_on, baseline_m, shear, order)


def with_hidden(matches: Matches, rows: RowMatches, focal_px: float) -> Matches:
    """Matches with the depth of the farther surface in the strips that the right view cannot see.

    Nothing is matched there, and a fit would carry the nearer surface on until the image has an edge. They
    count as much as the matches around them know (``known_share``).

    Args:
        matches: ``(1, 1, h, w)``, on any grid.
        rows: of the same images.
        focal_px: focal length along the rows, pixels of the grid of ``rows``.
    """
    layers = torch.stack([rows.shift, rows.hidden])[None]
    shift, hidden = F.interpolate(layers, matches.size, mode="nearest-exact").split(1, 1)
    put = (hidden > 0) & (shift > 0) & (matches.confidence < LEAST_KEPT)
    inverse_depth = shift / (focal_px * rows.baseline_m)
    confidence = HIDDEN_CONFIDENCE * known_share(matches)
    return replace(
        matches,
        inverse_depth=torch.where(put, inverse_depth, matches.inverse_depth),
        confidence=torch.where(put, confidence, matches.confidence),
        deviation=None if matches.deviation is None else torch.where(put, 1.0, matches.deviation),
    )
