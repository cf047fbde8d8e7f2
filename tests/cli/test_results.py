"""``--export`` and ``geodiff video``."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin import plotting
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, read_demo_pair
from geodiff_plugin.cameras import Camera
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.lenses import distortion_from_text, undistorted
from tests.cli.conftest import QUICK, report_of

pytestmark = pytest.mark.end_to_end

LENS = "-0.2,0.05,0,0"


def test_exports_are_next_to_the_ply(geodiff, textured_plane, command):
    out, exports = Path("geodiff-out"), "--export glb --export mesh --export colmap".split()
    assert geodiff(*command, "--set", "guidance_steps=0", *exports).code == 0
    assert all((out / f"{name}.glb").read_bytes()[:4] == b"glTF" for name in ("cloud", "mesh"))
    rig = read_calibration(out, image_names=("left.png", "right.png"), baseline_m=0.12)
    np.testing.assert_allclose(rig.E, textured_plane.E, atol=1e-6)
    assert geodiff(*command, *QUICK, "-q", "--overwrite").code == 0  # it leaves none of them behind
    assert not any((out / name).exists() for name in ("cloud.glb", "mesh.glb", "cameras.txt"))


def test_a_colmap_model_names_what_its_cameras_took(geodiff, command, pair_files):
    """Of a pair as if its lenses had distortion, and a third view without."""
    Image.fromarray(255 - np.asarray(Image.open(pair_files.right))).save("third.png")
    np.savetxt("pose.txt", np.eye(4) + 0.12 * np.eye(4, k=3))
    camera = f"--fx 60 --fy 60 --cx 31.5 --cy 23.5 --baseline 0.12 --distortion {LENS}".split()
    camera += "--steps 1 --set guidance_steps=0 -q --export colmap".split()
    view = ["--view", "third.png", "--view-E", "pose.txt", "--view-distortion", "0,0,0,0"]
    answer = geodiff(*command[:3], *command[5:], *camera, *view)
    assert answer.code == 0, answer.err
    out, written = Path("geodiff-out"), ["undistorted.png", "undistorted-2.png", "undistorted-3.png"]
    lines = (out / "images.txt").read_text().splitlines()
    assert [line.split()[9] for line in lines if line and line[0] != "#"] == written
    rig = read_calibration(out, image_names=tuple(written[:2]), baseline_m=0.12)
    assert rig.size_right == (64, 48) and rig.K_left[0, 0] == 60
    for name, path, lens in ((written[1], "right.png", LENS), (written[2], "third.png", "0,0,0,0")):
        image_01 = np.asarray(Image.open(path), np.float32) / 255
        expected = undistorted(image_01, Camera(rig.K_left, lens=distortion_from_text(lens)))
        image = np.asarray(Image.open(out / name), np.float32) / 255
        assert np.abs(image - expected).mean() < 0.01, "but for cleaning"
    assert set(report_of()["files"]["names"]) == {path.name for path in out.iterdir()}


def test_exported_cameras_are_those_that_the_cloud_fits(geodiff, prior, tmp_path, monkeypatch):
    """Of refined poses: the given ones leave the cloud next to what the right image shows."""
    monkeypatch.chdir(tmp_path)
    pair, turn = read_demo_pair(), np.radians(1.0)
    moved = pair.rig.E.copy()
    moved[1:3, 1:3] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    np.savetxt("K.txt", pair.rig.K_left)
    np.savetxt("E.txt", moved)
    views = [DEMO_PAIR_FOLDER / "left.png", DEMO_PAIR_FOLDER / "right.png", "--K", "K.txt", "--E", "E.txt"]
    run = ["--prior", prior, "--device", "cpu", "--steps", 1, "--resolution", 64, "--export", "colmap"]
    answer = geodiff("depth", *views, *run)
    assert answer.code == 0, answer.err
    pose = report_of()["pose"]
    assert pose["status"] == "refined"
    rig = read_calibration("geodiff-out", image_names=("left.png", "right.png"), baseline_m=0.12)
    np.testing.assert_allclose(rig.E[:3, :3], np.array(pose["E"][0])[:3, :3], atol=1e-5)
    assert not np.allclose(rig.E[:3, :3], moved[:3, :3], atol=3e-3)


# Videos


@pytest.fixture
def maps(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in range(3):
        np.save(f"{number}.npy", np.linspace(1, 4, 48 * 64, dtype=np.float32).reshape(48, 64) + number)
    return ["0.npy", "1.npy", "2.npy"]


@pytest.mark.parametrize("name", ["depth.webp", "depth.gif", "depth.mp4"])
def test_video(geodiff, maps, name):
    answer = geodiff("video", *maps, "--out", name, "--fps", 4)
    assert answer.code == 0 and "3 frames, 0.8 s" in answer.out, answer.err
    if name.endswith("mp4"):
        video = cv2.VideoCapture(name)
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 3 and video.get(cv2.CAP_PROP_FPS) == 4
        return
    with Image.open(name) as video:
        first = np.asarray(video.convert("RGB")).astype(int)
        assert video.n_frames == 3 and video.info["duration"] == 250
        video.seek(2)
        assert np.abs(first - np.asarray(video.convert("RGB"))).mean() > 10, "one range: it is farther"


def test_a_video_is_in_metres_unless_a_report_states_otherwise(geodiff, maps, monkeypatch):
    units, drawn = [], plotting.depth_frames

    def noting(*arguments, **named):
        units.append(named["unit"])
        return drawn(*arguments, **named)

    monkeypatch.setattr(plotting, "depth_frames", noting)
    for unit in ("m", None):
        Path("depth.npy").write_bytes(Path(maps[0]).read_bytes())
        Path("report.json").write_text(json.dumps({"unit": unit}))
        assert geodiff("video", ".", "--out", "depth.gif", "--overwrite").code == 0
    assert units == ["m", None]
