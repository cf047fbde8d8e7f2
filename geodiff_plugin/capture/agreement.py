"""Frames checked against each other's depth: averaged where they agree, outvoted where others agree."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import torch

from geodiff_plugin.pose.tracks import LONG_SIDE, grey_image, match_features, sift_features
from geodiff_plugin.types import DepthFrame

#: Two depths of one point agree within this share.
SAME_SHARE = 0.06
#: A frame's depth counts so many times that of another frame, whose pixels are resampled.
OWN_WEIGHT = 2.0
#: Every depth counts a little, however low its confidence.
LEAST_WEIGHT = 0.05
#: Confidence that one agreeing frame adds, as a share of what is missing to 1 and of its own confidence.
RISES = 0.4
#: So many other frames must agree with each other to replace a depth that none of them confirms.
OUTVOTES = 2
#: Side in pixels of the median that smooths depth around what others replace; OpenCV's largest for floats.
SMOOTHED = 5
#: Times that it is taken, one after the other.
ROUNDS = 3
#: Frames before and after a frame of a video that it is checked against.
STEADY = 3
#: Confidence from which others do not outvote what may have moved.
SURE = 0.8
#: The motion of a camera is known if so many matches fit it.
LEAST_INLIERS = 20
#: A match fits to within so many pixels of the shrunk pictures.
INLIER_PX = 1.5


class SeenIn(NamedTuple):
    """Where another frame's camera sees the points of a frame, ``(H, W)`` each."""

    row: np.ndarray  # of its nearest pixel; 0 outside
    column: np.ndarray
    z: np.ndarray  # depth in its camera
    inside: np.ndarray  # whether in its picture


def seen_in(frame: DepthFrame, other: DepthFrame) -> SeenIn:
    """Where the camera of ``other`` sees the points of ``frame``."""
    T = np.linalg.inv(other.E)
    points = (frame.world() @ T[:3, :3].T + T[:3, 3]) @ other.K.T
    z = points[:, 2].reshape(frame.depth.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (points[:, axis].reshape(z.shape) / z for axis in (0, 1))
        inside = (z > 1e-6) & (u > -0.5) & (v > -0.5)
        inside &= (u < other.depth.shape[1] - 0.5) & (v < other.depth.shape[0] - 0.5)
    row, column = (np.rint(np.where(inside, at, 0)).astype(int) for at in (v, u))
    return SeenIn(row, column, z, inside)


def agreed(frame: DepthFrame, others: Sequence[DepthFrame], moving: bool = False) -> DepthFrame:
    """A frame, with its depth averaged with that of others where they agree, ``confirmed`` and ``observers``.

    A depth that no other frame confirms gives way to a depth on which several others agree with more
    weight; where things may be ``moving``, only if its confidence is low. Inverse depths are averaged; a
    median smooths them around what others replace.

    Source: Merrell et al. 2007, S4: depth maps rendered into one view, supported by those that agree.
    """
    weight = OWN_WEIGHT * (LEAST_WEIGHT + frame.confidence)
    total, above = weight.copy(), weight / frame.depth
    confirmed, observers = (np.zeros(frame.depth.shape, np.uint8) for _ in range(2))
    missing = 1.0 - frame.confidence
    for other in others:
        said = _said_by(other, frame)
        observers += said.seen
        confirmed += said.agrees
        more = np.where(said.agrees, LEAST_WEIGHT + said.confidence, 0.0)
        total += more
        above += more / np.where(said.agrees, said.depth, 1.0)
        missing = missing * np.where(said.agrees, 1.0 - RISES * said.confidence, 1.0)
    inverse, confidence = above / total, 1.0 - missing
    alone = (confirmed == 0) & (frame.confidence < (SURE if moving else np.inf))
    seen_by = [rendered(other, frame, other.confidence) for other in others] if alone.any() else []
    for depth, _ in seen_by:  # a surface of another frame before ours speaks against ours
        observers += alone & (depth > 0) & (depth < (1 - SAME_SHARE) * frame.depth)
    if len(seen_by) >= OUTVOTES:
        vote = _vote(seen_by, alone)
        lost = (vote.votes >= OUTVOTES) & (vote.weight > weight[alone])
        at = np.flatnonzero(alone)[lost]
        inverse.flat[at] = vote.inverse_depth[lost]
        confidence.flat[at] = vote.confidence[lost]
        confirmed.flat[at] = vote.votes[lost]
        inverse = _smoothed_around(inverse, at)
    return replace(
        frame,
        depth=(1.0 / inverse).astype(np.float32),
        confidence=confidence.astype(np.float32),
        confirmed=confirmed,
        observers=np.maximum(observers, confirmed),
    )


def _smoothed_around(inverse: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Inverse depth ``(H, W)`` with a median at and beside the pixels of flat indices ``at``."""
    replaced = np.zeros(inverse.shape, np.uint8)
    replaced.flat[at] = 1
    near = cv2.dilate(replaced, np.ones((3, 3), np.uint8)) > 0
    for _ in range(ROUNDS):
        inverse = np.where(near, cv2.medianBlur(inverse.astype(np.float32), SMOOTHED), inverse)
    return inverse


class _Said(NamedTuple):
    """What another frame says of the point that each pixel of a frame shows, ``(H, W)`` each."""

    depth: np.ndarray  # in the frame's view
    confidence: np.ndarray
    seen: np.ndarray  # whether it sees the point, or a surface before it
    agrees: np.ndarray  # whether both depths agree


def _said_by(other: DepthFrame, frame: DepthFrame) -> _Said:
    row, column, z, seen = seen_in(frame, other)
    there = other.depth[row, column].astype(np.float64)
    moved = np.linalg.inv(frame.E) @ other.E
    rays = np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(other.K).T
    points = (rays * there[..., None]) @ moved[:3, :3].T + moved[:3, 3]
    depth = np.where(np.abs(points[..., 2]) < 1e-6, 1e-6, points[..., 2])
    # The nearest pixel lies up to half a pixel beside the point, so only depths are compared.
    same = seen & (np.abs(there / z - 1) < SAME_SHARE) & (np.abs(depth / frame.depth - 1) < SAME_SHARE)
    # A point behind what the other frame sees is hidden from it, which says nothing against ours.
    return _Said(depth, other.confidence[row, column], seen & (there > (1 - SAME_SHARE) * z), same)


def rendered(other: DepthFrame, frame: DepthFrame, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Another frame's depth, and ``values (H, W, ...)`` of its pixels, as a frame's camera sees them.

    The nearest point is seen. Gaps of a pixel or two between the points are filled; 0 where nothing is seen.
    """
    row, column, z, inside = seen_in(other, frame)
    order = np.argsort(-z[inside], kind="stable")  # the nearest is written last
    at = row[inside][order], column[inside][order]
    maps = np.zeros(frame.depth.shape), np.zeros((*frame.depth.shape, *values.shape[2:]), values.dtype)
    for into, of in zip(maps, (z, values), strict=True):
        into[at] = of[inside][order]
    height, width = frame.depth.shape
    for v, u in ((0, 1), (2, 1), (1, 0), (1, 2)):
        gaps = maps[0] == 0
        for into in maps:
            around = np.pad(into, [(1, 1), (1, 1), (0, 0)][: into.ndim])
            into[gaps] = around[v : v + height, u : u + width][gaps]
    return maps


class _Vote(NamedTuple):
    """The depth that most of the other frames agree on, ``(n,)`` each."""

    votes: np.ndarray  # number of frames that agree
    weight: np.ndarray  # of all of them
    inverse_depth: np.ndarray  # their mean
    confidence: np.ndarray  # their joint one


def _vote(seen_by: Sequence[tuple[np.ndarray, np.ndarray]], mask: np.ndarray) -> _Vote:
    """What the other frames agree on at the ``n`` pixels of a mask, by their depth and confidence."""
    depths = np.stack([depth[mask] for depth, _ in seen_by])
    sures = np.stack([confidence[mask] for _, confidence in seen_by])
    weights = np.where(depths > 0, LEAST_WEIGHT + sures, 0.0)
    inverse = 1.0 / np.where(depths > 0, depths, 1.0)
    best = _Vote(*(np.zeros(depths.shape[1]) for _ in _Vote._fields))
    for candidate in range(len(depths)):
        same = np.abs(inverse / inverse[candidate] - 1) < SAME_SHARE
        same &= (depths > 0) & (depths[candidate] > 0)
        weight = (weights * same).sum(0)
        mean = (weights * same * inverse).sum(0) / np.maximum(weight, 1e-9)
        sure = 1.0 - np.where(same, 1.0 - RISES * sures, 1.0).prod(0)
        better, by_these = weight > best.weight, _Vote(same.sum(0), weight, mean, sure)
        best = _Vote(*(np.where(better, new, old) for new, old in zip(by_these, best, strict=True)))
    return best._replace(votes=best.votes.astype(np.uint8))


def scene_poses(frames: Iterable[tuple[DepthFrame, np.ndarray]]) -> list[list[np.ndarray]]:
    """Camera-to-world poses of a video's frames from their matches and depth, a list for every scene.

    Frames come in order with their pictures ``(H, W, 3)`` in [0, 1]; their ``E`` is ignored. Where no motion
    fits, another scene begins. A scene's world is the camera of its first frame.
    """
    scenes = list[list[np.ndarray]]()
    before: _Picture | None = None
    for frame, picture in frames:
        image, factor = torch.from_numpy(picture).permute(2, 0, 1), LONG_SIDE / max(picture.shape)
        grey, K = grey_image(image, torch.from_numpy(frame.K), min(1.0, factor))
        depth = cv2.resize(frame.depth, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
        seen = _Picture(sift_features(grey), K, depth)
        T = None if before is None else _motion(before, seen)
        if T is None:
            scenes.append([np.eye(4)])
        else:
            scenes[-1].append(scenes[-1][-1] @ np.linalg.inv(T))
        before = seen
    return scenes


class _Picture(NamedTuple):
    """What the motion of a camera is found by."""

    features: tuple[np.ndarray, np.ndarray]  # of ``sift_features``
    K: np.ndarray  # (3, 3) pixels
    depth: np.ndarray  # (H, W) on its grid


def _motion(before: _Picture, after: _Picture) -> np.ndarray | None:
    """``T (4, 4)`` from the camera before to the one after; ``None`` where too few matches fit one."""
    pairs = match_features(before.features, after.features)
    if len(pairs) < LEAST_INLIERS:
        return None
    px, seen = before.features[0][pairs[:, 0], :2], after.features[0][pairs[:, 1], :2]
    column, row = np.rint(px).astype(int).clip(0, np.array(before.depth.shape[::-1]) - 1).T
    points = np.c_[px, np.ones(len(px))] @ np.linalg.inv(before.K).T * before.depth[row, column, None]
    fits, turn, shift, inliers = cv2.solvePnPRansac(points, seen, after.K, None, reprojectionError=INLIER_PX)
    if not fits or len(inliers) < LEAST_INLIERS:
        return None
    at = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(points[at], seen[at], after.K, None, turn, shift)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return T


def steadied(
    scenes: Sequence[Sequence[np.ndarray]], load: Callable[[int], DepthFrame]
) -> Iterator[DepthFrame]:
    """Every frame of a video in order, agreed with those before and after it in its scene.

    ``scenes`` are of ``scene_poses``; ``load(i)`` returns frame i, whose ``E`` is ignored.
    """
    poses = [(number, E) for number, scene in enumerate(scenes) for E in scene]

    @lru_cache(maxsize=2 * STEADY + 1)
    def posed(i: int) -> DepthFrame:
        return replace(load(i), E=poses[i][1])

    for i, (scene, _) in enumerate(poses):
        near = range(max(0, i - STEADY), min(len(poses), i + STEADY + 1))
        yield agreed(posed(i), [posed(j) for j in near if j != i and poses[j][0] == scene], moving=True)
