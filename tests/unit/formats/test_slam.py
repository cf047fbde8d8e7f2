"""Settings of SLAM programs."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import slam
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.calibrated_pair import (
    BODIES,
    K_LEFT,
    K_RIGHT,
    KS,
    LENS_LEFT,
    LENS_RIGHT,
    LENSES,
    SIZE_LEFT,
    SIZE_RIGHT,
    SIZES,
    UNCHOSEN,
    E,
    T,
    assert_is_parallel,
    assert_is_the_pair,
    numbers,
)


def read(reader, content, choice=UNCHOSEN):
    return reader((json.dumps(content),), choice)


@pytest.mark.parametrize(("lens", "model"), [("radialtangential", "opencv"), ("equidistant", "fisheye")])
def test_okvis_poses_are_in_the_imu_frame(lens, model):
    cameras = []
    for n, body in enumerate(BODIES):
        fx, fy, cx, cy = numbers(KS[n])
        cameras.append(
            {
                "T_SC": body.ravel().tolist(),
                "image_dimension": SIZES[n],
                "distortion_type": lens,
                "distortion_coefficients": LENSES[n][:4],
                "focal_length": [fx, fy],
                "principal_point": [cx, cy],
            }
        )
    assert_is_the_pair(read(slam.read_okvis, {"cameras": cameras}), lens=4, model=model)
    several = {"cameras": [cameras[1], cameras[1], cameras[0]]}
    assert_is_the_pair(read(slam.read_okvis, several, CameraChoice((2, 0))), lens=4, model=model)
    with pytest.raises(InputError, match=r"file \(0, 1, 2\); got 0,3"):
        read(slam.read_okvis, several, CameraChoice((0, 3)))


def matrix(values):
    return {"rows": 1, "cols": 1, "data": np.ravel(values).tolist()}


@pytest.mark.parametrize(
    ("key", "lens", "model"),
    [("T_B_C", "radial-tangential", "opencv"), ("T_C_B", "equidistant", "fisheye")],
)
def test_svo_poses_are_in_the_body_frame_or_inverted(key, lens, model):
    cameras = []
    for n, body in enumerate(BODIES):
        camera = {"type": "pinhole", "image_width": SIZES[n][0], "image_height": SIZES[n][1]}
        camera |= {"intrinsics": matrix(numbers(KS[n])), "distortion": {"type": lens}}
        camera["distortion"]["parameters"] = matrix(LENSES[n][:4])
        cameras.append({"camera": camera, key: matrix(body if key == "T_B_C" else np.linalg.inv(body))})
    rig = {"cameras": cameras}
    assert_is_the_pair(read(slam.read_svo, rig), lens=4, model=model)
    assert_is_the_pair(read(slam.read_svo, {"sensors": [{"id": 1}, rig]}), lens=4, model=model)
    several = {"cameras": [cameras[1], cameras[0], cameras[1]]}
    assert_is_the_pair(read(slam.read_svo, several, CameraChoice((1, 2))), lens=4, model=model)
    cameras[0]["camera"]["type"] = "omni"
    with pytest.raises(InputError, match="lens model of the left camera must be .*; got omni"):
        read(slam.read_svo, rig)


STELLA = dict(zip(("fx", "fy", "cx", "cy"), numbers(K_LEFT), strict=True))
STELLA |= {"setup": "stereo", "model": "perspective", "cols": 820, "rows": 616}
STELLA["focal_x_baseline"] = 0.173 * 811.5


def test_stella_rectified_settings_keep_the_original_cameras():
    rig = read(slam.read_stella, {"Camera": STELLA})
    assert_is_parallel(rig, sizes=(SIZE_LEFT, SIZE_LEFT))
    assert rig.as_taken is None
    R1, R2, *_ = cv2.stereoRectify(
        K_LEFT, np.zeros(5), K_RIGHT, np.zeros(5), SIZE_LEFT, T[:3, :3], T[:3, 3:], flags=0
    )
    length = float(np.linalg.norm(T[:3, 3]))
    camera = STELLA | {"focal_x_baseline": length * 811.5}
    made = {"R_left": R1.ravel().tolist(), "R_right": R2.ravel().tolist()}
    for n, side in enumerate(("left", "right")):
        made |= {f"K_{side}": KS[n].ravel().tolist(), f"D_{side}": LENSES[n][:5]}
    taken = read(slam.read_stella, {"Camera": camera, "StereoRectifier": made}).as_taken
    assert taken.size_left == taken.size_right == SIZE_LEFT
    np.testing.assert_allclose(taken.E, E, atol=1e-9)
    for got, expected in ((taken.K_left, K_LEFT), (taken.K_right, K_RIGHT)):
        np.testing.assert_array_equal(got, expected)
    assert [each.coefficients.tolist() for each in taken.distortion] == [LENS_LEFT[:5], LENS_RIGHT[:5]]
    fisheye = made | {"model": "fisheye", "D_left": LENS_LEFT[:4], "D_right": LENS_RIGHT[:4]}
    taken = read(slam.read_stella, {"Camera": camera, "StereoRectifier": fisheye}).as_taken
    assert [each.model for each in taken.distortion] == ["fisheye", "fisheye"]


@pytest.mark.parametrize(
    ("changes", "got"),
    [
        ({"model": "equirectangular"}, "of setup stereo and model equirectangular"),
        ({"focal_x_baseline": None, "setup": "monocular"}, "of setup monocular and model perspective"),
    ],
)
def test_stella_settings_without_a_stereo_pair_are_refused(changes, got):
    camera = {key: value for key, value in (STELLA | changes).items() if value is not None}
    sentence = (
        r"\Athe settings must be of a stereo camera \(setup stereo, model perspective, focal_x_baseline\); "
    )
    with pytest.raises(InputError, match=rf"{sentence}got {got}\. Give the settings that stella_vslam .*\Z"):
        read(slam.read_stella, {"Camera": camera})


@pytest.mark.parametrize(
    ("kind", "model", "count"), [(0, "opencv", None), (1, "opencv", 5), (2, "fisheye", 4)]
)
@pytest.mark.parametrize("inverse", [(0, 0), (1, 1), (0, 1)])
def test_airslam_poses_may_be_inverted_per_camera(kind, model, count, inverse):
    content = {"image_width": 820, "image_height": 616, "distortion_type": kind}
    for n, body in enumerate(BODIES):
        pose = np.linalg.inv(body) if inverse[n] else body
        content[f"cam{n}"] = {
            "intrinsics": numbers(KS[n]),
            "distortion_coeffs": LENSES[n][:5],
            "T_type": inverse[n],
            "T": pose.tolist(),
        }
    rig = read(slam.read_airslam, content)
    assert rig.size_left == rig.size_right == SIZE_LEFT
    assert_is_the_pair(replace(rig, size_right=SIZE_RIGHT), lens=count, model=model)
    with pytest.raises(InputError, match=r"\Adistortion_type must be one of 0, 1, 2; got 3\.\Z"):
        read(slam.read_airslam, content | {"distortion_type": 3})


def test_stvo_settings_have_two_cameras_or_one_rectified():
    size = {"cam_width": 820, "cam_height": 616}
    both = {"Kl": numbers(K_LEFT), "Kr": numbers(K_RIGHT), "Dl": LENS_LEFT[:5], "Dr": LENS_RIGHT[:5]}
    both |= {"R": T[:3, :3].ravel().tolist(), "t": T[:3, 3].tolist(), "cam_bl": 9.0} | size
    rig = read(slam.read_stvo, {"cam0": both})
    assert rig.size_left == rig.size_right == SIZE_LEFT
    assert_is_the_pair(replace(rig, size_right=SIZE_RIGHT))
    one = {f"cam_{key}": STELLA[key] for key in ("fx", "fy", "cx", "cy")} | size | {"cam_bl": 0.173}
    assert_is_parallel(read(slam.read_stvo, {"cam0": one}), sizes=(SIZE_LEFT, SIZE_LEFT))
    bent = read(
        slam.read_stvo, {"cam0": one | {"cam_d0": 0.3, "cam_d1": -0.1, "cam_d2": 0.02, "cam_d3": 0.01}}
    )
    assert [each.coefficients.tolist() for each in bent.distortion] == [[0.3, -0.1, 0.02, 0.01]] * 2
    assert not bent.rectified
