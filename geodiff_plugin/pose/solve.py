"""Robust least squares over the poses of right cameras, under a prior centred on the given poses.

Minimises, over 6 degrees of freedom a right view and one inverse depth a track,
    trust * sum log(1 + (residual / scale)^2)
    + mean |moved|^2 / sd^2 + |turned|^2 / 1.5 deg^2 + |shifted|^2 / (.1 |t|)^2
    + (change of log |t|)^2 / .05^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin.messages import Message
from geodiff_plugin.pose.tracks import (
    Projected,
    Tracks,
    blocks,
    median_residuals,
    project_tracks,
    solve_inverse_depth,
    split_residuals,
)

#: Robust scale of a fit before its noise is known, pixels of the right view.
SCALE_PX = 0.7
#: A pose prior this wide leaves a pose free, except for the length of its baseline.
FREE_PX = 1e3
#: The user is warned if an estimated pose leaves depth a larger relative standard deviation than this.
MOST_SPREAD = 0.06
_STEPS = 12
# A refined pose may move points, also along their lines, by this share of the residual that it explains:
# (explained residual / (_FAULTS * faults))^4. Faults are errors of the cameras (rolling shutter, lenses, K),
# which the residuals of neighbours have in common.
_FAULTS = 5.6
# Bounds of that share: below, a free pose would hide the faults; above, the given pose was wrong.
_MOVED_SHARE = (0.2, 40.0)
# Least residual that counts, and least distance by which such a pose may move points, pixels.
_FLOOR_PX = 0.05
# Least size of the faults, pixels: no camera has none.
_LEAST_FAULT_PX = 0.03
# A rectified pair has another share and a narrower prior, because its cameras are bolted together; a pan that
# fits the rows better is more often an error of the lenses.
_RIG_MOVED_SHARE = 0.4
# They turn by tenths of a degree.
_RIG_TURNED_RAD = np.radians(0.3)
# They hardly shift, in baselines.
_RIG_SHIFTED_SHARE = 0.01
# Robust scale after the first fit, as a factor on its residual.
_SCALE_BY = 2.0
# The least such scale, pixels.
_LEAST_SCALE_PX = 0.1
# Weight of residuals: a half, because blocks of the image do not show all that neighbours have in common.
_COUNTS = 0.5
# If the given pose was wrong, only the matches determine the new one, and narrower fits follow: what most
# matches agree on is nearer to the truth than the best compromise between all.
_NARROWER_BY = (1.0, 0.5)


class _Terms(NamedTuple):
    """A cost of poses, and how it changes with a step of all of them (``_turned``)."""

    cost: float
    gradient: np.ndarray  # (6V,)
    normal: np.ndarray  # (6V, 6V), the normal matrix of Gauss and Newton


@dataclass(frozen=True)
class PosePrior:
    """Standard deviations of the given poses.

    What two views cannot determine, above all the baseline's length and a rotation that a shift compensates,
    stays as given: such a change costs here and does not lower the residuals.
    """

    moved_px: np.ndarray  # (V,) of where the tracks' points project to
    turned_rad: float = np.radians(1.5)  # of the rotation
    shifted_share: float = 0.1  # of the camera's centre, as a share of the baseline
    longer_share: float = 0.05  # of the baseline's length likewise


def _turned(T: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The right camera turned about its own centre by ``step[:3]`` and its origin moved by ``step[3:]``."""
    by = np.eye(4)
    by[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    moved = by @ T
    moved[:3, 3] += step[3:]
    return moved


def _jacobian(at: Projected, inverse_depth: np.ndarray) -> np.ndarray:
    """``(N, 2, 6)``: derivative of the projected pixels by ``_turned``'s step."""
    x, y, z = at.scaled.T
    zero = np.zeros_like(x)
    by_turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], -1).reshape(-1, 3, 3)
    return np.concatenate([at.by_point @ by_turn, at.by_point * inverse_depth[:, None, None]], axis=2)


class _Observed(NamedTuple):
    """The observations of tracks under some poses and inverse depths."""

    weights: np.ndarray  # (V, N) robust
    residuals: np.ndarray  # (V, N, 2) pixels
    projected: list[Projected]  # where the tracks fall in each right view


class _Whitened(NamedTuple):
    """Residuals of tracks and their derivatives, each times the root of its robust weight; n = 2 V."""

    cost: float  # sum of log(1 + (residual / scale)^2)
    inverse_depth: np.ndarray  # (N,) 1/m that fits a track best
    residuals: np.ndarray  # (N, n)
    left_by_pose: np.ndarray  # (N, n, 6V) derivative by every view's step (_turned), depth eliminated
    depth_by_pose: np.ndarray  # (N, 6V) what a step does to the inverse depth, times minus slopes
    slopes: np.ndarray  # (N,)


def _whitened(tracks: Tracks, Ts: np.ndarray, scale_px: float) -> _Whitened:
    """Residuals of the tracks under poses ``Ts``; above ``scale_px`` an observation counts for less."""
    views = len(Ts)
    w = solve_inverse_depth(tracks, Ts)
    for _ in range(2 if views > 1 else 0):
        w = solve_inverse_depth(tracks, Ts, _observed(tracks, Ts, w, scale_px).weights)
    weights, offs, ats = _observed(tracks, Ts, w, scale_px)
    by_pose = np.zeros((len(tracks), views, 2, 6 * views))
    by_depth = np.zeros((len(tracks), views, 2))
    for v, at in enumerate(ats):
        root = np.sqrt(weights[v])[:, None]
        by_pose[:, v, :, 6 * v : 6 * v + 6] = _jacobian(at, w) * root[..., None]
        by_depth[:, v] = at.by_inverse_depth * root
    r = (offs * np.sqrt(weights)[..., None]).transpose(1, 0, 2).reshape(len(tracks), -1)
    J, j = by_pose.reshape(len(tracks), 2 * views, -1), by_depth.reshape(len(tracks), -1)
    cost = np.log1p((offs**2).sum(-1) / scale_px**2)[tracks.seen].sum()
    slopes = np.maximum(np.linalg.norm(j, axis=1), 1e-12)
    along = j / slopes[:, None]
    depth_by_pose = np.einsum("nk,nkp->np", along, J)
    left_by_pose = J - along[..., None] * depth_by_pose[:, None]
    return _Whitened(float(cost), w, r, left_by_pose, depth_by_pose, slopes)


def _observed(tracks: Tracks, Ts: np.ndarray, w: np.ndarray, scale: float) -> _Observed:
    """The observations of tracks of inverse depth ``w (N,)``; ``scale`` in pixels is that of the weights."""
    ats = [project_tracks(tracks.rays, w, K, T) for K, T in zip(tracks.K_rights, Ts, strict=True)]
    offs = np.stack([at.px - px for at, px in zip(ats, tracks.right_px, strict=True)])
    weights = tracks.seen / (scale**2 + (offs**2).sum(-1))
    return _Observed(weights, offs, ats)


def _prior_terms(
    tracks: Tracks, Ts: np.ndarray, given: np.ndarray, w: np.ndarray, prior: PosePrior
) -> _Terms:
    """``sum_v |m_v|^2 / (n_v moved_px^2) + |r_v|^2 + |s_v|^2 + l_v^2``, its gradient and normal matrix.

    ``m_v`` are the moves in pixels of the ``n_v`` tracks of inverse depth ``w`` that view ``v`` sees, ``r_v``
    the turn from the given pose, ``s_v`` the shift, and ``l_v`` the log of the ratio of the baselines, the
    last three each over its standard deviation in ``prior``.
    """
    size = 6 * len(Ts)
    cost, gradient, normal = 0.0, np.zeros(size), np.zeros((size, size))
    for v, (T, T_given) in enumerate(zip(Ts, given, strict=True)):
        at, before = (project_tracks(tracks.rays, w, tracks.K_rights[v], P) for P in (T, T_given))
        seen = tracks.seen[v]
        unit = 1.0 / (prior.moved_px[v] * np.sqrt(max(seen.sum(), 1)))
        moved = ((at.px - before.px)[seen] * unit).reshape(-1)
        J = (_jacobian(at, w)[seen] * unit).reshape(-1, 6)
        change = T @ np.linalg.inv(T_given)
        turn = Rotation.from_matrix(change[:3, :3]).as_rotvec()
        length, baseline = (np.linalg.norm(P[:3, 3]) for P in (T, T_given))
        slope = np.repeat([1.0 / prior.turned_rad, 1.0 / (prior.shifted_share * baseline)], 3)
        pulls = slope * np.r_[turn, change[:3, 3]]
        longer = np.log(length / baseline) / prior.longer_share
        by_step = np.r_[np.zeros(3), T[:3, 3] / (length**2 * prior.longer_share)]
        block = slice(6 * v, 6 * v + 6)
        cost += moved @ moved + pulls @ pulls + longer**2
        gradient[block] += J.T @ moved + slope * pulls + by_step * longer
        normal[block, block] += J.T @ J + np.diag(slope**2) + np.outer(by_step, by_step)
    return _Terms(cost, gradient, normal)


def solve_poses(
    tracks: Tracks,
    given: np.ndarray,
    prior: PosePrior,
    *,
    start: np.ndarray | None = None,
    scale_px: float = 1.0,
    trust: float = 1.0,
) -> np.ndarray:
    """The poses ``(V, 4, 4)`` that fit the tracks of V right views best under the prior.

    They minimise ``trust sum log(1 + r^2 / scale_px^2)`` over the residuals ``r`` of the tracks, each at the
    inverse depth that fits it best, plus the cost of the prior (``_prior_terms``), by ``_STEPS`` damped steps
    of Gauss and Newton (Levenberg 1944; Marquardt 1963).

    ``given (V, 4, 4)``, ``T_right_from_left``, is the middle of the prior, ``start`` where to begin if not
    there; from a residual of ``scale_px``, pixels of the right view, an observation counts for less; the
    residuals count ``trust``, (0, 1], against the prior (``tracks.split_residuals``).
    """
    Ts = np.array(given if start is None else start, dtype=np.float64)
    w_start = np.clip(solve_inverse_depth(tracks, Ts), 0.0, None)

    def terms(at: np.ndarray) -> _Terms:
        data, held = _whitened(tracks, at, scale_px), _prior_terms(tracks, at, given, w_start, prior)
        J = data.left_by_pose  # with the inverse depths eliminated
        gradient, normal = np.einsum("nkp,nk->p", J, data.residuals), np.einsum("nkp,nkq->pq", J, J)
        return _Terms(
            trust * data.cost + held.cost,
            trust * gradient + held.gradient,
            trust * normal + held.normal,
        )

    damping, now = 1e-3, terms(Ts)
    for _ in range(_STEPS):
        damped = now.normal + damping * np.diag(np.diag(now.normal))
        step = np.linalg.solve(damped, -now.gradient)
        tried = np.stack([_turned(T, step[6 * v : 6 * v + 6]) for v, T in enumerate(Ts)])
        new = terms(tried)
        if new.cost >= now.cost:
            damping *= 8.0
            continue
        converged = now.cost - new.cost < 1e-6 * max(now.cost, 1.0)
        Ts, now, damping = tried, new, damping * 0.2
        if converged:
            break
    return Ts


def nearby_poses(sparse: Tracks, given: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Poses that fit the sparse matches, sought from far away first: then no match is an outlier yet."""
    before = np.nan_to_num(before, nan=1.0)
    prior, Ts = PosePrior(1.5 * before + _FLOOR_PX), given
    for scale in (max(float(before.max()), 1.0), 1.0):
        Ts = solve_poses(sparse, given, prior, start=Ts, scale_px=scale)
    return Ts


def regularised_poses(
    tracks: Tracks, given: np.ndarray, near: np.ndarray, before: np.ndarray, rig: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Poses that fit all matches; the better the given ones fit, the nearer to them.

    ``given`` and ``near (V, 4, 4)``, which fit roughly, are ``T_right_from_left``; ``before (V,)`` pixels,
    ``median_residuals`` of the poses as given; ``rig`` whether these are those of a rectified rig.

    Returns:
        ``(V, 4, 4)``: free where they explain nearly all of the residual, near the given ones where the
        cameras have faults that no pose explains, and where they are those of a rectified rig. And
        ``(V, 4, 4)``: those that fit best, but for the lengths of the baselines.
    """
    free = PosePrior(np.full(len(given), FREE_PX), longer_share=0.02)
    fitted = solve_poses(tracks, given, free, start=near, scale_px=SCALE_PX)
    left = np.maximum(median_residuals(tracks, fitted), _FLOOR_PX)
    explained = np.sqrt(np.clip(before**2 - left**2, 0.0, None))
    views = [tracks.view(v) for v in range(len(given))]
    parts = [split_residuals(view, T) if len(view) else None for view, T in zip(views, fitted, strict=True)]
    faults = np.array([np.nan if part is None else part.faults_px for part in parts])
    times = explained / (_FAULTS * np.maximum(faults, _LEAST_FAULT_PX))
    share = np.full_like(times, _RIG_MOVED_SHARE) if rig else np.clip(times**4, *_MOVED_SHARE)
    moved = np.maximum(np.nan_to_num(share * explained), _FLOOR_PX)
    counting = float(np.mean([part.trust for part in parts if part is not None]))
    held = PosePrior(moved, _RIG_TURNED_RAD, _RIG_SHIFTED_SHARE) if rig else PosePrior(moved)
    wrong = not rig and bool((times > 1.0).any())
    Ts = fitted
    for by in (_SCALE_BY, *(_NARROWER_BY if wrong else ())):
        scale_px = max(by * float(np.nanmean(left)), _LEAST_SCALE_PX)
        how = {"scale_px": scale_px, "trust": _COUNTS * counting}
        Ts = solve_poses(tracks, given, held, start=Ts, **how)
    return Ts, fitted


def depth_spread(tracks: Tracks, Ts: np.ndarray) -> float:
    """The relative standard deviation of depth caused by errors of free poses ``Ts (V, 4, 4)``.

    ``Ts`` are the best fit to the tracks, which may have outliers. The result is the median over the tracks;
    ``inf`` if none lies in front of the cameras. The covariance of the poses is the sandwich of robust
    statistics (Huber 1967; White 1982) over blocks of the image, because residuals of neighbours are not
    independent. The unit of length is taken as exact.
    """
    at = _whitened(tracks, Ts, SCALE_PX)
    ahead = at.inverse_depth > 0
    if not ahead.any():
        return float("inf")
    # Steps with translations in baselines, without the one that only changes the unit.
    unit = np.tile(np.repeat([1.0, np.linalg.norm(Ts[0, :3, 3])], 3), len(Ts))
    longer = np.concatenate([np.r_[np.zeros(3), T[:3, 3]] for T in Ts]) / unit
    free = unit[:, None] * np.linalg.svd(longer[None])[2][1:].T
    J = at.left_by_pose @ free
    of_track = blocks(tracks)
    pulls = np.zeros((of_track.max() + 1, J.shape[-1]))
    np.add.at(pulls, of_track, np.einsum("nkp,nk->np", J, at.residuals))
    inverse = np.linalg.pinv(np.einsum("nkp,nkq->pq", J, J))
    covariance = inverse @ (pulls.T @ pulls) @ inverse
    by_step = (at.depth_by_pose @ free)[ahead] / (at.slopes * at.inverse_depth)[ahead, None]
    return float(np.median(np.einsum("np,pq,nq->n", by_step, covariance, by_step)) ** 0.5)


def undetermined_pose(spread: float | None) -> tuple[Message, ...]:
    """A message where the matches do not determine an estimated pose; none for ``None``."""
    if spread is None or spread <= MOST_SPREAD:
        return ()
    sentence = (
        "The matches do not determine the estimated pose: by it alone depths may be off by "
        f"{100 * spread:.0f} % (one standard deviation). Take photographs that show more texture or are "
        "further apart, or give the pose."
    )
    return (Message("estimate.undetermined", sentence),)
