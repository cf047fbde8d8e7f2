"""How sure depths are that rest on an estimated pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.guidance.photographs import estimate_rig
from geodiff_plugin.pose.solve import MOST_SPREAD, SCALE_PX, Prior, depth_spread, open_pose, solve_poses
from geodiff_plugin.pose.tracks import Tracks, solve_inverse_depth
from tests.unit.test_pose_refine import TRUE, make_tracks, pose

THIRD = pose((2.0, 5.0, -1.0), (-0.25, 0.1, 0.05))


def moved(tracks: Tracks, by_px: np.ndarray) -> Tracks:
    return replace(tracks, right_px=tracks.right_px + by_px)


def fitted(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Poses that nothing but the matches holds, the first baseline as long as it was."""
    free = Prior(np.full(len(Ts), 1e3), turned_rad=1.0, shifted_share=10.0, longer_share=1.0)
    solved = solve_poses(tracks, Ts, free, scale_px=SCALE_PX)
    solved[:, :3, 3] *= np.linalg.norm(Ts[0, :3, 3]) / np.linalg.norm(solved[0, :3, 3])
    return solved


@pytest.mark.parametrize(("poses", "noise_px"), [([TRUE], 0.1), ([TRUE, THIRD], 0.4)])
def test_it_is_the_scatter_of_depths_over_photographs(poses, noise_px: float) -> None:
    clean, Ts, _ = make_tracks(poses, 0.0, count=300, outliers=0.0)
    rng = np.random.default_rng(0)
    drawn = [moved(clean, noise_px * rng.normal(size=clean.right_px.shape)) for _ in range(30)]
    solved = [fitted(tracks, Ts) for tracks in drawn]
    # Depths of the clean matches: what differs is the pose alone.
    inverse = np.stack([solve_inverse_depth(clean, Ts) for Ts in solved])
    scatter = float(np.median((inverse / inverse.mean(0)).std(0)))
    said = np.median([depth_spread(tracks, Ts) for tracks, Ts in zip(drawn, solved, strict=True)])
    assert 0.6 * scatter < said < 1.7 * scatter


def test_residuals_alike_in_neighbours_make_it_larger() -> None:
    tracks, Ts, _ = make_tracks([TRUE], noise_px=0.3, outliers=0.0, count=1500)
    alone = depth_spread(tracks, fitted(tracks, Ts))
    wave = np.sin(tracks.left_px / 40.0) * 0.3 * 2**0.5  # of the same size, but smooth
    clean = make_tracks([TRUE], noise_px=0.0, outliers=0.0, count=1500)[0]
    smooth = moved(clean, wave)
    assert depth_spread(smooth, fitted(smooth, Ts)) > 1.5 * alone


def test_the_unit_changes_nothing() -> None:
    tracks, Ts, _ = make_tracks([TRUE, THIRD])
    longer = Ts.copy()
    longer[:, :3, 3] *= 1000.0
    assert depth_spread(tracks, longer) == pytest.approx(depth_spread(tracks, Ts), rel=1e-3)


def test_a_sentence_where_it_is_large() -> None:
    assert open_pose(MOST_SPREAD) == ()
    (sentence,) = open_pose(0.084)
    assert "leave the estimated pose open" in sentence and "8 %" in sentence


def test_photographs_whose_matches_leave_the_pose_open() -> None:
    """A rendered corridor with little texture: its depths are off by a quarter, and that is said."""
    pytest.importorskip("poselib")
    sample = load(find_pairs("synthetic-posed:1+9")[0])
    rig = estimate_rig(
        [sample.left, sample.right],
        K=(sample.K_left, sample.K_right),
        baseline_m=float(np.linalg.norm(sample.E[:3, 3])),
    )
    assert rig.depth_spread > MOST_SPREAD
    assert any("leave the estimated pose open" in sentence for sentence in rig.warnings)
