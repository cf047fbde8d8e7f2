"""The Space's app, started as the Space starts it and asked through gradio's own client."""

import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

from tests.serving import free_port, served, write_plane

pytestmark = pytest.mark.end_to_end

SPACE = Path(__file__).resolve().parents[2] / "examples" / "space"


@pytest.fixture
def address(tmp_path):
    pytest.importorskip("gradio", reason="gradio is not installed")
    port = free_port()
    (tmp_path / "server").mkdir()
    environment = {"GRADIO_SERVER_PORT": str(port), "TMPDIR": str(tmp_path / "server")}
    with served([sys.executable, "app.py"], port, tmp_path, environment, cwd=SPACE) as url:
        yield url


def test_card_has_what_a_space_needs():
    yaml = pytest.importorskip("yaml")
    _, head, text = (SPACE / "README.md").read_text().split("---", 2)
    card = yaml.safe_load(head)
    assert card["sdk"] == "gradio" and (SPACE / card["app_file"]).exists() and text.strip()
    lines = (SPACE.parents[1] / "constraints.txt").read_text().splitlines()
    pinned = next(line for line in lines if line.startswith("gradio=="))
    assert pinned == f"gradio=={card['sdk_version']}"
    assert len(card["short_description"]) <= 60
    project = tomllib.loads((SPACE.parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(project["dependencies"]) <= set((SPACE / "requirements.txt").read_text().splitlines())


@pytest.mark.filterwarnings("ignore")  # the client's own
@pytest.mark.slow
def test_it_answers_the_client(address, tmp_path):
    client_module = pytest.importorskip("gradio_client")
    *files, true_m = write_plane(tmp_path)
    left, right, K = (client_module.handle_file(str(path)) for path in files)
    client = client_module.Client(address, verbose=False, download_files=str(tmp_path / "home"))
    asked = client.view_api(return_format="dict")["named_endpoints"]["/estimate"]["parameters"]
    by_label = {entry["label"]: entry["parameter_name"] for entry in asked}
    calibration = next(name for label, name in by_label.items() if label.startswith("Calibration file"))
    given = {entry["parameter_name"]: None for entry in asked if not entry["parameter_has_default"]}
    given |= {by_label["Left image"]: left, by_label["Right image"]: right, calibration: [K]}
    answer = client.predict(**given, api_name="/estimate")
    kept = {path.name for path in (tmp_path / "server").rglob("*.npy")}
    client.close()
    assert kept and "median depth" in str(answer[0])
    files = [entry for entry in answer if isinstance(entry, list) and "depth.npy" in str(entry)][0]
    depth_m = np.load(next(path for path in files if str(path).endswith("depth.npy")))
    assert np.median(np.abs(depth_m - true_m) / true_m) < 0.1
    for _ in range(60):  # the server notices within seconds that the visitor has left
        if not list((tmp_path / "server").rglob("*.npy")):
            return
        time.sleep(0.5)
    pytest.fail("what a visitor got is still there")
