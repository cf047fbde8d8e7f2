"""The commands of the tutorial on a first rig, on the demo pair with a calibration of each device."""

import json
import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.plotting import as_rgb_image
from tests.contracts.calibrations import Drawn, oak, quest, realsense_printed, rigid
from tests.contracts.calibrations import zed as zed_conf
from tests.unit.formats.heic_files import write_spatial_photo

pytestmark = pytest.mark.end_to_end

PAGE = Path(__file__).parents[2] / "docs/tutorials/first-rig.md"
#: The fastest preset, and an option that stops a run whose depth is not trusted.
OPTIONS = ("--preset", "fast", "--strict", "--device", "cpu", "-q")
#: Size of raw images of a ZED at 720p.
ZED_SIZE = (1280, 720)
LENS = [0.03, -0.01, 0.002, -0.001]


@pytest.fixture(scope="module")
def demo():
    return read_demo_pair()


def command_of(section: str) -> list[str]:
    """The first command of a section of the page."""
    text = PAGE.read_text("utf-8").partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    command = re.search(r"^geodiff (depth (?:.*\\\n)*.*)$", text, re.M)[1]
    return shlex.split(command.replace("\\\n", " "))


def drawn(demo, K=None, size=None, lens=(0.0,) * 4) -> Drawn:
    """The rig of the demo pair, whose cameras also have a pose in a frame of their own."""
    K = demo.rig.K_left if K is None else K
    T, lenses = np.linalg.inv(demo.rig.E), (list(lens), list(lens))
    return Drawn((K, K), T, size or demo.rig.size_left, lenses, rigid([0.1, -0.2, 0.3], [1.0, 0.4, -0.2]))


def images_of(demo) -> tuple[np.ndarray, np.ndarray]:
    left, right = (np.asarray(as_rgb_image(view)) for view in (demo.left, demo.right))
    return left, right


def write_images(left, right, names=("left.png", "right.png")) -> None:
    for image, name in zip((left, right), names, strict=True):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(name)


def write_zed(demo) -> tuple[np.ndarray, Path]:
    """Raw images of a size that a ZED has, of the middle of the views, with lens distortion."""
    scale = ZED_SIZE[0] / demo.left.shape[1]
    whole = ZED_SIZE[0], round(demo.left.shape[0] * scale)
    top = (whole[1] - ZED_SIZE[1]) // 2
    K = np.diag([scale, scale, 1.0]) @ (demo.rig.K_left + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    K -= [[0, 0, 0.5], [0, 0, 0.5 + top], [0, 0, 0]]
    u, v = np.meshgrid(*map(np.arange, ZED_SIZE))
    px = np.stack([u, v], -1).reshape(-1, 1, 2).astype(np.float64)
    at = cv2.undistortPoints(px, K, np.array(LENS), P=K).reshape(*u.shape, 2).astype(np.float32)
    rows = slice(top, top + ZED_SIZE[1])
    views = [cv2.resize(image, whole, interpolation=cv2.INTER_CUBIC)[rows] for image in images_of(demo)]
    write_images(*(cv2.remap(view, at, None, cv2.INTER_LINEAR) for view in views))
    Path("SN1234.conf").write_text(zed_conf(drawn(demo, K, ZED_SIZE, LENS))[0])
    depth_m = np.where(demo.valid, demo.depth_m, 0)
    return cv2.resize(depth_m, whole, interpolation=cv2.INTER_NEAREST)[rows], Path("geodiff-out")


def write_realsense(demo) -> tuple[np.ndarray, Path]:
    """Grey images of the infrared cameras, which the camera rectifies."""
    grey = [np.asarray(Image.fromarray(image).convert("L")) for image in images_of(demo)]
    write_images(*grey, names=("ir_left.png", "ir_right.png"))
    Path("realsense.txt").write_text(realsense_printed(drawn(demo))[0])
    return np.where(demo.valid, demo.depth_m, 0), Path("geodiff-out")


def write_oak(demo) -> tuple[np.ndarray, Path]:
    """Images that StereoDepth rectified, by the rotations in the calibration."""
    write_images(*images_of(demo))
    rotations = {f"rectifiedRotation{side}": np.eye(3).tolist() for side in ("Left", "Right")}
    sockets = {"leftCameraSocket": 1, "rightCameraSocket": 2}
    entries = json.loads(oak(drawn(demo, lens=LENS))[0]) | {"stereoRectificationData": sockets | rotations}
    Path("oak.json").write_text(json.dumps(entries))
    return np.where(demo.valid, demo.depth_m, 0), Path("geodiff-out")


def write_quest(demo) -> tuple[np.ndarray, Path]:
    """A pair as converted by the recipe, and the cameras of its session."""
    write_images(*images_of(demo), names=[f"pairs/{side}/1000.png" for side in ("left", "right")])
    Path("session").mkdir()
    for side, text in zip(("left", "right"), quest(drawn(demo)), strict=True):
        Path(f"session/{side}_camera_mruk_intrinsics.json").write_text(text)
    return np.where(demo.valid, demo.depth_m, 0), Path("quest-depth/1000")


def write_photo(demo) -> tuple[np.ndarray, Path]:
    """One file with both images and their cameras."""
    pillow_heif = pytest.importorskip("pillow_heif", minversion="1.8")
    pillow_heif.register_heif_opener()
    write_spatial_photo(Path("photo.heic"), images_of(demo), demo.rig.K_left, demo.rig.E[0, 3])
    return np.where(demo.valid, demo.depth_m, 0), Path("geodiff-out")


RECIPES = {
    "ZED": write_zed,
    "RealSense": write_realsense,
    "OAK": write_oak,
    "Quest 3": write_quest,
    "Spatial photos": write_photo,
}


@pytest.mark.parametrize("section", RECIPES)
def test_the_command_of_a_recipe_gives_the_depth_of_the_demo_pair(
    section, demo, geodiff, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    expected_m, out = RECIPES[section](demo)
    words = [word.removeprefix("/usr/local/zed/settings/") for word in command_of(section)]
    answer = geodiff(*words, *OPTIONS)
    assert answer.code == 0, answer.err
    depth_m = np.load(out / "depth.npy")
    scores = evaluate_depth(depth_m, expected_m, expected_m > 0)
    assert scores["abs_rel"] < 0.05 and scores["coverage"] > 0.98
    known = (expected_m > 0) & (depth_m > 0)
    assert np.median(depth_m[known] / expected_m[known]) == pytest.approx(1, abs=0.01)
    assert (out / "undistorted.png").exists() == (section == "ZED")
