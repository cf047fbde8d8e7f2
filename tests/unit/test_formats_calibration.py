"""What is special in single formats: which cameras, which resolution, which names, which lens."""

import json
import re
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import read_rig
from tests.contracts.calibrations import NAMES, SAMPLES, choice, read_texts, rigid, written

ZED_HD = {"image_size": (1280, 720)}


@pytest.fixture
def reading(tmp_path):
    """``reading(text, ..., **choice)`` reads texts as files, for a caller that undistorts."""
    return partial(read_texts, tmp_path, distorted=True)


@pytest.mark.parametrize("cam1", ["cam1=[700 0 300; 0 700 200; 0 0 1]\n", ""])
def test_doffs_wins_over_cam1_with_a_warning(reading, cam1):
    with pytest.warns(UserWarning, match="cam1 .* 331 px"):
        rig = reading(f"cam0=[700 0 300; 0 700 200; 0 0 1]\n{cam1}doffs=31\nbaseline=80\n")
    assert rig.K_right[0, 2] == 331 and rig.K_left[0, 2] == 300


KITTI = {
    camera: f"721.5 0 609.6 {offset} 0 721.5 172.9 {0.1 * camera} 0 0 1 {1e-4 * camera}"
    for camera, offset in ((0, 0.0), (1, -380.0), (2, 45.0), (3, -340.0))
}


@pytest.mark.parametrize("key", ["P{}", "P_rect_{:02d}"])
def test_kitti_cameras_are_those_asked_for_else_those_of_the_folder_else_the_only_or_the_colour_pair(
    reading, key
):
    rows = {camera: f"{key.format(camera)}: {row}\n" for camera, row in KITTI.items()}
    for cameras, hint, baseline_px in (
        ((3, 2), None, -385.0),
        ((2, 3), "image_0", 385.0),
        (None, "data/training/image_0/000000_10.png", 380.0),
        (None, "image_02/data", 385.0),
        (None, "colored_0", 385.0),
    ):
        rig = reading("".join(rows.values()), cameras=cameras, image_folder_hint=hint)
        assert rig.E[0, 3] == pytest.approx(baseline_px / 721.5, rel=1e-3)
    grey = reading(rows[0] + rows[1], image_folder_hint="image_2")
    assert grey.E[0, 3] == pytest.approx(380.0 / 721.5, rel=1e-3)
    with pytest.warns(UserWarning, match="2,3 is taken"):
        rig = reading("".join(rows.values()), image_folder_hint="my/photos")
    assert rig.E[0, 3] == pytest.approx(385.0 / 721.5, rel=1e-3)
    driving = "P_rect_101: 100 0 45 0 0 100 19 0 0 0 1 0\nP_rect_103: 100 0 45 -109 0 100 19 0 0 0 1 0\n"
    assert reading(driving).E[0, 3] == pytest.approx(1.09)


NONE = {"radtan": "none", r"coeffs:\n(  - .*\n)+": "coeffs: []\n"}
CAMERA1 = {
    r"Camera\.([fc][xy])": r"Camera1.\1",
    "Camera.bf: 84.0": 'Camera.type: "Rectified"\nStereo.b: 0.12',
}
OLD = {r"Camera1\.": "Camera.", r"Stereo.T_c1_c2": "Tlr", "rows: 4": "rows: 3", ", 0.0, 0.0, 0.0, 1.0 ]": "]"}
THIRD = {r"(?s)\A(.*)(cam1:)(.*)-0.12(.*)": r"\1cam1:\3-0.12\4\ncam2:\3-0.3\4"}
#: A sample, what is replaced in all its files by regular expression, choices, and its baseline then.
CHANGED = [
    ("kalibr", {r"\A": "%YAML:1.0\n", "(cam[01]):": r"\1:  # a comment"} | NONE, {}, 0.12),
    ("ros", {r"\A": "%YAML 1.1\n---\n", "image_.*\n": ""}, {}, 0.12),
    ("euroc", {"T_BS:": "T_BS: !!opencv-matrix"}, {}, 0.12),
    ("kalibr", THIRD, {"cameras": (0, 2)}, 0.42),
    ("kalibr", {}, {"baseline_m": 0.24}, 0.24),
    ("oak", {}, {"cameras": (0, 1)}, -0.08),  # 1 -> 2 is -0.12 m in x, 2 -> 0 is +0.04
    ("orb_slam_rectified", CAMERA1, {}, 0.12),
    ("orb_slam", OLD, {}, 0.12),
    ("zed", {"TY=": "TY_HD="}, ZED_HD, 0.12),
]


@pytest.mark.parametrize(("sample", "changes", "given", "baseline_m"), CHANGED)
def test_a_sample_in_another_way_is_read_as_well(reading, sample, changes, given, baseline_m):
    texts = SAMPLES[sample]
    for old, new in changes.items():
        texts = [re.sub(old, new, text) for text in texts]
    rig = reading(*texts, **given)
    assert rig.E[0, 3] == pytest.approx(baseline_m) and rig.distortion == (None, None)


# OpenCV

K1 = np.array([[700.0, 0, 320], [0, 702, 240], [0, 0, 1]])
K2 = np.array([[710.0, 0, 330], [0, 709, 236], [0, 0, 1]])
D1, D2 = np.array([[-0.25, 0.125, 0.001, 0.0, 0.0]]), np.array([[-0.125, 0.25, 0.0, 0.0, 0.0]])
POSE = rigid([0.03, 0.2, 0.02], (-0.12, 0.02, 0.04))


def storage(path: Path, **entries) -> Path:
    """What OpenCV itself writes."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        file.write(name, value)
    file.release()
    return path


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv_reads_what_opencv_rectified(tmp_path, suffix):
    *_, P1, P2, Q, _, _ = cv2.stereoRectify(K1, D1, K2, D2, (640, 480), POSE[:3, :3], POSE[:3, 3:], alpha=0)
    given = {"M1": K1, "D1": D1, "M2": K2, "D2": D2, "R": POSE[:3, :3], "T": POSE[:3, 3:], "P1": P1, "P2": P2}
    more = {"Q": Q, "image_width": 640, "image_height": 480, "note": "rectified"}
    path = storage(tmp_path / f"stereo.{suffix}", **given, **more, nothing=np.array([[np.nan, np.inf]]))
    rig = read_calibration(path)
    np.testing.assert_allclose(rig.K_left, P1[:, :3])
    assert rig.rectified and rig.size_left == (640, 480)
    assert rig.E[0, 3] == pytest.approx(np.linalg.norm(POSE[:3, 3]), rel=1e-6)
    if suffix == "json":  # older versions write 1. where JSON wants 1.0
        path.write_text(path.read_text().replace("0.0,", "0.,"))
        np.testing.assert_array_equal(read_calibration(path).E, rig.E)


def test_opencv_in_two_files(tmp_path):
    zero = np.zeros((1, 5))
    intrinsics = storage(tmp_path / "intrinsics.yml", M1=K1, D1=zero, M2=K2, D2=zero)
    extrinsics = storage(tmp_path / "extrinsics.xml", R=POSE[:3, :3], T=POSE[:3, 3:])
    for pair in ((intrinsics, extrinsics), (extrinsics, intrinsics)):
        np.testing.assert_allclose(read_calibration(pair).T_right_from_left, POSE, atol=1e-12)
    with pytest.raises(ValueError, match="no R, T.*give all of them"):
        read_calibration(intrinsics)


@pytest.mark.parametrize(
    "names",
    [
        "cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2 R T",
        "K_left dist_left K_right dist_right R T",
        "Camera_Matrix_1 Distortion_Coeffs_1 Camera_Matrix_2 Distortion_Coeffs_2 rotation Translation_Vector",
    ],
)
def test_opencv_by_the_names_of_tutorials(tmp_path, names):
    # OpenCV 5 writes an array of one axis as another kind of matrix; lists of points have two channels.
    values = dict(zip(names.split(), (K1, D1[0], K2, D2, POSE[:3, :3], POSE[:3, 3]), strict=True))
    values |= {"image_width": 640, "points": np.arange(8.0).reshape(4, 1, 2)}
    rig = read_calibration(storage(tmp_path / "a.yml", **values), distorted=True)
    np.testing.assert_array_equal(rig.K_right, K2)
    np.testing.assert_allclose(rig.T_right_from_left, POSE, atol=1e-12)
    assert [lens.coefficients[0] for lens in rig.distortion] == [-0.25, -0.125]


def test_projections_by_other_names_and_a_vertical_rig(tmp_path):
    P = K1 @ np.eye(3, 4), K1 @ np.hstack([np.eye(3), [[0], [-0.2], [0]]])
    sides = {"image_width": np.array([[640]]), "image_height": np.array([[480]])}
    settings = storage(tmp_path / "plain.yml", LEFT_P=P[0], RIGHT_P=P[1]).read_text()
    (tmp_path / "euroc.yaml").write_text(
        settings.replace("T_P", "T.P") + "Camera.k1: 0.1\nCamera.bf: 3.0\nLEFT.width: 640\nLEFT.height: 480\n"
    )
    storage(tmp_path / "a.yml", projMatrixL=P[0], projMatrixR=P[1], **sides)
    storage(tmp_path / "b.yml", PL=P[0], PR=P[1], k1=0.1, k2=0.2, p1=0.0, p2=0.3)
    for name, size in (("a.yml", (640, 480)), ("b.yml", None), ("euroc.yaml", (640, 480))):
        rig = read_calibration(tmp_path / name)
        assert rig.rectified and rig.size_left == size
        np.testing.assert_allclose(rig.E[:3, 3], (0, 0.2, 0), atol=1e-12)


# ZED, RealSense, OAK-D


def test_zed_takes_the_section_of_the_image(reading, tmp_path):
    for size, focal in (((2208, 1242), 1400), ((1280, 720), 700)):
        rig = reading(SAMPLES["zed"][0], image_size=size)
        assert rig.K_left[0, 0] == focal and rig.size_left == size
    guidance = GeometryGuidance.from_calibration(np.zeros((1242, 2208, 3)), tmp_path / "file0.dat")
    assert guidance.rigs[0].K_left[0, 0] == 1400
    lens = "k1=1\nk2=2\nk3=5\np1=3\np2=4\nk4=6\n"  # rational, in a section of its own
    text = re.sub(r"(?m)^[kp]\d=0.*\n", "", SAMPLES["zed"][0]) + f"[LEFT_DISTO]\n{lens}[RIGHT_DISTO]\n{lens}"
    assert reading(text, **ZED_HD).distortion[0].coefficients.tolist() == [1, 2, 3, 4, 5, 6, 0, 0]


def test_the_first_zeds_have_no_shift_but_along_the_baseline(reading):
    text = SAMPLES["zed"][0]
    bare = re.sub(r"(?m)^(TY|TZ|p1|p2|k3)\w*=.*\n", "", text)
    assert bare != text
    rig = reading("\ufeff" + bare.replace("Baseline", "BaseLine"), **ZED_HD)
    np.testing.assert_allclose(rig.E[:3, 3], (0.12, 0, 0), atol=1e-12)


def test_ros_files_that_opencv_wrote_are_a_pair_by_their_projections(reading):
    texts = []
    for x in (0.0, -84.0):
        head = "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
        matrices = {
            "camera_matrix": [[710.0, 0, 330], [0, 712, 250], [0, 0, 1]],
            "distortion_coefficients": [[-0.2, 0.05, 0, 0, 0]],
            "rectification_matrix": np.eye(3).tolist(),
            "projection_matrix": [[700.0, 0, 320, x], [0, 700, 240, 0], [0, 0, 1, 0]],
        }
        for name, values in matrices.items():
            numbers = ", ".join(map(str, np.ravel(values)))
            head += f"{name}: !!opencv-matrix\n   rows: {len(values)}\n   cols: {len(values[0])}\n"
            head += f"   dt: d\n   data: [ {numbers} ]\n"
        texts.append(head)
    rig = reading(*texts)
    assert rig.E[0, 3] == pytest.approx(0.12) and rig.rectified and rig.size_left == (640, 480)
    assert rig.as_taken.K_left[0, 0] == 710 and None not in rig.as_taken.distortion


def test_realsense_models(reading):
    data = json.loads(SAMPLES["realsense"][0])

    def of(model, coefficients):
        for camera in data["intrinsics"].values():
            camera.update(model=model, coeffs=coefficients)
        return reading(json.dumps(data))

    five = [0.1, 0.2, 0.003, 0.004, 0.5]
    for model in ("RS2_DISTORTION_BROWN_CONRADY", 4):
        assert of(model, five).distortion[0].coefficients.tolist() == five
    lens = of("distortion.kannala_brandt4", [*five[:4], 0.0]).distortion[1]
    assert lens.model == "fisheye" and lens.coefficients.tolist() == five[:4]
    for model in (2, "Inverse Brown Conrady"):
        assert of(model, [0.0] * 5).rectified, "zeros are no lens"
        with pytest.raises(InputError, match=r"lens model of the left .*got .*rectify"):
            of(model, five)
    data["extrinsics"]["translation"] = [0.3, 0, 0]
    assert of("none", [0.0] * 5).E[0, 3] == pytest.approx(0.3), "from right to left it is inverted"


def test_oak_scales_to_the_image_and_takes_the_right_cameras_intrinsics(reading):
    data = json.loads(SAMPLES["oak"][0])
    sockets = {"leftCameraSocket": 1, "rightCameraSocket": 2}
    data["stereoRectificationData"] = sockets | {"rectifiedRotationLeft": [1]}
    dict(data["cameraData"])[2]["intrinsicMatrix"][0][0] = 712.5
    fisheye = SAMPLES["oak"][0].replace('"cameraType": 0', '"cameraType": 1')
    assert [(lens.model, len(lens.coefficients)) for lens in reading(fisheye).distortion] == [
        ("fisheye", 4)
    ] * 2
    rig = reading(json.dumps(data), image_size=(320, 240))
    assert rig.rectified and rig.size_left == (320, 240) and rig.distortion == (None, None)
    assert rig.K_left[0].tolist() == [356.25, 0, pytest.approx((300 + 0.5) / 2 - 0.5)]
    np.testing.assert_array_equal(rig.K_left, rig.K_right)


# COLMAP, nerfstudio


@pytest.mark.parametrize(
    ("camera", "model", "coefficients"),
    [
        ("RADIAL 640 480 700 300.5 200.5 -0.1 0.02", "opencv", [-0.1, 0.02, 0, 0]),
        ("FULL_OPENCV 640 480 700 700 300.5 200.5 1 2 3 4 5 6 7 8", "opencv", [1, 2, 3, 4, 5, 6, 7, 8]),
        ("RADIAL_FISHEYE 640 480 700 300.5 200.5 1 2", "fisheye", [1, 2, 0, 0]),
        ("SIMPLE_FISHEYE 640 480 700 300.5 200.5", "fisheye", [0, 0, 0, 0]),
        ("FOV 640 480 700 700 300.5 200.5 1", "FOV", [1]),  # removed by pycolmap
        ("EQUIRECTANGULAR 640 480 640 480", "got EQUIRECTANGULAR", None),
    ],
)
def test_colmap_models(reading, camera, model, coefficients):
    cameras, images = SAMPLES["colmap"]
    texts = images, re.sub("OPENCV 640.*", camera, cameras)  # in any order
    if coefficients is None:
        with pytest.raises(InputError, match=f"{model}.*panoramas"):
            reading(*texts, **choice("colmap"))
        return
    with pytest.warns(UserWarning, match="has no unit.*--baseline"):
        rig = reading(*texts, image_names=NAMES)
    assert rig.E[0, 3] == pytest.approx(0.5) and rig.unit is None
    assert rig.K_left.tolist() == [[700, 0, 300], [0, 700, 200], [0, 0, 1]]
    for lens in rig.distortion:
        assert lens.model == model and lens.coefficients.tolist() == coefficients


@pytest.fixture
def nerf(reading):
    """``nerf(changes, **choice)``: the sample with other entries of the file; its frames have poses alone."""
    data = json.loads(SAMPLES["nerf"][0])
    shared = {key: data["frames"][0][key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    for frame in data["frames"]:
        frame["transform_matrix"] = frame["transform_matrix"][:3]  # the last row may be left out
        for key in (*shared, "k1", "k2", "p1", "p2"):
            del frame[key]

    def read(changes: dict, **given):
        entries = data | shared | changes
        entries = {key: value for key, value in entries.items() if value is not None}
        return reading(json.dumps(entries), **choice("nerf") | given)

    read.frames = data["frames"]
    return read


def test_nerf_angles_and_defaults(nerf):
    bare = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"))
    angle = {"camera_angle_x": 2 * np.arctan(320 / 700)}
    rig = nerf(bare | angle, image_size=(640, 480))
    np.testing.assert_allclose(rig.K_right, [[700, 0, 319.5], [0, 700, 239.5], [0, 0, 1]])
    rig = nerf(bare | angle | {"camera_angle_y": 2 * np.arctan(240 / 600), "w": 640.0, "h": 480.0})
    np.testing.assert_allclose(np.diag(rig.K_left), [700, 600, 1])
    assert np.diag(nerf({"fl_y": None, "camera_angle_x": 0.1}).K_left).tolist() == [700, 700, 1]
    for changes, said in (
        (bare | angle, r"entries 'w' and 'h'; got none\. Give image_size"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 50.0}, "in radians.*got 50.0. Is it in deg"),
        ({"fl_x": None, "fl_y": None}, "'fl_x' or 'camera_angle_x'; got none"),
    ):
        with pytest.raises(InputError, match=said):
            nerf(changes)


def test_nerf_lenses(nerf):
    given = {"distortion_params": [-0.2, 0.05, 0.01, 0, 0.003, -0.002]}
    assert nerf(given).distortion[0].coefficients.tolist() == [-0.2, 0.05, 0.003, -0.002, 0.01]
    k = {"k1": 0.1, "k2": -0.02, "k3": 0.003, "k4": 0.0004}
    for said in ({"camera_model": "OPENCV_FISHEYE"}, {"camera_model": None, "is_fisheye": True}):
        lens = nerf(said | k).distortion[0]
        assert lens.model == "fisheye" and lens.coefficients.tolist() == list(k.values())
    assert nerf({"camera_model": "SIMPLE_PINHOLE"}, distorted=False).distortion == (None, None)


@pytest.mark.parametrize(
    ("in_file", "asked"),
    [
        (("./train/r_0", "./train/r_1", "./train/r_2"), ("train/r_0.png", "/data/lego/train/r_2.png")),
        (("../images/a.png", "../images/b.png", "../images/c.png"), ("/x/images/a.png", "images/c.png")),
        (("images\\a.png", "images\\b.png", "images\\c.png"), ("images/a.png", "/x/images/c.png")),
        (("one/0.png", "one/1.png", "two/0.png"), ("/x/one/0.png", "two/0.png")),
    ],
)
def test_images_are_found_by_the_ends_of_their_paths(nerf, in_file, asked):
    named = [frame | {"file_path": name} for frame, name in zip(nerf.frames, in_file, strict=True)]
    rig = nerf({"frames": named}, image_names=asked)
    assert rig.E[0, 3] == pytest.approx(0.12) and rig.E[0, 0] == pytest.approx(1)


def test_every_pair_of_a_folder_has_its_own_cameras(tmp_path):
    calib = written(tmp_path, SAMPLES["colmap"])

    def read(right: str):
        given = DepthOptions(left=Path("rig/left.jpg"), right=Path("rig", right), calib=calib, baseline=0.12)
        return read_rig(given, (640, 480), (640, 480))

    first = read("right.jpg")
    assert np.abs(read("other.jpg").E - first.E).max() > 0.01
    assert read("right.jpg").E.tolist() == first.E.tolist()


RS_VIEW = {"width": 848, "height": 480, "ppx": 424.0, "ppy": 240.0, "fx": 420.0, "fy": 421.0}
RS_APART = {"rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [-0.05, 0, 0]}


@pytest.mark.parametrize(
    "further",
    [
        {"infrared1_to_infrared2": RS_APART, "color": RS_VIEW | {"fx": 900.0}, "depth_to_color": RS_APART},
        {"infrared1_to_infrared2": RS_APART, "cameras": {"RGB": RS_VIEW}, "rgb": RS_APART},
        {"baseline": 0.05},
    ],
)
def test_the_infrared_pair_of_a_realsense_is_told_from_its_other_cameras(reading, further):
    rig = reading(json.dumps({"infrared1": RS_VIEW, "infrared2": RS_VIEW | {"ppx": 426.0}} | further))
    assert (rig.K_left[0, 0], rig.K_left[0, 2], rig.K_right[0, 2]) == (420, 424, 426)
    np.testing.assert_allclose(rig.E[:3, 3], (0.05, 0, 0))


@pytest.mark.parametrize(
    "entries", [{}, {"a": RS_VIEW, "b": RS_VIEW, "baseline_mm": 50}, {"a": RS_VIEW, "baseline": 0.05}]
)
def test_a_realsense_without_a_pair_is_not_called_cut_off(reading, entries):
    with pytest.raises(InputError, match="two rs2 intrinsics.*their baseline in metres"):
        reading(json.dumps(entries or RS_VIEW))


def test_a_region_of_interest_of_ros_moves_the_principal_point(reading):
    """``image_geometry``: K and P are of the whole sensor, images of its region of interest."""

    def info(shift: float, x_offset: int) -> str:
        roi = {"x_offset": x_offset, "y_offset": 60, "width": 320, "height": 240, "do_rectify": False}
        P = [480.0, 0, 322.0, shift, 0, 480.0, 241.0, 0, 0, 0, 1.0, 0]
        entries = {"width": 640, "height": 480, "distortion_model": "plumb_bob", "D": [0.1] * 5, "P": P}
        return yaml.safe_dump(entries | {"roi": roi})

    rig = reading(info(0.0, 100), info(-48.0, 120))
    assert rig.size_left == rig.size_right == (320, 240)
    np.testing.assert_allclose(rig.K_left[:2, 2], (222, 181))
    np.testing.assert_allclose(rig.K_right[:2, 2], (202, 181))
    np.testing.assert_allclose(rig.E[:3, 3], (0.1, 0, 0))


LINES = {
    "colons": "fx: {}\nfy: {}\ncx: {}\ncy: {}\nbaseline: {}\n",
    "equals": "# mine\nfx = {}\nfy={}\ncx = {} # px\ncy = {}\nbaseline_m = {}\n",
}


@pytest.mark.parametrize("form", LINES)
def test_numbers_by_their_names_are_read(reading, form):
    rig = reading(LINES[form].format(500.0, 501.0, 320.5, 240.0, 0.12))
    np.testing.assert_array_equal(rig.K_left, [[500, 0, 320.5], [0, 501, 240], [0, 0, 1]])
    np.testing.assert_array_equal(rig.K_right, rig.K_left)
    assert rig.E[0, 3] == 0.12
    with pytest.raises(InputError, match="no 'cy'"):
        reading(LINES[form].format(500.0, 501.0, 320.5, "?", 0.12))
    with pytest.raises(InputError, match="the baseline"):
        reading(LINES[form].format(500.0, 501.0, 320.5, 240.0, -0.12))


@pytest.mark.parametrize("names", [("K1", "K2"), ("K_left", "K_right"), ("cameraMatrixL", "cameraMatrixR")])
def test_named_matrices_may_be_plain_yaml(reading, names):
    K = [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]
    rig = reading(yaml.safe_dump({names[0]: K, names[1]: K, "R": np.eye(3).tolist(), "T": [-0.12, 0, 0]}))
    np.testing.assert_array_equal(rig.K_left, K)
    np.testing.assert_allclose(rig.E[:3, 3], (0.12, 0, 0))
    with pytest.raises(InputError, match="no M2"):
        reading(yaml.safe_dump({names[0]: K, "R": np.eye(3).tolist(), "T": [-0.12, 0, 0]}))


@pytest.mark.parametrize(
    ("text", "cure"),
    [
        ("intrinsics:\n  camRect0:\n    camera_matrix: [1, 2, 3, 4]\n", "DSEC.*camRect"),
        ("P1: 600  # penalty\nP2: 2400\ncamera_fps: 30\n", "no M1, M2, R, T"),
        ("camera.height=960\ncamera.A=[1085 0 640; 0 1085 480; 0 0 1]\nt=0.159\n", "rc_visard.*--baseline"),
    ],
)
def test_calibrations_that_are_not_read_are_named_with_their_cure(reading, text, cure):
    with pytest.raises(InputError, match=cure):
        reading(text)


def test_a_baseline_of_middlebury_in_metres_is_refused_unless_it_is_given(reading):
    K = "[700 0 300; 0 700 200; 0 0 1]"
    text = f"cam0={K}\ncam1={K}\ndoffs=0\nbaseline=0.0054\n"
    with pytest.raises(InputError, match=r"millimetres.*--baseline 0\.0054"):
        reading(text)
    assert reading(text, baseline_m=0.0054).E[0, 3] == pytest.approx(0.0054)


def test_one_camera_for_both_images_needs_only_the_baseline_that_is_given(reading):
    rig = reading("fx: 700\nfy: 701\ncx: 320\ncy: 240\n", baseline_m=0.2)
    assert rig.E[0, 3] == pytest.approx(0.2) and rig.K_left[1, 1] == 701


@pytest.mark.parametrize(
    "unused", [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0], [0] * 12], ids=["identity", "zeros"]
)
def test_projections_that_a_program_left_unused_are_not_read(reading, unused):
    K = [[700, 0, 320], [0, 700, 240], [0, 0, 1]]
    lenses = {"D1": [0.1, 0, 0, 0], "D2": [0, 0.1, 0, 0]}
    pose = {"R": np.eye(3).tolist(), "T": [-0.12, 0, 0], "P1": unused, "P2": unused}
    rig = reading(json.dumps({"K1": K, "K2": K} | lenses | pose), distorted=True)
    np.testing.assert_allclose(rig.E[:3, 3], (0.12, 0, 0))
    assert not rig.rectified and None not in rig.distortion


def test_projections_as_lists_of_yaml_are_not_taken_for_those_of_kitti(reading):
    P1, P2 = ([[700, 0, 320, x], [0, 700, 240, 0], [0, 0, 1, 0]] for x in (0, -84))
    rig = reading(yaml.safe_dump({"P1": P1, "P2": P2}, default_flow_style=False))
    assert rig.E[0, 3] == pytest.approx(0.12)


def test_ros_files_of_single_cameras_without_projections_say_so(reading):
    text = "image_width: 752\ncamera_matrix: {rows: 3, cols: 3, data: [1]}\ndistortion_model: plumb_bob\n"
    with pytest.raises(InputError, match=r"projection_matrix.*single cameras\. Calibrate the pair"):
        reading(text, text)


def test_a_matrix_of_middlebury_may_have_commas(reading):
    K = "[700, 0, 300; 0, 700, 200; 0, 0, 1]"
    rig = reading(f"cam0={K}\ncam1={K}\ndoffs=0\nbaseline=80\n")
    np.testing.assert_array_equal(rig.K_left, [[700, 0, 300], [0, 700, 200], [0, 0, 1]])
