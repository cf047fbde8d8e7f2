"""Matches along the rows of a rectified pair at full resolution, by OpenCV's semi-global matcher."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel
from geodiff_plugin._threads import BackgroundTask, sent_to_cpu
from geodiff_plugin.geometry import image_size, is_rectified, resize_image, size_within
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.consistency import known_share
from geodiff_plugin.matching.gaps import fill_background, find_gaps, hidden_gaps
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
#: Confidence of what is put into a hidden strip where the matches around it know enough: it is a guess that
#: the farther surface goes on, and on a blank wall the end of the strip is one as well.
HIDDEN_CONFIDENCE = 0.8
#: A match in a hidden strip is kept from this confidence on.
LEAST_KEPT = 0.05


class RowChecks(NamedTuple):
    """What the rows of a rectified pair say about its pictures."""

    shear: float  # of the right one along its rows, pixels per row, as far as it is certain (NaN: unknown)
    occlusion: float  # [-1, 1], below 0 where what is matched as far hides what is near (NaN: unknown)


class RowMatches(NamedTuple):
    """Matches along the rows of a rectified pair; maps ``(H, W)`` on the grid that they were sought on."""

    shift: Tensor  # pixels from where the point would be at infinity, >= 0
    matched: Tensor  # 1 where both views agree, else 0
    hidden: Tensor  # 1 in a gap between two that the right view cannot see (``hidden_gaps``)
    filled: Tensor  # 1 in another gap between two; the shift of a gap is that of its farther end
    baseline_m: Tensor  # () distance of the cameras, metres, on the CPU
    checks: BackgroundTask[RowChecks]  # still being worked out while the maps are used: the verdict asks

    @property
    def certain(self) -> Tensor:
        """1 where the shift is matched, or that of the surface which goes on behind a nearer one, else 0."""
        return self.matched + self.hidden


class RowPictures(NamedTuple):
    """A rectified pair as its rows are matched; mirrored if its second view is on the left."""

    greys: Callable[[], tuple[np.ndarray, np.ndarray]]  # left, right: (H, W) uint8; it waits for them
    lines: BackgroundTask[np.ndarray]  # (N, 4), ``upright_lines`` of the left one
    infinity_px: float  # disparity of a point at infinity
    focal_px: float  # of the left one, along the rows
    shift_m: np.floating[Any]  # of left points into the right frame, along the rows; above 0: mirrored
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
    return cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE)


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
    shift = raw.astype(np.float32)
    shift /= 16.0
    shift -= np.float32(infinity_px)
    return shift, shift >= MIN_SHIFT_PX  # OpenCV puts pixels without a match one pixel before the search


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
    K, K_right, T = (each.numpy(force=True) for each in (K_left, view.K, view.T_right_from_left))
    infinity, mirrored = float(K[0, 2] - K_right[0, 2]), bool(T[0, 3] > 0)
    levels = grey(torch.stack([left_01, view.image_01]))[:, 0] * 255.0
    received = sent_to_cpu(levels.round().byte())

    def greys() -> tuple[np.ndarray, np.ndarray]:
        # Mirrored, a view to the left becomes one to the right.
        both = (each[:, ::-1] if mirrored else each for each in received().numpy())
        left, right = map(np.ascontiguousarray, both)
        return left, right

    lines = BackgroundTask(lambda: upright_lines(greys()[0]), left_01.device)
    infinity = -infinity if mirrored else infinity
    return RowPictures(greys, lines, infinity, float(K[0, 0]), T[0, 3], left_01.device)


def _to_device(layers: Sequence[np.ndarray], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Maps ``(H, W)`` as ``(C, H, W)`` on a device.

    On CUDA the host does not wait for what the device still has to do, as with pageable memory it would.
    """
    on_cuda = device.type == "cuda"
    staged = torch.empty(len(layers), *layers[0].shape, dtype=dtype, device="cpu", pin_memory=on_cuda)
    np.stack(layers, out=staged.numpy())
    return staged.to(device, non_blocking=on_cuda)


def match_rows(pictures: RowPictures, nearest_px: float) -> RowMatches:
    """Match the rows of a pair; ``nearest_px`` is the largest shift of the search."""
    left, right = pictures.greys()
    shift, known = _row_shifts(left, right, pictures.infinity_px, nearest_px)
    gaps = find_gaps(known)
    is_hidden = hidden_gaps(shift, gaps, pictures.infinity_px)
    hidden, filled = (gaps.put(np.zeros_like(known), each) for each in (is_hidden, gaps.inner & ~is_hidden))
    whole = fill_background(shift, gaps) if known.any() else np.zeros_like(shift)
    way = slice(None, None, -1 if pictures.shift_m > 0 else 1)  # mirrored pictures are mirrored back
    (shift_on,) = _to_device([whole[:, way]], torch.float32, pictures.device)
    kinds = [each[:, way] for each in (known, hidden, filled)]
    matched, hidden_on, filled_on = _to_device(kinds, torch.bool, pictures.device).float()
    baseline_m = torch.tensor(abs(pictures.shift_m), device="cpu")

    def checked() -> RowChecks:
        shear = certain_shear(pictures.lines.result(), shift, known)
        return RowChecks(shear, occlusion_order(left, shift, gaps))

    checks = BackgroundTask(checked, pictures.device)
    return RowMatches(shift_on, matched, hidden_on, filled_on, baseline_m, checks)


class HiddenStrips(NamedTuple):
    """The strips of an image that the right view cannot see, ``(1, 1, h, w)`` each."""

    inside: Tensor  # bool
    inverse_depth: Tensor  # 1/m of the farther surface, which goes on in them


def hidden_strips(rows: RowMatches, size: tuple[int, int], focal_px: float) -> HiddenStrips:
    """The strips on a grid of ``size``; ``focal_px`` is the focal length on the grid of ``rows``."""
    layers = torch.stack([rows.shift, rows.hidden])[None]
    shift, hidden = F.interpolate(layers, size, mode="nearest-exact").split(1, 1)
    return HiddenStrips((hidden > 0) & (shift > 0), shift / (focal_px * rows.baseline_m))


def with_hidden(matches: Matches, strips: HiddenStrips) -> Matches:
    """Matches ``(1, 1, h, w)`` with the depth of the farther surface in the strips, on their grid.

    Nothing is matched there, and a fit would carry the nearer surface on until the image has an edge. They
    count as much as the matches around them know (``known_share``).
    """
    if use_kernel(matches.confidence) and matches.deviation is not None:
        from geodiff_plugin.matching import window_kernels as kernels

        inverse_depth, confidence, deviation = kernels.with_hidden(matches, matches.deviation, strips)
        return replace(matches, inverse_depth=inverse_depth, confidence=confidence, deviation=deviation)
    put = strips.inside & (matches.confidence < LEAST_KEPT)
    confidence = HIDDEN_CONFIDENCE * known_share(matches)
    return replace(
        matches,
        inverse_depth=torch.where(put, strips.inverse_depth, matches.inverse_depth),
        confidence=torch.where(put, confidence, matches.confidence),
        deviation=None if matches.deviation is None else torch.where(put, 1.0, matches.deviation),
    )
