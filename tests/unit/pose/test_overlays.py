"""Features of burnt-in text stay at one pixel; those of a scene do not, unless the camera stands still."""

import cv2
import numpy as np
import pytest

from geodiff_plugin.pose.overlays import (
    MAX_SAMPLES,
    NEAR_PX,
    moving,
    reduced,
    sampled_frames,
    static_features,
    static_pixels,
)
from tests.unit.capture_room import SIZE, render, walk

TEXT = np.array([[20.0, 10.0], [24.0, 10.0], [300.0, 200.0]])


def features(frames: int, drift_px: float, text=TEXT, scene=100, shown=1.0):
    """Pixels and descriptors of a scene that drifts behind text, which a fraction of the frames show."""
    rng = np.random.default_rng(0)
    at, of_scene, of_text = (
        rng.uniform(40, 280, (scene, 2)),
        rng.random((scene, 32)),
        rng.random((len(text), 32)),
    )
    px, descriptors = [], []
    for i in range(frames):
        here = text + rng.normal(0, 0.1, text.shape) if i < shown * frames else text[:0]
        px.append(np.concatenate([here, at + i * drift_px]))
        values = np.concatenate([of_text[: len(here)], of_scene])
        descriptors.append(
            (512 * (values + rng.normal(0, 0.02, values.shape)).clip(0, 1) / 8).astype(np.uint8)
        )
    return px, descriptors


@pytest.mark.parametrize(("frames", "shown"), [(8, 1.0), (10, 0.5), (100, 0.6)])
def test_text_that_stays_is_found(frames, shown):
    px, descriptors = features(frames, 2.3, shown=shown)
    found = static_features(px, descriptors)
    assert len(found) and moving(found, found).sum() == 0
    kept = moving(px[0], found)
    assert not kept[: len(TEXT)].any() and kept[len(TEXT) :].mean() > 0.95


@pytest.mark.parametrize(
    ("frames", "drift_px", "text", "shown"),
    [
        (8, 2.3, TEXT[:0], 1.0),  # no text
        (8, 0.0, TEXT, 1.0),  # a camera that stands still
        (3, 2.3, TEXT, 1.0),  # too few frames
        (20, 2.3, TEXT, 0.2),  # too few with text
    ],
)
def test_nothing_else_is_static(frames, drift_px, text, shown):
    assert len(static_features(*features(frames, drift_px, text, shown=shown))) == 0


def test_other_descriptors_at_one_pixel_are_no_overlay():
    px, _ = features(8, 2.3)
    rng = np.random.default_rng(1)
    assert len(static_features(px, [rng.integers(0, 2, (len(each), 32)) for each in px])) == 0


def test_frames_without_features_have_no_overlay():
    nothing = [np.zeros((0, 2))] * 6, [np.zeros((0, 32))] * 6
    assert len(static_features(*nothing)) == 0 and moving(nothing[0][0], TEXT).shape == (0,)


def test_features_up_to_a_distance_are_dropped():
    places = TEXT[:1] + [[0, 0], [NEAR_PX - 0.1, 0], [0, NEAR_PX + 0.1]]
    assert moving(places, TEXT[:1]).tolist() == [False, False, True]
    assert moving(places, TEXT[:0]).all()


def burnt_in(shown: float = 1.0, noise: float = 1.0, count: int = 10, alpha: float = 1.0) -> list[np.ndarray]:
    """Frames of a walk through a room, of which a fraction shows a clock in a corner."""
    rng, frames = np.random.default_rng(0), []
    for i, E in enumerate(walk(count)):
        grey = cv2.cvtColor(render(E)[0], cv2.COLOR_RGB2GRAY)
        if i % 5 < 5 * shown:
            clock = cv2.putText(grey.copy(), "12:34 REC", (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2)
            grey = np.rint(alpha * clock + (1 - alpha) * grey)
        frames.append((grey + rng.normal(0, noise, grey.shape)).clip(0, 255).astype(np.uint8))
    return frames


@pytest.mark.parametrize(("shown", "alpha"), [(1.0, 1.0), (0.6, 1.0), (1.0, 0.8)])
def test_burnt_in_text_is_static(shown, alpha):
    found = static_pixels(burnt_in(shown, alpha=alpha))
    text = (
        cv2.putText(
            np.zeros(SIZE[::-1], np.uint8), "12:34 REC", (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2
        )
        > 0
    )
    assert found[text].mean() > 0.9
    found[4:42, :132] = False
    assert found.mean() < 0.002


@pytest.mark.parametrize("shown", [0.0, 0.2])
def test_nothing_of_a_scene_is_static(shown):
    found = static_pixels(burnt_in(shown))
    assert found is None or found.mean() < 0.002


def test_a_camera_that_stands_still_has_no_overlay():
    still = [burnt_in()[0]] * 8
    assert static_pixels(still) is None
    # Half of the time it stands: what it saw then is no overlay.
    moving_frames = burnt_in(0.0)
    assert static_pixels([moving_frames[0]] * 8 + moving_frames[1:]) is None


def test_a_frame_around_the_image_is_static_as_a_whole():
    frames = burnt_in(0.0)
    for frame in frames:
        frame[:12], frame[-12:], frame[:, :20], frame[:, -20:] = 90, 90, 90, 90
        cv2.putText(frame, "LIVE", (30, 11), cv2.FONT_HERSHEY_PLAIN, 0.8, 230, 1)
    found = static_pixels(frames)
    assert found[:12].mean() > 0.98 and found[:, :20].mean() > 0.98 and found[20:-20, 30:-30].mean() < 0.01


def test_frames_of_several_sizes_and_few_frames_have_none():
    frames = burnt_in()
    assert static_pixels(frames[:3]) is None and static_pixels([*frames, frames[0][1:]]) is None


def test_frames_are_sampled_evenly():
    assert sampled_frames(3) == [0, 1, 2] and len(sampled_frames(1000)) == MAX_SAMPLES
    assert sampled_frames(1000)[-1] == 999 and np.ptp(np.diff(sampled_frames(1000))) <= 1
    assert reduced(np.zeros((900, 1600), np.uint8)).shape == (270, 480)
