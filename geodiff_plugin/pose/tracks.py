"""``Tracks``: left points matched in the right images, and their residuals under poses (Eq. 25).

They are matched by SIFT, and by optical flow once there is a first depth.
"""

from __future__ import annotations

import functools
import math
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

from geodiff_plugin._certain import SD_PER_MAD
from geodiff_plugin._threads import available_cores
from geodiff_plugin.geometry import plane_rays, project_rays
from geodiff_plugin.matching.build import pilot_volume
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.types import PosedViews

#: Longer side of the left image that matches are sought on, pixels; residuals are in pixels of this grid.
LONG_SIDE = 832
# SIFT: ratio test of nearest and second nearest descriptor (Lowe 2004).
_RATIO = 0.8
# SIFT: upper bound on the points, which bounds the time of matching.
_MOST_POINTS = 4000
# SIFT: contrast threshold, low, so that blank walls give some points as well.
_CONTRAST = 0.01
# SIFT: upper bound on its threads, each of which keeps the memory of a picture.
_MOST_THREADS = 4
# Flow: side of a cell, which gives one match, pixels.
_CELL_PX = 10
# Flow: least standard deviation of the grey of a cell, of 255.
_LEAST_CONTRAST = 2.0
# Flow: bound on the forward-backward difference, pixels.
_THERE_AND_BACK_PX = 0.5
# Flow: bound on the flow, which only corrects a warp, pixels.
_FARTHEST_PX = 24.0
# Windows that spread matches into holes, pixels of the coarse sweep; each has a hundredth of the last weight.
_WINDOWS = (3, 7, 15, 31, 63)
# Least inverse depth, as a share of the largest.
_FARTHEST = 1e-3
#: With fewer matches than this a pose is not checked.
FEWEST = 40
#: Blocks a row of the left image, for what neighbouring residuals have in common.
_BLOCKS = 10
#: Fewest residuals of a block that say so.
_FEWEST_IN_BLOCK = 5
#: Fewest blocks.
_FEWEST_BLOCKS = 3
#: Nearer to its epipolar line than this a match says on which side of infinity it lies, pixels.
_ON_LINE_PX = 2.0
#: A match lies behind infinity if it is further than this from the point at infinity, pixels.
_BEHIND_PX = 1.0
#: How far matches lie behind infinity is measured at this quantile of all: of right pairs at most 2 % do.
_FARTHEST_BEHIND = 0.97
#: Least divisor.
TINY = 1e-12
#: A grey image ``(H, W)`` uint8 and its K ``(3, 3)`` float64.
GreyImage = tuple[np.ndarray, np.ndarray]


def rays_through(pixels: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Rays ``(N, 3)`` with z = 1 through pixels ``(N, 2)`` of a camera ``K (3, 3)``."""
    return np.linalg.solve(K, np.c_[pixels, np.ones(len(pixels))].T).T


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
        """``(N, 3)`` left rays with z = 1."""
        return rays_through(self.left_px, self.K_left)

    def kept(self, mask: np.ndarray | slice) -> Tracks:
        """The tracks of a boolean mask or an index."""
        left_px, right_px, seen = self.left_px[mask], self.right_px[:, mask], self.seen[:, mask]
        return replace(self, left_px=left_px, right_px=right_px, seen=seen)

    def alone(self, v: int) -> Tracks:
        """All tracks, with right view ``v`` alone."""
        at = slice(v, v + 1)
        return replace(self, right_px=self.right_px[at], seen=self.seen[at], K_rights=self.K_rights[at])

    def view(self, v: int) -> Tracks:
        """The tracks that right view ``v`` sees, of that view alone."""
        return self._views[v]

    @cached_property
    def _views(self) -> tuple[Tracks, ...]:
        return tuple(self.alone(v).kept(seen) for v, seen in enumerate(self.seen))

    def seen_anywhere(self) -> Tracks:
        """The tracks that at least one right view sees."""
        return self.kept(np.any(self.seen, axis=0))


def merge_tracks(parts: Sequence[Tracks]) -> Tracks:
    """Tracks of the same views one after the other."""
    return replace(
        parts[0],
        left_px=np.concatenate([p.left_px for p in parts]),
        right_px=np.concatenate([p.right_px for p in parts], axis=1),
        seen=np.concatenate([p.seen for p in parts], axis=1),
    )


class Projected(NamedTuple):
    """Tracks in one right view, at given inverse depths."""

    px: np.ndarray  # (N, 2)
    scaled: np.ndarray  # (N, 3) the points in the right frame times their inverse left depth
    by_point: np.ndarray  # (N, 2, 3) derivative of px by scaled
    by_inverse_depth: np.ndarray  # (N, 2) by inverse depth


def project_tracks(rays: np.ndarray, inverse_depth: np.ndarray, K: np.ndarray, T: np.ndarray) -> Projected:
    """Where a right camera ``K (3, 3)``, ``T_right_from_left (4, 4)`` sees points on left rays.

    ``rays (N, 3)`` have z = 1, ``inverse_depth (N,)`` is in 1/m, 0 for infinity.
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
    """Tracks of one right view, and the points of their epipolar lines that are nearest to the matches."""

    off_px: np.ndarray  # (N,) from the matches to these points, positive along the normals
    normals: np.ndarray  # (N, 2) of the lines
    inverse_depth: np.ndarray  # (N,) 1/m of these points, negative where rays diverge


def epipolar(tracks: Tracks, T: np.ndarray) -> Epipolar:
    """The least reprojection error of tracks of one right view, in closed form.

    At inverse depth w a left ray x projects to ``a + w b`` with ``a = K R x`` and ``b = K t``, a point of the
    line ``a x b``; of these the one nearest to the match is taken. Where ``a`` and ``b`` are parallel, the
    line is a point, and all values are 0.

    Args:
        tracks: of one right view; where it does not see a track, the values mean nothing.
        T: ``(4, 4)`` ``T_right_from_left``.
    """
    A, b = tracks.K_rights[0] @ T[:3, :3], tracks.K_rights[0] @ T[:3, 3]
    across_b = np.array([[0.0, b[2], -b[1]], [-b[2], 0.0, b[0]]])  # of a x b, the normal of the line
    ax, ay, az, nx, ny = np.concatenate([A, across_b @ A]) @ tracks.rays.T
    length = np.maximum(np.hypot(nx, ny), TINY)
    nx, ny = nx / length, ny / length
    x, y = tracks.right_px[0].T
    cx, cy, dx, dy = ax - x * az, ay - y * az, b[0] - x * b[2], b[1] - y * b[2]  # a and b from the match
    along_c, along_d = ny * cx - nx * cy, ny * dx - nx * dy
    inverse_depth = -along_c * along_d / np.maximum(along_d**2, TINY)
    return Epipolar((cy * dx - cx * dy) / length, np.stack([nx, ny], axis=1), inverse_depth)


def _linear_inverse_depth(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """The inverse depth with the least algebraic error, ``(N,)``."""
    above, below = np.zeros(len(tracks)), np.zeros(len(tracks))
    for right_px, seen, K, T in zip(tracks.right_px, tracks.seen, tracks.K_rights, Ts, strict=True):
        A, b = tracks.rays @ (K @ T[:3, :3]).T, K @ T[:3, 3]
        c = A[:, :2] - right_px * A[:, 2:]
        d = b[:2] - right_px * b[2]
        above -= np.where(seen, (c * d).sum(1), 0.0)
        below += np.where(seen, (d * d).sum(1), 0.0)
    return above / np.maximum(below, TINY)


def solve_inverse_depth(tracks: Tracks, Ts: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """The inverse depth ``(N,)`` 1/m of every track that fits its right pixels best.

    ``Ts (V, 4, 4)`` are ``T_right_from_left``, ``weights (V, N)``; the result is negative where rays diverge.
    With one right view it has a closed form, with more Gauss-Newton finds it.
    """
    if len(Ts) == 1:
        return np.where(tracks.seen[0], epipolar(tracks, Ts[0]).inverse_depth, 0.0)
    weights = tracks.seen.astype(float) if weights is None else weights * tracks.seen
    inverse_depth = _linear_inverse_depth(tracks, Ts)
    for _ in range(3):
        above, below = np.zeros(len(tracks)), np.full(len(tracks), TINY)
        for v, T in enumerate(Ts):
            at = project_tracks(tracks.rays, inverse_depth, tracks.K_rights[v], T)
            off = tracks.right_px[v] - at.px
            above += weights[v] * (at.by_inverse_depth * off).sum(1)
            below += weights[v] * (at.by_inverse_depth**2).sum(1)
        inverse_depth = inverse_depth + above / below
    return inverse_depth


def residuals_px(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Reprojection error of every observation under poses ``Ts (V, 4, 4)``; NaN where not seen.

    ``(V, N)`` pixels of the right views; with one right view it is the distance from the epipolar line.
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
    """Median distance from the epipolar lines, ``(V,)`` pixels, NaN for a view with too few matches."""
    views = [(tracks.view(v), T[None]) for v, T in enumerate(Ts)]
    return np.array([np.median(residuals_px(*v)) if len(v[0]) >= FEWEST else np.nan for v in views])


def blocks(tracks: Tracks) -> np.ndarray:
    """The block of the left image that every track lies in, ``(N,)``, numbered from 0 without gaps."""
    width = max(2.0 * tracks.K_left[0, 2], 1.0)  # that of an image whose principal point is near its middle
    column, row = (tracks.left_px // (width / _BLOCKS)).astype(int).T
    return np.unique(row * 1000 + column, return_inverse=True)[1]


class Behind(NamedTuple):
    """Matches beyond the point at infinity, among those on their epipolar lines; NaN for too few of these."""

    share: float  # of them
    px: float  # how far beyond the farthest of them lie, pixels; 0 where hardly any do


def behind_infinity(tracks: Tracks, Ts: np.ndarray) -> Behind:
    """Matches that lie behind infinity under poses ``Ts (V, 4, 4)``.

    Two rays that diverge meet behind the cameras. Of right cameras and poses only noise and wrong matches do
    so, by less than ``_BEHIND_PX``: in 73 right pairs up to 2 % of the matches did by more.
    """
    beyond_px = []
    for v, T in enumerate(Ts):
        seen = tracks.view(v)
        at = epipolar(seen, T)
        far = project_tracks(seen.rays, np.zeros(len(seen)), seen.K_rights[0], T).px
        nearest = seen.right_px[0] + at.off_px[:, None] * at.normals
        away_px = np.hypot(*(nearest - far).T)
        behind = (at.inverse_depth < 0) & (away_px > _BEHIND_PX)
        beyond_px.append(np.where(behind, away_px, 0.0)[np.abs(at.off_px) < _ON_LINE_PX])
    every_px = np.concatenate(beyond_px)
    if len(every_px) < FEWEST:
        return Behind(math.nan, math.nan)
    return Behind(float((every_px > 0).mean()), float(np.quantile(every_px, _FARTHEST_BEHIND)))


class SharedErrors(NamedTuple):
    """What neighbouring matches have in common, of one right view."""

    trust: float  # (0, 1], weight of a match, less where neighbours repeat each other's error
    faults_px: float  # standard deviation of the error that they share, pixels


def split_residuals(tracks: Tracks, T: np.ndarray) -> SharedErrors:
    """Split the residuals of matches into noise of their own and errors that neighbours share.

    Such errors are those that no pose explains (rolling shutter, lens distortion, K); with them many matches
    determine a pose no better than a few. The means of blocks of the image show them: the mean of ``n``
    independent residuals has ``1 / n`` of their variance. ``T (4, 4)`` fits tracks of one right view.
    """
    off = epipolar(tracks, T).off_px
    scale = max(SD_PER_MAD * float(np.median(np.abs(off))), 1e-3)
    kept = np.abs(off) < 3.0 * scale
    block = blocks(tracks.kept(kept))
    count = np.bincount(block)
    mean = np.bincount(block, off[kept]) / count
    enough = count >= _FEWEST_IN_BLOCK
    count, mean = count[enough], mean[enough]
    total = float((off[kept] ** 2).mean())
    inflated = (count * mean**2).mean() / total if len(count) else 1.0
    common = total
    if len(count) >= _FEWEST_BLOCKS:
        between = (mean**2).mean()
        common = between - max(total - between, 0.0) * (1.0 / count).mean()
    return SharedErrors(float(1.0 / max(inflated, 1.0)), float(max(common, 0.0) ** 0.5))


def grey_image(image_01: Tensor, K_image: Tensor, factor: float) -> GreyImage:
    """A grey image shrunk by a factor <= 1."""
    planes = image_01.detach().cpu().float()
    pixels = planes.permute(1, 2, 0)
    if len(planes) == 3:
        # Planes that OpenCV merges, which takes a fifth of the time of torch's copy.
        array = pixels.numpy() if pixels.is_contiguous() else cv2.merge(list(planes.numpy()))
        grey = cv2.cvtColor(array, cv2.COLOR_RGB2GRAY)
    else:
        grey = pixels.contiguous().numpy()[..., 0]
    K = K_image.numpy(force=True).astype(np.float64)
    height, width = grey.shape
    size = max(1, round(width * factor)), max(1, round(height * factor))
    if factor < 1.0:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        scale = np.array([size[0] / width, size[1] / height])
        K[:2, :2] *= scale[:, None]
        K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5
    return cv2.convertScaleAbs(grey, alpha=255.0), K


def grey_views(posed: PosedViews) -> list[GreyImage]:
    """The images, left one first, at about as many pixels per radian: on the grid of the matches."""
    views = [grey_image(posed.left_01, posed.K_left, min(1.0, LONG_SIDE / max(posed.size)))]
    for image, K_right, _ in posed.views:
        as_fine = float(np.float32(views[0][1][0, 0]) / K_right.numpy(force=True)[0, 0])
        views.append(grey_image(image, K_right, min(1.0, as_fine, 2 * LONG_SIDE / max(image.shape[-2:]))))
    return views


def sift_features(
    grey: np.ndarray, most: int = _MOST_POINTS, contrast: float = _CONTRAST
) -> tuple[np.ndarray, np.ndarray]:
    """Points ``(N, 4)`` float64 of a grey image ``(H, W)`` uint8, and their RootSIFT ``(N, 128)`` float32.

    Of each point x and y, the centre of the first pixel at (0, 0), diameter and degrees; descriptors have
    unit length (Arandjelovic and Zisserman 2012).
    """
    sift = cv2.SIFT.create(nfeatures=most, contrastThreshold=contrast)
    points, descriptors = sift.detectAndCompute(grey, None)
    if not points:
        return np.zeros((0, 4)), np.zeros((0, 128), np.float32)
    descriptors /= np.maximum(descriptors.sum(1, keepdims=True), 1e-7)
    root = np.sqrt(descriptors, out=descriptors)
    size, angle = [p.size for p in points], [p.angle for p in points]
    return np.c_[cv2.KeyPoint.convert(points), size, angle].astype(np.float64), root


def match_features(left: tuple[np.ndarray, np.ndarray], right: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Indices ``(M, 2)`` of features that are each other's nearest and pass the ratio test from the left."""
    if min(len(left[0]), len(right[0])) < 2:
        return np.zeros((0, 2), int)
    # Unit vectors: distance^2 = 2 - 2 alike. The product is torch's, because after one of NumPy the threads
    # of its BLAS keep all cores busy for a tenth of a second, waiting for another.
    alike = (torch.from_numpy(left[1]) @ torch.from_numpy(right[1]).T).numpy()
    rows = np.arange(len(alike))
    best = alike.argmax(1)
    nearest = alike[rows, best]
    mutual = alike.max(0)[best] == nearest  # several times as fast as argmax along columns
    alike[rows, best] = -1.0
    second = alike.max(1)
    kept = mutual & ((1.0 - nearest) < _RATIO**2 * (1.0 - second))
    return np.c_[rows[kept], best[kept]]


@functools.cache
def _feature_threads(process: int, scale: float) -> ThreadPoolExecutor:
    """Threads of a process for SIFT, which spends most of its time outside of Python's lock.

    Pictures of another scale have others: small ones, which take less time, do not wait for whole ones.
    They stay for the next pictures: a thread takes long to start while others have the lock, and the memory
    for the scales of a picture, some 100 MB, would come from the system and go back to it each time.
    """
    threads = min(available_cores(), _MOST_THREADS)
    return ThreadPoolExecutor(threads, thread_name_prefix=f"geodiff-features-{scale:g}")


def sparse_tracks(views: Sequence[GreyImage], scale: float = 1.0) -> Tracks:
    """SIFT points of the left image with their matches in the right ones, in pixels of these images.

    They are sought in images of ``scale`` times the size.
    """
    (_, K), *rights = views
    greys = [_shrunk(grey, scale) for grey, _ in views]
    found = _feature_threads(os.getpid(), scale).map(sift_features, greys)
    left, *of_rights = (
        (_enlarged(points[:, :2], small, grey), descriptors)
        for (points, descriptors), small, (grey, _) in zip(found, greys, views, strict=True)
    )
    right_px = np.zeros((len(rights), len(left[0]), 2))
    seen = np.zeros(right_px.shape[:2], bool)
    for v, right in enumerate(of_rights):
        of_left, of_right = match_features(left, right).T
        right_px[v, of_left], seen[v, of_left] = right[0][of_right], True
    K_rights = np.stack([K_right for _, K_right in rights])
    return Tracks(left[0], right_px, seen, K, K_rights).seen_anywhere()


def _shrunk(grey: np.ndarray, scale: float) -> np.ndarray:
    """An image ``(H, W)`` of ``scale`` times the size."""
    if scale == 1.0:
        return grey
    height, width = (max(1, round(side * scale)) for side in grey.shape)
    return cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)


def _enlarged(px: np.ndarray, small: np.ndarray, large: np.ndarray) -> np.ndarray:
    """Pixels ``(N, 2)`` of a small image in the large one that it was made of."""
    if small.shape == large.shape:
        return px
    return (px + 0.5) * (np.array(large.shape[::-1]) / small.shape[::-1]) - 0.5


def _flow(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Dense inverse search (Kroeger et al. 2016), ``(H, W, 2)`` pixels."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)
    return dis.calc(source, target, None)


def _read(field: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Values of a map ``(H, W, 2)`` at pixels ``(N, 2)``, bilinear."""
    at = px.astype(np.float32)[:, None]
    return cv2.remap(field, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]


def _dense_matches(
    left: np.ndarray, right: np.ndarray, uv: np.ndarray, visible: np.ndarray, centres: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Right pixels ``(N, 2)`` of cell centres, predicted by ``uv``, and which of them pass the checks."""
    warped = cv2.remap(right, uv, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    there, back = _flow(left, warped), _flow(warped, left)
    flow = _read(there, centres)
    landed = centres + flow
    off = np.linalg.norm(flow + _read(back, landed), axis=1)
    column, row = np.clip(np.rint(landed), 0, (left.shape[1] - 1, left.shape[0] - 1)).astype(int).T
    values, window = left.astype(np.float32), (_CELL_PX + 1,) * 2
    spread = cv2.blur(values**2, window) - cv2.blur(values, window) ** 2
    holds = (off < _THERE_AND_BACK_PX) & (np.linalg.norm(flow, axis=1) < _FARTHEST_PX) & visible[row, column]
    holds &= spread[centres[:, 1], centres[:, 0]] > _LEAST_CONTRAST**2
    holds &= ((landed >= 0) & (landed <= np.array(left.shape[::-1]) - 1)).all(1)
    return _read(uv, landed).astype(np.float64), holds


def coarse_depth(posed: PosedViews, size: tuple[int, int]) -> Tensor:
    """A rough, smooth depth without holes, ``(1, 1, H, W)`` metres: the matches of a coarse sweep, spread."""
    matches = match_volume(pilot_volume(posed))
    weight = matches.confidence[None] ** 2 + 1e-9
    values = matches.inverse_depth[None] * weight
    above, below = values.clone(), weight.clone()
    for i, window in enumerate(_WINDOWS):
        share = 100.0 ** -(i + 1)
        above += share * F.avg_pool2d(values, window, 1, window // 2, count_include_pad=False)
        below += share * F.avg_pool2d(weight, window, 1, window // 2, count_include_pad=False)
    inverse = F.avg_pool2d(above / below, 5, 1, 2, count_include_pad=False)
    depth_m = 1.0 / inverse.clamp_min(_FARTHEST * float(inverse.max()))
    return F.interpolate(depth_m.detach().cpu().float(), size, mode="bilinear", align_corners=False)


def dense_tracks(views: Sequence[GreyImage], depth_m: Tensor, Ts: np.ndarray) -> Tracks:
    """The centres of the left image's cells with their places by optical flow in the right images.

    ``depth_m (1, 1, H, W)`` is rough, on the left grid, without holes, and goes with the poses ``Ts
    (V, 4, 4)``, ``T_right_from_left``.
    """
    (left, K), *rights = views
    size = left.shape
    rows, columns = (np.arange(_CELL_PX // 2, side, _CELL_PX) for side in size)
    centres = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    right_px = np.zeros((len(Ts), len(centres), 2))
    seen = np.zeros((len(Ts), len(centres)), bool)
    for v, ((image, K_right), T) in enumerate(zip(rights, Ts, strict=True)):
        K_l, K_r, T_r = (torch.as_tensor(m, dtype=torch.float32, device="cpu")[None] for m in (K, K_right, T))
        rays = plane_rays(K_l, K_r, T_r, (size[0], size[1]))
        uv = project_rays(depth_m, rays)[0][0].numpy()  # outside of the image for points behind it
        visible = np.asarray(((uv >= 0) & (uv <= np.array(image.shape[::-1]) - 1)).all(-1))
        right_px[v], seen[v] = _dense_matches(left, image, uv, visible, centres)
    K_rights = np.stack([K_right for _, K_right in rights])
    return Tracks(centres.astype(np.float64), right_px, seen, K, K_rights).seen_anywhere()
