"""How sure depths are that rest on an estimated pose.

Data flow: matches + the poses that fit them best -> relative standard deviation of depth.
Paper: none. The covariance of the poses is the sandwich of robust statistics (Huber 1967; White 1982), with
blocks of the image as what is independent: residuals of neighbours are alike.
"""

from __future__ import annotations

import numpy as np

from geodiff_plugin.pose.noise import blocks
from geodiff_plugin.pose.settle import SCALE_PX
from geodiff_plugin.pose.solve import whitened
from geodiff_plugin.pose.tracks import Tracks

__all__ = ["MOST_SPREAD", "depth_spread", "open_pose"]

#: The user is warned if depths are less sure than this.
MOST_SPREAD = 0.06


def depth_spread(tracks: Tracks, Ts: np.ndarray) -> float:
    """The relative standard deviation of the depth of a track, in the median, caused by errors of free poses.

    Args:
        tracks: of V right views, those that the poses explain and some that they do not.
        Ts: ``(V, 4, 4)``, ``T_right_from_left``, that fit them best; the unit of length is taken as known.

    Returns:
        0.05 for 5 %; ``inf`` where no track lies in front of the cameras.
    """
    at = whitened(tracks, Ts, SCALE_PX)
    ahead = at.inverse_depth > 0
    if not ahead.any():
        return float("inf")
    # Steps with translations in baselines, and without the one along all translations at once, which
    # changes nothing but the unit.
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


def open_pose(spread: float | None) -> tuple[str, ...]:
    """A sentence where the matches leave an estimated pose, and so the depth, open; none for ``None``."""
    if spread is None or spread <= MOST_SPREAD:
        return ()
    return (
        f"The matches leave the estimated pose open: by it alone depths may be off by {100 * spread:.0f} % "
        "(one standard deviation). Take photographs that show more texture or are further apart, or give "
        "the pose.",
    )
