"""``transforms.json`` of nerfstudio and instant-ngp: axes, pixel centres, angles, lenses, names."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import InputError
from geodiff_plugin.app.cameras import CAMERA_WAYS, CameraFields, Views
from geodiff_plugin.cli.inputs import read_rig
from geodiff_plugin.cli.options import DepthOptions
from tests.contracts import factory_calibrations as factory
from tests.scenes import render_pair

NAMES = ("images/left.jpg", "images/right.jpg")


@pytest.fixture
def reading(tmp_path):
    """``reading(data, **choice)`` reads what ``json`` makes of the data, for a caller that undistorts."""

    def read(data: dict, **choice):
        given = {"image_names": NAMES, "baseline_m": 0.12, "distorted": True} | choice
        return factory.read_texts(tmp_path, json.dumps(data), **given)

    return read


@pytest.fixture
def data() -> dict:
    return json.loads(factory.NERF)


def turned(data: dict) -> dict:
    """The sample with two cameras that share no axis, at places that differ in all directions."""
    data = copy.deepcopy(data)
    for frame, turn, place in zip(
        data["frames"], ([0.3, 0.5, -0.2], [0, 0, 0], [0.1, 0.7, 0.1]), np.eye(3), strict=True
    ):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
        frame["transform_matrix"] = matrix.tolist()
    return data


def nerf_pixels(frame: dict, camera: dict, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where NeRF's camera, looking along -z with y up, sees points; first pixel's centre at 0.5."""
    matrix = np.array(frame["transform_matrix"])
    x, y, z = matrix[:3, :3].T @ (points - matrix[:3, 3]).T
    return np.stack([camera["cx"] - camera["fl_x"] * x / z, camera["cy"] + camera["fl_y"] * y / z], -1), -z


def test_points_land_where_nerfs_own_cameras_see_them(reading, data):
    data = turned(data) | {"fl_y": 650.0}
    left, _, right = data["frames"]
    with pytest.warns(UserWarning, match="has no unit"):
        rig = reading(data, baseline_m=None)
    world = np.array(left["transform_matrix"])
    places = np.random.default_rng(0).uniform([-1, -1, -9], [1, 1, -4], (20, 3))
    points = places @ world[:3, :3].T + world[:3, 3]
    (seen, depth), (expected, _) = (nerf_pixels(frame, data, points) for frame in (left, right))
    rays = np.linalg.inv(rig.K_left) @ np.vstack([(seen - 0.5).T, np.ones(20)])
    in_right = rig.T_right_from_left @ np.vstack([rays * depth, np.ones(20)])
    projected = rig.K_right @ in_right[:3]
    np.testing.assert_allclose((projected[:2] / projected[2]).T, expected - 0.5, atol=1e-8)


def test_a_rendered_pair_comes_back(reading):
    pair = render_pair(3, "room", (48, 64), posed=True)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = Rotation.from_rotvec([1.1, -0.4, 0.8]).as_matrix(), (3, -2, 5)
    K, truth = pair.K_left.numpy(), pair.E.numpy()
    frames = []
    for name, E in zip(NAMES, (np.eye(4), truth), strict=True):
        axes = world @ E
        axes[:3, 1:3] *= -1  # y up, z backward
        axes[:3, 3] *= 1.7  # of no unit
        frames.append({"file_path": name, "transform_matrix": axes.tolist()})
    focal = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5, "w": 64, "h": 48}
    rig = reading(focal | {"frames": frames}, baseline_m=float(np.linalg.norm(truth[:3, 3])))
    assert np.abs(truth[:3, 3]).min() > 1e-3 and np.abs(truth[:3, :3] - np.eye(3)).max() > 0.01
    np.testing.assert_allclose(rig.E, truth, atol=1e-12)
    np.testing.assert_allclose(rig.K_left, K)
    np.testing.assert_allclose(rig.K_right, K)


# Units


def test_without_a_measured_distance_it_warns_and_keeps_the_unit_before_nerfstudios_scale(reading, data):
    with pytest.warns(UserWarning, match="has no unit.*--baseline"):
        assert reading(data, baseline_m=None).E[0, 3] == pytest.approx(0.5)
    with pytest.warns(UserWarning, match="has no unit"):
        assert reading(data | {"applied_scale": 0.25}, baseline_m=None).E[0, 3] == pytest.approx(2.0)
    with pytest.raises(InputError, match="applied_scale.* above 0"):
        reading(data | {"applied_scale": 0})


# Intrinsics


def test_pixel_centres_and_size(reading, data):
    rig = reading(data)
    assert rig.K_left.tolist() == [[700, 0, 300], [0, 700, 200], [0, 0, 1]]
    assert rig.size_left == rig.size_right == (640, 480) and not rig.rectified


def without(data: dict, *keys: str) -> dict:
    return {key: value for key, value in data.items() if key not in keys}


def test_angles_of_nerfs_rendered_scenes(reading, data):
    angle = 2 * math.atan(320 / 700)
    bare = without(data, "fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model") | {"camera_angle_x": angle}
    rig = reading(bare, image_size=(640, 480))
    np.testing.assert_allclose(rig.K_right, [[700, 0, 319.5], [0, 700, 239.5], [0, 0, 1]])
    rig = reading(bare | {"camera_angle_y": 2 * math.atan(240 / 600), "w": 640.0, "h": 480.0})
    np.testing.assert_allclose(np.diag(rig.K_left), [700, 600, 1])
    with pytest.raises(InputError, match=r"entries 'w' and 'h'; got none\. Give image_size"):
        reading(bare)
    with pytest.raises(InputError, match=r"camera_angle_x .* in radians.*got 50\.0\. Is it in deg"):
        reading(bare | {"camera_angle_x": 50.0}, image_size=(640, 480))


def test_a_focal_length_goes_before_an_angle_and_one_may_stand_for_both_axes(reading, data):
    rig = reading(without(data, "fl_y") | {"camera_angle_x": 0.1})
    assert np.diag(rig.K_left).tolist() == [700, 700, 1]
    with pytest.raises(InputError, match="'fl_x' or 'camera_angle_x'; got none"):
        reading(without(data, "fl_x", "fl_y"))


def test_entries_of_a_frame_go_before_those_of_the_file(reading, data):
    data["frames"][2] |= {"fl_x": 350, "fl_y": 351, "cx": 160.5, "cy": 120.5, "w": 320, "h": 240, "k1": 0.1}
    rig = reading(data)
    assert np.diag(rig.K_left).tolist() == [700, 700, 1] and rig.size_left == (640, 480)
    assert rig.K_right.tolist() == [[350, 0, 160], [0, 351, 120], [0, 0, 1]] and rig.size_right == (320, 240)
    assert rig.distortion[0] is None and rig.distortion[1].coefficients[0] == 0.1


# Lenses


def test_perspective_lenses_are_nerfstudios_polynomial(reading, data):
    k1, k2, k3, p1, p2 = -0.2, 0.05, 0.01, 0.003, -0.002
    lens = reading(data | {"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2}).distortion[0]
    assert lens.model == "opencv"
    x, y = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 30))
    r = x**2 + y**2
    d = 1 + k1 * r + k2 * r**2 + k3 * r**3
    bent = x * d + 2 * p1 * x * y + p2 * (r + 2 * x**2), y * d + 2 * p2 * x * y + p1 * (r + 2 * y**2)
    rays = np.stack([x, y, np.ones(30)], -1)
    points, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), lens.coefficients)
    np.testing.assert_allclose(points[:, 0], np.stack(bent, -1), atol=1e-12)
    params = {"distortion_params": [k1, k2, k3, 0, p1, p2]}
    np.testing.assert_array_equal(reading(data | params).distortion[1].coefficients, lens.coefficients)


@pytest.mark.parametrize("said", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_fisheyes(reading, data, said):
    k = [0.1, -0.02, 0.003, 0.0004]
    given = without(data, "camera_model") | said | dict(zip(("k1", "k2", "k3", "k4"), k, strict=True))
    for lens in reading(given).distortion:
        assert lens.model == "fisheye" and lens.coefficients.tolist() == k
    with pytest.raises(InputError, match="Lens distortion of the left camera"):
        reading(given, distorted=False)


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", None])
def test_models_of_a_pinhole(reading, data, model):
    given = without(data, "camera_model") | ({} if model is None else {"camera_model": model})
    assert reading(given, distorted=False).distortion == (None, None)


# Names


def named(data: dict, *names: str) -> dict:
    data = copy.deepcopy(data)
    for frame, name in zip(data["frames"], names, strict=True):
        frame["file_path"] = name
    return data


@pytest.mark.parametrize(
    ("in_file", "asked"),
    [
        (("./train/r_0", "./train/r_1", "./train/r_2"), ("train/r_0.png", "/data/lego/train/r_2.png")),
        (("images/a.png", "images/b.png", "images/c.png"), ("a.png", "c.png")),  # typed in their folder
        (("../images/a.png", "../images/b.png", "../images/c.png"), ("/x/images/a.png", "images/c.png")),
        (("images\\a.png", "images\\b.png", "images\\c.png"), ("images/a.png", "/x/images/c.png")),
        (("one/0.png", "one/1.png", "two/0.png"), ("/x/one/0.png", "two/0.png")),
        (("0.png", "1.png", "two/0.png"), ("one/0.png", "two/0.png")),
    ],
)
def test_images_are_found_by_the_ends_of_their_paths(reading, data, in_file, asked):
    rig = reading(named(data, *in_file), image_names=asked)
    assert rig.E[0, 3] == pytest.approx(0.12) and rig.E[0, 0] == pytest.approx(1)


# Matrices and other entries


def test_a_matrix_may_lack_its_last_row(reading, data):
    for frame in data["frames"]:
        del frame["transform_matrix"][3]
    assert reading(data).E[0, 3] == pytest.approx(0.12)


# The doors


@pytest.mark.parametrize("kind", ["nerf", "colmap"])
def test_every_pair_of_a_folder_has_its_own_cameras(tmp_path, kind):
    if kind == "nerf":
        path = tmp_path / "named_freely.txt"
        path.write_text(json.dumps(turned(json.loads(factory.NERF))))
        calib = (path,)
    else:
        calib = (tmp_path / "one.txt", tmp_path / "two.txt")
        for path, text in zip(calib, (factory.COLMAP_CAMERAS, factory.COLMAP_IMAGES), strict=True):
            path.write_text(text)
    folder = Path("images" if kind == "nerf" else "rig")
    size = (640, 480)

    def read(right: str):
        given = DepthOptions(left=folder / "left.jpg", right=folder / right, calib=calib, baseline=0.12)
        return read_rig(given, size, size)

    first = read("right.jpg")
    assert np.abs(read("other.jpg").E - first.E).max() > 0.01
    assert read("right.jpg").E.tolist() == first.E.tolist()


def test_the_page_knows_photographs_by_their_names_alone(tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text(factory.NERF)
    image = np.random.default_rng(0).random((480, 640, 3)).astype(np.float32)
    views = Views(image, image, None, ("/tmp/page/0f/left.jpg", "/tmp/page/3a/right.jpg"))
    guidance = CAMERA_WAYS["file"].guide(views, CameraFields(calibration=str(path), baseline_m=0.12), {})
    assert float(guidance.rigs[0].E[0, 3]) == pytest.approx(0.12)
