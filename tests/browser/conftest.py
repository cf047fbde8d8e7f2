"""A served page and a headless Chromium; without either the tests are skipped with the reason."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.serving import free_port, served, write_plane

CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync".split()
FLAGS += ["--disable-background-networking", "--disable-component-update"]
FLAGS += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # WebGL without a GPU, for the cloud


#: A window that is no wider is touched.
PHONE_PX = 390


@pytest.fixture(scope="session")
def chromium():
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    found = next(filter(None, map(shutil.which, CHROMIUM_NAMES)), None)
    if found is None:
        pytest.skip(f"no browser is installed ({', '.join(CHROMIUM_NAMES)})")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def server(chromium, tmp_path_factory):
    """Address of ``geodiff app`` in a process of its own, and the file with its output."""
    pytest.importorskip("gradio", reason="gradio is not installed")
    folder, port = tmp_path_factory.mktemp("app"), free_port()
    command = [sys.executable, "-m", "geodiff_plugin", "app", "--device", "cpu", "--port", str(port)]
    with served(command, port, folder) as url:
        yield url, folder / "log.txt"


@pytest.fixture(scope="session")
def address(server):
    """Address of ``geodiff app`` in a process of its own."""
    return server[0]


@pytest.fixture
def visitor(chromium, address):
    """``visitor()`` opens the page as another visitor; foreign requests and exceptions are failures."""
    contexts, foreign, errors = [], [], []

    def note(request) -> None:
        if not request.url.startswith((address, "data:", "blob:")):
            foreign.append(request.url)

    def come(height: int = 1000, width: int = 1400):
        size = {"width": width, "height": height}
        # Without the slow turn at first, which a software renderer would spend its time on.
        context = chromium.new_context(
            viewport=size, accept_downloads=True, reduced_motion="reduce", has_touch=width <= PHONE_PX
        )
        contexts.append(context)
        context.set_default_timeout(60_000)  # of a machine that does other things as well
        page = context.new_page()
        page.on("request", note)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(address)
        page.wait_for_selector("#run")
        return page

    yield come
    for context in contexts:
        context.close()
    assert foreign == [] and errors == []


@pytest.fixture(scope="session")
def plane_files(tmp_path_factory):
    """``plane_files(baseline_m)`` writes a small pair of a tilted plane with its calibration."""
    made: dict[float, list[Path]] = {}

    def make(baseline_m: float = 0.12) -> list[Path]:
        if baseline_m not in made:
            folder = tmp_path_factory.mktemp("plane")
            *files, depth_m = write_plane(folder, baseline_m)
            np.save(folder / "depth.npy", depth_m * baseline_m / 0.12)
            made[baseline_m] = [*files, folder / "depth.npy"]
        return made[baseline_m]

    return make
