"""The scale of an estimated or refined pose, which photographs alone do not show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.pose.tracks import Tracks, project_tracks, residuals_px, solve_inverse_depth

NO_UNIT = (
    "No length is known, so the result has no unit: all depths are in baselines of the first two cameras. "
    "Give their distance (baseline), a known length in the left photograph, or known points."
)
#: Relative standard deviation, under the poses of a tracker, of the distance between two cameras and of the
#: scene's median depth; measured on 85 pairs of two trackers (docs/how-to/poses.md).
LENGTH_SPREAD, DEPTH_SPREAD = 0.15, 0.05
#: The user is warned if the scale of a refined pose is less certain than this.
MOST_SCALE_SPREAD = 0.1
#: A pixel's depth is that of the matches this near, pixels of their grid.
_NEAR_PX = 40.0


@dataclass(frozen=True)
class Scale:
    """Metres per unit of an estimated pose.

    ``source`` is ``"baseline"``, ``"known length"``, ``"points"`` or ``"none"``; ``factor`` is 1 without one;
    ``spread`` is its relative standard error as the matches show, ``None`` where they cannot; ``warnings``
    are sentences for the user.
    """

    source: str
    factor: float
    spread: float | None = None
    warnings: tuple[str, ...] = ()

    @property
    def unit(self) -> str | None:
        """``"m"``, or ``None`` where there is no unit."""
        return None if self.source == "none" else "m"


def _point_at(px: np.ndarray, tracks: Tracks, inverse_depth: np.ndarray) -> tuple[np.ndarray, float]:
    """The point ``(3,)`` of a left pixel in units, and the relative spread of its depth."""
    away = np.linalg.norm(tracks.left_px - px, axis=1)
    near = np.argsort(away)[:8]
    near = near[away[near] < _NEAR_PX]
    if len(near) < 3:
        cure = "Choose ends on something with texture that both photographs show."
        got = f"({px[0]:.0f}, {px[1]:.0f}) with {len(near)} nearby"
        bad_value("known length", "near matched points", got, cure)
    w = inverse_depth[near]
    middle = float(np.median(w))
    spread = 1.4826 * float(np.median(np.abs(w / middle - 1)))
    ray = np.linalg.solve(tracks.K_left, (*px, 1.0))
    return ray / middle, spread


def find_scale(
    tracks: Tracks,
    Ts: np.ndarray,
    factor: float,
    baseline_m: float | None,
    known_length: tuple[float, float, float, float, float] | None,
    points: np.ndarray | None,
) -> Scale:
    """Metres per unit, from whichever length is given.

    ``Ts (V, 4, 4)`` are ``T_right_from_left`` in units; ``factor`` is pixels of the tracks' grid a pixel of
    the left photograph; ``baseline_m`` the distance of the first right camera; ``known_length``
    ``(x1, y1, x2, y2, metres)`` in the left photograph; ``points`` ``(N, 3)`` metres in the left frame.

    Raises:
        InputError: baseline and length together, or ends of a length where nothing is matched.
    """
    given = [name for name, v in (("baseline", baseline_m), ("known length", known_length)) if v is not None]
    if len(given) > 1:
        bad_value("scale", "given once", " and ".join(given), "Drop one; points may be given beside.")
    if baseline_m is not None:
        return Scale("baseline", baseline_m / float(np.linalg.norm(Ts[0, :3, 3])))
    fits = (np.nan_to_num(residuals_px(tracks, Ts), nan=0.0) < 1.5).all(0)
    tracks = tracks.kept(fits)
    inverse_depth = solve_inverse_depth(tracks, Ts)
    tracks, inverse_depth = tracks.kept(inverse_depth > 0), inverse_depth[inverse_depth > 0]
    if known_length is not None:
        *ends, metres = known_length
        check_number(metres, "known length", 1e-6, 1e6)
        pixels = (np.array(ends).reshape(2, 2) + 0.5) * factor - 0.5
        (first, s1), (second, s2) = (_point_at(px, tracks, inverse_depth) for px in pixels)
        length = float(np.linalg.norm(first - second))
        if length < 1e-9:
            bad_value("known length", "between two places", "the same place twice")
        return Scale("known length", metres / length, float(np.hypot(s1, s2)))
    if points is not None:
        return _by_points(tracks, inverse_depth, points)
    return Scale("none", 1.0, None, (NO_UNIT,))


def _by_points(tracks: Tracks, inverse_depth: np.ndarray, points: np.ndarray) -> Scale:
    ahead = points[points[:, 2] > 0]
    px = project_tracks(ahead, np.zeros(len(ahead)), tracks.K_left, np.eye(4)).px
    away, nearest = cKDTree(tracks.left_px).query(px)
    close = away < _NEAR_PX / 4
    if close.sum() < 5:
        bad_value("points", "with at least 5 near matched points", f"{int(close.sum())}")
    ratios = ahead[close, 2] * inverse_depth[nearest[close]]
    factor = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios / factor - 1))) / np.sqrt(close.sum())
    return Scale("points", factor, spread)


def refined_scale(refined: np.ndarray, given: np.ndarray, misfit: float) -> tuple[float, float]:
    """By how much to multiply refined translations, which matches alone determine only up to scale.

    Two lengths survive the refinement of a tracker's pose: that of the baseline, and the depth of the scene.
    A tracker errs in turn and shift together, so that the scene stays where it was seen and the baseline is
    too long or too short. The result is the mean of both, weighted by their uncertainties.

    ``refined`` and ``given (N,)`` are inverse depths of matches under the refined poses, with baselines as
    long as given, and under the given ones; values <= 0 are left out. ``misfit`` says how wrongly the given
    poses predict places in the images: the median distance of the matches from their epipolar lines as a
    share of their median parallax. As much error is expected along the lines, where it changes depth.

    Returns the factor (1 keeps the baselines, another the median inverse depth), and its relative standard
    deviation; NaN for both without matches in front of the cameras.
    """
    ahead = (refined > 0) & (given > 0)
    if not ahead.any():
        return float("nan"), float("nan")
    by_depth = float(np.median(np.log(refined[ahead] / given[ahead])))
    of_length, of_depth = LENGTH_SPREAD**2, DEPTH_SPREAD**2 + misfit**2
    weight = of_length / (of_length + of_depth)
    # The variance of the weighted mean, and what the two lengths disagree by.
    variance = weight * of_depth + weight * (1.0 - weight) * by_depth**2
    return float(np.exp(weight * by_depth)), float(np.sqrt(variance))
