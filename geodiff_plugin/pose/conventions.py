"""Detects the convention in which a capture's camera poses are written, from the residuals of its matches."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from geodiff_plugin.cameras import Camera
from geodiff_plugin.findings import Finding
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.pose.reconstruction import Match

#: Maximum number of matches of a pair that measure its residual.
MAX_PER_PAIR = 100
#: Maximum number of pairs used to detect a convention.
MAX_PAIRS = 200
#: Maximum ratio of another convention's misfit to the misfit of the given one for it to be chosen.
CONVENTION_GAIN = 0.5
#: Maximum distance of the matches from their epipolar lines, relative to the focal length, at which a
#: detected convention is trusted. Poses of trackers give at most half of it.
MAX_GUESS_ERROR = 0.007
AS_GIVEN = "as given"
#: Image rotations relative to the cameras that are tried, in quarter turns.
QUARTERS = (0, 1, 2, 3)


class Convention(NamedTuple):
    """Given poses ``(N, 4, 4)`` converted to this package's convention from an assumed one."""

    name: str
    E: np.ndarray
    quarters: int = 0  # counter-clockwise quarter turns of the images relative to the cameras
    off_px: float = 0.0  # median distance of the matches from their epipolar lines
    off: float = 0.0  # the same relative to the focal length

    @property
    def turned_deg(self) -> int:
        """Counter-clockwise rotation of the images, degrees."""
        return 90 * self.quarters


def _conventions(E: np.ndarray) -> Iterator[Convention]:
    """Yield every supported convention, those with upright images first."""
    forms = {
        AS_GIVEN: E,
        "with OpenGL's axes (y up, z backward)": E @ OPENGL_FROM_OPENCV,
        "world-to-camera": np.linalg.inv(E),
        "world-to-camera with OpenGL's axes": np.linalg.inv(OPENGL_FROM_OPENCV @ E),
    }
    for quarters in QUARTERS:
        cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
        roll = np.eye(4)
        roll[:2, :2] = [[cosine, -sine], [sine, cosine]]
        for name, form in forms.items():
            yield Convention(name, form @ roll, quarters)


def residuals_px(E: np.ndarray, K: np.ndarray, matches: Sequence[Match]) -> list[np.ndarray]:
    """Compute the distances of every pair's matches from their epipolar lines under poses, pixels."""
    distances = []
    for i, j, px_i, px_j in matches:
        step = max(1, len(px_i) // MAX_PER_PAIR)
        T = np.linalg.inv(E[j]) @ E[i]
        x, y, z = T[:3, 3]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        F = np.linalg.inv(K[j]).T @ cross @ T[:3, :3] @ np.linalg.inv(K[i])
        a, b = (np.c_[px[::step], np.ones(len(px[::step]))] for px in (px_i, px_j))
        Fa = a @ F.T
        Fb = b @ F
        below = np.sqrt((Fa[:, :2] ** 2).sum(1) + (Fb[:, :2] ** 2).sum(1))
        distances.append(np.abs((b * Fa).sum(1)) / np.maximum(below, 1e-12))
    return distances


def median_px(distances: Sequence[np.ndarray]) -> float:
    """Return the median over all pairs; NaN without pairs."""
    return float(np.median(np.concatenate(distances))) if distances else math.nan


def find_convention(E: np.ndarray, K: np.ndarray, matches: Sequence[Match]) -> Convention:
    """Detect the convention of poses from the matches; as given if no other fits clearly better.

    A rotation of the images relative to their cameras is detected only if it fits clearly better than the
    convention that would be used for upright images. A camera that moves straight ahead does not determine
    it.

    Args:
        E: ``(N, 4, 4)`` poses as given.
        K: ``(N, 3, 3)`` intrinsics, pixels.
        matches: matches of pairs of frames.
    """
    some = matches[:: max(1, len(matches) // MAX_PAIRS)]
    fits = [(_misfit(each.E, K, some), each) for each in _conventions(E)]
    as_given = fits[0]
    upright = min((fit for fit in fits if not fit[1].quarters), key=itemgetter(0))
    rotated = min((fit for fit in fits if fit[1].quarters), key=itemgetter(0))
    chosen = upright if upright[0] < CONVENTION_GAIN * as_given[0] else as_given
    chosen = rotated if rotated[0] < CONVENTION_GAIN * chosen[0] else chosen
    found = chosen[1]
    off_px = median_px(residuals_px(found.E, K, some))
    return found._replace(off_px=off_px, off=off_px / float(np.median(K[:, 0, 0])))


def reported_convention(found: Convention) -> list[Finding]:
    """Return the findings about a detected convention; none if poses are used as given."""
    notes = []
    if found.quarters:
        sentence = (
            f"The matches fit the poses ({found.name}) only if the images are rotated by {found.turned_deg} "
            "degrees counter-clockwise relative to their cameras. Check whether the images were rotated "
            "after capture, and whether their stored orientation is the one that the poses and K assume."
        )
        notes.append(Finding("capture.rotated", sentence))
    elif found.name != AS_GIVEN:
        sentence = f"The poses are interpreted as {found.name}: as declared, they contradict the matches."
        notes.append(Finding("capture.convention", sentence))
    if notes and found.off > MAX_GUESS_ERROR:
        sentence = (
            f"The matches are still {found.off_px:.1f} px from their epipolar lines, so the convention of "
            "the poses is unknown. Pass camera-to-world poses of these images."
        )
        notes.append(Finding("capture.unknown-convention", sentence))
    return notes


def _misfit(E: np.ndarray, K: np.ndarray, matches: Sequence[Match]) -> float:
    """Compute the median residual under poses, pixels, over the fraction of points in front of cameras."""
    ahead, count = 0, 0
    for i, j, px_i, px_j in matches:
        T = np.linalg.inv(E[j]) @ E[i]
        a, b = Camera(K[i]).rays(px_i), Camera(K[j]).rays(px_j)
        a = a @ T[:3, :3].T
        # Solve z_j b = z_i a + t for both depths by least squares.
        aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
        at, bt = a @ T[:3, 3], b @ T[:3, 3]
        below = aa * bb - ab**2
        ahead += int(((ab * bt > bb * at) & (aa * bt > ab * at) & (below > 0)).sum())
        count += len(a)
    return median_px(residuals_px(E, K, matches)) / max(ahead / max(count, 1), 0.05)
