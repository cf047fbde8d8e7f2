"""Compares depth maps of frames: averages depths where they agree, replaces depths outvoted by others."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import torch

from geodiff_plugin.cameras import NEAREST, Camera, joined, keep_nearest
from geodiff_plugin.pose.tracks import match_features, reduced_grey, sift_features
from geodiff_plugin.result.sigma import depth_sigma
from geodiff_plugin.types import DepthFrame

#: Relative tolerance within which two depths of a point agree.
AGREEMENT_TOLERANCE = 0.06
#: Weight of a frame's own depth relative to another frame's, whose pixels are resampled.
OWN_WEIGHT = 2.0
#: Minimum weight of a depth, however low its confidence.
MIN_WEIGHT = 0.05
#: Fraction of the remaining uncertainty (1 - confidence) removed by an agreeing frame, times its confidence.
CONFIDENCE_GAIN = 0.4
#: Number of other frames that must agree with each other to replace an unconfirmed depth.
MIN_AGREEING = 2
#: Side in pixels of the median filter around replaced depths; the largest that OpenCV supports for floats.
MEDIAN_SIZE = 5
#: Number of iterations of the median filter.
MEDIAN_ITERATIONS = 3
#: Number of previous and following video frames that a frame is compared with.
NEIGHBOUR_FRAMES = 3
#: Confidence from which other frames do not outvote a depth in a scene that may move.
MIN_STATIC_CONFIDENCE = 0.8
#: Minimum number of inlier matches for a camera motion.
MIN_INLIERS = 20
#: Maximum reprojection error of an inlier match, in pixels of the downscaled images.
INLIER_PX = 1.5


class SeenIn(NamedTuple):
    """Projection of a frame's points into another frame's camera, ``(H, W)`` each."""

    row: np.ndarray  # row of the nearest pixel; 0 outside
    column: np.ndarray
    z: np.ndarray  # depth in its camera
    inside: np.ndarray  # whether inside the image


def seen_in(frame: DepthFrame, other: DepthFrame) -> SeenIn:
    """Project the points of ``frame`` into the camera of ``other``."""
    px, z = other.camera.project(other.camera.from_world(frame.world()))
    inside = other.camera.contains(px) & (frame.depth > 0)
    column, row = (np.rint(np.where(inside, at, 0)).astype(int) for at in np.moveaxis(px, -1, 0))
    return SeenIn(row, column, z, inside)


def agreed(frame: DepthFrame, others: Sequence[DepthFrame], moving: bool = False) -> DepthFrame:
    """Average a frame's depth with agreeing depth of other frames; set ``confirmed`` and ``observers``.

    Replaces a depth that no other frame confirms by one on which several others agree with more weight; if
    objects may be ``moving``, only at low confidence. Averages inverse depths, and applies a median filter
    around replaced depths.

    Source: Merrell et al. 2007, S4: depth maps rendered into one view, with support from agreeing maps.
    """
    weight = OWN_WEIGHT * (MIN_WEIGHT + frame.confidence)
    known = frame.depth > 0  # pixels that are not valid have no depth
    total = weight.copy()
    above = weight / np.where(known, frame.depth, 1.0)
    confirmed, observers = (np.zeros(frame.depth.shape, np.uint8) for _ in range(2))
    missing = 1.0 - frame.confidence
    for other in others:
        found = _compare(other, frame)
        observers += found.seen
        confirmed += found.agrees
        more = np.where(found.agrees, MIN_WEIGHT + found.confidence, 0.0)
        total += more
        above += more / np.where(found.agrees, found.depth, 1.0)
        missing = missing * np.where(found.agrees, 1.0 - CONFIDENCE_GAIN * found.confidence, 1.0)
    inverse = above / total
    confidence = 1.0 - missing
    unconfirmed = (
        known & (confirmed == 0) & (frame.confidence < (MIN_STATIC_CONFIDENCE if moving else np.inf))
    )
    seen_by = [rendered(other, frame, other.confidence) for other in others] if unconfirmed.any() else []
    for depth, _ in seen_by:  # a surface in front of ours contradicts it
        observers += unconfirmed & (depth > 0) & (depth < (1 - AGREEMENT_TOLERANCE) * frame.depth)
    if len(seen_by) >= MIN_AGREEING:
        vote = _vote(seen_by, unconfirmed)
        lost = (vote.supporters >= MIN_AGREEING) & (vote.weight > weight[unconfirmed])
        at = np.flatnonzero(unconfirmed)[lost]
        inverse.flat[at] = vote.inverse_depth[lost]
        confidence.flat[at] = vote.confidence[lost]
        confirmed.flat[at] = vote.supporters[lost]
        inverse = _median_around(inverse, at, known)
    depth = np.where(known, 1.0 / inverse, 0.0).astype(np.float32)
    return replace(
        frame,
        depth=depth,
        confidence=confidence.astype(np.float32),
        sigma=_agreed_sigma(frame, depth, confidence),
        confirmed=confirmed,
        observers=np.maximum(observers, confirmed),
    )


def _agreed_sigma(frame: DepthFrame, depth: np.ndarray, confidence: np.ndarray) -> np.ndarray | None:
    """Return the standard deviation ``(H, W)`` of a frame's depth after agreement; ``None`` without one.

    Agreeing frames raise the confidence, which bounds it (``depth_sigma`` without geometry). A depth that was
    replaced has the bound. The errors of poses are common to all frames, so averaging does not reduce it
    further.
    """
    if frame.sigma is None:
        return None
    bound = depth_sigma(depth, confidence)
    replaced = np.abs(depth - frame.depth) > AGREEMENT_TOLERANCE * frame.depth
    return np.where(replaced | ~(frame.sigma < bound), bound, frame.sigma).astype(np.float32)


def _median_around(inverse: np.ndarray, at: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Median-filter inverse depth ``(H, W)`` at and next to the pixels with flat indices ``at``.

    Only where the depth of the whole window is ``known``.
    """
    replaced = np.zeros(inverse.shape, np.uint8)
    replaced.flat[at] = 1
    near = cv2.dilate(replaced, np.ones((3, 3), np.uint8)) > 0
    if not known.all():
        near &= cv2.erode(known.astype(np.uint8), np.ones((MEDIAN_SIZE, MEDIAN_SIZE), np.uint8)) > 0
    for _ in range(MEDIAN_ITERATIONS):
        inverse = np.where(near, cv2.medianBlur(inverse.astype(np.float32), MEDIAN_SIZE), inverse)
    return inverse


class _Comparison(NamedTuple):
    """Another frame's depth of the point at each pixel of a frame, ``(H, W)`` each."""

    depth: np.ndarray  # in the frame's view
    confidence: np.ndarray
    seen: np.ndarray  # whether it observes the point, or a surface in front of it
    agrees: np.ndarray  # whether both depths agree


def _compare(other: DepthFrame, frame: DepthFrame) -> _Comparison:
    row, column, z, seen = seen_in(frame, other)
    other_depth = other.depth[row, column].astype(np.float64)
    points = other.camera.to_world(other.camera.rays(joined(column, row)) * other_depth[..., None])
    depth = frame.camera.from_world(points)[..., 2]
    depth = np.where(np.abs(depth) < NEAREST, NEAREST, depth)
    # The nearest pixel is up to half a pixel off the point, so only depths are compared.
    same = (
        seen
        & (np.abs(other_depth / z - 1) < AGREEMENT_TOLERANCE)
        & (np.abs(depth / np.where(frame.depth > 0, frame.depth, 1.0) - 1) < AGREEMENT_TOLERANCE)
    )
    # A point behind the other frame's surface is occluded in that frame, which does not contradict it.
    return _Comparison(
        depth, other.confidence[row, column], seen & (other_depth > (1 - AGREEMENT_TOLERANCE) * z), same
    )


def rendered(other: DepthFrame, frame: DepthFrame, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Render another frame's depth and ``values (H, W, ...)`` of its pixels into a frame's camera.

    Z-buffered: the nearest point wins. Fills gaps of a pixel or two; 0 where there is no point.
    """
    row, column, z, inside = seen_in(other, frame)
    row, column, z, values = row[inside], column[inside], z[inside], values[inside]
    cells = row * frame.depth.shape[1] + column
    nearest = torch.full((frame.depth.size,), torch.inf, dtype=torch.float64)
    keep_nearest(nearest, torch.from_numpy(cells), torch.from_numpy(z))
    is_nearest = z == nearest.numpy()[cells]
    pixels = row[is_nearest], column[is_nearest]
    depth = np.zeros(frame.depth.shape)
    shown = np.zeros((*frame.depth.shape, *values.shape[1:]), values.dtype)
    depth[pixels], shown[pixels] = z[is_nearest], values[is_nearest]
    _fill_gaps(depth, shown)
    return depth, shown


def _fill_gaps(depth: np.ndarray, values: np.ndarray) -> None:
    """Fill pixels with depth 0 from the pixels above, below, to the left and to the right, in this order."""
    height, width = depth.shape
    for v, u in ((0, 1), (2, 1), (1, 0), (1, 2)):
        gaps = depth == 0
        for target in (depth, values):
            around = np.pad(target, [(1, 1), (1, 1), *[(0, 0)] * (target.ndim - 2)])
            target[gaps] = around[v : v + height, u : u + width][gaps]


class _Vote(NamedTuple):
    """The depth supported by most of the other frames, ``(n,)`` each."""

    supporters: np.ndarray  # number of frames that agree
    weight: np.ndarray  # total weight of these frames
    inverse_depth: np.ndarray  # their mean
    confidence: np.ndarray  # their joint confidence


def _vote(seen_by: Sequence[tuple[np.ndarray, np.ndarray]], mask: np.ndarray) -> _Vote:
    """Find the depth that other frames agree on at the ``n`` pixels of a mask, from depth and confidence."""
    depths = np.stack([depth[mask] for depth, _ in seen_by])
    confidences = np.stack([confidence[mask] for _, confidence in seen_by])
    weights = np.where(depths > 0, MIN_WEIGHT + confidences, 0.0)
    inverse = 1.0 / np.where(depths > 0, depths, 1.0)
    best = _Vote(*(np.zeros(depths.shape[1]) for _ in _Vote._fields))
    for candidate in range(len(depths)):
        same = np.abs(inverse / inverse[candidate] - 1) < AGREEMENT_TOLERANCE
        same &= (depths > 0) & (depths[candidate] > 0)
        weight = (weights * same).sum(0)
        mean = (weights * same * inverse).sum(0) / np.maximum(weight, 1e-9)
        confidence = 1.0 - np.where(same, 1.0 - CONFIDENCE_GAIN * confidences, 1.0).prod(0)
        better = weight > best.weight
        candidate_vote = _Vote(same.sum(0), weight, mean, confidence)
        best = _Vote(*(np.where(better, new, old) for new, old in zip(candidate_vote, best, strict=True)))
    return best._replace(supporters=best.supporters.astype(np.uint8))


def scene_poses(frames: Iterable[tuple[DepthFrame, np.ndarray]]) -> list[list[np.ndarray]]:
    """Estimate camera-to-world poses of a video's frames from matches and depth, as a list per scene.

    Frames are in order with their images ``(H, W, 3)`` in [0, 1]; their ``E`` is ignored. If no camera motion
    fits, a new scene starts. The world frame of a scene is the camera of its first frame.
    """
    scenes = list[list[np.ndarray]]()
    before: _Image | None = None
    for frame, image in frames:
        grey, camera, _ = reduced_grey(torch.from_numpy(image).permute(2, 0, 1), frame.camera)
        depth = cv2.resize(frame.depth, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
        seen = _Image(sift_features(grey), camera, depth)
        T = None if before is None else _motion(before, seen)
        if T is None:
            scenes.append([np.eye(4)])
        else:
            scenes[-1].append(scenes[-1][-1] @ np.linalg.inv(T))
        before = seen
    return scenes


class _Image(NamedTuple):
    """Features, camera and depth used to estimate the camera motion."""

    features: tuple[np.ndarray, np.ndarray]  # from ``sift_features``
    camera: Camera
    depth: np.ndarray  # (H, W) on the grid of the camera


def _motion(before: _Image, after: _Image) -> np.ndarray | None:
    """Return ``T (4, 4)`` from the previous camera to the next; ``None`` if too few matches fit a motion."""
    pairs = match_features(before.features, after.features)
    if len(pairs) < MIN_INLIERS:
        return None
    px, seen = before.features[0][pairs[:, 0], :2], after.features[0][pairs[:, 1], :2]
    column, row = np.rint(px).astype(int).clip(0, np.array(before.depth.shape[::-1]) - 1).T
    points = before.camera.rays(px) * before.depth[row, column, None]
    K = after.camera.K
    fits, rotation, translation, inliers = cv2.solvePnPRansac(
        points, seen, K, None, reprojectionError=INLIER_PX
    )
    if not fits or len(inliers) < MIN_INLIERS:
        return None
    at = inliers[:, 0]
    rotation, translation = cv2.solvePnPRefineLM(points[at], seen[at], K, None, rotation, translation)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return T


def temporally_smoothed(
    scenes: Sequence[Sequence[np.ndarray]], load: Callable[[int], DepthFrame]
) -> Iterator[DepthFrame]:
    """Smooth the depth of a video temporally: compare every frame with its neighbours in its scene, in order.

    ``scenes`` is the result of ``scene_poses``; ``load(i)`` returns frame i, whose ``E`` is ignored.
    """
    poses = [(number, E) for number, scene in enumerate(scenes) for E in scene]

    @lru_cache(maxsize=2 * NEIGHBOUR_FRAMES + 1)
    def posed(i: int) -> DepthFrame:
        frame = load(i)
        return replace(frame, camera=replace(frame.camera, E=poses[i][1]))

    for i, (scene, _) in enumerate(poses):
        near = range(max(0, i - NEIGHBOUR_FRAMES), min(len(poses), i + NEIGHBOUR_FRAMES + 1))
        yield agreed(posed(i), [posed(j) for j in near if j != i and poses[j][0] == scene], moving=True)
