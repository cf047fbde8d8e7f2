"""``Tracks``: left points matched in the right images, and their residuals under poses (Eq. 25).

Matches are from SIFT, and from optical flow once there is an initial depth.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.statistics import SD_PER_MAD
from geodiff_plugin._internal.threads import available_cores
from geodiff_plugin.cameras import Camera, PosedViews, resized_mask, resized_px, scaled_size
from geodiff_plugin.geometry import plane_rays, project_rays
from geodiff_plugin.matching.build import coarse_volume
from geodiff_plugin.matching.consistency import match_volume, window_mean

#: Longer side of the left image for matching, pixels; residuals are in pixels of this grid.
LONG_SIDE = 832
# SIFT: ratio test of nearest and second nearest descriptor (Lowe 2004).
_RATIO = 0.8
# SIFT: maximum number of points, which bounds the matching time.
_MAX_POINTS = 4000
# SIFT: contrast threshold, low enough to find some points on textureless walls.
_CONTRAST = 0.01
# SIFT: an image is dark if 99 % of its grey levels, of 255, are below this. In 358 real images this quantile
# is 189 or more; with 12 % of the light it is about 25.
_DARK = 64
# SIFT: standard deviation of the blur of dark images, pixels: stretching the contrast amplifies the noise.
_DARK_BLUR_PX = 1.0
# SIFT: maximum number of threads, each of which holds the memory of one image.
_MAX_THREADS = 4
# Flow: side of a cell that gives one match, pixels.
_CELL_PX = 10
# Flow: minimum standard deviation of a cell's grey levels, of 255.
_MIN_CONTRAST = 2.0
# Flow: maximum forward-backward difference, pixels.
_MAX_ROUND_TRIP_PX = 0.5
# Flow: maximum flow, which only corrects a warp, pixels.
_MAX_PX = 24.0
# Radii of the windows that spread matches into holes, pixels of the coarse sweep; each has a hundredth of the
# weight of the previous one.
_RADII = (1, 3, 7, 15, 31)
# Minimum inverse depth, relative to the largest.
MIN_INVERSE_RATIO = 1e-3
#: Minimum number of matches for checking a pose.
MIN_MATCHES = 40
#: Number of image blocks per row for errors that neighbouring residuals share.
_BLOCKS = 10
#: Minimum number of residuals in a block.
_MIN_IN_BLOCK = 5
#: Minimum number of blocks.
_MIN_BLOCKS = 3
#: Lower bound of divisors.
TINY = 1e-12


class GreyImage(NamedTuple):
    """A grey image for feature matching."""

    grey: np.ndarray  # (H, W) uint8
    camera: Camera  # camera of the image, in float64
    valid: np.ndarray | None = None  # (H, W) bool; None for everywhere

    def keeps(self, px: np.ndarray, radius: np.ndarray | float) -> np.ndarray:
        """Return whether all pixels around pixels ``(N, 2)``, up to a radius, are valid, ``(N,)`` bool."""
        return np.ones(len(px), bool) if self.valid is None else surrounded(self.valid, px, radius)


def surrounded(valid: np.ndarray, px: np.ndarray, radius: np.ndarray | float) -> np.ndarray:
    """Return whether all pixels within a radius of pixels ``(N, 2)`` are ``valid (H, W)``, ``(N,)`` bool."""
    away = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    column, row = np.clip(np.rint(px), 0, np.array(away.shape[::-1]) - 1).astype(int).T
    return np.asarray(away[row, column] > radius)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points seen in the left image and in V right images."""

    left_px: np.ndarray  # (N, 2) float64
    right_px: np.ndarray  # (V, N, 2) float64
    seen: np.ndarray  # (V, N) bool, where right_px is known
    K_left: np.ndarray  # (3, 3)
    K_rights: np.ndarray  # (V, 3, 3)

    def __len__(self) -> int:
        return len(self.left_px)

    @cached_property
    def rays(self) -> np.ndarray:
        """Left rays ``(N, 3)`` with z = 1."""
        # Not computed by ``Camera.rays``, which differs in the last bit and would change refined poses.
        return np.linalg.solve(self.K_left, np.c_[self.left_px, np.ones(len(self))].T).T

    def right_rays(self, v: int) -> np.ndarray:
        """Return the rays ``(N, 3)`` of right view ``v`` with z = 1."""
        return Camera(self.K_rights[v]).rays(self.right_px[v])

    def kept(self, mask: np.ndarray | slice) -> Tracks:
        """Select tracks by a boolean mask or an index."""
        left_px = self.left_px[mask]
        right_px = self.right_px[:, mask]
        seen = self.seen[:, mask]
        return replace(self, left_px=left_px, right_px=right_px, seen=seen)

    def alone(self, v: int) -> Tracks:
        """Return all tracks, restricted to right view ``v``."""
        at = slice(v, v + 1)
        return replace(self, right_px=self.right_px[at], seen=self.seen[at], K_rights=self.K_rights[at])

    def view(self, v: int) -> Tracks:
        """Return the tracks that right view ``v`` sees, restricted to that view."""
        return self._views[v]

    @cached_property
    def _views(self) -> tuple[Tracks, ...]:
        return tuple(self.alone(v).kept(seen) for v, seen in enumerate(self.seen))

    def seen_anywhere(self) -> Tracks:
        """Return the tracks that at least one right view sees."""
        return self.kept(np.any(self.seen, axis=0))


def merge_tracks(parts: Sequence[Tracks]) -> Tracks:
    """Concatenate tracks of the same views."""
    return replace(
        parts[0],
        left_px=np.concatenate([p.left_px for p in parts]),
        right_px=np.concatenate([p.right_px for p in parts], axis=1),
        seen=np.concatenate([p.seen for p in parts], axis=1),
    )


class Projected(NamedTuple):
    """Projections of tracks into one right view, at given inverse depths."""

    px: np.ndarray  # (N, 2)
    scaled: np.ndarray  # (N, 3) points in the right frame times their inverse left depth
    by_point: np.ndarray  # (N, 2, 3) derivative of px by scaled
    by_inverse_depth: np.ndarray  # (N, 2) derivative by inverse depth


def project_tracks(rays: np.ndarray, inverse_depth: np.ndarray, K: np.ndarray, T: np.ndarray) -> Projected:
    """Project points on left rays into a right camera ``K (3, 3)``, ``T_right_from_left (4, 4)``.

    ``rays (N, 3)`` have z = 1; ``inverse_depth (N,)`` is in 1/m, 0 for infinity.
    """
    scaled = rays @ T[:3, :3].T + inverse_depth[:, None] * T[:3, 3]
    z = scaled[:, 2]
    z = np.where(np.abs(z) < 1e-6, 1e-6, z)
    flat = scaled[:, :2] / z[:, None]
    px = flat @ K[:2, :2].T + K[:2, 2]
    by_point = np.empty((len(rays), 2, 3))
    by_point[:, :, :2] = K[:2, :2] / z[:, None, None]
    by_point[:, :, 2] = -(flat @ K[:2, :2].T) / z[:, None]
    return Projected(px, scaled, by_point, by_point @ T[:3, 3])


class Epipolar(NamedTuple):
    """Tracks of one right view and the points on their epipolar lines nearest to the matches."""

    off_px: np.ndarray  # (N,) from the matches to these points, positive along the normals
    normals: np.ndarray  # (N, 2) of the lines
    inverse_depth: np.ndarray  # (N,) 1/m of these points, negative where rays diverge


def epipolar(tracks: Tracks, T: np.ndarray) -> Epipolar:
    """Compute the minimum reprojection error of tracks of one right view in closed form.

    At inverse depth w a left ray x projects to ``a + w b`` with ``a = K R x`` and ``b = K t``, a point on the
    line ``a x b``; the result is the point nearest to the match. If ``a`` and ``b`` are parallel, the line is
    a point and all values are 0.

    Args:
        tracks: tracks of one right view; values of tracks that it does not see are undefined.
        T: ``(4, 4)`` ``T_right_from_left``.
    """
    A = tracks.K_rights[0] @ T[:3, :3]
    b = tracks.K_rights[0] @ T[:3, 3]
    across_b = np.array([[0.0, b[2], -b[1]], [-b[2], 0.0, b[0]]])  # rows of a x b, the normal of the line
    ax, ay, az, nx, ny = np.concatenate([A, across_b @ A]) @ tracks.rays.T
    length = np.maximum(np.hypot(nx, ny), TINY)
    nx, ny = nx / length, ny / length
    x, y = tracks.right_px[0].T
    cx, cy, dx, dy = ax - x * az, ay - y * az, b[0] - x * b[2], b[1] - y * b[2]  # relative to the match
    along_c, along_d = ny * cx - nx * cy, ny * dx - nx * dy
    inverse_depth = -along_c * along_d / np.maximum(along_d**2, TINY)
    return Epipolar((cy * dx - cx * dy) / length, np.stack([nx, ny], axis=1), inverse_depth)


def _linear_inverse_depth(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Compute the inverse depth with the least algebraic error, ``(N,)``."""
    above, below = np.zeros(len(tracks)), np.zeros(len(tracks))
    for right_px, seen, K, T in zip(tracks.right_px, tracks.seen, tracks.K_rights, Ts, strict=True):
        A = tracks.rays @ (K @ T[:3, :3]).T
        b = K @ T[:3, 3]
        c = A[:, :2] - right_px * A[:, 2:]
        d = b[:2] - right_px * b[2]
        above -= np.where(seen, (c * d).sum(1), 0.0)
        below += np.where(seen, (d * d).sum(1), 0.0)
    return above / np.maximum(below, TINY)


def solve_inverse_depth(tracks: Tracks, Ts: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Compute the inverse depth ``(N,)`` 1/m of every track that fits its right pixels best.

    ``Ts (V, 4, 4)`` are ``T_right_from_left``, ``weights (V, N)``. The result is negative where rays diverge.
    It has a closed form for one right view and uses Gauss-Newton for several.
    """
    if len(Ts) == 1:
        return np.where(tracks.seen[0], epipolar(tracks, Ts[0]).inverse_depth, 0.0)
    weights = tracks.seen.astype(float) if weights is None else weights * tracks.seen
    inverse_depth = _linear_inverse_depth(tracks, Ts)
    for _ in range(3):
        above = np.zeros(len(tracks))
        below = np.full(len(tracks), TINY)
        for v, T in enumerate(Ts):
            at = project_tracks(tracks.rays, inverse_depth, tracks.K_rights[v], T)
            off = tracks.right_px[v] - at.px
            above += weights[v] * (at.by_inverse_depth * off).sum(1)
            below += weights[v] * (at.by_inverse_depth**2).sum(1)
        inverse_depth = inverse_depth + above / below
    return inverse_depth


def residuals_px(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Compute the reprojection error of every observation under poses ``Ts (V, 4, 4)``; NaN if not seen.

    ``(V, N)`` pixels of the right views; for one right view, the distance from the epipolar line.
    """
    if len(Ts) == 1:
        return np.where(tracks.seen, np.abs(epipolar(tracks, Ts[0]).off_px), np.nan)
    inverse_depth = solve_inverse_depth(tracks, Ts)
    off = [
        np.linalg.norm(project_tracks(tracks.rays, inverse_depth, K, T).px - px, axis=1)
        for px, K, T in zip(tracks.right_px, tracks.K_rights, Ts, strict=True)
    ]
    return np.where(tracks.seen, np.stack(off), np.nan)


def median_residuals(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Compute the median distance from the epipolar lines, ``(V,)`` pixels; NaN with few matches."""
    views = [(tracks.view(v), T[None]) for v, T in enumerate(Ts)]
    return np.array([np.median(residuals_px(*v)) if len(v[0]) >= MIN_MATCHES else np.nan for v in views])


def blocks(tracks: Tracks) -> np.ndarray:
    """Return the left image block of every track, ``(N,)``, numbered from 0 without gaps."""
    width = max(2.0 * tracks.K_left[0, 2], 1.0)  # width of an image whose principal point is near its centre
    column, row = (tracks.left_px // (width / _BLOCKS)).astype(int).T
    return np.unique(row * 1000 + column, return_inverse=True)[1]


class SharedErrors(NamedTuple):
    """Errors that neighbouring matches of one right view share."""

    trust: float  # (0, 1], weight of a match, lower if neighbours repeat each other's error
    faults_px: float  # standard deviation of the shared error, pixels


def split_residuals(tracks: Tracks, T: np.ndarray) -> SharedErrors:
    """Split the residuals of matches into independent noise and errors that neighbours share.

    Shared errors are those that no pose explains (rolling shutter, lens distortion, K). With them, many
    matches determine a pose no better than a few. They are measured from the means of image blocks: the mean
    of ``n`` independent residuals has ``1 / n`` of their variance. ``T (4, 4)`` is fitted to tracks of one
    right view.
    """
    off = epipolar(tracks, T).off_px
    scale = max(SD_PER_MAD * float(np.median(np.abs(off))), 1e-3)
    kept = np.abs(off) < 3.0 * scale
    block = blocks(tracks.kept(kept))
    count = np.bincount(block)
    mean = np.bincount(block, off[kept]) / count
    enough = count >= _MIN_IN_BLOCK
    count, mean = count[enough], mean[enough]
    total = float((off[kept] ** 2).mean())
    inflated = (count * mean**2).mean() / total if len(count) else 1.0
    common = total
    if len(count) >= _MIN_BLOCKS:
        between = (mean**2).mean()
        common = between - max(total - between, 0.0) * (1.0 / count).mean()
    return SharedErrors(float(1.0 / max(inflated, 1.0)), float(max(common, 0.0) ** 0.5))


def grey_image(image_01: Tensor, camera: Camera, factor: float, valid: Tensor | None = None) -> GreyImage:
    """Convert an image with valid pixels ``(H, W)`` bool to grey and downscale it by a factor <= 1."""
    planes = image_01.detach().cpu().float()
    pixels = planes.permute(1, 2, 0)
    if len(planes) == 3:
        # OpenCV merges the planes in a fifth of the time of torch's copy.
        array = pixels.numpy() if pixels.is_contiguous() else cv2.merge(list(planes.numpy()))
        grey = cv2.cvtColor(array, cv2.COLOR_RGB2GRAY)
    else:
        grey = pixels.contiguous().numpy()[..., 0]
    camera = Camera(camera.K.astype(np.float64), (grey.shape[1], grey.shape[0]))
    if factor < 1.0:
        size = scaled_size((grey.shape[0], grey.shape[1]), factor, factor)[::-1]
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        camera = camera.resized(size)
    grey = cv2.convertScaleAbs(grey, alpha=255.0)
    if valid is None:
        return GreyImage(grey, camera)
    return GreyImage(grey, camera, resized_mask(valid.cpu(), (grey.shape[0], grey.shape[1])).numpy())


def reduced_grey(image_01: Tensor, camera: Camera, valid: Tensor | None = None) -> GreyImage:
    """Convert an image to grey with at most ``LONG_SIDE`` pixels on its longer side."""
    return grey_image(image_01, camera, min(1.0, LONG_SIDE / max(image_01.shape[-2:])), valid)


def grey_views(posed: PosedViews) -> list[GreyImage]:
    """Convert the images, left one first, to grey with similar pixels per radian, on the matching grid."""
    left = reduced_grey(posed.left.image_01, posed.left.camera, posed.left.valid)
    rights = []
    for view in posed.rights:
        as_fine = float(np.float32(left.camera.K[0, 0]) / view.camera.K[0, 0])
        factor = min(1.0, as_fine, 2 * LONG_SIDE / max(view.size))
        rights.append(grey_image(view.image_01, view.camera, factor, view.valid))
    return [left, *rights]


def sift_features(
    grey: np.ndarray, max_points: int = _MAX_POINTS, contrast: float = _CONTRAST
) -> tuple[np.ndarray, np.ndarray]:
    """Extract points ``(N, 4)`` float64 of a grey image ``(H, W)`` uint8, and RootSIFT ``(N, 128)`` float32.

    Points have x and y, with the centre of the first pixel at (0, 0), diameter and angle in degrees.
    Descriptors have unit length (Arandjelovic and Zisserman 2012). The contrast of dark images is stretched.
    """
    grey = _stretched_if_dark(grey)
    sift = cv2.SIFT.create(nfeatures=max_points, contrastThreshold=contrast)
    points, descriptors = sift.detectAndCompute(grey, None)
    if not points:
        return np.zeros((0, 4)), np.zeros((0, 128), np.float32)
    descriptors /= np.maximum(descriptors.sum(1, keepdims=True), 1e-7)
    root = np.sqrt(descriptors, out=descriptors)
    size, angle = [p.size for p in points], [p.angle for p in points]
    return np.c_[cv2.KeyPoint.convert(points), size, angle].astype(np.float64), root


def _stretched_if_dark(grey: np.ndarray) -> np.ndarray:
    """Stretch the contrast of a dark image ``(H, W)`` uint8; return others as they are."""
    levels = np.cumsum(cv2.calcHist([grey], [0], None, [256], [0, 256]))
    low, high = np.searchsorted(levels, (0.01 * grey.size, 0.99 * grey.size))
    if high >= _DARK:
        return grey
    blurred = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _DARK_BLUR_PX)
    return np.clip(np.rint((blurred - low) * (255.0 / max(high - low, 1))), 0, 255).astype(np.uint8)


def match_features(left: tuple[np.ndarray, np.ndarray], right: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return indices ``(M, 2)`` of mutual nearest features that pass the ratio test from the left."""
    if min(len(left[0]), len(right[0])) < 2:
        return np.zeros((0, 2), int)
    # Unit vectors: distance^2 = 2 - 2 similarity. The product uses torch: after a NumPy product its BLAS
    # threads keep all cores busy for a tenth of a second, waiting for the next one.
    similarity = (torch.from_numpy(left[1]) @ torch.from_numpy(right[1]).T).numpy()
    rows = np.arange(len(similarity))
    best = similarity.argmax(1)
    nearest = similarity[rows, best]
    mutual = similarity.max(0)[best] == nearest  # several times as fast as argmax along columns
    similarity[rows, best] = -1.0
    second = similarity.max(1)
    kept = mutual & ((1.0 - nearest) < _RATIO**2 * (1.0 - second))
    return np.c_[rows[kept], best[kept]]


@functools.cache
def _feature_threads(process: int, scale: float) -> ThreadPoolExecutor:
    """Return a process's threads for SIFT, which mostly runs without the GIL.

    Every image scale has its own threads, so that small images, which take less time, do not wait for
    full-size ones. They are kept for later images: a thread starts slowly while others hold the GIL, and the
    memory for an image's scales, about 100 MB, would be allocated and freed every time.
    """
    threads = min(available_cores(), _MAX_THREADS)
    return ThreadPoolExecutor(threads, thread_name_prefix=f"geodiff-features-{scale:g}")


def sparse_tracks(views: Sequence[GreyImage], scale: float = 1.0) -> Tracks:
    """Match SIFT points of the left image in the right ones, in pixels of these images.

    Features are extracted from images scaled by ``scale``.
    """
    greys = [_downscaled(view.grey, scale) for view in views]
    found = _feature_threads(os.getpid(), scale).map(sift_features, greys)
    left, *of_rights = (
        _valid_features(_upscaled(points[:, :2], small, view.grey), points[:, 2] / scale, descriptors, view)
        for (points, descriptors), small, view in zip(found, greys, views, strict=True)
    )
    pairs = [match_features(left, right) for right in of_rights]
    return join_matches(views, [px for px, _ in (left, *of_rights)], pairs)


def join_matches(
    views: Sequence[GreyImage], found_px: Sequence[np.ndarray], pairs: Sequence[np.ndarray]
) -> Tracks:
    """Join matches of the left image in each right one to tracks.

    Args:
        views: images, left one first.
        found_px: ``(N, 2)`` pixels of the features of every image.
        pairs: ``(M, 2)`` indices of left and right features for each right image.
    """
    left_px, *of_rights = found_px
    right_px = np.zeros((len(of_rights), len(left_px), 2))
    seen = np.zeros(right_px.shape[:2], bool)
    for v, (px, (of_left, of_right)) in enumerate(zip(of_rights, (pair.T for pair in pairs), strict=True)):
        right_px[v, of_left], seen[v, of_left] = px[of_right], True
    K_left, *K_rights = (view.camera.K for view in views)
    return Tracks(left_px, right_px, seen, K_left, np.stack(K_rights)).seen_anywhere()


def _valid_features(
    px: np.ndarray, diameter: np.ndarray, descriptors: np.ndarray, view: GreyImage
) -> tuple[np.ndarray, np.ndarray]:
    """Keep the features ``(N, 2)`` of an image, with descriptors, that show valid pixels only."""
    if view.valid is None:
        return px, descriptors
    kept = view.keeps(px, diameter)
    return px[kept], descriptors[kept]


def _downscaled(grey: np.ndarray, scale: float) -> np.ndarray:
    """Scale an image ``(H, W)`` by ``scale``."""
    if scale == 1.0:
        return grey
    height, width = (max(1, round(side * scale)) for side in grey.shape)
    return cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)


def _upscaled(px: np.ndarray, small: np.ndarray, large: np.ndarray) -> np.ndarray:
    """Convert pixels ``(N, 2)`` of a downscaled image to the original one."""
    if small.shape == large.shape:
        return px
    return resized_px(px, (small.shape[1], small.shape[0]), (large.shape[1], large.shape[0]))


def _flow(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute dense inverse search flow (Kroeger et al. 2016), ``(H, W, 2)`` pixels."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)
    return dis.calc(source, target, None)


def _read(field: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Sample a map ``(H, W, 2)`` at pixels ``(N, 2)``, bilinear."""
    at = px.astype(np.float32)[:, None]
    return cv2.remap(field, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]


def _dense_matches(
    left: np.ndarray, right: np.ndarray, uv: np.ndarray, visible: np.ndarray, centres: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Match cell centres by optical flow from the left image to the right one, warped by a first guess.

    Args:
        left: ``(H, W)`` uint8.
        right: ``(h, w)`` uint8.
        uv: ``(H, W, 2)`` float32, the right pixel predicted for each left pixel.
        visible: ``(H, W)``, whether the prediction is inside the right image.
        centres: ``(N, 2)`` integer left pixels.

    Returns:
        Right pixels ``(N, 2)``, and ``(N,)`` whether each match passes the checks: small flow, confirmed by
        the backward flow, which ends in the visible part of the image, from a cell with enough contrast.
    """
    warped = cv2.remap(right, uv, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    forward, backward = _flow(left, warped), _flow(warped, left)
    flow = _read(forward, centres)
    ends = centres + flow  # pixels of the warped image
    last = np.array(left.shape[::-1]) - 1
    round_trip_px = np.linalg.norm(flow + _read(backward, ends), axis=1)
    column, row = np.clip(np.rint(ends), 0, last).astype(int).T
    holds = (round_trip_px < _MAX_ROUND_TRIP_PX) & (np.linalg.norm(flow, axis=1) < _MAX_PX)
    holds &= visible[row, column] & ((ends >= 0) & (ends <= last)).all(1)
    holds &= _local_variance(left)[centres[:, 1], centres[:, 0]] > _MIN_CONTRAST**2
    return _read(uv, ends).astype(np.float64), holds


def _local_variance(grey: np.ndarray) -> np.ndarray:
    """Compute the variance of grey levels in a window of one cell around each pixel."""
    values = grey.astype(np.float32)
    window = (_CELL_PX + 1,) * 2
    return cv2.blur(values**2, window) - cv2.blur(values, window) ** 2


def coarse_depth(posed: PosedViews, size: tuple[int, int]) -> Tensor:
    """Compute a rough, smooth depth without holes, ``(1, 1, H, W)`` metres, from a coarse sweep's matches."""
    matches = match_volume(coarse_volume(posed))
    weight = matches.confidence[None] ** 2 + 1e-9
    values = matches.inverse_depth[None] * weight
    above, below = values.clone(), weight.clone()
    for i, radius in enumerate(_RADII):
        fraction = 100.0 ** -(i + 1)
        above += fraction * window_mean(values, radius)
        below += fraction * window_mean(weight, radius)
    inverse = window_mean(above / below, 2)
    depth_m = 1.0 / inverse.clamp_min(MIN_INVERSE_RATIO * float(inverse.max()))
    return F.interpolate(depth_m.detach().cpu().float(), size, mode="bilinear", align_corners=False)


def dense_tracks(views: Sequence[GreyImage], depth_m: Tensor, Ts: np.ndarray) -> Tracks:
    """Match the centres of the left image's cells in the right images by optical flow.

    ``depth_m (1, 1, H, W)`` is approximate, on the left grid, without holes, and belongs to the poses ``Ts
    (V, 4, 4)``, ``T_right_from_left``.
    """
    left, *rights = views
    rows, columns = (np.arange(_CELL_PX // 2, side, _CELL_PX) for side in left.grey.shape)
    centres = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    right_px = np.zeros((len(Ts), len(centres), 2))
    seen = np.zeros((len(Ts), len(centres)), bool)
    valid = left.keeps(centres, _CELL_PX)
    for v, (right, T) in enumerate(zip(rights, Ts, strict=True)):
        rays = plane_rays(depth_m, [left.camera], [right.camera], [T])
        uv = project_rays(depth_m, rays)[0][0].numpy()  # outside the image for points behind the camera
        visible = np.asarray(((uv >= 0) & (uv <= np.array(right.grey.shape[::-1]) - 1)).all(-1))
        right_px[v], seen[v] = _dense_matches(left.grey, right.grey, uv, visible, centres)
        seen[v] &= valid & right.keeps(right_px[v], _CELL_PX)
    K_rights = np.stack([right.camera.K for right in rights])
    centres_px = centres.astype(np.float64)
    return Tracks(centres_px, right_px, seen, left.camera.K, K_rights).seen_anywhere()
