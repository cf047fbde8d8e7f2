"""The page of ``geodiff live``: what it shows of the newest result, when it draws, and how it is served."""

import io
import re
import urllib.error
import urllib.request
from base64 import b64decode
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin import InputError
from geodiff_plugin.app import live
from geodiff_plugin.app.live import LivePage, LiveView, build_live_page
from geodiff_plugin.jobs import LiveResult
from geodiff_plugin.plotting import depth_figure
from tests.serving import free_port
from tests.unit.jobs import made_runs

pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # gradio 6.31 leaves files and sockets open
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


def result(number: int, factor: float = 1.0, **changes) -> LiveResult:
    output = made_runs.output(**changes)
    frame = SimpleNamespace(number=number, output=output)
    return LiveResult(frame, factor * made_runs.depth_map(), {})


def shown_image(html: str) -> np.ndarray:
    encoded = re.search(r"data:image/jpeg;base64,([^\"]+)", html)[1]
    return np.asarray(Image.open(io.BytesIO(b64decode(encoded))))


def test_the_newest_depth_has_a_colour_bar_in_metres_and_a_status(monkeypatch):
    view = LiveView()
    assert view.drawn().number == -1 and live.WAITING in view.drawn().status
    view.put(result(3), "frame 3: not read")
    view.put(result(4), "frame 4: 2.0 frames/s, latency 500 ms; <not trusted>")
    units = []
    figure = lambda *given, unit: units.append(unit) or depth_figure(*given, unit=unit)  # noqa: E731
    monkeypatch.setattr(live, "depth_figure", figure)
    drawn = view.drawn()
    assert drawn.number == 4 and "frame 4: 2.0 frames/s, latency 500 ms; &lt;not trusted&gt;" in drawn.status
    assert 'class="verdict bad"' in drawn.status and units == ["m"]
    expected = np.asarray(depth_figure(made_runs.depth_map()))
    found = shown_image(drawn.depth)
    assert found.shape == expected.shape and np.abs(found.astype(float) - expected).mean() < 3
    assert view.drawn() is drawn and len(units) == 1, "drawn once"
    view.put(result(5, unit=None), "frame 5")
    assert view.drawn().number == 5 and units == ["m", None]


def test_colours_change_slowly():
    view = LiveView()
    view.put(result(0), "")
    first = view._newest
    view.put(result(1, 2.0), "")
    assert view._newest.near == pytest.approx(1.1 * first.near)
    assert view._newest.far == pytest.approx(1.1 * first.far)
    view.put(result(2, 0.0), "")
    assert view._newest.far == pytest.approx(1.1 * first.far), "a frame without depth"


def test_an_open_page_gets_each_result_once():
    gr = pytest.importorskip("gradio")
    view = LiveView()
    page = build_live_page(view)
    (tick,) = (each for each in page.fns.values() if each.targets[0][1] == "tick")
    assert tick.api_visibility == "private"
    assert tick.fn(-1) == [gr.skip()] * 3
    view.put(result(7), "frame 7")
    number, depth, status = tick.fn(-1)
    assert number == 7 and "data:image/jpeg" in depth and "frame 7" in status
    assert tick.fn(7) == [gr.skip()] * 3


@pytest.fixture
def served(tmp_path, monkeypatch):
    """A page on a free port of this machine, and that port."""
    pytest.importorskip("gradio")
    monkeypatch.setattr(live.launch, "_new_folder", lambda: str(tmp_path))
    monkeypatch.setattr(live.launch, "_remove_leftovers", lambda: None)
    monkeypatch.setattr(live.launch.tempfile, "tempdir", None)
    for name in ("GRADIO_TEMP_DIR", *live.launch.QUIET):
        monkeypatch.setenv(name, "before")
    port = free_port()
    with LivePage("127.0.0.1", port) as page:
        yield page, port


def test_it_is_served_like_the_app_until_the_context_ends(served):
    page, port = served
    assert page.address.rstrip("/") == f"http://127.0.0.1:{port}"
    with urllib.request.urlopen(page.address, timeout=30) as answer:
        assert live.TITLE in answer.read().decode()
        assert dict(live.launch.HEADERS)[b"x-content-type-options"].decode() == "nosniff"
        assert answer.headers["content-security-policy"].startswith("default-src 'self'")
    foreign = urllib.request.Request(page.address, headers={"Host": "evil"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(foreign, timeout=30)
    with pytest.raises(InputError, match=f"--host and --port must be .* got 127.0.0.1 and {port}, which is"):
        LivePage("127.0.0.1", port)
    page.show(result(1), "frame 1")
    assert page._view.drawn().number == 1
    page.__exit__()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(page.address, timeout=5)
