"""The page of ``geodiff live --app`` while a recorded video is processed."""

import re
import sys

import numpy as np
import pytest
from PIL import Image

from tests.serving import free_port, served, write_plane
from tests.unit.streaming.test_sources import write_video

#: Milliseconds until a result is on the page: the command loads the prior first.
RESULT_MS = 120_000
#: Frames of the video, which lasts longer than the test.
FRAMES = 300


@pytest.fixture
def address(tmp_path):
    """Address of the page of a command that processes every frame of a video."""
    pytest.importorskip("gradio", reason="gradio is not installed")
    *paths, calibration, _ = write_plane(tmp_path)
    views = np.hstack([np.asarray(Image.open(path)) for path in paths])
    video, port = write_video(tmp_path / "rig.avi", [views] * FRAMES), free_port()
    source = ["--source", str(video), "--side-by-side", "full", "--calib", str(calibration), "--every-frame"]
    command = [sys.executable, "-m", "geodiff_plugin", "live", *source, "--device", "cpu", "--app"]
    with served([*command, "--port", str(port)], port, tmp_path) as url:
        yield url


def frame_of(page) -> int:
    return int(re.match(r"frame (\d+): ", page.locator("#live-status .verdict").inner_text())[1])


def test_an_open_page_follows_the_frames(chromium, address):
    context = chromium.new_context()
    page, foreign = context.new_page(), []
    page.on("request", lambda request: foreign.append(request.url))
    page.goto(address)
    page.wait_for_selector("#live-depth img", timeout=RESULT_MS)
    first, drawn = frame_of(page), page.locator("#live-depth img").get_attribute("src")
    assert "latency" in page.locator("#live-status .verdict").inner_text() and drawn.startswith(
        "data:image/jpeg"
    )
    assert page.locator("#live-depth img").evaluate("image => image.naturalWidth") > 128
    page.wait_for_function(
        f"() => !document.querySelector('#live-status .verdict').innerText.startsWith('frame {first}:')",
        timeout=RESULT_MS,
    )
    assert frame_of(page) > first
    assert [url for url in foreign if not url.startswith((address, "data:", "blob:"))] == []
    context.close()
