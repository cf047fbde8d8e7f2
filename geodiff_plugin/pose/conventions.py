"""Which convention of camera poses a capture was written in, by the residuals of its matches."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.reconstruction import Match
from geodiff_plugin.pose.tracks import rays_through

#: Matches of a pair that its residual is taken from, at most.
MOST_PER_PAIR = 100
#: Pairs that a convention is found by, at most.
MOST_PAIRS = 200
#: Another convention of the given poses is taken where it leaves this share of their misfit at most.
CONVENTION_GAIN = 0.5
#: A guessed convention is not trusted if the matches lie further off their epipolar lines, in shares of the
#: focal length: under the poses of trackers they lay within half of it.
MOST_GUESS = 0.007
AS_GIVEN = "as given"
#: What pictures may be turned by against their cameras, quarters.
QUARTERS = (0, 1, 2, 3)


class Convention(NamedTuple):
    """Given poses ``(N, 4, 4)`` as ours would have them, if they were written in a certain way."""

    name: str
    E: np.ndarray
    quarters: int = 0  # by how many the pictures are turned counter-clockwise against the cameras
    off_px: float = 0.0  # median distance of the matches from their epipolar lines
    off: float = 0.0  # the same in shares of the focal length

    @property
    def turned_deg(self) -> int:
        """By how many degrees they are turned."""
        return 90 * self.quarters


def _conventions(E: np.ndarray) -> Iterator[Convention]:
    """Every way in which poses are written, with upright pictures first."""
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
    """Distances of the matches of every pair from their epipolar lines under poses, pixels."""
    distances = []
    for i, j, px_i, px_j in matches:
        step = max(1, len(px_i) // MOST_PER_PAIR)
        T = np.linalg.inv(E[j]) @ E[i]
        x, y, z = T[:3, 3]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        F = np.linalg.inv(K[j]).T @ cross @ T[:3, :3] @ np.linalg.inv(K[i])
        a, b = (np.c_[px[::step], np.ones(len(px[::step]))] for px in (px_i, px_j))
        Fa, Fb = a @ F.T, b @ F
        below = np.sqrt((Fa[:, :2] ** 2).sum(1) + (Fb[:, :2] ** 2).sum(1))
        distances.append(np.abs((b * Fa).sum(1)) / np.maximum(below, 1e-12))
    return distances


def median_px(distances: Sequence[np.ndarray]) -> float:
    """Median over all pairs; NaN without any."""
    return float(np.median(np.concatenate(distances))) if distances else math.nan


def find_convention(E: np.ndarray, K: np.ndarray, matches: Sequence[Match]) -> Convention:
    """How poses were written, by the matches; as given where nothing fits clearly better.

    That pictures are turned against their cameras is found only where this fits clearly better than every
    convention with upright ones. A camera that drives straight ahead does not tell.

    Args:
        E: ``(N, 4, 4)`` as given.
        K: ``(N, 3, 3)`` pixels.
        matches: of pairs of frames.
    """
    some = matches[:: max(1, len(matches) // MOST_PAIRS)]
    conventions = list(_conventions(E))
    misfits = [_misfit(each.E, K, some) for each in conventions]
    best = 0
    for turned in (False, True):
        among = [k for k, each in enumerate(conventions) if (each.quarters > 0) is turned]
        k = min(among, key=misfits.__getitem__)
        best = k if misfits[k] < CONVENTION_GAIN * misfits[best] else best
    off_px = median_px(residuals_px(conventions[best].E, K, some))
    return conventions[best]._replace(off_px=off_px, off=off_px / float(np.median(K[:, 0, 0])))


def noted_convention(found: Convention) -> list[Message]:
    """What the user is told of a convention; nothing if poses are read as given."""
    notes = []
    if found.quarters:
        sentence = (
            f"The matches fit the poses, {found.name}, only if the pictures are turned by {found.turned_deg} "
            "degrees counter-clockwise against their cameras: are they stored in another orientation than "
            "the one that the poses and K are for?"
        )
        notes.append(Message("capture.turned", sentence))
    elif found.name != AS_GIVEN:
        sentence = f"The poses are read as {found.name}: as written, the matches contradict them."
        notes.append(Message("capture.convention", sentence))
    if notes and found.off > MOST_GUESS:
        sentence = (
            f"Even so the matches lie {found.off_px:.1f} px off their epipolar lines: the convention of the "
            "poses is not known. Give camera-to-world poses of these pictures."
        )
        notes.append(Message("capture.convention-unsure", sentence))
    return notes


def _misfit(E: np.ndarray, K: np.ndarray, matches: Sequence[Match]) -> float:
    """Median residual of matches under poses, pixels, over the share of points in front of both cameras."""
    ahead, count = 0, 0
    for i, j, px_i, px_j in matches:
        T = np.linalg.inv(E[j]) @ E[i]
        a, b = rays_through(px_i, K[i]), rays_through(px_j, K[j])
        a = a @ T[:3, :3].T
        # z_j b = z_i a + t, in the least squares sense, for both depths.
        aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
        at, bt = a @ T[:3, 3], b @ T[:3, 3]
        below = aa * bb - ab**2
        ahead += int(((ab * bt > bb * at) & (aa * bt > ab * at) & (below > 0)).sum())
        count += len(a)
    return median_px(residuals_px(E, K, matches)) / max(ahead / max(count, 1), 0.05)
