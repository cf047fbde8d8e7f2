"""Simultaneous frames of two videos: synthetic rigs whose motion is known at every moment."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from geodiff_plugin.formats.recordings import VideoFacts
from geodiff_plugin.formats.synchronization import estimate_offset, pair_frames, watch
from tests.videos import write_video

SIZE = (96, 64)
RNG = np.random.default_rng(3)
#: A wide scene, blurred, in front of which the rig moves.
SCENE = gaussian_filter(RNG.normal(size=(240, 600)), 4.0)
SCENE = np.clip(127 + 90 * SCENE / SCENE.std() / 2, 0, 255)
#: Positions of the rig every hundredth of a second: a smoothed random walk.
WALK = np.cumsum(gaussian_filter(RNG.normal(size=(2, 2000)), (0, 15)), axis=1)
WALK = 60 * WALK / np.abs(WALK).max()


def seen(t: float, disparity: float = 0.0, gain: float = 1.0) -> np.ndarray:
    """The view of a camera of the rig at a time in seconds."""
    x, y = (np.interp(t, np.arange(2000) / 100, along) for along in WALK)
    left, top = round(250 + x + disparity), round(88 + y)
    crop = np.clip(gain * SCENE[top : top + SIZE[1], left : left + SIZE[0]], 0, 255)
    return np.repeat(crop.astype(np.uint8)[..., None], 3, axis=2)


def recorded(path, start: float, times: np.ndarray, **view) -> object:
    write_video(path, [seen(start + t, **view) for t in times], times)
    return watch(path, "LEFT")


@pytest.mark.parametrize("offset_s", [0.0, 0.73, -0.41])
def test_the_offset_of_two_cameras_of_a_rig_is_found(tmp_path, offset_s):
    variable = np.concatenate([[0.0], np.cumsum(RNG.choice([0.04, 0.05, 0.08], 79))])
    left = recorded(tmp_path / "l.mp4", 2.0, variable)
    right = recorded(tmp_path / "r.mp4", 2.0 + offset_s, np.arange(90) / 25, disparity=6, gain=0.8)
    found = estimate_offset(left, right)
    assert found is not None and found.seconds == pytest.approx(offset_s, abs=0.02)
    assert found.correlation > 0.6 and (offset_s == 0 or found.without < found.correlation - 0.2)


def test_no_offset_is_found_without_motion_in_common(tmp_path):
    times = np.arange(50) / 25
    left = recorded(tmp_path / "l.mp4", 2.0, times)
    assert estimate_offset(left, recorded(tmp_path / "other.mp4", 12.0, times)) is None
    still = write_video(tmp_path / "still.mp4", [seen(2.0)] * 50, times)
    assert estimate_offset(left, watch(still, "RIGHT")) is None
    assert estimate_offset(watch(still, "LEFT"), watch(still, "RIGHT")) is None
    assert estimate_offset(left, recorded(tmp_path / "short.mp4", 2.0, times[:8])) is None


def facts(times) -> VideoFacts:
    return VideoFacts(len(times), 25.0, SIZE, tuple(times))


def test_frames_are_paired_with_the_nearest_of_their_time():
    left = np.concatenate([[0.0], np.cumsum(RNG.uniform(0.03, 0.06, 60))])
    right = np.arange(80) / 30
    for offset_s in (0.0, 0.5, -0.7):
        pairs = dict(pair_frames(facts(left), facts(right), offset_s))
        apart = np.abs(left[:, None] - (right[None] + offset_s))
        half = max(np.median(np.diff(left)), 1 / 30) / 2
        for n in range(len(left)):
            assert (n in pairs) == (apart[n].min() <= half)
            assert n not in pairs or apart[n, pairs[n]] == apart[n].min()
    assert pair_frames(facts(left), facts(right), 100.0) == []
    assert pair_frames(facts([0.0]), facts([0.0, 0.04]), 0.0) == [(0, 0)]


def test_synchronized_videos_are_paired_frame_by_frame_despite_jitter():
    rng = np.random.default_rng(7)  # the state of ``RNG`` depends on which tests ran before
    times = np.concatenate([[0.0], np.cumsum(rng.choice([0.02, 0.04, 0.06], 39))])
    jitter = np.concatenate([[0.0], rng.uniform(-0.015, 0.015, 39)])
    assert (np.diff(times + jitter) > 0).all()
    # The jitter is less than half of the usual interval, but the nearest frame is sometimes the next one.
    assert (np.abs(times[:-1] - (times + jitter)[1:]) < np.abs(jitter[:-1])).any()
    assert pair_frames(facts(times), facts(times + jitter), 0.0) == [(n, n) for n in range(40)]
