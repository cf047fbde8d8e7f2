"""Robotics calibrations: chains, body frames and regions of interest."""

import json

import cv2
import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import robotics
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.calibrated_pair import (
    BODIES,
    K_LEFT,
    K_RIGHT,
    KS,
    LENS_RIGHT,
    LENSES,
    SIZE_LEFT,
    SIZES,
    UNCHOSEN,
    E,
    T,
    assert_is_parallel,
    assert_is_the_pair,
    numbers,
    pose,
    quaternion,
    words,
)


def kalibr_camera(n: int, count: int = 4, model: str = "radtan") -> dict:
    return {
        "intrinsics": numbers(KS[n]),
        "resolution": list(SIZES[n]),
        "distortion_coeffs": LENSES[n][:count],
        "distortion_model": model,
    }


def kalibr(cameras, choice=UNCHOSEN, **outer):
    return robotics.read_kalibr((json.dumps({f"cam{n}": c for n, c in enumerate(cameras)} | outer),), choice)


def test_kalibr_chain_poses_are_relative_to_the_previous_camera():
    left, right = kalibr_camera(0), kalibr_camera(1) | {"T_cn_cnm1": T.tolist()}
    assert_is_the_pair(kalibr([left, right]), lens=4)
    with_imu = [each | {"T_cam_imu": np.eye(4).tolist()} for each in (left, right)]
    assert_is_the_pair(kalibr(with_imu), lens=4)  # T_cn_cnm1 takes precedence
    below = {"rig": {"cam0": left, "cam1": right}, "before": {"a": 1}, "rate": 20}
    assert_is_the_pair(robotics.read_kalibr((json.dumps(below),), CameraChoice()), lens=4)
    with pytest.raises(KeyError):
        kalibr([left, kalibr_camera(1)])


def test_kalibr_cameras_are_chosen_by_number_along_the_chain():
    """cam2 is the left camera and cam0 the right one; cam1 between them has another pose."""
    between = pose((40, 5, -8), (1, 2, 3))  # cam0 to cam1
    chain = [kalibr_camera(1), kalibr_camera(1) | {"T_cn_cnm1": between.tolist()}]
    cam2_from_cam1 = E @ np.linalg.inv(between)
    chain.append(kalibr_camera(0) | {"T_cn_cnm1": cam2_from_cam1[:3].tolist()})
    chain.append(kalibr_camera(0) | {"T_cn_cnm1": "nonsense"})
    assert_is_the_pair(kalibr(chain, CameraChoice((2, 0))), lens=4)
    np.testing.assert_allclose(kalibr(chain).E, np.linalg.inv(between), atol=1e-9)
    with pytest.raises(InputError, match=r"cameras must be two different cameras of the file \(0, 1, 2, 3\)"):
        kalibr(chain, CameraChoice((2, 4)))


@pytest.mark.parametrize("key", ["T_imu_cam", "T_cam_imu"])
def test_openvins_poses_are_relative_to_the_imu(key):
    cameras = [
        kalibr_camera(n) | {key: (body if key == "T_imu_cam" else np.linalg.inv(body)).tolist()}
        for n, body in enumerate(BODIES)
    ]
    assert_is_the_pair(kalibr(cameras), lens=4)
    assert_is_the_pair(kalibr([cameras[0], {"other": 1}, cameras[1]][::2]), lens=4)
    with pytest.raises(KeyError):
        kalibr([{k: v for k, v in cameras[0].items() if k != key}, cameras[1]])


def test_kalibr_cameras_may_have_extra_intrinsics_and_no_model():
    """Double sphere and others put their parameters before fx; the model itself is refused."""
    cameras = [kalibr_camera(0), kalibr_camera(1) | {"T_cn_cnm1": T.tolist()}]
    for camera in cameras:
        camera["intrinsics"] = [0.5, *camera["intrinsics"]]
    assert_is_the_pair(kalibr(cameras), lens=4)
    cameras[1]["camera_model"] = "omni"
    with pytest.raises(InputError, match="the lens model of the right camera must be .*; got omni"):
        kalibr(cameras)
    fisheye = [{**each, "camera_model": "pinhole", "distortion_model": "equidistant"} for each in cameras]
    assert_is_the_pair(kalibr(fisheye), lens=4, model="fisheye")


@pytest.mark.parametrize(
    ("kind", "names", "model", "count"),
    [
        ("pinhole-radtan8", "k1 k2 p1 p2 k3 k4 k5 k6", "opencv", 8),
        ("kb4", "k1 k2 k3 k4", "fisheye", 4),
        ("pinhole", "", "opencv", None),
    ],
)
def test_basalt_poses_are_quaternions_in_the_imu_frame(kind, names, model, count):
    poses, cameras = [], []
    for n, body in enumerate(BODIES):
        place = dict(zip(("px", "py", "pz"), body[:3, 3].tolist(), strict=True))
        poses.append(place | dict(zip(("qx", "qy", "qz", "qw"), quaternion(body), strict=True)))
        values = dict(zip(("fx", "fy", "cx", "cy"), numbers(KS[n]), strict=True))
        values |= dict(zip(names.split(), LENSES[n], strict=False))
        cameras.append({"camera_type": kind, "intrinsics": values})
    data = {"T_imu_cam": poses, "intrinsics": cameras, "resolution": SIZES}
    for content in (data, {"value0": data}):
        rig = robotics.read_basalt((json.dumps(content),), CameraChoice())
        assert_is_the_pair(rig, lens=count, model=model)
    turned = {key: [values[1], values[0], values[0]] for key, values in data.items()}
    rig = robotics.read_basalt((json.dumps(turned),), CameraChoice((2, 0)))
    assert_is_the_pair(rig, lens=count, model=model)
    cameras[0]["camera_type"] = "ds"
    with pytest.raises(
        InputError,
        match=r"\Acamera_type must be one of pinhole, pinhole-radtan8, kb4; got ds\. "
        r"Calibrate with basalt_calibrate .*\Z",
    ):
        robotics.read_basalt((json.dumps(data),), CameraChoice())


@pytest.mark.parametrize(
    ("kind", "of_K", "of_lens", "model"),
    [
        ("PINHOLE", "fx fy cx cy", "k1 k2 p1 p2", "opencv"),
        ("kannala_brandt", "mu mv u0 v0", "k2 k3 k4 k5", "fisheye"),
    ],
)
def test_vins_fusion_poses_are_in_the_body_frame(kind, of_K, of_lens, model):
    config = {f"body_T_cam{n}": {"data": body.ravel().tolist()} for n, body in enumerate(BODIES)}
    config |= {"cam0_calib": "l.yaml", "cam1_calib": "sub/r.yaml"}
    assert robotics.vins_cameras(json.dumps(config)) == ["l.yaml", "sub/r.yaml"]
    texts = [json.dumps(config)]
    for n in range(2):
        K = dict(zip(of_K.split(), numbers(KS[n]), strict=True))
        lens = dict(zip(of_lens.split(), LENSES[n], strict=False))
        parts = {"projection_parameters": K, "distortion_parameters": lens}
        if model == "fisheye":
            parts = {"projection_parameters": lens | K, "distortion_parameters": None}
        head = {"model_type": kind, "image_width": SIZES[n][0], "image_height": SIZES[n][1]}
        texts.append(json.dumps(head | parts))
    assert_is_the_pair(robotics.read_vins(tuple(texts), CameraChoice()), lens=4, model=model)
    texts[2] = texts[2].replace(kind, "mei")
    with pytest.raises(
        InputError, match=r"\Amodel_type must be one of PINHOLE, KANNALA_BRANDT; got MEI\. Calib"
    ):
        robotics.read_vins(tuple(texts), CameraChoice())


@pytest.mark.parametrize("as_list", [False, True])
def test_euroc_sensor_poses_are_in_the_body_frame(as_list):
    texts = []
    for n, body in enumerate(BODIES):
        numbers_ = body.ravel().tolist()
        sensor = kalibr_camera(n) | {"T_BS": numbers_ if as_list else {"rows": 4, "data": numbers_}}
        sensor["distortion_coefficients"] = sensor.pop("distortion_coeffs")
        texts.append(json.dumps(sensor))
    assert_is_the_pair(robotics.read_euroc(tuple(texts), CameraChoice()), lens=4)


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
    return robotics.read_ros(tuple(map(json.dumps, infos)), CameraChoice())


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


def test_ros_files_of_single_cameras_are_refused():
    (P1, R1), (P2, R2) = rectified()
    left, right = info(0, P1, R1), info(1, P2, R2)
    alone = r"These are of single cameras\. Calibrate the pair .*\Z"
    for infos in ([{**left, "projection_matrix": None}, right], [left, {**right, "projection_matrix": None}]):
        with pytest.raises(
            InputError, match=rf"\Aprojection_matrix must be in both files; got none\. {alone}"
        ):
            ros(infos)
    with pytest.raises(
        InputError,
        match=r"\Aprojection_matrix\[0, 3\] must be -fx \* baseline in the right "
        rf"camera's file; got the same in both\. {alone}",
    ):
        ros([left, info(1, P1, R2)])


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
        rig = robotics.read_ros_ini(given, CameraChoice())
        assert_is_parallel(rig, P1[:, :3], P2[:, :3], baseline=LENGTH, sizes=SIZES)
        assert_is_the_pair(rig.as_taken)
    for given, count in (((texts[0],), 1), ((*texts, texts[0]), 3), (("x",), 0)):
        with pytest.raises(
            InputError,
            match=rf"\Athe file must be of two cameras, \[image\] before each; "
            rf"got {count} of them\. Give left\.ini and right\.ini",
        ):
            robotics.read_ros_ini(given, CameraChoice())


def orb(text: str):
    return robotics.read_orb_slam((text,), CameraChoice())


@pytest.mark.parametrize(
    ("kind", "keys", "model"),
    [("PinHole", "k1 k2 p1 p2 k3", "opencv"), ("KannalaBrandt8", "k1 k2 k3 k4", "fisheye")],
)
@pytest.mark.parametrize("version", [1, 0])
def test_orb_slam_settings_contain_both_cameras_and_their_pose(kind, keys, model, version):
    left, name = ("Camera1", "Stereo.T_c1_c2") if version else ("Camera", "Tlr")
    lines = [f'Camera.type: "{kind}"', f"Camera.width: {SIZE_LEFT[0]}", f"Camera.height: {SIZE_LEFT[1]}"]
    for n, camera in enumerate((left, "Camera2")):
        of_camera = [*numbers(KS[n]), *LENSES[n][: len(keys.split())]]
        pairs = zip(("fx fy cx cy " + keys).split(), of_camera, strict=True)
        lines += [f"{camera}.{key}: {value!r}" for key, value in pairs]
    lines.append(f"{name}: {{rows: 4, cols: 4, data: [{words(E, ', ')}]}}")
    rig = orb("\n".join(lines))
    assert rig.size_left == rig.size_right == SIZE_LEFT
    without_sizes = orb("\n".join(line for line in lines if "width" not in line and "height" not in line))
    assert_is_the_pair(without_sizes, lens=len(keys.split()), model=model, sizes=False)
    bare = [line for line in lines if ".k2" not in line and ".p1" not in line]
    if kind == "PinHole":
        expected = [LENS_RIGHT[0], 0, 0, *LENS_RIGHT[3:5]]
        assert orb("\n".join(bare)).distortion[1].coefficients.tolist() == expected
    else:
        with pytest.raises(InputError, match=f"{left}.k2 must be a finite number"):
            orb("\n".join(bare))
    with pytest.raises(InputError, match=f"{left}.fy must be a finite number; got None"):
        orb("\n".join(line for line in lines if f"{left}.fy" not in line))


def rectified_orb(camera: str, kind: str | None, baseline: str, **more) -> str:
    values = dict(zip(("fx", "fy", "cx", "cy"), numbers(K_LEFT), strict=True)) | more
    lines = [f"{camera}.{key}: {value!r}" for key, value in values.items()]
    lines += [f'Camera.type: "{kind}"'] if kind else []
    return "\n".join([*lines, baseline, "Camera.width: 820", "Camera.height: 616"])


RECTIFIED_ORB = [
    ("Camera1", "Rectified", "Stereo.b: 0.173"),
    ("Camera", "PinHole", f"Camera.bf: {0.173 * 811.5}"),
    ("Camera", "Rectified", f"Camera.bf: {0.173 * 811.5}"),
    ("Camera", None, f"Camera.bf: {0.173 * 811.5}"),
]


@pytest.mark.parametrize(("camera", "kind", "baseline"), RECTIFIED_ORB)
def test_rectified_orb_slam_settings_have_one_camera_and_a_baseline(camera, kind, baseline):
    assert_is_parallel(orb(rectified_orb(camera, kind, baseline)), sizes=(SIZE_LEFT, SIZE_LEFT))
    with pytest.raises(
        InputError,
        match=rf"\ALens distortion of {camera} must be zero for rectified images, which "
        r"have no Stereo\.T_c1_c2; got another\. Is it of a single camera\?\Z",
    ):
        orb(rectified_orb(camera, kind, baseline, k3=0.1))


@pytest.mark.parametrize(
    ("text", "got"),
    [
        (rectified_orb("Camera1", "PinHole", "Stereo.b: 0.173"), "PinHole without them"),
        (rectified_orb("Camera1", "Rectified", "Camera.bf: 84.0"), "Rectified without them"),
        (rectified_orb("Camera", "KannalaBrandt8", "Camera.bf: 84.0"), "KannalaBrandt8 without them"),
        (rectified_orb("Camera", None, "a: 1"), "PinHole without them"),
        (
            rectified_orb("Camera1", "Rectified", "Stereo.b: 0.173\nRGBD.DepthMapFactor: 5000.0"),
            "Rectified with a depth sensor",
        ),
        (
            rectified_orb("Camera", "PinHole", "Camera.bf: 40.0\nDepthMapFactor: 5000.0"),
            "PinHole with a depth sensor",
        ),
    ],
)
def test_orb_slam_settings_without_a_stereo_pair_are_refused(text, got):
    baseline = "Stereo.b" if "Camera1" in text else "Camera.bf"
    sentence = (
        rf"\Athe settings must be of a stereo camera, with Stereo\.T_c1_c2, or {baseline} of rectified "
    )
    sentence += (
        rf"images; got of a camera of type {got}\. Give the settings that ORB-SLAM runs in stereo with\.\Z"
    )
    with pytest.raises(InputError, match=sentence):
        orb(text)
