"""Matches the rows of a rectified pair at full resolution with OpenCV's semi-global matcher."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin.cameras import PosedViews, View, eroded, is_rectified, size_within
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.consistency import known_fraction
from geodiff_plugin.matching.constants import MIN_KEPT_CONFIDENCE, OCCLUDED_CONFIDENCE
from geodiff_plugin.matching.gaps import Gaps, fill_background, find_gaps, occluded_gaps
from geodiff_plugin.matching.matches import HalfOcclusions, Matches
from geodiff_plugin.matching.planes import MIN_SHIFT_PX

#: Parameters of OpenCV's matcher: keep matches that both views agree on, and remove speckles.
PARAMETERS = {
    "blockSize": 5,
    "uniquenessRatio": 10,
    "speckleWindowSize": 100,
    "speckleRange": 2,
    "disp12MaxDiff": 1,
}
#: Half width in pixels of the windows that must be completely valid: the matcher window, with a margin.
VALID_RADIUS = 3
#: Maximum shift as a fraction of the image width, which bounds the search time.
MAX_SHIFT = 0.3
#: Maximum number of pixels of the matched images; larger ones are downscaled.
MAX_PIXELS = 600_000


class RowMatches(NamedTuple):
    """Row matches of a rectified pair; maps ``(H, W)`` on the grid of the matching."""

    shift: Tensor  # pixels from the point's position at infinity, >= 0
    matched: Tensor  # 1 where both views agree, else 0
    occluded: Tensor  # 1 in a half-occlusion, a gap that the right view cannot see (``occluded_gaps``)
    filled: Tensor  # 1 in other gaps between two matches; a gap has the shift of its farther end
    baseline_m: Tensor  # () baseline, metres, on the CPU

    @property
    def certain(self) -> Tensor:
        """1 where the shift is matched, or belongs to a surface continuing behind a nearer one, else 0."""
        return self.matched + self.occluded


class RowImages(NamedTuple):
    """A rectified pair in the form in which its rows are matched."""

    levels: Tensor  # (2, H, W) uint8, left and right, on the device of the call
    infinity_px: float  # disparity of a point at infinity, after mirroring
    focal_px: float  # of the left camera, along the rows
    shift_m: np.floating[Any]  # from left points to the right frame, along the rows
    valid: np.ndarray | None = None  # (2, H, W) bool, compared pixels of both images; None for all

    @property
    def device(self) -> torch.device:
        """Device of the matches."""
        return self.levels.device

    @property
    def mirrored(self) -> bool:
        """Whether the second view is on the left; mirroring makes it a right view."""
        return bool(self.shift_m > 0)

    def greys(self, levels: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Return left and right image ``(H, W)`` uint8 from ``levels`` on the CPU, mirrored if necessary."""
        both = (each[:, ::-1] if self.mirrored else each for each in levels.numpy())
        left, right = map(np.ascontiguousarray, both)
        return left, right

    def compared(self) -> tuple[np.ndarray, np.ndarray] | None:
        """``valid`` of the left and of the right image, mirrored as ``greys``; ``None`` for all pixels."""
        if self.valid is None:
            return None
        left, right = self.valid[..., ::-1] if self.mirrored else self.valid
        return left, right

    def shift_px(self, inverse_depth: float) -> float:
        """Return the shift of points at an inverse depth, 1/m."""
        return inverse_depth * (self.focal_px * abs(float(self.shift_m)))


def make_matcher(lowest: int, count: int, channels: int, mode: int = cv2.STEREO_SGBM_MODE_SGBM_3WAY) -> Any:
    """Create OpenCV's matcher for ``count`` disparities from ``lowest``, for images with ``channels``."""
    area = channels * PARAMETERS["blockSize"] ** 2
    return cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=count,
        P1=8 * area,
        P2=32 * area,
        mode=mode,
        **PARAMETERS,
    )


def pad_columns(image: np.ndarray, count: int) -> np.ndarray:
    """Repeat the first column ``count`` times: OpenCV leaves that many columns empty."""
    return cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE)


def grid_of_rows(size: tuple[int, int]) -> tuple[int, int]:
    """Return the matching grid ``(H, W)`` for an image or map size, limited to ``MAX_PIXELS``."""
    return size_within(size, MAX_PIXELS)


def _row_shifts(
    left: np.ndarray, right: np.ndarray, infinity_px: float, nearest_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Match grey levels ``(H, W)`` uint8; returns float32 shifts from infinity, and where views agree.

    A point at infinity has the disparity ``infinity_px``. The search covers ``nearest_px`` more.
    """
    lowest = int(np.floor(infinity_px))
    count = 16 * max(1, int(np.ceil(min(nearest_px + 4.0, MAX_SHIFT * left.shape[1]) / 16)))
    pad = max(0, lowest + count)
    matcher = make_matcher(lowest, count, 1)
    raw = matcher.compute(pad_columns(left, pad), pad_columns(right, pad))[:, pad:]
    shift = raw.astype(np.float32)
    shift /= 16.0
    shift -= np.float32(infinity_px)
    return shift, shift >= MIN_SHIFT_PX  # OpenCV puts unmatched pixels one pixel before the search


def first_rectified_pair(native: PosedViews) -> RowImages | None:
    """Return the left image and the first view of the same size that is rectified with it, if any.

    ``native`` has the image and its right views at native size.
    """
    left = native.left
    size = grid_of_rows(native.size)
    for right in native.rights:
        if right.size == native.size and is_rectified(left.camera, right.camera, right.T_right_from_left):
            return row_images(left.resized(size), right.resized(size))
    return None


def row_images(left: View, right: View) -> RowImages:
    """Convert a rectified pair of one size for row matching, with the right view on either side."""
    K = left.camera.K
    K_right = right.camera.K
    T = right.T_right_from_left
    infinity = float(K[0, 2] - K_right[0, 2])
    mirrored = bool(T[0, 3] > 0)
    levels = grey(torch.stack([left.image_01, right.image_01]))[:, 0] * 255.0
    infinity = -infinity if mirrored else infinity
    return RowImages(levels.round().byte(), infinity, float(K[0, 0]), T[0, 3], _valid_of(left, right))


def _valid_of(left: View, right: View) -> np.ndarray | None:
    """Return ``RowImages.valid`` for two views of one size."""
    if left.valid is None and right.valid is None:
        return None
    masks = [
        np.ones(v.size, bool) if v.valid is None else eroded(v.valid, VALID_RADIUS).cpu().numpy()
        for v in (left, right)
    ]
    return np.stack(masks)


def _to_device(layers: Sequence[np.ndarray], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Copy maps ``(H, W)`` as ``(C, H, W)`` to a device.

    On CUDA, pinned memory keeps the host from waiting for pending device work.
    """
    on_cuda = device.type == "cuda"
    staged = torch.empty(len(layers), *layers[0].shape, dtype=dtype, device="cpu", pin_memory=on_cuda)
    np.stack(layers, out=staged.numpy())
    return staged.to(device, non_blocking=on_cuda)


class RowShifts(NamedTuple):
    """Row shifts of a pair, mirrored if its second view is on the left."""

    grey: np.ndarray  # (H, W) uint8, the left image
    shift: np.ndarray  # (H, W) float32 pixels from the point's position at infinity
    known: np.ndarray  # (H, W) bool, where both views agree on it
    gaps: Gaps  # gaps of ``known``


def match_rows(images: RowImages, greys: tuple[np.ndarray, np.ndarray], nearest_px: float) -> RowShifts:
    """Match the rows of ``images.greys``; ``nearest_px`` is the maximum shift."""
    left, right = greys
    shift, known = _row_shifts(left, right, images.infinity_px, nearest_px)
    compared = images.compared()
    if compared is not None:
        known &= compared[0] & _seen_valid(compared[1], shift + images.infinity_px)
    return RowShifts(left, shift, known, find_gaps(known))


def _seen_valid(valid: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Return whether the right pixels at a disparity ``(H, W)`` are valid; outside, the nearest counts."""
    height, width = disparity.shape
    column = np.rint(np.arange(width) - disparity).clip(0, width - 1).astype(int)
    return valid[np.arange(height)[:, None], column]


def row_matches(images: RowImages, shifts: RowShifts) -> RowMatches:
    """Copy the matches of ``match_rows`` to the device of the pair, with filled gaps."""
    _, shift, known, gaps = shifts
    compared = images.compared()
    inner = gaps.inner if compared is None else gaps.inner & gaps.all_of(compared[0])
    is_occluded = occluded_gaps(shift, gaps, images.infinity_px) & inner
    occluded, filled = (gaps.put(np.zeros_like(known), each) for each in (is_occluded, inner & ~is_occluded))
    whole = fill_background(shift, gaps) if known.any() else np.zeros_like(shift)
    direction = slice(None, None, -1 if images.mirrored else 1)  # mirrored images are mirrored back
    (shift_on,) = _to_device([whole[:, direction]], torch.float32, images.device)
    kinds = [each[:, direction] for each in (known, occluded, filled)]
    matched, occluded_on, filled_on = _to_device(kinds, torch.bool, images.device).float()
    return RowMatches(
        shift_on, matched, occluded_on, filled_on, torch.tensor(abs(images.shift_m), device="cpu")
    )


def half_occlusions(rows: RowMatches, size: tuple[int, int], focal_px: float) -> HalfOcclusions:
    """Return the half-occlusions on a grid of ``size``; ``focal_px`` belongs to the grid of ``rows``."""
    layers = torch.stack([rows.shift, rows.occluded])[None]
    shift, occluded = F.interpolate(layers, size, mode="nearest-exact").split(1, 1)
    return HalfOcclusions((occluded > 0) & (shift > 0), shift / (focal_px * rows.baseline_m))


@has_kernel(
    "matching.kernels.windows.with_occluded",
    when=lambda matches, strips: matches.deviation is not None,
)
def with_occluded(matches: Matches, strips: HalfOcclusions) -> Matches:
    """Fill half-occlusions of matches ``(1, 1, h, w)`` with the depth of the farther surface, on their grid.

    They have no matches, and a fit would extend the nearer surface up to the next image edge. Their weight is
    the data support by surrounding matches (``known_fraction``).
    """
    put = strips.inside & (matches.confidence < MIN_KEPT_CONFIDENCE)
    confidence = OCCLUDED_CONFIDENCE * known_fraction(matches)
    return replace(
        matches,
        inverse_depth=torch.where(put, strips.inverse_depth, matches.inverse_depth),
        confidence=torch.where(put, confidence, matches.confidence),
        deviation=None if matches.deviation is None else torch.where(put, 1.0, matches.deviation),
    )
