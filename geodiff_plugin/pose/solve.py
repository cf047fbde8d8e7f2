"""Robust least squares for the poses of right cameras, with a prior centred on the given poses.

Minimizes, over 6 degrees of freedom per right view and one inverse depth per track,
    trust * sum log(1 + (residual / scale)^2)
    + mean |displacement|^2 / sd^2 + |rotation|^2 / 1.5 deg^2 + |shift|^2 / (.1 |t|)^2
    + (change of log |t|)^2 / .05^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin.findings import Finding
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
#: Standard deviation of a pose prior that leaves a pose free except for its baseline length, pixels.
FREE_PX = 1e3
#: Relative standard deviation of depth above which an estimated pose triggers a warning.
MAX_DEPTH_REL_STD = 0.06
_STEPS = 12
# A refined pose may displace points, also along their lines, by a fraction of the residual that it explains:
# (explained residual / (_FAULTS * faults))^4. Faults are errors of the cameras (rolling shutter, lenses, K),
# which neighbouring residuals share.
_FAULTS = 5.6
# Bounds of that fraction: with a larger lower bound, a free pose would absorb the faults; at the upper bound,
# the given pose was wrong.
_DISPLACEMENT_FRACTION = (0.2, 40.0)
# Minimum residual, and minimum displacement that such a pose allows, pixels.
_FLOOR_PX = 0.05
# Minimum size of the faults, pixels: no camera has none.
_MIN_ERROR_PX = 0.03
# A rectified pair has another fraction and a narrower prior, because its cameras are rigidly mounted. A
# rotation about the vertical axis that fits the rows better is more often a lens error.
_RIG_DISPLACEMENT_FRACTION = 0.4
# Standard deviation of a rig's rotation: tenths of a degree.
_RIG_ROTATION_RAD = np.radians(0.3)
# Standard deviation of a rig's shift, in baselines.
_RIG_SHIFT_FRACTION = 0.01
# Robust scale after the first fit, as a multiple of its residual.
_SCALE_FACTOR = 2.0
# Minimum of that scale, pixels.
_MIN_SCALE_PX = 0.1
# Weight of residuals: one half, because image blocks do not show all errors that neighbours share.
_DATA_WEIGHT = 0.5
# If the given pose was wrong, only the matches determine the new one, and fits with smaller scales follow:
# the consensus of most matches is more accurate than the best compromise between all.
_FINAL_FACTORS = (1.0, 0.5)


class _Terms(NamedTuple):
    """Cost of poses with its derivatives by a step of all of them (``_apply_step``)."""

    cost: float
    gradient: np.ndarray  # (6V,)
    normal: np.ndarray  # (6V, 6V), Gauss-Newton normal matrix


@dataclass(frozen=True)
class PosePrior:
    """Standard deviations of the given poses.

    Quantities that two views do not determine, above all the baseline length and a rotation compensated by a
    shift, are kept as given: changing them has a cost here and does not lower the residuals.
    """

    displacement_px: np.ndarray  # (V,) of the projections of the tracks' points
    rotation_rad: float = np.radians(1.5)  # of the rotation
    shift_fraction: float = 0.1  # of the camera centre, relative to the baseline
    length_fraction: float = 0.05  # of the baseline length, relative


def _apply_step(T: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Rotate the right camera about its centre by ``step[:3]`` and translate its origin by ``step[3:]``."""
    by = np.eye(4)
    by[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    displaced = by @ T
    displaced[:3, 3] += step[3:]
    return displaced


def _jacobian(at: Projected, inverse_depth: np.ndarray) -> np.ndarray:
    """Compute the derivative ``(N, 2, 6)`` of the projected pixels by the step of ``_apply_step``."""
    x, y, z = at.scaled.T
    zero = np.zeros_like(x)
    by_turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], -1).reshape(-1, 3, 3)
    return np.concatenate([at.by_point @ by_turn, at.by_point * inverse_depth[:, None, None]], axis=2)


class _Observed(NamedTuple):
    """Residuals of tracks for given poses and inverse depths."""

    weights: np.ndarray  # (V, N) robust
    residuals: np.ndarray  # (V, N, 2) pixels
    projected: list[Projected]  # projections into each right view


class _Whitened(NamedTuple):
    """Residuals of tracks and their derivatives, times the square root of their robust weights; n = 2 V."""

    cost: float  # sum of log(1 + (residual / scale)^2)
    inverse_depth: np.ndarray  # (N,) 1/m, best fit of each track
    residuals: np.ndarray  # (N, n)
    left_by_pose: np.ndarray  # (N, n, 6V) derivative by every view's step (_apply_step), depth eliminated
    depth_by_pose: np.ndarray  # (N, 6V) change of the inverse depth by a step, times minus slopes
    slopes: np.ndarray  # (N,)


def _whitened(tracks: Tracks, Ts: np.ndarray, scale_px: float) -> _Whitened:
    """Compute residuals of the tracks under poses ``Ts``; above ``scale_px`` observations weigh less."""
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
    J = by_pose.reshape(len(tracks), 2 * views, -1)
    j = by_depth.reshape(len(tracks), -1)
    cost = np.log1p((offs**2).sum(-1) / scale_px**2)[tracks.seen].sum()
    slopes = np.maximum(np.linalg.norm(j, axis=1), 1e-12)
    along = j / slopes[:, None]
    depth_by_pose = np.einsum("nk,nkp->np", along, J)
    left_by_pose = J - along[..., None] * depth_by_pose[:, None]
    return _Whitened(float(cost), w, r, left_by_pose, depth_by_pose, slopes)


def _observed(tracks: Tracks, Ts: np.ndarray, w: np.ndarray, scale: float) -> _Observed:
    """Project tracks of inverse depth ``w (N,)``; ``scale`` is the weights' robust scale, pixels."""
    ats = [project_tracks(tracks.rays, w, K, T) for K, T in zip(tracks.K_rights, Ts, strict=True)]
    offs = np.stack([at.px - px for at, px in zip(ats, tracks.right_px, strict=True)])
    weights = tracks.seen / (scale**2 + (offs**2).sum(-1))
    return _Observed(weights, offs, ats)


def _prior_terms(
    tracks: Tracks, Ts: np.ndarray, given: np.ndarray, w: np.ndarray, prior: PosePrior
) -> _Terms:
    """Compute ``sum_v |m_v|^2 / (n_v displacement_px^2) + |r_v|^2 + |s_v|^2 + l_v^2`` with its derivatives.

    ``m_v`` are the displacements in pixels of the ``n_v`` tracks of inverse depth ``w`` that view ``v`` sees,
    ``r_v`` the rotation from the given pose, ``s_v`` the shift, and ``l_v`` the log ratio of the baselines;
    the last three are divided by their standard deviations in ``prior``.
    """
    size = 6 * len(Ts)
    cost = 0.0
    gradient = np.zeros(size)
    normal = np.zeros((size, size))
    for v, (T, T_given) in enumerate(zip(Ts, given, strict=True)):
        at, before = (project_tracks(tracks.rays, w, tracks.K_rights[v], P) for P in (T, T_given))
        seen = tracks.seen[v]
        unit = 1.0 / (prior.displacement_px[v] * np.sqrt(max(seen.sum(), 1)))
        displaced = ((at.px - before.px)[seen] * unit).reshape(-1)
        J = (_jacobian(at, w)[seen] * unit).reshape(-1, 6)
        change = T @ np.linalg.inv(T_given)
        rotation = Rotation.from_matrix(change[:3, :3]).as_rotvec()
        length, baseline = (np.linalg.norm(P[:3, 3]) for P in (T, T_given))
        slope = np.repeat([1.0 / prior.rotation_rad, 1.0 / (prior.shift_fraction * baseline)], 3)
        weighted_change = slope * np.r_[rotation, change[:3, 3]]
        log_ratio = np.log(length / baseline) / prior.length_fraction
        by_step = np.r_[np.zeros(3), T[:3, 3] / (length**2 * prior.length_fraction)]
        block = slice(6 * v, 6 * v + 6)
        cost += displaced @ displaced + weighted_change @ weighted_change + log_ratio**2
        gradient[block] += J.T @ displaced + slope * weighted_change + by_step * log_ratio
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
    """Fit the poses ``(V, 4, 4)`` of V right views to the tracks under the prior.

    They minimize ``trust sum log(1 + r^2 / scale_px^2)`` over the residuals ``r`` of the tracks, each at its
    best inverse depth, plus the cost of the prior (``_prior_terms``), by ``_STEPS`` damped Gauss-Newton steps
    (Levenberg 1944; Marquardt 1963).

    ``given (V, 4, 4)``, ``T_right_from_left``, is the centre of the prior; ``start`` is the initial value if
    different. ``scale_px``, pixels of the right view, is the residual above which an observation weighs less.
    ``trust`` in (0, 1] is the weight of the residuals against the prior (``tracks.split_residuals``).
    """
    Ts = np.array(given if start is None else start, dtype=np.float64)
    w_start = np.clip(solve_inverse_depth(tracks, Ts), 0.0, None)

    def terms(at: np.ndarray) -> _Terms:
        data = _whitened(tracks, at, scale_px)
        prior_terms = _prior_terms(tracks, at, given, w_start, prior)
        J = data.left_by_pose  # with the inverse depths eliminated
        gradient = np.einsum("nkp,nk->p", J, data.residuals)
        normal = np.einsum("nkp,nkq->pq", J, J)
        return _Terms(
            trust * data.cost + prior_terms.cost,
            trust * gradient + prior_terms.gradient,
            trust * normal + prior_terms.normal,
        )

    damping = 1e-3
    now = terms(Ts)
    for _ in range(_STEPS):
        damped = now.normal + damping * np.diag(np.diag(now.normal))
        step = np.linalg.solve(damped, -now.gradient)
        tried = np.stack([_apply_step(T, step[6 * v : 6 * v + 6]) for v, T in enumerate(Ts)])
        new = terms(tried)
        if new.cost >= now.cost:
            damping *= 8.0
            continue
        converged = now.cost - new.cost < 1e-6 * max(now.cost, 1.0)
        Ts = tried
        now = new
        damping = damping * 0.2
        if converged:
            break
    return Ts


def nearby_poses(sparse: Tracks, given: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Fit poses to the sparse matches, first with a large scale, so that no match is an outlier yet."""
    before = np.nan_to_num(before, nan=1.0)
    prior = PosePrior(1.5 * before + _FLOOR_PX)
    Ts = given
    for scale in (max(float(before.max()), 1.0), 1.0):
        Ts = solve_poses(sparse, given, prior, start=Ts, scale_px=scale)
    return Ts


def regularized_poses(
    tracks: Tracks, given: np.ndarray, near: np.ndarray, before: np.ndarray, rig: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Fit poses to all matches, regularized towards the given ones the better these fit.

    ``given`` and ``near (V, 4, 4)``, which fit approximately, are ``T_right_from_left``; ``before (V,)``
    pixels, ``median_residuals`` of the given poses; ``rig``: whether they belong to a rectified rig.

    Returns:
        ``(V, 4, 4)``: free where they explain nearly all of the residual; near the given ones for cameras
        with faults that no pose explains, and for a rectified rig. And ``(V, 4, 4)``: the best fit except for
        the baseline lengths.
    """
    free = PosePrior(np.full(len(given), FREE_PX), length_fraction=0.02)
    fitted = solve_poses(tracks, given, free, start=near, scale_px=SCALE_PX)
    left = np.maximum(median_residuals(tracks, fitted), _FLOOR_PX)
    explained = np.sqrt(np.clip(before**2 - left**2, 0.0, None))
    views = [tracks.view(v) for v in range(len(given))]
    parts = [split_residuals(view, T) if len(view) else None for view, T in zip(views, fitted, strict=True)]
    faults = np.array([np.nan if part is None else part.faults_px for part in parts])
    times = explained / (_FAULTS * np.maximum(faults, _MIN_ERROR_PX))
    fraction = (
        np.full_like(times, _RIG_DISPLACEMENT_FRACTION) if rig else np.clip(times**4, *_DISPLACEMENT_FRACTION)
    )
    displaced = np.maximum(np.nan_to_num(fraction * explained), _FLOOR_PX)
    counting = float(np.mean([part.trust for part in parts if part is not None]))
    prior_terms = (
        PosePrior(displaced, _RIG_ROTATION_RAD, _RIG_SHIFT_FRACTION) if rig else PosePrior(displaced)
    )
    wrong = not rig and bool((times > 1.0).any())
    Ts = fitted
    for by in (_SCALE_FACTOR, *(_FINAL_FACTORS if wrong else ())):
        scale_px = max(by * float(np.nanmean(left)), _MIN_SCALE_PX)
        how = {"scale_px": scale_px, "trust": _DATA_WEIGHT * counting}
        Ts = solve_poses(tracks, given, prior_terms, start=Ts, **how)
    return Ts, fitted


def depth_spread(tracks: Tracks, Ts: np.ndarray) -> float:
    """Compute the relative standard deviation of depth caused by errors of free poses ``Ts (V, 4, 4)``.

    ``Ts`` are the best fit to the tracks, which may have outliers. The result is the median over the tracks;
    ``inf`` if none is in front of the cameras. The covariance of the poses is the sandwich estimator of
    robust statistics (Huber 1967; White 1982) over image blocks, because neighbouring residuals are not
    independent. The unit of length is assumed exact.
    """
    at = _whitened(tracks, Ts, SCALE_PX)
    ahead = at.inverse_depth > 0
    if not ahead.any():
        return float("inf")
    # Steps with translations in baselines, excluding the one that only changes the unit.
    unit = np.tile(np.repeat([1.0, np.linalg.norm(Ts[0, :3, 3])], 3), len(Ts))
    log_ratio = np.concatenate([np.r_[np.zeros(3), T[:3, 3]] for T in Ts]) / unit
    free = unit[:, None] * np.linalg.svd(log_ratio[None])[2][1:].T
    J = at.left_by_pose @ free
    of_track = blocks(tracks)
    weighted_change = np.zeros((of_track.max() + 1, J.shape[-1]))
    np.add.at(weighted_change, of_track, np.einsum("nkp,nk->np", J, at.residuals))
    inverse = np.linalg.pinv(np.einsum("nkp,nkq->pq", J, J))
    covariance = inverse @ (weighted_change.T @ weighted_change) @ inverse
    by_step = (at.depth_by_pose @ free)[ahead] / (at.slopes * at.inverse_depth)[ahead, None]
    return float(np.median(np.einsum("np,pq,nq->n", by_step, covariance, by_step)) ** 0.5)


def unconstrained_pose(spread: float | None) -> tuple[Finding, ...]:
    """Return a finding if the matches do not constrain an estimated pose; none for ``None``."""
    if spread is None or spread <= MAX_DEPTH_REL_STD:
        return ()
    sentence = (
        "The matches do not constrain the estimated pose: from it alone depths may be off by "
        f"{100 * spread:.0f} % (one standard deviation). Take images with more texture or a "
        "wider baseline, or pass the pose."
    )
    return (Finding("estimate.unconstrained", sentence),)
