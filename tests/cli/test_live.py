"""``geodiff live`` on a recorded video of both views side by side."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from geodiff_plugin.cli import live
from geodiff_plugin.jobs import LiveMeter
from tests.unit.streaming.test_sources import write_video

pytestmark = pytest.mark.end_to_end


@pytest.fixture
def rig(pair_files, textured_plane, prior) -> list:
    video = write_video(Path("rig.avi"), [np.hstack([textured_plane.left, textured_plane.right])] * 4)
    source = ["live", "--source", video, "--side-by-side", "full", "--calib", pair_files.calib]
    return [*source, "--prior", prior, "--steps", 1, "--device", "cpu", "--every-frame"]


def test_a_recorded_video(geodiff, rig, textured_plane):
    answer = geodiff(*rig, "--out", "out")
    assert answer.code == 0, answer.err
    first, *_, last = answer.out.splitlines()
    assert first.startswith("frame 0: latency ") and " m, median " in first
    assert last.startswith("4 frames, 0 skipped, ") and " frames/s; latency " in last
    assert sorted(path.name for path in Path("out").iterdir()) == [
        *("K.txt", "depth", "frames.csv", "left", "sigma")
    ]
    depth_m = cv2.imread("out/depth/000003.png", cv2.IMREAD_UNCHANGED) / 1000
    assert depth_m.shape == textured_plane.left.shape[:2]
    assert np.median(np.abs(depth_m / textured_plane.depth_m - 1)) < 0.05
    sigma_m = cv2.imread("out/sigma/000003.png", cv2.IMREAD_UNCHANGED) / 1000
    most = float(np.median(sigma_m))
    answer = geodiff(*rig, "--frames", 1, "--out", "holes", "--max-sigma", most, "--min-confidence", 0.1)
    assert answer.code == 0, answer.err
    holed, sigma = (
        cv2.imread(f"holes/{name}/000000.png", cv2.IMREAD_UNCHANGED) for name in ("depth", "sigma")
    )
    assert 0.1 < (holed > 0).mean() < 0.9 and sigma.max() <= np.ceil(1000 * most)
    np.testing.assert_array_equal(holed > 0, sigma > 0)


def test_a_line_of_json_per_result(geodiff, rig):
    answer = geodiff(*rig, "--json", "--check-every", 2)
    rows = [json.loads(line) for line in answer.out.splitlines()]
    assert [row["frame"] for row in rows] == [0, 1, 2, 3]
    assert [row["checked"] for row in rows] == [True, False, True, False]
    assert rows[0]["rate_hz"] is None and rows[3]["rate_hz"] > 0


def test_a_video_is_played_at_its_rate_and_the_newest_frame_wins(geodiff, rig, textured_plane):
    """The network is slower than 240 frames a second."""
    write_video(Path("rig.avi"), [np.hstack([textured_plane.left, textured_plane.right])] * 40, fps=240.0)
    answer = geodiff(*rig[:-1], "--json")
    numbers = [json.loads(line)["frame"] for line in answer.out.splitlines()]
    assert numbers[-1] == 39 and len(numbers) < 30 and numbers == sorted(set(numbers))


def test_ctrl_c_is_the_usual_end(geodiff, rig, monkeypatch):
    add = LiveMeter.add

    def interrupted(meter, result):
        add(meter, result)
        if meter.results == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(LiveMeter, "add", interrupted)
    answer = geodiff(*rig)
    assert answer.code == 0 and answer.out.splitlines()[-1].startswith("2 frames, 0 skipped")


def test_a_window_shows_both_and_ends_the_run(geodiff, rig, monkeypatch, textured_plane):
    shown, keys = [], iter([-1, ord("q")])
    for name in ("namedWindow", "destroyWindow"):
        monkeypatch.setattr(live.cv2, name, lambda *_: None, raising=False)
    monkeypatch.setattr(live.cv2, "imshow", lambda _, image: shown.append(image))
    monkeypatch.setattr(live.cv2, "waitKey", lambda _: next(keys))
    monkeypatch.setattr(live.cv2, "getWindowProperty", lambda *_: 1.0)
    answer = geodiff(*rig, "--window", "-q")
    assert (answer.code, answer.out, len(shown)) == (0, "", 2)
    width = textured_plane.left.shape[1]
    np.testing.assert_array_equal(shown[0][:, :width], textured_plane.left[..., ::-1])
    assert shown[0].shape[1] == 2 * width and shown[0][:, width:].std() > 10


def test_a_page_shows_every_result_with_its_line_and_ends_with_the_command(geodiff, rig, monkeypatch):
    from geodiff_plugin.app import live as page

    calls = []

    class Page:
        address = "http://there"

        def __init__(self, host, port):
            calls.append((host, port))

        def __enter__(self):
            return self

        def __exit__(self, *_):
            calls.append("closed")

        def show(self, result, line):
            calls.append((result.frame.number, line))

    monkeypatch.setattr(page, "LivePage", Page)
    answer = geodiff(*rig, "--app", "--port", 8000, "--frames", 2)
    assert answer.code == 0 and "Serving on http://there" in answer.err
    assert calls[0] == ("127.0.0.1", 8000) and calls[-1] == "closed"
    assert [number for number, _ in calls[1:-1]] == [0, 1]
    assert calls[1][1] == answer.out.splitlines()[0] and "frames/s" in calls[2][1]
    answer = geodiff(*rig, "--port", 8000)
    assert answer.code == 2 and "--port needs --app" in answer.err


def test_an_opencv_without_windows_is_named(geodiff, rig, monkeypatch):
    def none(*_):
        raise cv2.error("The function is not implemented")

    monkeypatch.setattr(live.cv2, "namedWindow", none)
    answer = geodiff(*rig, "--window")
    assert answer.code == 2 and "--window needs an OpenCV with windows" in answer.err
