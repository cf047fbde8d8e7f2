"""A session of QuestRealityCapture: the recipe of the tutorial, run on files in its layout."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.quest import _camera
from tests.contracts.calibrations import RIG, quest

PAGE = Path(__file__).parents[3] / "docs/tutorials/first-rig.md"
HEADER = (
    "pair_index,left_file_name,right_file_name,left_timestamp_us_realtime,right_timestamp_us_realtime,"
    "time_delta_us,left_frame_index,right_frame_index"
)


def write_session(folder: Path) -> list[np.ndarray]:
    """Two pairs, of which the second is 12 ms apart; returns the images of the first."""
    width, height = RIG.size
    rng, rows, images = np.random.default_rng(0), [HEADER], list[np.ndarray]()
    for side, text in zip(("left", "right"), quest(RIG), strict=True):
        (folder / f"{side}_camera_mruk_rgba").mkdir(parents=True)
        (folder / f"{side}_camera_mruk_intrinsics.json").write_text(text)
    for number, delta in enumerate((900, 12000), 1):
        times = {"left": 10**15 + number, "right": 10**15 + number + delta}
        for side, time in times.items():
            image = rng.integers(0, 256, (height, width, 4), np.uint8)
            image[::-1].tofile(folder / f"{side}_camera_mruk_rgba/{time}.rgba")  # rows from the bottom
            images.append(image)
        names = ",".join(f"{time}.rgba" for time in times.values())
        rows.append(f"{number},{names},{times['left']},{times['right']},{delta},{number},{number}")
    (folder / "mruk_stereo_pairs.csv").write_text("\n".join(rows) + "\n")
    return images[:2]


def test_the_recipe_writes_pairs_that_were_taken_together(tmp_path):
    images = write_session(tmp_path / "session")
    code = re.search(r"## Quest 3.*?```python\n(.*?)```", PAGE.read_text("utf-8"), re.S)[1]
    (tmp_path / "convert.py").write_text(code)
    subprocess.run([sys.executable, "convert.py"], cwd=tmp_path, check=True)
    for side, image in zip(("left", "right"), images, strict=True):
        (path,) = (tmp_path / "pairs" / side).iterdir()
        assert path.name == "1000000000000001.png"
        np.testing.assert_array_equal(np.asarray(Image.open(path)), image[..., :3])
    files = [tmp_path / f"session/{side}_camera_mruk_intrinsics.json" for side in ("left", "right")]
    for order in (files, files[::-1]):  # the files name their side
        rig = read_calibration(order)
        np.testing.assert_allclose(rig.T_right_from_left, RIG.T, atol=1e-9)


def test_the_image_is_a_centred_crop_of_the_sensor_resized():
    """As PassthroughCameraAccess computes it: half the width, and the middle three quarters of the height."""
    entries = {
        "resolution": {"width": 640, "height": 480},
        "sensorResolution": {"width": 1280, "height": 1280},
        "focalLength": {"x": 900.0, "y": 910.0},
        "principalPoint": {"x": 650.0, "y": 630.0},
    }
    camera = _camera(entries)
    expected = [[450, 0, 324.5], [0, 455, 480 - (630 - 160) / 2 - 0.5], [0, 0, 1]]
    np.testing.assert_allclose(camera.K, expected)
    assert camera.size == (640, 480)
