"""Parts of an image that moved across the epipolar lines, counted block by block."""

import math
from dataclasses import replace

import numpy as np
import pytest

from geodiff_plugin.pose.tracks import Tracks, epipolar
from geodiff_plugin.trust.moving_objects import Moved, MovingObjects, _medians, moved_fraction
from tests.unit.pose.posed_scene import K_LEFT, K_RIGHTS, POSES, make_scene, projected
from tests.unit.trust.made_stages import tracks_stage
from tests.unit.trust.sheets import good, judged

SIDE = 2 * K_LEFT[0, 2] / 10


def in_blocks(off_by_block: list[np.ndarray], v: int) -> tuple[Tracks, np.ndarray]:
    """Matches of one view in as many blocks of the left image, so far off their lines."""
    T, rng = np.linalg.inv(POSES[v]), np.random.default_rng(0)
    off, block = (
        np.concatenate(off_by_block),
        np.repeat(np.arange(len(off_by_block)), [len(o) for o in off_by_block]),
    )
    order = rng.permutation(len(off))
    off, block = off[order], block[order]
    left_px = np.stack([block % 7, 1 + block // 7], axis=1) * SIDE + rng.uniform(2, SIDE - 2, (len(off), 2))
    rays = np.linalg.solve(K_LEFT, np.c_[left_px, np.ones(len(off))].T).T
    right_px = projected(rays * rng.uniform(2, 6, (len(off), 1)), K_RIGHTS[v], T)
    tracks = Tracks(left_px, right_px[None], np.ones((1, len(off)), bool), K_LEFT, K_RIGHTS[v : v + 1])
    normals = epipolar(tracks, T).normals
    return replace(tracks, right_px=right_px[None] + off[:, None] * normals), T


def spread_about(middle: float, apart: float, count: int) -> np.ndarray:
    """Values with this median, and this median deviation from it."""
    return middle + apart * np.resize([-1.0, 1.0, 0.0], count) if apart else np.full(count, middle)


@pytest.mark.parametrize("v", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("block", "moves"),
    [
        (spread_about(2.1, 0.0, 9), True),
        (spread_about(1.9, 0.0, 9), False),  # less than 2 px
        (spread_about(6.0, 1.4, 9), True),
        (spread_about(6.0, 1.6, 9), False),  # not together
        (spread_about(29.0, 0.0, 9), True),
        (spread_about(31.0, 0.0, 9), None),  # wrong matches, which do not count
        (spread_about(6.0, 0.0, 5), True),
        (spread_about(6.0, 0.0, 4), None),  # too few
    ],
)
def test_a_block_moved_if_its_matches_are_off_their_lines_together(v, sign, block, moves):
    rest = [spread_about(0.05, 0.0, 12)] * 5
    tracks, T = in_blocks([sign * block, *rest], v)
    compared = 60 + (0 if moves is None else len(block))
    assert moved_fraction(tracks, T) == pytest.approx(len(block) / compared if moves else 0.0)


def test_a_move_is_several_times_the_usual_distance():
    for usual, moves in ((0.73, True), (0.77, False)):
        tracks, T = in_blocks([np.full(9, 3.0), *[spread_about(0.0, usual, 12)] * 5], 0)
        off = np.abs(epipolar(tracks, T).off_px)
        tracks = replace(tracks, right_px=tracks.right_px)
        assert np.median(off) == pytest.approx(usual)
        assert (moved_fraction(tracks, T) > 0) is moves


@pytest.mark.parametrize(("count", "known"), [(40, True), (39, False)])
def test_forty_matches_in_blocks_are_needed(count, known):
    tracks, T = in_blocks([np.full(8, 6.0), np.zeros(count - 8), np.zeros(4)], 1)
    assert math.isnan(moved_fraction(tracks, T)) is not known


def test_medians_of_blocks_are_numpys():
    rng = np.random.default_rng(0)
    block = rng.permutation(np.repeat(np.arange(5), [1, 2, 3, 6, 7]))
    values, count = rng.normal(size=len(block)), np.bincount(block)
    expected = [np.median(values[block == k]) for k in range(5)]
    np.testing.assert_allclose(_medians(values, block, count), expected)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.45])
def test_a_part_that_moved_is_measured_among_noise_and_wrong_matches(part):
    scene = make_scene(1500, noise_px=0.2, outliers=0.05)
    tracks, T = scene.tracks.alone(0), scene.Ts[0]
    x, normals = tracks.left_px[:, 0], epipolar(tracks, T).normals
    inside = x < np.quantile(x, part)

    def shifted(px: float | np.ndarray) -> Tracks:
        return replace(tracks, right_px=tracks.right_px + (inside * px)[:, None] * normals)

    assert moved_fraction(shifted(6.0), T) == pytest.approx(part, abs=0.07)
    assert moved_fraction(shifted(1.7), T) == 0.0
    each_its_own = np.random.default_rng(0).uniform(-25, 25, len(tracks))
    assert moved_fraction(shifted(each_its_own), T) == 0.0
    assert math.isnan(moved_fraction(tracks.kept(slice(0)), T))


def test_the_worst_view_counts_of_those_with_enough_matches():
    scene = make_scene(400)
    tracks, Ts = scene.tracks, scene.Ts
    inside = tracks.left_px[:, 0] < 300
    tracks.right_px[1] += (inside * 6.0)[:, None] * epipolar(tracks.alone(1), Ts[1]).normals
    alone = [moved_fraction(tracks.view(v), Ts[v]) for v in range(2)]
    assert alone[0] == 0.0 and alone[1] > 0.3
    elsewhere = np.stack([np.eye(4)] * 2)  # only the poses as given count
    assert MovingObjects.of_tracks(tracks_stage(tracks, Ts, elsewhere)) == Moved(alone[1])
    for views, found in ([1], Moved(0.0)), ([0, 1], None):
        seen = tracks.seen.copy()
        seen[views, 39:] = False
        assert MovingObjects.of_tracks(tracks_stage(replace(tracks, seen=seen), Ts)) == found


def test_unknown_motion_is_not_ruled_out():
    assert MovingObjects.rules_out(Moved(0.0)) and not MovingObjects.rules_out(None)


def test_the_finding_states_how_much_moved():
    assert "35 % of the matches are on objects that moved" in judged(good(Moved(0.3456)), "views.moved")
