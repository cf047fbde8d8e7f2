"""Check which common error in a pose or K explains the misfit of matches, without correcting it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.pose.fit import pose_change
from geodiff_plugin.pose.tracks import MIN_MATCHES, Tracks, epipolar
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.inverse_pose import InversePose
from geodiff_plugin.trust.stages import TracksStage

#: Codes that every one of these errors suppresses.
NEGATIVE_DISPARITY = ("depth.negative-disparity", "camera.cx-mismatch")
OPENGL = FindingKind(
    "pose.opengl",
    REASON,
    "The pose seems to use OpenGL axes",
    cause="E comes from OpenGL or Blender, where y points up and z points backward.",
    hint="Pass diag(1, -1, -1, 1) @ E @ diag(1, -1, -1, 1).",
    explains=NEGATIVE_DISPARITY,
)
OPENGL_INVERSE = FindingKind(
    "pose.opengl-inverse",
    REASON,
    "The pose seems to be world-to-camera in OpenGL axes",
    cause="E comes from OpenGL or Blender, where y points up and z points backward, and it is the inverse "
    "(world-to-camera) pose.",
    hint="Pass inv(diag(1, -1, -1, 1) @ E @ diag(1, -1, -1, 1)).",
    explains=NEGATIVE_DISPARITY,
)
TRANSPOSED = FindingKind(
    "pose.transposed",
    REASON,
    "The rotation seems to be transposed",
    cause="Rows and columns of the rotation are swapped.",
    hint="Transpose E[:3, :3].",
    explains=NEGATIVE_DISPARITY,
)
MIXED = FindingKind(
    "pose.mixed",
    REASON,
    "E mixes a pose and its inverse",
    cause="E combines a camera-to-world rotation with a world-to-camera translation.",
    hint="Take both from the camera-to-world pose, whose translation is the camera position.",
    explains=NEGATIVE_DISPARITY,
)
VERTICAL = FindingKind(
    "pose.vertical",
    REASON,
    "The baseline seems to be along y, not along x",
    cause="The cameras are mounted one above the other, but only the length of the baseline was given, so it "
    "was assumed to be along x.",
    hint="Pass the pose with its translation along y (E, --E).",
    explains=NEGATIVE_DISPARITY,
)
SWAPPED_K = FindingKind(
    "camera.swapped",
    REASON,
    "The camera matrices seem to be swapped",
    cause="K was passed as (K_right, K_left).",
    hint="Pass K as (K_left, K_right).",
    explains=NEGATIVE_DISPARITY,
)
SCALED_K = FindingKind(
    "camera.scaled",
    REASON,
    "K seems to be for a different image size",
    cause="The images were resized, and K was not scaled.",
    hint="Scale K as the message describes.",
    explains=NEGATIVE_DISPARITY,
)
SCALED_FOCAL = FindingKind(
    "camera.focal-scaled",
    REASON,
    "The focal lengths seem to be for a different image size",
    cause="The images were resized, and only the principal point in K was adjusted.",
    hint="Scale fx and fy as the message describes.",
    explains=NEGATIVE_DISPARITY,
)
ORDER_INVERTED = FindingKind(
    "depth.inverted-order",
    REASON,
    "The depth order is inverted",
    cause="Left and right are swapped, the baseline has the wrong sign, E is world-to-camera, or the prior "
    "map is in a different prediction space (for example disparity instead of depth).",
    hint="Swap the images, flip the sign, invert E, or specify the map's prediction space (--space).",
    explains=("depth.order", *NEGATIVE_DISPARITY),
)

SCALE_FACTORS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 2, 2.0, 3.0, 4.0)
#: Maximum entry of the rotation's difference from the identity for parallel cameras.
PARALLEL = 1e-6
#: Maximum coarse and fine epipolar distances, pixels, of a match that supports a pose and is in front of both
#: cameras. The coarse one allows for a wrong pose that is also inaccurate. The fine one is needed because,
#: with a short baseline, even a wrong K or pose leaves most matches within a few pixels of their epipolar
#: lines.
NEAR_PX = (4.0, 1.5)
#: An error must explain more matches than the given pose by this factor.
CLEARLY = 2.0
#: An error must explain at least this fraction of all matches.
MIN_FRACTION = 0.5
#: An error must explain at least this fraction of the matches that the nearby pose explains.
NEARLY = 0.85
#: Maximum ratio of the candidate's median residual to the nearby pose's residual. An inaccurate pose can look
#: like an error, because another K or other axes can bring it close to the matches but not onto them. So
#: either this ratio must hold, or the candidate must be far from the given pose or have another K. If only
#: the fine fractions distinguish the candidate from the given pose, both conditions must hold.
AS_EXACT = 1.2
#: Minimum rotation between a far candidate and the given pose, degrees.
FAR_DEG = 5.0
#: Minimum translation between a far candidate and the given pose, as a fraction of the baseline.
FAR_SHIFT = 0.8
#: A finer measure decides between candidates whose fraction is at least this multiple of the largest.
ALIKE = 0.95


@dataclass(frozen=True)
class PoseError:
    """An error that explains the matches of a view."""

    code: str
    factor: float | None = None  # factor that would correct K


@dataclass(frozen=True)
class FoundErrors:
    """The errors of all right views, without duplicates."""

    found: tuple[PoseError, ...]


class PoseErrors(Check[FoundErrors]):
    """Detects common errors in poses and camera matrices by undoing each of them in turn.

    An error must explain clearly more matches than the given pose. It must also explain about as many matches
    as the best nearby pose, with a similar residual. Otherwise the pose is only inaccurate.
    """

    kinds = (
        ORDER_INVERTED, OPENGL, OPENGL_INVERSE, TRANSPOSED, MIXED, VERTICAL, SWAPPED_K, SCALED_K,
        SCALED_FOCAL,
    )  # fmt: skip

    @classmethod
    def of_tracks(cls, stage: TracksStage) -> FoundErrors:
        views = [
            (stage.tracks.view(v), *poses)
            for v, poses in enumerate(zip(stage.given, stage.nearby, strict=True))
        ]
        found = [find_pose_error(*view) for view in views if len(view[0]) >= MIN_MATCHES]
        return FoundErrors(tuple(dict.fromkeys(error for error in found if error is not None)))

    @classmethod
    def rules_out(cls, fact: FoundErrors | None) -> bool:
        return fact is None or not fact.found

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact, dense = facts[cls], facts[InversePose]
        found = () if fact is None else fact.found
        if (dense is not None and dense.inverse) or any(each.code == ORDER_INVERTED.code for each in found):
            yield inverted_order()
        yield from (_finding(each) for each in found if each.code != ORDER_INVERTED.code)


def inverted_order() -> Finding:
    """Create the finding that the depth order is inverted."""
    return Finding(
        ORDER_INVERTED,
        "The depth order is inverted. Check for swapped images, the baseline's sign, a world-to-camera E, "
        "and --space.",
    )


_AXES = (
    "E seems to use OpenGL or Blender axes (y up, z backward), so depth is wrong. Pass "
    "diag(1, -1, -1, 1) @ E @ diag(1, -1, -1, 1)."
)
_MESSAGES = {
    OPENGL: _AXES,
    OPENGL_INVERSE: f"{_AXES} It also seems to be world-to-camera: invert it as well.",
    TRANSPOSED: "The rotation in E seems to be transposed, so depth is wrong. Transpose E[:3, :3].",
    MIXED: "E seems to mix a camera-to-world rotation with a world-to-camera translation, so depth is wrong. "
    "Take both from the camera-to-world pose.",
    VERTICAL: "The baseline seems to be along the y axis, not the x axis: the cameras are mounted one above "
    "the other. Pass E with the translation (0, {factor:+g} * baseline, 0) in metres.",
    SWAPPED_K: "K seems to be passed as (K_right, K_left), so depth is wrong. Swap the two matrices.",
    SCALED_K: "K seems to be for images of {size:.3g} times this width and height, so depth is wrong. "
    "With s = {factor:g} use fx * s and (cx + 0.5) * s - 0.5, and likewise fy, cy.",
    SCALED_FOCAL: "The focal lengths seem to be for images of {size:.3g} times this width and height, so "
    "depth is wrong. Multiply fx and fy by {factor:.3g}; the principal point fits.",
}


def _finding(error: PoseError) -> Finding:
    kind = next(kind for kind in _MESSAGES if kind.code == error.code)
    if error.factor is None:
        return Finding(kind, _MESSAGES[kind])
    return Finding(kind, _MESSAGES[kind].format(factor=error.factor, size=1 / error.factor))


class _Support(NamedTuple):
    """Data support of a pose from matches."""

    fractions: tuple[float, ...]  # fractions of supporting matches, coarse and fine
    median_px: float  # median residual


class _Undone(NamedTuple):
    """Tracks and pose ``(4, 4)`` after an error is undone."""

    error: PoseError
    tracks: Tracks
    T: np.ndarray


class _Candidate(NamedTuple):
    """An error that may explain the misfit."""

    error: PoseError
    support: _Support  # support after the error is undone
    far: bool  # whether undoing the error changes the given pose or K by more than an inaccuracy


def _support(tracks: Tracks, T: np.ndarray) -> _Support:
    in_front, off_px = _in_front(tracks, T)
    fractions = tuple(float((in_front & (off_px < near_px)).mean()) for near_px in NEAR_PX)
    return _Support(fractions, float(np.median(off_px)))


def _in_front(tracks: Tracks, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which matches ``(N,)`` are in front of both cameras, and their epipolar distances, pixels."""
    at = epipolar(tracks, T)
    in_front = (at.inverse_depth > 0) & ((tracks.rays @ T[2, :3] + at.inverse_depth * T[2, 3]) > 0)
    return in_front, np.abs(at.off_px)


def fine_fraction(tracks: Tracks, T: np.ndarray) -> float:
    """Return the fraction of the matches within the fine epipolar distance."""
    in_front, off_px = _in_front(tracks, T)
    return float((in_front & (off_px < NEAR_PX[-1])).mean())


def _undone(tracks: Tracks, T: np.ndarray) -> Iterator[_Undone]:
    """Yield the tracks and the pose ``T (4, 4)`` with each of the common errors undone."""
    inverse = np.linalg.inv(T)
    differ = not np.allclose(tracks.K_left, tracks.K_rights[0], rtol=0.02)
    swapped = replace(tracks, K_left=tracks.K_rights[0], K_rights=tracks.K_left[None])
    if differ:  # swapped images of different cameras also have each other's K
        yield _Undone(PoseError(ORDER_INVERTED.code), swapped, inverse)
    yield _Undone(PoseError(ORDER_INVERTED.code), tracks, inverse)
    yield _Undone(PoseError(OPENGL.code), tracks, OPENGL_FROM_OPENCV @ T @ OPENGL_FROM_OPENCV)
    yield _Undone(PoseError(OPENGL_INVERSE.code), tracks, OPENGL_FROM_OPENCV @ inverse @ OPENGL_FROM_OPENCV)
    transposed, mixed = inverse.copy(), inverse.copy()
    transposed[:3, :3] = inverse[:3, :3].T
    yield _Undone(PoseError(TRANSPOSED.code), tracks, np.linalg.inv(transposed))
    mixed[:3, 3] = -inverse[:3, :3] @ inverse[:3, 3]  # the given translation is world-to-camera
    yield _Undone(PoseError(MIXED.code), tracks, np.linalg.inv(mixed))
    yield from (
        _Undone(PoseError(VERTICAL.code, sign), tracks, _vertical(T, sign)) for sign in _vertical_signs(T)
    )
    if differ:
        yield _Undone(PoseError(SWAPPED_K.code), swapped, T)
    for factor in SCALE_FACTORS:
        yield from (_Undone(*scaled, T) for scaled in _scaled(tracks, factor))


def _vertical_signs(T: np.ndarray) -> tuple[float, ...]:
    """Return the signs of a vertical baseline to try: both if the given pose describes a horizontal rig."""
    horizontal = np.allclose(T[:3, :3], np.eye(3), atol=PARALLEL) and not T[1:3, 3].any()
    return (1.0, -1.0) if horizontal else ()


def _vertical(T: np.ndarray, sign: float) -> np.ndarray:
    """Return the pose ``T`` with the right camera below (``sign`` 1) or above (-1) the left one."""
    vertical = T.copy()
    vertical[:3, 3] = 0.0, -sign * np.linalg.norm(T[:3, 3]), 0.0
    return vertical


def _scaled(tracks: Tracks, factor: float) -> Iterator[tuple[PoseError, Tracks]]:
    """Yield the tracks with K scaled by a factor, and with only the focal lengths scaled."""
    Ks = np.stack([tracks.K_left, *tracks.K_rights])
    Ks[:, :2, :2] *= factor
    focal = replace(tracks, K_left=Ks[0], K_rights=Ks[1:])
    Ks = Ks.copy()
    Ks[:, :2, 2] = (Ks[:, :2, 2] + 0.5) * factor - 0.5
    yield PoseError(SCALED_K.code, factor), replace(tracks, K_left=Ks[0], K_rights=Ks[1:])
    yield PoseError(SCALED_FOCAL.code, factor), focal


def _likeliest(tracks: Tracks, T: np.ndarray) -> _Candidate:
    """Return the error with the largest fraction of matches; among similar ones the best fine fit."""
    candidates = []
    for each in _undone(tracks, T):
        (rotation_deg,), (shift,) = pose_change(T[None], each.T[None])
        far = each.tracks is not tracks or rotation_deg >= FAR_DEG or shift >= FAR_SHIFT
        candidates.append(_Candidate(each.error, _support(each.tracks, each.T), bool(far)))
    for level in range(len(NEAR_PX)):
        largest = max(each.support.fractions[level] for each in candidates)
        candidates = [each for each in candidates if each.support.fractions[level] >= ALIKE * largest]
    return min(candidates, key=lambda each: each.support.median_px)


def find_pose_error(tracks: Tracks, T: np.ndarray, near: np.ndarray) -> PoseError | None:
    """Find the error that explains the misfit of one right view's matches; ``None`` if there is none.

    ``T (4, 4)`` is the given ``T_right_from_left``, and ``near`` is the best-fitting pose near it. If only
    ``near`` fits, the pose is merely inaccurate.
    """
    given = _support(tracks, T)
    if all(CLEARLY * fraction >= 1.0 for fraction in given.fractions):  # no fraction exceeds 1
        return None
    nearby, best = _support(tracks, near), _likeliest(tracks, T)
    return best.error if _explains(best, given, nearby) else None


def _explains(candidate: _Candidate, given: _Support, nearby: _Support) -> bool:
    """Whether an error, rather than an inaccurate pose, explains the matches."""
    support = candidate.support
    pairs = zip(support.fractions, nearby.fractions, strict=True)
    if any(fraction <= NEARLY * other for fraction, other in pairs):
        return False
    coarsely, finely = (
        fraction > max(MIN_FRACTION, CLEARLY * other)
        for fraction, other in zip(support.fractions, given.fractions, strict=True)
    )
    exactly = support.median_px <= AS_EXACT * nearby.median_px
    return (exactly or candidate.far) if coarsely else (finely and exactly and candidate.far)
