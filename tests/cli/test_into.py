"""``geodiff depth --reproject camera.json``: depth as another camera sees it, in files, folders and bags."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._internal.reprojection import maps_in_camera
from geodiff_plugin.cameras import Camera, PosedCamera
from tests.cli.conftest import report_of
from tests.unit.formats.test_target import extrinsic, intrinsic

pytestmark = pytest.mark.end_to_end

#: A preset with confidence and sigma.
QUICK = ["--steps", "1", "--preset", "fast", "--device", "cpu"]
K_TO = [[70.0, 0, 40.0], [0, 70.0, 28.0], [0, 0, 1]]
E_TO = [[1.0, 0, 0, 0.02], [0, 1, 0, -0.01], [0, 0, 1, 0], [0, 0, 0, 1]]
CAMERA = {"K": K_TO, "E": E_TO, "width": 80, "height": 56, "frame_id": "colour"}


def camera_file(folder, **changed):
    path = folder / "camera.json"
    path.write_text(json.dumps({k: v for k, v in (CAMERA | changed).items() if v is not None}))
    return path


def expected_of(folder):
    """Depth and sigma."""
    depth, confidence, sigma = (np.load(folder / f"{name}.npy") for name in ("depth", "confidence", "sigma"))
    camera = PosedCamera(np.array(K_TO), (80, 56), E=np.array(E_TO))
    K = np.reshape(report_of(folder)["K"], (3, 3))
    return maps_in_camera(depth * (confidence > 0), sigma, Camera(K), camera)


def check(folder):
    seen_m, sigma_m = (np.load(folder / f"{name}_reprojected.npy") for name in ("depth", "sigma"))
    np.testing.assert_array_equal((seen_m, sigma_m), expected_of(folder))
    np.testing.assert_array_equal(np.isfinite(sigma_m), seen_m > 0)
    whole, whole_sigma = (
        np.asarray(Image.open(folder / f"{name}_reprojected_mm.png")) for name in ("depth", "sigma")
    )
    assert whole.dtype == whole_sigma.dtype == np.uint16 and whole.shape == whole_sigma.shape == (56, 80)
    np.testing.assert_allclose(whole / 1000, np.where(seen_m < 65.5, seen_m, 0), atol=6e-4)
    expected = np.minimum(np.ceil(1000 * sigma_m.astype(np.float64)), 65535)
    np.testing.assert_array_equal(whole_sigma, np.nan_to_num(expected))
    fraction = report_of(folder)["reproject"]["known_fraction"]
    assert fraction > 0.3 and fraction == pytest.approx((seen_m > 0).mean(), abs=1e-4)


def test_a_pair_is_written_as_the_other_camera_sees_it(pair_files, geodiff, tmp_path):
    words = [*pair_files.command, *QUICK, "--reproject", camera_file(tmp_path), "--out", "o", "-q"]
    answer = geodiff(*words)
    assert answer.code == 0, answer.err
    check(tmp_path / "o")
    files = {f"{name}_reprojected{kind}" for name in ("depth", "sigma") for kind in (".npy", "_mm.png")}
    assert files <= set(report_of(tmp_path / "o")["files"]["names"])


def test_a_camera_that_sees_nothing_is_reported(pair_files, geodiff, tmp_path):
    """Its pose is in centimetres."""
    E = np.array(E_TO)
    E[0, 3] = 1500.0
    words = [*pair_files.command, *QUICK, "--reproject", camera_file(tmp_path, E=E.tolist()), "--out", "o"]
    answer = geodiff(*words)
    assert answer.code == 0 and "The camera of --reproject sees no depth. Check that its E" in answer.err
    assert report_of(tmp_path / "o")["reproject"]["known_fraction"] == 0


def test_the_text_of_a_realsense_is_the_camera_of_its_colour_images(pair_files, geodiff, tmp_path):
    size, text = (80, 56), "Intrinsic Parameters:\n\n"
    for sizes in (size, (160, 112)):
        text += intrinsic("Color", np.array(K_TO), sizes, "RGB8")
    text += extrinsic("Infrared 1", "Color", np.linalg.inv(E_TO))
    (tmp_path / "realsense.txt").write_text(text)
    words = [*pair_files.command, *QUICK, "--reproject", tmp_path / "realsense.txt", "--out", "o", "-q"]
    answer = geodiff(*words)
    assert answer.code == 2 and "--reproject-size must be a size of the colour images" in answer.err
    answer = geodiff(*words, "--reproject-size", "80x56")
    assert answer.code == 0, answer.err
    check(tmp_path / "o")


def test_many_pairs_and_their_smoothed_depth_are_reprojected(pair_files, geodiff, tmp_path):
    for name, file in (("l", pair_files.left), ("r", pair_files.right)):
        (tmp_path / name).mkdir()
        for number in range(2):
            Image.open(file).save(tmp_path / name / f"{number}.png")
    words = [
        "depth",
        "l",
        "r",
        "--calib",
        pair_files.calib,
        *QUICK,
        "--reproject",
        camera_file(tmp_path),
        "-q",
    ]
    answer = geodiff(*words, "--out", "o", "--temporal-smoothing")
    assert answer.code == 0, answer.err
    for number in range(2):
        check(tmp_path / "o" / str(number))
    camera_file(tmp_path, width=81)
    answer = geodiff(*words, "--out", "o", "--temporal-smoothing")
    assert answer.code == 2 and "camera.json changed" in answer.err


def test_a_bag_has_the_depth_and_the_camera_of_that_camera(geodiff, textured_plane, tmp_path, monkeypatch):
    pytest.importorskip("rosbags")
    from rosbags.highlevel import AnyReader

    from tests.unit.formats import bags

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bags, "K", textured_plane.K)
    bags.write_bag(tmp_path / "drive.mcap", images=(textured_plane.left, textured_plane.right))
    topics = ("--left-topic", bags.TOPICS[0], "--right-topic", bags.TOPICS[1])
    answer = geodiff(
        "depth", "drive.mcap", *topics, *QUICK, "--reproject", camera_file(tmp_path), "-q", "--out", "d.mcap"
    )
    assert answer.code == 0, answer.err
    with AnyReader([tmp_path / "d.mcap"]) as reader:
        read = {c.topic: reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()}
    image, info = read["/depth/image"], read["/depth/camera_info"]
    assert image.header.frame_id == info.header.frame_id == "colour"
    sigma = read["/depth/sigma"]
    assert sigma.header == image.header and sigma.encoding == "16UC1"
    values, sigma_values = (x.data.view(np.uint16).reshape(x.height, x.width) for x in (image, sigma))
    seen_m, sigma_m = expected_of(tmp_path / "d-frames/000001")
    np.testing.assert_allclose(values / 1000, np.where(seen_m < 65.5, seen_m, 0), atol=6e-4)
    expected = np.minimum(np.ceil(1000 * sigma_m.astype(np.float64)), 65535)
    np.testing.assert_array_equal(sigma_values, np.nan_to_num(expected))
    np.testing.assert_array_equal(info.k.reshape(3, 3), K_TO)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"E": None}, "without E"),
        ({"width": None, "height": None}, "without width, height"),
        ({"width": "wide"}, "--reproject: size must be an integer"),
        ({"K": [[1, 2], [3, 4]]}, "--reproject: K must be a 3x3 matrix"),
        ({"E": [[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]}, "--reproject: E must be rigid"),
    ],
)
def test_an_invalid_camera_file_is_rejected_before_any_work(changed, words, pair_files, geodiff, tmp_path):
    answer = geodiff(*pair_files.command, "--reproject", camera_file(tmp_path, **changed), "--out", "o", "-q")
    assert answer.code == 2 and words in answer.err and not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    "text", ["[]", "{", "3", "[" * 5000, '{"K": NaN, "E": null, "width": 1, "height": 1}']
)
def test_damaged_camera_files_are_a_sentence(text, pair_files, geodiff, tmp_path):
    (tmp_path / "camera.json").write_text(text)
    answer = geodiff(*pair_files.command, "--reproject", tmp_path / "camera.json", "--out", "o", "-q")
    assert answer.code == 2 and answer.err.startswith("geodiff: --reproject")


def test_it_is_where_opencv_puts_it(pair_files, geodiff, tmp_path):
    """A pixel of the left image lands where ``cv2.projectPoints`` puts its point, at that depth."""
    words = [*pair_files.command, *QUICK, "--reproject", camera_file(tmp_path), "--out", "o", "-q"]
    assert geodiff(*words).code == 0
    depth_m, K = np.load("o/depth.npy"), np.reshape(report_of("o")["K"], (3, 3))
    seen_m = np.load("o/depth_reprojected.npy")
    row, column = 24, 30
    point = np.linalg.inv(K) @ [column, row, 1] * depth_m[row, column] - np.array(E_TO)[:3, 3]
    (u, v) = cv2.projectPoints(point[None], np.zeros(3), np.zeros(3), np.array(K_TO), None)[0][0, 0]
    around = seen_m[int(v) : int(v) + 2, int(u) : int(u) + 2]
    assert around.min() * 0.98 < point[2] < around.max() * 1.02


@pytest.mark.parametrize("fill", [False, True])
def test_masked_pixels_are_in_no_file_unless_they_are_filled(pair_files, geodiff, tmp_path, fill):
    trimesh = pytest.importorskip("trimesh")
    height, width = np.asarray(Image.open(pair_files.left)).shape[:2]
    valid = np.arange(width)[None].repeat(height, 0) >= 20
    for name, mask in (("l.png", valid), ("r.png", valid | (np.arange(height) > 40)[:, None])):
        Image.fromarray(mask.astype(np.uint8) * 255).save(tmp_path / name)
    words = [*pair_files.command, *QUICK, "--mask", "l.png", "--right-mask", "r.png", "--export", "mesh"]
    words += ["--reproject", camera_file(tmp_path), *(["--fill"] if fill else []), "--out", "o", "-q"]
    answer = geodiff(*words)
    assert answer.code == 0, answer.err
    depth_m = np.load("o/depth.npy")
    assert (depth_m[valid] > 0).all() and (depth_m[~valid] > 0).all() == fill == (depth_m[~valid] > 0).any()
    K = np.reshape(report_of("o")["K"], (3, 3))
    check(tmp_path / "o")
    points = np.asarray(trimesh.load("o/mesh.glb", force="mesh").vertices)
    column = K[0, 0] * points[:, 0] / np.abs(points[:, 2]) + K[0, 2]
    assert (column < 19).any() == fill
