"""Frames of video files, and of cameras that OpenCV is replaced by."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from geodiff_plugin import InputError
from geodiff_plugin.streaming import sources
from geodiff_plugin.streaming.sources import CameraSource, StereoFrame

SIZE = (48, 64)


def write_video(path: Path, frames, fps: float = 30.0) -> Path:
    """Lossless: FFV1 in an AVI file."""
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), fps, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def made(count: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.integers(0, 255, (*SIZE, 3), np.uint8) for _ in range(count)]


@pytest.fixture
def views() -> tuple[list[np.ndarray], list[np.ndarray]]:
    return made(3), made(3, seed=1)


def check(frames: list[StereoFrame], lefts, rights) -> None:
    assert len(frames) == len(lefts)
    for number, (frame, left, right) in enumerate(zip(frames, lefts, rights, strict=True)):
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)
        assert frame.stamp == number and frame.arrived_s <= time.perf_counter()


def test_one_video_holds_both_views(tmp_path, views):
    video = write_video(tmp_path / "rig.avi", [np.hstack(pair) for pair in zip(*views, strict=True)])
    source = CameraSource([video], realtime=False)
    check(list(source), *views)
    source.close()


def test_two_videos_end_with_the_shorter(tmp_path, views):
    lefts, rights = views
    videos = write_video(tmp_path / "l.avi", lefts), write_video(tmp_path / "r.avi", rights[:2])
    check(list(CameraSource([str(video) for video in videos], realtime=False)), lefts[:2], rights[:2])


def test_a_file_is_played_at_its_rate(tmp_path, views):
    video = write_video(
        tmp_path / "rig.avi", [np.hstack(pair) for pair in zip(*views, strict=True)], fps=20.0
    )
    assert CameraSource([video])._interval_s == pytest.approx(0.05)
    begun = time.perf_counter()
    arrived = [frame.arrived_s - begun for frame in CameraSource([video])]
    np.testing.assert_array_less([-1e-9, 0.045, 0.095], arrived)


def test_two_files_are_played_at_the_rate_of_the_first(tmp_path, views):
    rates = (20.0, 40.0)
    videos = [write_video(tmp_path / f"{rate}.avi", views[0], rate) for rate in rates]
    assert CameraSource(videos)._interval_s == pytest.approx(0.05)
    assert CameraSource(videos[::-1])._interval_s == pytest.approx(0.025)


class Camera:
    """A device that fails at first, delivers some frames, and then is gone."""

    def __init__(self, name, frames=(), failures: int = 0, opened: bool = True):
        self.name, self.frames, self.failures, self.opened = name, list(frames), failures, opened
        self.settings, self.released = {}, False

    def isOpened(self):  # noqa: N802 - OpenCV's name
        return self.opened

    def set(self, key, value):
        self.settings[key] = value

    def get(self, _):
        return 0.0

    def grab(self):
        self.failures -= 1
        return self.failures < 0 and bool(self.frames)

    def retrieve(self):
        return True, cv2.cvtColor(self.frames.pop(0), cv2.COLOR_RGB2BGR)

    def release(self):
        self.released = True


@pytest.fixture
def cameras(monkeypatch):
    """Devices by number or URL, in place of OpenCV's."""
    known = {}
    monkeypatch.setattr(sources.cv2, "VideoCapture", lambda name: known[name])
    monkeypatch.setattr(sources, "RETRY_S", 0.0)
    return known


def test_two_cameras(cameras, views):
    cameras |= {0: Camera(0, views[0], failures=3), 2: Camera(2, views[1])}
    source = CameraSource(["0", 2], size=(640, 480))
    for camera in cameras.values():
        size = [camera.settings[key] for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        assert size == [640, 480] and camera.settings[cv2.CAP_PROP_BUFFERSIZE] == 1
    frames = iter(source)
    check([next(frames) for _ in range(3)], *views)
    with pytest.raises(
        InputError, match=r"--source must be a camera or stream that delivers frames.*none from 0"
    ):
        next(frames)
    source.close()
    assert all(camera.released for camera in cameras.values())


def test_only_devices_and_streams_are_waited_for(cameras, views, monkeypatch, tmp_path):
    waits = []
    monkeypatch.setattr(sources.time, "sleep", waits.append)
    monkeypatch.setattr(sources, "RETRY_S", 0.125)
    cameras[0] = Camera(0, views[0], failures=3)
    next(iter(CameraSource([0, 0])))
    assert waits.count(0.125) == 2  # both sources share the device, which is read twice per attempt
    waits.clear()
    path = tmp_path / "rig.avi"
    path.write_bytes(b"-")
    cameras[str(path)] = Camera("", failures=3)
    assert list(CameraSource([path])) == [] and waits == []


def test_a_stream_is_opened_by_its_url(cameras, views):
    cameras["rtsp://rig/both"] = Camera("", [np.hstack(pair) for pair in zip(*views, strict=True)])
    frames = iter(CameraSource(["rtsp://rig/both"]))
    check([next(frames) for _ in range(3)], *views)


def test_a_camera_that_cannot_be_opened_releases_the_other(cameras):
    cameras |= {0: Camera(0), 1: Camera(1, opened=False)}
    with pytest.raises(InputError, match="a camera, a video file or a stream that OpenCV can open; got 1"):
        CameraSource([0, 1])
    assert cameras[0].released


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ((), "one source that holds both views, or two; got 0 sources"),
        ((0, 1, 2), "got 3 sources"),
        (("missing.mp4",), "missing.mp4"),
    ],
)
def test_sources_that_are_none(names, message):
    with pytest.raises(InputError, match=message):
        CameraSource(names)
