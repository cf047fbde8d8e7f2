"""Which usual mistake of a given pose or K would explain its misfit; nothing is repaired."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.tracks import FEWEST, Tracks, epipolar

INVERSE = Message(
    "pose.inverse",
    "The inverse pose explains the views better than the given one: are left and right swapped, "
    "is the sign of the baseline wrong, or is E world-to-camera?",
)
_OPENGL = Message(
    "pose.opengl",
    "The pose fits with the y and z axes of the cameras turned around: E seems to be in the axes of OpenGL "
    "or Blender (y up, z backward). Give diag(1, -1, -1, 1) @ E @ diag(1, -1, -1, 1).",
)
_OPENGL_INVERSE = Message(
    "pose.opengl-inverse", f"{_OPENGL} It also seems to be world-to-camera: invert it as well."
)
_TRANSPOSED = Message(
    "pose.transposed",
    "The pose fits with its rotation transposed: check the order of rows and columns in E.",
)
_KEPT_T = Message(
    "pose.mixed",
    "The pose fits with its rotation as it is and its translation that of the inverse: "
    "E mixes camera-to-world with world-to-camera.",
)
_K_SWAPPED = Message(
    "camera.swapped",
    "The views fit with the two camera matrices exchanged: K seems to be (K_right, K_left).",
)
_FACTORS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 2, 2.0, 3.0, 4.0)
# A match supports a pose if it lies in front of both cameras and this near to its epipolar line, pixels:
# coarsely, because a mistaken pose may be inexact as well, and finely, because with a short baseline even a
# wrong K or pose leaves most matches within a few pixels of their lines.
_NEAR_PX = (4.0, 1.5)
# A mistake must explain more matches than the given pose by this factor.
_CLEARLY = 2.0
# It must explain this share of all matches.
_AT_LEAST = 0.5
# It must explain this share of those that the nearby pose explains.
_NEARLY = 0.85
# An inexact pose may look like a mistake: another K or other axes can bring it near the matches, but not onto
# them. So either the median residual must be within this factor of the nearby pose's, or the candidate must
# lie far from the given pose, or have another K. If only the fine shares distinguish it from the given pose,
# both must hold.
_AS_EXACT = 1.2
# How far from the given pose counts as far, degrees.
_FAR_DEG = 5.0
# The same in shares of the baseline.
_FAR_SHIFT = 0.8
# Among candidates whose share is this near the largest, a finer measure decides.
_ALIKE = 0.95


class _Fit(NamedTuple):
    """How well matches support a pose."""

    shares: tuple[float, ...]  # of the matches that do, coarsely and finely
    median_px: float  # residual


class _Undone(NamedTuple):
    """Tracks and pose ``(4, 4)`` as they would be if a mistake had not been made."""

    mistake: Message
    tracks: Tracks
    T: np.ndarray


class _Candidate(NamedTuple):
    """A mistake that might explain the misfit."""

    mistake: Message
    fit: _Fit  # without the mistake
    far: bool  # whether the given pose is too far from that without the mistake to be merely inexact


def _fit(tracks: Tracks, T: np.ndarray) -> _Fit:
    ahead, off_px = _ahead(tracks, T)
    shares = tuple(float((ahead & (off_px < near_px)).mean()) for near_px in _NEAR_PX)
    return _Fit(shares, float(np.median(off_px)))


def _ahead(tracks: Tracks, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which matches ``(N,)`` lie in front of both cameras, and how far from their lines, pixels."""
    at = epipolar(tracks, T)
    ahead = (at.inverse_depth > 0) & ((tracks.rays @ T[2, :3] + at.inverse_depth * T[2, 3]) > 0)
    return ahead, np.abs(at.off_px)


def _fine_share(tracks: Tracks, T: np.ndarray) -> float:
    """The last of the shares of ``_fit``."""
    ahead, off_px = _ahead(tracks, T)
    return float((ahead & (off_px < _NEAR_PX[-1])).mean())


def _scaled_K(factor: float) -> Message:
    return Message(
        "camera.scaled",
        f"The views fit with K times {factor:g}: it seems to be for images of {1 / factor:.3g} times the "
        f"width and height of these. With s = {factor:g} take fx * s and (cx + 0.5) * s - 0.5, and likewise "
        "fy, cy.",
    )


def _scaled_focal(factor: float) -> Message:
    return Message(
        "camera.focal-scaled",
        f"The views fit with the focal lengths times {factor:.3g} and the principal point as it is: K seems "
        f"to be for images of {1 / factor:.3g} times the width and height of these, its principal point set "
        "to the middle.",
    )


def _undone(tracks: Tracks, T: np.ndarray) -> Iterator[_Undone]:
    """The tracks and the pose ``T (4, 4)`` without each of the usual mistakes."""
    inverse = np.linalg.inv(T)
    yield _Undone(INVERSE, tracks, inverse)
    yield _Undone(_OPENGL, tracks, OPENGL_FROM_OPENCV @ T @ OPENGL_FROM_OPENCV)
    yield _Undone(_OPENGL_INVERSE, tracks, OPENGL_FROM_OPENCV @ inverse @ OPENGL_FROM_OPENCV)
    turned, mixed = inverse.copy(), inverse.copy()
    turned[:3, :3] = inverse[:3, :3].T
    yield _Undone(_TRANSPOSED, tracks, np.linalg.inv(turned))
    mixed[:3, 3] = -inverse[:3, :3] @ inverse[:3, 3]  # the given one is that of world-to-camera
    yield _Undone(_KEPT_T, tracks, np.linalg.inv(mixed))
    if not np.allclose(tracks.K_left, tracks.K_rights[0], rtol=0.02):
        swapped = replace(tracks, K_left=tracks.K_rights[0], K_rights=tracks.K_left[None])
        yield _Undone(_K_SWAPPED, swapped, T)
    for factor in _FACTORS:
        Ks = np.stack([tracks.K_left, *tracks.K_rights])
        Ks[:, :2, :2] *= factor
        focal = replace(tracks, K_left=Ks[0], K_rights=Ks[1:])
        Ks = Ks.copy()
        Ks[:, :2, 2] = (Ks[:, :2, 2] + 0.5) * factor - 0.5
        scaled = replace(tracks, K_left=Ks[0], K_rights=Ks[1:])
        yield _Undone(_scaled_K(factor), scaled, T)
        yield _Undone(_scaled_focal(factor), focal, T)


def pose_change(given: np.ndarray, Ts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far poses ``Ts (V, 4, 4)`` lie from the given ones: ``(V,)`` degrees, shares of the baselines."""
    change = Ts @ np.linalg.inv(given)
    cosines = (np.trace(change[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    shifts = np.linalg.norm(change[:, :3, 3], axis=1) / np.linalg.norm(given[:, :3, 3], axis=1)
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))), shifts


def _likeliest(tracks: Tracks, T: np.ndarray) -> _Candidate:
    """The mistake with the largest share of matches; among similar ones that with the best fine fit."""
    candidates = []
    for each in _undone(tracks, T):
        (turned_deg,), (shift,) = pose_change(T[None], each.T[None])
        far = each.tracks is not tracks or turned_deg >= _FAR_DEG or shift >= _FAR_SHIFT
        candidates.append(_Candidate(each.mistake, _fit(each.tracks, each.T), bool(far)))
    for level in range(len(_NEAR_PX)):
        largest = max(each.fit.shares[level] for each in candidates)
        candidates = [each for each in candidates if each.fit.shares[level] >= _ALIKE * largest]
    return min(candidates, key=lambda each: each.fit.median_px)


def find_mistake(tracks: Tracks, T: np.ndarray, near: np.ndarray) -> Message | None:
    """The mistake that would make the matches of one right view fit, or ``None``.

    ``T (4, 4)`` is ``T_right_from_left`` as given, ``near`` the pose near it that fits best: where only
    that fits, the pose is inexact.
    """
    given = _fit(tracks, T)
    if all(_CLEARLY * share >= 1.0 for share in given.shares):  # no share is more than 1
        return None
    nearby = _fit(tracks, near)
    mistake, fit, far = _likeliest(tracks, T)
    if any(share <= _NEARLY * other for share, other in zip(fit.shares, nearby.shares, strict=True)):
        return None
    coarsely, finely = (
        share > max(_AT_LEAST, _CLEARLY * other)
        for share, other in zip(fit.shares, given.shares, strict=True)
    )
    exactly = fit.median_px <= _AS_EXACT * nearby.median_px
    clear = (exactly or far) if coarsely else (finely and exactly and far)
    return mistake if clear else None


def exchangeable(
    tracks: Tracks, given: np.ndarray, near: np.ndarray, sizes: Sequence[tuple[int, ...]]
) -> float:
    """Share of the matches that fit as well if near and far are exchanged, [0, 1]; NaN for too few.

    Near and far are exchanged where the pictures were given in the wrong order, mirrored or upside down. Of
    the matches that fit the poses ``near (V, 4, 4)``, it is the share that would fit these or the ``given``
    ones once that is undone, for the worst of the three and for the view that excludes it best. Parallel
    cameras see such matches behind infinity unless their principal points differ; others see them off their
    epipolar lines. ``sizes`` are ``(H, W)`` of the left image and of the right ones that the tracks are of.
    """
    shares = []
    tried = (near,) if near is given else (given, near)  # one, where the poses fit as given
    for v, poses in enumerate(zip(*tried, strict=True)):
        seen = tracks.view(v)
        if len(seen) < FEWEST:
            continue
        exchanged = list(_exchanged(seen, sizes[0], sizes[v + 1]))
        undone = max(_fine_share(each, T) for T in poses for each in exchanged)
        as_it_is = _fine_share(seen, near[v])
        shares.append(min(1.0, undone / as_it_is) if as_it_is > 0 else 1.0)
    return min(shares, default=math.nan)


def _exchanged(tracks: Tracks, left: tuple[int, ...], right: tuple[int, ...]) -> Iterator[Tracks]:
    """Tracks of one right view with the pictures exchanged, mirrored, and turned by 180 degrees."""
    yield replace(tracks, left_px=tracks.right_px[0], right_px=tracks.left_px[None])
    for turned in (np.array([True, False]), np.array([True, True])):
        left_px = np.where(turned, np.array(left[::-1]) - 1.0 - tracks.left_px, tracks.left_px)
        right_px = np.where(turned, np.array(right[::-1]) - 1.0 - tracks.right_px, tracks.right_px)
        yield replace(tracks, left_px=left_px, right_px=right_px)
