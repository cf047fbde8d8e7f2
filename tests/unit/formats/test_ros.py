"""Calibrations of ROS: rectified images and regions of interest."""

import json

import cv2
import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import ros as of_ros
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.calibrated_pair import (
    K_LEFT,
    K_RIGHT,
    KS,
    LENSES,
    SIZE_LEFT,
    SIZES,
    E,
    T,
    assert_is_parallel,
    assert_is_the_pair,
    words,
)


def info(n: int, P, R, **changes) -> dict:
    names = {"K": "camera_matrix", "D": "distortion_coefficients", "R": "rectification_matrix"}
    values = {"K": KS[n].ravel().tolist(), "D": LENSES[n][:5], "R": np.ravel(R).tolist()}
    entries = {name: {"data": values[key]} for key, name in names.items()}
    entries |= {"projection_matrix": {"data": np.ravel(P).tolist()}, "distortion_model": "plumb_bob"}
    entries |= {"image_width": SIZES[n][0], "image_height": SIZES[n][1]}
    return entries | changes


def rectified():
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        K_LEFT, np.zeros(5), K_RIGHT, np.zeros(5), SIZE_LEFT, T[:3, :3], T[:3, 3:], flags=0, alpha=0.3
    )
    return (P1, R1), (P2, R2)


def ros(infos):
    return of_ros.read_ros(tuple(map(json.dumps, infos)), CameraChoice())


LENGTH = float(np.linalg.norm(E[:3, 3]))


def test_ros_camera_info_describes_rectified_and_original_images():
    (P1, R1), (P2, R2) = rectified()
    rig = ros([info(0, P1, R1), info(1, P2, R2)])
    assert_is_parallel(rig, P1[:, :3], P2[:, :3], baseline=LENGTH, sizes=SIZES)
    assert_is_the_pair(rig.as_taken)
    taken = ros([info(0, P1, R1, rectified=False), info(1, P2, R2, rectified=False)])
    assert_is_the_pair(taken)
    assert_is_the_pair(ros([info(0, P1, R1), info(1, P2, R2, rectified=False)]))
    still = ros([info(0, P1, R1, rectified=True), info(1, P2, R2, rectified=True)])
    assert still.rectified and still.as_taken is not None


@pytest.mark.parametrize("keys", ["PKDR", "pkdr"])
def test_ros_messages_use_one_letter_keys(keys):
    infos = []
    for n, (P, R) in enumerate(rectified()):
        values = dict(zip(keys, (P, KS[n], LENSES[n][:5], R), strict=True))
        message = {key: np.ravel(value).tolist() for key, value in values.items()}
        infos.append(message | {"width": SIZES[n][0], "height": SIZES[n][1], "distortion_model": "plumb_bob"})
    rig = ros(infos)
    assert (rig.size_left, rig.size_right) == SIZES
    assert_is_the_pair(rig.as_taken)


def test_ros_files_of_rectified_images_may_omit_the_original_cameras():
    (P1, R1), (P2, R2) = rectified()
    left, right = info(0, P1, R1), info(1, P2, R2)
    for missing in ("distortion_model", "camera_matrix", "rectification_matrix"):
        rig = ros([{k: v for k, v in left.items() if k != missing}, right])
        assert rig.as_taken is None and rig.rectified


@pytest.mark.parametrize(
    "changes",
    [
        {"distortion_model": "double_sphere"},  # which rectified images do not need
        {"camera_matrix": {"data": [0.0] * 9}},  # a driver that knows only P
        {"rectification_matrix": {"data": []}},
    ],
)
def test_a_driver_may_leave_the_original_camera_empty(changes):
    (P1, R1), (P2, R2) = rectified()
    rig = ros([info(0, P1, R1), info(1, P2, R2, **changes)])
    assert rig.as_taken is None and rig.rectified
    with pytest.raises(InputError):
        ros([info(0, P1, R1), info(1, P2, R2, rectified=False, **changes)])


def test_a_rectified_camera_without_lens_coefficients_had_no_distortion():
    (P1, R1), (P2, R2) = rectified()
    none = {"distortion_coefficients": {"data": []}}
    taken = ros([info(0, P1, R1, **none), info(1, P2, R2, **none)]).as_taken
    assert taken.left.lens is taken.right.lens is None


@pytest.mark.parametrize(
    ("name", "damaged", "reported"),
    [
        ("distortion_coefficients", "hello", "the lens distortion of the right camera must be"),
        ("distortion_coefficients", [0.1, 0.2, 0.3], "the lens distortion of the right camera must be"),
        ("camera_matrix", "hello", "K must be"),
        ("camera_matrix", [500.0] * 8, "K must be 9 finite numbers; got 8"),
        ("rectification_matrix", [1.0, "x"], "R must be"),
        ("rectification_matrix", [2.0] * 9, "the rectifying rotation"),
    ],
)
def test_damaged_original_cameras_are_not_ignored(name, damaged, reported):
    """Without them, raw images are not recognised as such."""
    (P1, R1), (P2, R2) = rectified()
    with pytest.raises(InputError, match=reported):
        ros([info(0, P1, R1), info(1, P2, R2, **{name: {"data": damaged}})])


def test_region_of_interest_shifts_all_principal_points():
    (P1, R1), (P2, R2) = rectified()
    windows = [
        {"x_offset": 40, "y_offset": 24, "width": 700, "height": 500},
        {"x_offset": 60, "y_offset": 24, "width": 710, "height": 500},
    ]
    rig = ros([info(0, P1, R1, roi=windows[0]), info(1, P2, R2, roi=windows[1])])
    assert (rig.size_left, rig.size_right) == ((700, 500), (710, 500))
    taken = rig.as_taken
    assert (taken.size_left, taken.size_right) == ((700, 500), (710, 500))
    for K, whole, x in (
        (rig.K_left, P1[:, :3], 40),
        (rig.K_right, P2[:, :3], 60),
        (taken.K_left, K_LEFT, 40),
        (taken.K_right, K_RIGHT, 60),
    ):
        np.testing.assert_allclose(K, whole - [[0, 0, x], [0, 0, 24], [0, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(rig.E[:3, 3], [LENGTH, 0, 0], atol=1e-9)
    np.testing.assert_allclose(taken.E, E, atol=1e-9)
    none = {"x_offset": 0, "y_offset": 0, "width": 0, "height": 0}
    assert ros([info(0, P1, R1, roi=none), info(1, P2, R2)]).size_left == SIZE_LEFT
    only_x = ros([info(0, P1, R1, roi={"x_offset": 3}), info(1, P2, R2, roi={"y_offset": 5})])
    np.testing.assert_allclose(only_x.K_left, P1[:, :3] - [[0, 0, 3], [0, 0, 0], [0, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(only_x.K_right, P2[:, :3] - [[0, 0, 0], [0, 0, 5], [0, 0, 0]], atol=1e-9)


def test_binning_divides_K_and_P_of_binned_images():
    (P1, R1), (P2, R2) = rectified()
    binned = dict(binning_x=2, binning_y=4, roi={"x_offset": 40, "width": 700, "height": 500})
    infos = [info(0, P1, R1, **binned), info(1, P2, R2, **binned)]
    smaller = np.diag([0.5, 0.25, 1])
    shift = np.array([[0, 0, 40], [0, 0, 0], [0, 0, 0]])
    for size in (None, (350, 125)):
        rig = of_ros.read_ros(tuple(map(json.dumps, infos)), CameraChoice(image_size=size))
        assert rig.size_left == rig.size_right == (350, 125)
        np.testing.assert_allclose(rig.K_left, smaller @ (P1[:, :3] - shift), atol=1e-9)
        np.testing.assert_allclose(rig.as_taken.K_right, smaller @ (K_RIGHT - shift), atol=1e-9)
        np.testing.assert_allclose(rig.E[:3, 3], [LENGTH, 0, 0], atol=1e-9)
    rig = of_ros.read_ros(tuple(map(json.dumps, infos)), CameraChoice(image_size=(700, 500)))
    assert rig.size_left == (700, 500)  # a driver that writes K of the binned images
    np.testing.assert_allclose(rig.K_left, P1[:, :3] - shift, atol=1e-9)
    assert ros([info(0, P1, R1, binning_x=0, binning_y=0), info(1, P2, R2)]).size_left == SIZE_LEFT
    odd = ros([info(0, P1, R1, binning_x=2, binning_y=2, image_width=701), info(1, P2, R2)])
    assert odd.size_left[0] == 350
    for wrong in (-2, 1.5):
        with pytest.raises(InputError, match="binning_x, binning_y must be whole numbers of pixels"):
            ros([info(0, P1, R1, binning_x=wrong), info(1, P2, R2)])


def test_ros_files_with_P_of_zeros_name_P():
    (P1, R1), (P2, R2) = rectified()
    with pytest.raises(InputError, match=r"projection_matrix \(P\) must be .*got zeros.*--K, --K-right, --E"):
        ros([info(0, P1, R1), info(1, 0 * P2, R2)])


def test_ros_files_of_single_cameras_are_rejected():
    (P1, R1), (P2, R2) = rectified()
    left, right = info(0, P1, R1), info(1, P2, R2)
    alone = r"These are of single cameras\. Calibrate the pair .*\Z"
    for infos in ([{**left, "projection_matrix": None}, right], [left, {**right, "projection_matrix": None}]):
        with pytest.raises(
            InputError, match=rf"\Aprojection_matrix must be specified in both files; got none\. {alone}"
        ):
            ros(infos)
    with pytest.raises(
        InputError,
        match=r"\Aprojection_matrix\[0, 3\] must be -fx \* baseline in the right "
        rf"camera's file; got the same in both\. {alone}",
    ):
        ros([left, info(1, P1, R2)])


def test_one_camera_info_is_enough_for_a_left_image_alone():
    (P1, R1), _ = rectified()
    alone = CameraChoice(is_alone=True)

    def single(**changes):
        return of_ros.read_ros((json.dumps(info(0, P1, R1, **changes)),), alone)

    of_rectified = single()
    np.testing.assert_allclose(of_rectified.K_left, P1[:, :3])
    assert of_rectified.left.lens is None and of_rectified.size_left == SIZE_LEFT
    for raw in (
        {"projection_matrix": {"data": [0.0] * 12}},
        {"projection_matrix": None},
        {"rectified": False},
    ):
        rig = single(**raw)
        np.testing.assert_allclose(rig.K_left, K_LEFT)
        np.testing.assert_allclose(rig.left.lens.coefficients, LENSES[0][:5])
        np.testing.assert_array_equal(rig.E, np.eye(4))
    binned = single(projection_matrix=None, binning_x=2, binning_y=2, roi={"x_offset": 40})
    np.testing.assert_allclose(binned.K_left[0], (K_LEFT[0] - [0, 0, 40]) / 2)
    assert binned.size_left == (SIZE_LEFT[0] // 2, SIZE_LEFT[1] // 2)


def ini(n: int, P, R) -> str:
    width, height = SIZES[n]
    parts = [f"# oST\n\n[image]\n\nwidth\n{width}\n\nheight\n{height}\n\n[side]\n"]
    for name, matrix in (
        ("camera matrix", KS[n]),
        ("distortion", [LENSES[n][:5]]),
        ("rectification", R),
        ("projection", P),
    ):
        parts.append(f"{name}\n" + "\n".join(words(row) for row in matrix) + "\n")
    return "\n".join(parts)


def test_ros_ini_files_match_the_yaml_form():
    texts = [ini(n, P, R) for n, (P, R) in enumerate(rectified())]
    (P1, _), (P2, _) = rectified()
    for given in (tuple(texts), ("\n".join(texts),)):
        rig = of_ros.read_ros_ini(given, CameraChoice())
        assert_is_parallel(rig, P1[:, :3], P2[:, :3], baseline=LENGTH, sizes=SIZES)
        assert_is_the_pair(rig.as_taken)
    for given, count in (((texts[0],), 1), ((*texts, texts[0]), 3), (("x",), 0)):
        with pytest.raises(
            InputError,
            match=rf"\Athe file must be a file of two cameras, each starting with \[image\]; "
            rf"got {count} of them\. Pass left\.ini and right\.ini",
        ):
            of_ros.read_ros_ini(given, CameraChoice())
