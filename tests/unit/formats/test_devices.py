"""Calibrations from ZED, RealSense and OAK-D."""

import json

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import devices
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.calibrated_pair import (
    K_LEFT,
    K_RIGHT,
    KS,
    LENSES,
    SIZE_LEFT,
    SIZE_RIGHT,
    SIZES,
    E,
    T,
    assert_is_parallel,
    assert_is_the_pair,
    numbers,
    pose,
    vector,
    words,
)
from tests.views import lenses_of

# ZED

#: Names of the resolutions of one camera.
ZED_SIZES = {
    "4K": (3840, 2160),
    "QHDPLUS": (3200, 1800),
    "2K": (2208, 1242),
    "FHD1200": (1920, 1200),
    "FHD": (1920, 1080),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}


def zed_text(name: str = "FHD", count: int = 8, per_size: str = "_FHD", lens_apart: bool = False) -> str:
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")[:count]
    lines = []
    for n, side in enumerate(("LEFT", "RIGHT")):
        lines += [f"[{side}_CAM_{name}]"]
        lines += [f"{key}={v!r}" for key, v in zip(("fx", "fy", "cx", "cy"), numbers(KS[n]), strict=True)]
        lines += [f"[{side}_DISTO]"] if lens_apart else []
        lines += [f"{key}={v!r}" for key, v in zip(order, LENSES[n], strict=False)]
    shift = (-1000 * T[:3, 3]).tolist()
    lines += [
        "[STEREO]",
        f"Baseline={shift[0]!r}",
        f"TY{per_size}={shift[1]!r}",
        f"TZ{per_size}={shift[2]!r}",
    ]
    lines += [f"{key}_{name}={v!r}" for key, v in zip(("RX", "CV", "RZ"), vector(T), strict=True)]
    lines += [f"{key}_OTHER=0.7" for key in ("RX", "CV", "RZ", "TY", "TZ")]
    return "\n".join(lines) + "\n"


def zed(text: str, size=None):
    return devices.read_zed((text,), CameraChoice(image_size=size))


@pytest.mark.parametrize("per_size", ["_FHD", ""])
@pytest.mark.parametrize("lens_apart", [True, False])
@pytest.mark.parametrize("count", [4, 5, 8])
def test_zed_pose_is_a_rotation_vector_and_a_shift_in_millimetres(per_size, lens_apart, count):
    rig = zed(zed_text("FHD", count, per_size, lens_apart))
    assert rig.size_left == rig.size_right == (1920, 1080)
    np.testing.assert_allclose(rig.E, E, atol=1e-9)
    for K, lens, expected, coefficients in zip(
        (rig.K_left, rig.K_right), lenses_of(rig), KS, LENSES, strict=True
    ):
        np.testing.assert_array_equal(K, expected)
        padded = [*coefficients[:count], 0.0][: max(5, count)]
        assert lens.coefficients.tolist() == padded and lens.model == "opencv"


@pytest.mark.parametrize(("name", "size"), ZED_SIZES.items())
def test_zed_sections_are_selected_by_resolution(name, size):
    assert zed(zed_text(name, per_size="")).size_left == size
    other = zed_text("VGA" if name != "VGA" else "HD", per_size="").partition("[STEREO]")[0]
    both = other.replace("fx=", "fx=1") + zed_text(name, per_size="")
    np.testing.assert_array_equal(zed(both, size).K_right, K_RIGHT)
    with pytest.raises(InputError, match="the left image must be of a size in the file"):
        zed(both)
    with pytest.raises(InputError, match=r"size in the file \(none\)"):
        zed(zed_text(name).replace("RIGHT_CAM", "NO_CAM"))


def test_zed_files_may_repeat_sections_and_contain_percent_signs():
    """The last value wins, and percent signs are not interpolated."""
    text = zed_text().replace("[STEREO]", "[STEREO]\nnote=50% of %(x)s\nTZ_FHD=9")
    text = text.replace("[LEFT_CAM_FHD]", "[LEFT_CAM_FHD]\nfx=1\n[LEFT_CAM_FHD]")
    rig = zed(text)
    np.testing.assert_allclose(rig.E, E, atol=1e-9)
    np.testing.assert_array_equal(rig.K_left, K_LEFT)


def test_early_zed_files_have_only_the_baseline():
    bare = "\n".join(line for line in zed_text().splitlines() if line[:2] not in ("TY", "TZ"))
    np.testing.assert_allclose(zed(bare).T_right_from_left[:3, 3], [T[0, 3], 0, 0], atol=1e-12)


# RealSense


def rs_camera(n: int, model="brown_conrady", count: int = 5, **changes) -> dict:
    values = dict(zip(("fx", "fy", "ppx", "ppy"), numbers(KS[n]), strict=True))
    values |= {"width": SIZES[n][0], "height": SIZES[n][1], "model": model, "coeffs": LENSES[n][:count]}
    return values | changes


BETWEEN = {"rotation": T[:3, :3].T.ravel().tolist(), "translation": T[:3, 3].tolist()}
BACK = {"rotation": E[:3, :3].T.ravel().tolist(), "translation": E[:3, 3].tolist()}


def realsense(data):
    return devices.read_realsense((data if isinstance(data, str) else json.dumps(data),), CameraChoice())


def test_realsense_rotations_are_column_major_in_either_direction():
    cameras = {"left": rs_camera(0), "right": rs_camera(1)}
    for between in (BETWEEN, BACK):
        assert_is_the_pair(realsense(cameras | {"extrinsics": between}))
    named = {"infra1": rs_camera(0), "infra2": rs_camera(1), "infra_extrinsics": BETWEEN}
    others = {
        "color": rs_camera(1),
        "RGB": {"colour": rs_camera(0)},
        "depth": rs_camera(0),
        "depth_to_rgb": BACK,
    }
    others |= {"Gyro": BACK, "accel_to_infra": BACK, "imu": BACK, "confidence": rs_camera(0)}
    assert_is_the_pair(realsense(others | named))
    assert_is_the_pair(realsense([rs_camera(0), {"a": [rs_camera(1)]}, BETWEEN]))


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ("brown_conrady", "opencv"),
        ("RS2_DISTORTION_BROWN_CONRADY", "opencv"),
        ("distortion.brown_conrady", "opencv"),
        ("Brown Conrady", "opencv"),
        (4, "opencv"),
        ("4", "opencv"),
        ("kannala_brandt4", "fisheye"),
        (5, "fisheye"),
    ],
)
def test_realsense_lens_models_have_names_and_numbers(model, expected):
    count = 5 if expected == "opencv" else 4
    cameras = {"left": rs_camera(0, model, count), "right": rs_camera(1, model, count)}
    assert_is_the_pair(realsense(cameras | {"extrinsics": BETWEEN}), lens=count, model=expected)


def test_realsense_without_distortion_is_rectified_for_every_model_name():
    for model in ("inverse_brown_conrady", "none", 2, "modified"):
        straight = [rs_camera(n, model, coeffs=[0.0] * 5) for n in range(2)]
        rig = realsense([*straight, BETWEEN])
        assert rig.rectified and lenses_of(rig) == (None, None)
        if model != "none":
            with pytest.raises(InputError, match="lens model of the left camera"):
                realsense([rs_camera(0, model), straight[1], BETWEEN])
    bare = [{k: v for k, v in rs_camera(n).items() if k not in ("model", "coeffs")} for n in range(2)]
    assert realsense([*bare, BETWEEN]).rectified
    fisheye = [rs_camera(n, 5, coeffs=[0.0] * 4) for n in range(2)]
    assert [lens.model for lens in lenses_of(realsense([*fisheye, BETWEEN]))] == ["fisheye"] * 2


@pytest.mark.parametrize("name", ["baseline", "baseline_m", "baseline_meters", "baseline_metres"])
def test_realsense_baseline_may_replace_extrinsics(name):
    cameras = {"left": rs_camera(0, coeffs=[]), "right": rs_camera(1, coeffs=[])}
    assert_is_parallel(realsense(cameras | {name: 0.173}), K_LEFT, K_RIGHT, sizes=SIZES)
    with_pose = realsense(cameras | {name: 9.0, "extrinsics": BETWEEN})
    np.testing.assert_allclose(with_pose.E, E, atol=1e-9)


@pytest.mark.parametrize(
    ("data", "counts"),
    [
        ([rs_camera(0), BETWEEN], "1 and 1"),
        ([rs_camera(0), rs_camera(1)], "2 and 0"),
        ([rs_camera(0), rs_camera(1), BETWEEN, BACK], "2 and 2"),
        ([rs_camera(0), rs_camera(1), rs_camera(0), BETWEEN], "3 and 1"),
        ({"a": rs_camera(0), "b": rs_camera(1), "x": BETWEEN, "y": BACK, "baseline": 0.2}, "2 and 2"),
        ([rs_camera(0), rs_camera(1), {"baseline": 0.2}], "2 and 0"),
    ],
)
def test_realsense_files_without_exactly_one_pair_are_rejected(data, counts):
    sentence = r"\Athe file must be two rs2 intrinsics \(fx, fy, ppx, ppy\) of the infrared pair and its "
    sentence += rf"extrinsics only; got {counts}\. Keep the entries of the infrared pair; .*\Z"
    with pytest.raises(InputError, match=sentence):
        realsense(data)


def rs_printed(n: int, size, scale: float = 1.0) -> str:
    fx, fy, cx, cy = (scale * number for number in numbers(KS[n]))
    return (
        f' Intrinsic of "Infrared {n + 1}" / {size[0]}x{size[1]} / {{Y8}}\n  Width: \t{size[0]}\n'
        f"  Height: \t{size[1]}\n  PPX: \t{cx}\n  PPY: \t{cy}\n  Fx: \t{fx}\n  Fy: \t{fy}\n"
        f"  Distortion: \tBrown Conrady\n  Coeffs: \t{words(LENSES[n][:5], '  ')}\n  FOV (deg): \t1 x 2\n\n"
    )


def test_printed_realsense_calibrations_are_selected_by_resolution():
    text = "Intrinsic Parameters:\n\n"
    for size, scale in ((SIZE_LEFT, 1.0), ((410, 308), 0.5)):
        text += rs_printed(0, size, scale) + rs_printed(1, size, scale)
        text += rs_printed(0, size, 3.0).replace("{Y8}", "{Y16}")  # the first entry of a resolution wins
    rows = "\n".join(f"  {words(row, '   ')}" for row in T[:3, :3])
    text += (
        ' Extrinsic from "Infrared 1"\t  To\t  "Infrared 1" :\n Rotation Matrix:\n  1 0 0\n  0 1 0\n  0 0 1\n'
    )
    text += " Translation Vector: 0 0 0\n\n"
    text += f' Extrinsic from "Infrared 1"\t  To\t  "Infrared 2" :\n Rotation Matrix:\n{rows}\n\n'
    text += f" Translation Vector: {words(T[:3, 3], '  ')}\n\n"
    text += ' Extrinsic from "Infrared 2"\t  To\t  "Infrared 1" :\n Rotation Matrix:\n  9 9 9\n'
    for size, scale in ((SIZE_LEFT, 1.0), ((410, 308), 0.5)):
        rig = devices.read_realsense((text,), CameraChoice(image_size=size))
        np.testing.assert_allclose(rig.E, E, atol=1e-9)
        assert rig.size_left == rig.size_right == size
        for K, lens, expected, coefficients in zip(
            (rig.K_left, rig.K_right), lenses_of(rig), KS, LENSES, strict=True
        ):
            np.testing.assert_allclose(np.delete(K, 2, 0), scale * expected[:2], atol=1e-9)
            assert lens.coefficients.tolist() == coefficients[:5]
    with pytest.raises(InputError, match=r"size in the file \(410x308, 820x616\)"):
        devices.read_realsense((text,), CameraChoice())


# OAK-D


def oak_camera(n: int, to, T_to, model: int = 0, count: int = 14) -> dict:
    lens = [*LENSES[n], 0.001, -0.002, 0.003, -0.004, 0.005, 0.006][:count]
    link = {"toCameraSocket": to, "rotationMatrix": T_to[:3, :3].tolist()}
    link["translation"] = dict(zip("xyz", (100 * T_to[:3, 3]).tolist(), strict=True))
    return {
        "cameraType": model,
        "distortionCoeff": lens,
        "extrinsics": link,
        "intrinsicMatrix": KS[n].tolist(),
        "width": SIZES[n][0],
        "height": SIZES[n][1],
    }


NOWHERE = pose((0, 0, 0), (0, 0, 0))
TO_COLOUR = pose((15, 25, -35), (0.3, 0.1, -0.2))
#: How the two cameras may be linked, directly or through the colour camera.
LINKS = {
    "left to right": (("CAM_C", T), (-1, NOWHERE), (-1, NOWHERE)),
    "right to left": ((-1, NOWHERE), (1, E), (-1, NOWHERE)),
    "left to right to colour": ((2, T), (0, TO_COLOUR), (-1, NOWHERE)),
    "both to colour": (("RGB", TO_COLOUR @ T), ("CAM_A", TO_COLOUR), ("AUTO", NOWHERE)),
    "right by left to colour": (("CENTER", TO_COLOUR), ("LEFT", E), (-1, NOWHERE)),
    "in a circle": ((0, TO_COLOUR @ T), (0, TO_COLOUR), (2, np.linalg.inv(TO_COLOUR))),
}


def oak(data, **choice):
    return devices.read_oak((json.dumps(data),), CameraChoice(**choice))


def oak_data(affinities, **camera):
    of_left, of_right, of_colour = affinities
    cameras = {
        1: oak_camera(0, *of_left, **camera),
        2: oak_camera(1, *of_right, **camera),
        0: oak_camera(1, *of_colour, **camera),
    }
    return {"cameraData": [[socket, each] for socket, each in cameras.items()]}


@pytest.mark.parametrize("affinities", LINKS.values(), ids=LINKS)
def test_oak_poses_follow_the_links_between_sockets(affinities):
    rig = oak(oak_data(affinities))
    np.testing.assert_allclose(rig.E, E, atol=1e-9)
    np.testing.assert_array_equal(rig.K_left, K_LEFT)
    np.testing.assert_array_equal(rig.K_right, K_RIGHT)
    assert (rig.size_left, rig.size_right) == SIZES and not rig.rectified
    for lens, expected in zip(lenses_of(rig), LENSES, strict=True):
        assert lens.coefficients.tolist() == [*expected, 0.001, -0.002, 0.003, -0.004, 0.005, 0.006]


def test_oak_intrinsics_scale_to_the_image_and_crops_are_rejected():
    data = oak_data(LINKS["left to right"])
    for entry in data["cameraData"]:
        entry[1] |= {"width": 1000, "height": 700}
    rig = oak(data, image_size=(500, 350))
    assert rig.size_left == rig.size_right == (500, 350)
    half = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
    np.testing.assert_allclose(rig.K_left, half @ K_LEFT, atol=1e-9)
    np.testing.assert_allclose(rig.K_right, half @ K_RIGHT, atol=1e-9)
    with pytest.raises(
        InputError,
        match=r"\Athe left image must be of the aspect ratio of its camera's images "
        r"\(1000x700\); got 640x400\. For a crop of the sensor, pass --fx .*\Z",
    ):
        oak(data, image_size=(640, 400))


def test_rectified_oak_images_use_the_right_cameras_matrix():
    data = oak_data(LINKS["left to right"])
    length = float(np.linalg.norm(T[:3, 3]))
    by_name = {"leftCameraSocket": "LEFT", "rightCameraSocket": "CAM_C"}
    for sockets in ({}, {"leftCameraSocket": 1, "rightCameraSocket": 2}, by_name, dict.fromkeys(by_name, -1)):
        data["stereoRectificationData"] = sockets | {"rectifiedRotationLeft": [[1, 0, 0]]}
        assert_is_parallel(oak(data), K_RIGHT, baseline=length, sizes=(SIZE_RIGHT, SIZE_RIGHT))
        turned = oak(data, cameras=(2, 1))
        np.testing.assert_allclose(turned.E, T, atol=1e-9)
        np.testing.assert_array_equal(turned.K_left, K_RIGHT)
        assert not turned.rectified and None not in lenses_of(turned)
    data["stereoRectificationData"] = {"leftCameraSocket": 2, "rightCameraSocket": 1}
    np.testing.assert_allclose(oak(data).E, T, atol=1e-9)
    data["stereoRectificationData"] = None
    np.testing.assert_allclose(oak(data).E, E, atol=1e-9)


def test_oak_sockets_may_have_names_and_fisheye_lenses():
    data = oak_data(LINKS["left to right"], model=1, count=4)
    assert [lens.model for lens in lenses_of(oak(data))] == ["fisheye", "fisheye"]
    for names in (("LEFT", "RIGHT", "RGB"), ("CAM_B", "CAM_C", "CAM_A"), ("left", "right", "center")):
        each = dict(zip(names, (entry[1] for entry in data["cameraData"]), strict=True))
        rig = oak({"cameraData": each})
        np.testing.assert_array_equal(rig.K_left, K_LEFT)
        np.testing.assert_allclose(rig.E, E, atol=1e-9)
    for entry in data["cameraData"]:
        del entry[1]["cameraType"]
    assert [lens.model for lens in lenses_of(oak(data))] == ["opencv", "opencv"]
    far = [[9, oak_camera(0, "CAM_J", NOWHERE)], [8, oak_camera(0, "CAM_J", T)], [7, oak_camera(1, 8, E)]]
    letters = {f"CAM_{letter}": camera for letter, (_, camera) in zip("JIH", far, strict=True)}
    np.testing.assert_allclose(oak({"cameraData": letters}, cameras=(8, 9)).E, E, atol=1e-9)


def test_oak_cameras_without_a_common_link_are_rejected():
    with pytest.raises(
        InputError, match=r"\Aextrinsics must be a chain of links from socket 1 to 2; got none\. Calibrate"
    ):
        oak(oak_data(((-1, NOWHERE), (0, TO_COLOUR), (-1, NOWHERE))))
    with pytest.raises(InputError, match=r"\Athe rotation of extrinsics of socket 1 must be 9"):
        broken = oak_data(LINKS["left to right"])
        broken["cameraData"][0][1]["extrinsics"]["rotationMatrix"] = [1]
        oak(broken)
    with pytest.raises(InputError, match=r"\AintrinsicMatrix of socket 2 must be 9 finite numbers"):
        broken = oak_data(LINKS["left to right"])
        broken["cameraData"][1][1]["intrinsicMatrix"] = [1]
        oak(broken)
