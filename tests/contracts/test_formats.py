"""Every entry of CALIBRATION_FORMATS: any rig is read as it was written, and bad files get a sentence."""

import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import CALIBRATION_FORMATS, read_calibration
from tests.contracts import calibrations as of
from tests.contracts.calibrations import SAMPLES, choice, rigid, written
from tests.views import lenses_of

TAKE = settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
#: Files that only warn: doffs with fewer digits contradicts cam1; a rig in metres without a unit.
pytestmark = pytest.mark.filterwarnings("ignore:cam1", "ignore:The calibration states no unit")


@st.composite
def rigs(draw, turned: bool = True) -> of.Drawn:
    def number(low: float, high: float) -> float:
        return draw(st.floats(low, high))

    size = draw(st.integers(64, 4000)), draw(st.integers(48, 3000))
    focal, Ks = number(100, 3000), []
    for side in range(2):
        f = focal if side == 0 or not turned else number(100, 3000)
        cx, cy = (number(0.3, 0.7) * along for along in size)
        cy = Ks[0][1, 2] if side and not turned else cy
        fy = f * number(0.8, 1.25) if turned else f
        Ks.append(np.array([[f, 0, cx], [0, fy, cy], [0, 0, 1]]))
    turn = [number(-0.5, 0.5) for _ in range(3)] if turned else [0, 0, 0]
    T = rigid(turn, [-number(0.02, 3.0), *((number(-0.5, 0.5), number(-0.5, 0.5)) if turned else (0, 0))])
    lenses = tuple([round(number(-0.3, 0.3), 6) or 0.01 for _ in range(4)] for _ in range(2))
    world = rigid([number(-1, 1) for _ in range(3)], [number(-5, 5) for _ in range(3)])
    return of.Drawn(tuple(Ks), T, size, lenses, world)


def check(rig, drawn: of.Drawn, size: tuple[int, int] | None) -> None:
    for K, expected in zip((rig.K_left, rig.K_right), drawn.K, strict=True):
        np.testing.assert_allclose(K, expected, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(rig.T_right_from_left, drawn.T, atol=1e-6)
    assert rig.unit == "m" and rig.size_left == rig.size_right == size


@pytest.mark.parametrize("write", of.ANY_POSE, ids=lambda write: write.__name__)
@TAKE
@given(drawn=rigs())
def test_a_rig_of_any_pose_is_read_as_it_was_written(tmp_path, write, drawn):
    choices = choice(write.__name__, float(np.linalg.norm(drawn.T[:3, 3])))
    rig = of.read_texts(tmp_path, *write(drawn), distorted=True, **choices)
    check(rig, drawn, None if write in (of.mvsnet, of.bouguet) else choices.get("image_size", drawn.size))
    assert not rig.rectified or write in (of.realsense, of.realsense_printed)
    kind = None if write in (of.mvsnet, of.quest) else "fisheye" if "fisheye" in write.__name__ else "opencv"
    for lens, expected in zip(lenses_of(rig) if kind else (), drawn.lenses, strict=bool(kind)):
        numbers = lens.coefficients.tolist()
        assert lens.model == kind and numbers[:4] == expected and not any(numbers[4:])


@pytest.mark.parametrize("write", of.RECTIFIED, ids=lambda write: write.__name__)
@TAKE
@given(drawn=rigs(turned=False))
def test_a_rectified_rig_is_read_as_it_was_written(tmp_path, write, drawn):
    rig = of.read_texts(tmp_path, *write(drawn), distorted=True, **choice(write.__name__))
    without_size = (of.kitti_projections, of.booster, of.vkitti, of.argoverse, of.robotcar)
    check(rig, drawn, None if write in without_size else drawn.size)
    assert rig.rectified == (write not in (of.stereodemo, of.spatial_photo)) and lenses_of(rig) == (
        None,
        None,
    )


@pytest.mark.parametrize("sample", SAMPLES)
def test_a_sample_is_recognised_as_its_own_format_and_read_whatever_its_line_ends(sample, tmp_path):
    texts = SAMPLES[sample]
    for text in texts:
        formats = CALIBRATION_FORMATS.items()
        assert sample.startswith(next(name for name, each in formats if re.search(each.mark, text, re.M)))
    paths = written(tmp_path, texts)
    plain = read_calibration(paths, **choice(sample))
    assert pytest.approx(np.linalg.inv(of.RIG.T), abs=1e-9) == plain.E and "file0.dat" in plain.source
    assert plain.K_left.dtype == plain.K_right.dtype == plain.E.dtype == np.float64
    for path, text in zip(sorted(tmp_path.iterdir()), texts, strict=True):
        path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    again = read_calibration(paths, **choice(sample))
    np.testing.assert_array_equal(again.K_right, plain.K_right)
    assert again.size_left == plain.size_left


NO_LENS = {"radtan": "none", r"coeffs:\n(  - .*\n)+": "coeffs: []\n"}
CAMERA1 = {
    r"Camera\.([fc][xy])": r"Camera1.\1",
    "Camera.bf: 84.0": 'Camera.type: "Rectified"\nStereo.b: 0.12',
}
OLD = {r"Camera1\.": "Camera.", r"Stereo.T_c1_c2": "Tlr", "rows: 4": "rows: 3", ", 0.0, 0.0, 0.0, 1.0 ]": "]"}
THIRD = {r"(?s)\A(.*)(cam1:)(.*)-0.12(.*)": r"\1cam1:\3-0.12\4\ncam2:\3-0.3\4"}
#: A sample, what is replaced in all its files by regular expression, choices, and its baseline then.
OTHER_FORMS = [
    ("kalibr", {r"\A": "%YAML:1.0\n", "(cam[01]):": r"\1:  # a comment"} | NO_LENS, {}, 0.12),
    ("ros", {r"\A": "%YAML 1.1\n---\n", "image_.*\n": ""}, {}, 0.12),
    ("euroc", {"T_BS:": "T_BS: !!opencv-matrix"}, {}, 0.12),
    ("kalibr", THIRD, {"cameras": (0, 2)}, 0.42),
    ("kalibr", {}, {"baseline_m": 0.24}, 0.24),
    ("oak", {}, {"cameras": (0, 1)}, -0.08),  # 1 -> 2 is -0.12 m in x, 2 -> 0 is +0.04
    ("orb_slam_rectified", CAMERA1, {}, 0.12),
    ("orb_slam", OLD, {}, 0.12),
    ("zed", {"TY=": "TY_HD="}, choice("zed"), 0.12),
    ("middlebury", {r"(?<=\d) (?=\d)": ", "}, {}, 0.12),
    # Lists of YAML are not KITTI's projections.
    ("opencv_projections", {r"(?s)!!opencv-matrix.*?\[(.*?)\]": r"[\1]"}, {}, 0.12),
    # ORB-SLAM2's settings describe the rectification too.
    ("opencv_projections", {"P1": "LEFT.P", "P2": "RIGHT.P", r"\Z": "Camera.bf: 3.0\n"}, {}, 0.12),
]  # fmt: skip


@pytest.mark.parametrize(("sample", "changes", "given_", "baseline_m"), OTHER_FORMS)
def test_other_forms_of_a_sample_are_read_as_well(sample, changes, given_, baseline_m, tmp_path):
    texts = SAMPLES[sample]
    for old, new in changes.items():
        texts = [re.sub(old, new, text) for text in texts]
    assert not changes or tuple(texts) != SAMPLES[sample], "the sample has nothing of that kind"
    rig = of.read_texts(tmp_path, *texts, distorted=True, **given_)
    assert rig.E[0, 3] == pytest.approx(baseline_m) and lenses_of(rig) == (None, None)


def test_every_format_has_a_sample():
    assert all(any(sample.startswith(name) for sample in SAMPLES) for name in CALIBRATION_FORMATS)


@pytest.mark.parametrize("sample", SAMPLES)
def test_a_cut_off_file_is_a_sentence_that_names_it_or_a_whole_rig(sample, tmp_path):
    *others, last = SAMPLES[sample]
    cuts, refused = range(1, len(last), max(7, len(last) // 24)), 0
    for cut in cuts:
        try:
            rig = of.read_texts(tmp_path, *others, last[:cut], **choice(sample))
        except ValueError as error:
            assert isinstance(error, InputError) and re.search(r"must be .*; got .*", str(error), re.DOTALL)
            refused += 1
        else:
            assert np.isfinite(rig.E).all() and rig.K_right[0, 0] > 0
    assert refused > 0.5 * len(cuts)


#: A sample, what is replaced in its last file (or in all, for "all:"), by what, and the message.
REFUSALS = [
    ("middlebury", "baseline=120.0\n", "", "no 'baseline'. It may be from a different program"),
    ("middlebury", "line=120.0\nwidth=640\nheight=480\nndisp=64\n", "", "no 'baseline'. The file seems "
                                                                        "truncated"),
    ("middlebury", "baseline=120.0", "baseline=0", "baseline must be positive"),
    ("middlebury", "200.0; 0.0 0.0 1.0]\ndoffs", "200.0; 0.0 0.0\ndoffs", "cam1 must be"),
    ("kitti_projections", "P1:", "X1:", "the file must be a calibration of two cameras"),
    ("foundation_stereo", "0.12", "", "9 numbers of K and the baseline in metres; got 9 numbers.*--K"),
    ("stereodemo", '"fx": 700.0', '"fx": "a"', r"fx, fy, cx, cy must be 4 finite numbers; got \('a', 700"),
    ("stereodemo", "700.0", "9" * 5000, "must be a whole stereodemo JSON"),
    ("opencv", "1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0", "1.5, 0, 0, 0, 1.5, 0, 0, 0, 1.5",
     "R, T must be rigid.*rotation"),
    ("opencv", "[ 0.0, 0.0, 0.0, 0.0 ]\nM2", "[ 0.1, 0.0, 0.0, 0.0 ]\nM2", "of the left .*rectify"),
    ("opencv", "[ 0.0, 0.0, 0.0, 0.0 ]\nR", "[ 1, 2, 3 ]\nR", "right camera must be 4, 5, 8, 12, 14 co"),
    ("opencv", "D2:", "dist_of_right:", r"both cameras \(D1, D2\); got dist_of_right. Name"),
    ("opencv", "0.0, 0.0, 0.0, 0.0 ]\nR", "0.1, 0.0, 0.0, 0.0 ]\nD1: 3\nR", "got for one of them"),
    ("opencv", "D2:", "mtxL:", "K1 must be unique; got m1, mtxl, which differ"),
    ("booster", "<opencv_storage>", '<!DOCTYPE x [<!ENTITY a "b">]><opencv_storage>', "entities"),
    ("booster", "</opencv_storage>", "", "must be a whole Booster xml"),
    ("mvsnet", "0.0 0.0 0.0 1.0\n\nintrinsic", "1.0 0.0 0.0 1.0\n\nintrinsic", "last row .*transposed"),
    ("realsense", '"translation"', '"moved"', "its extrinsics only; got 2 and 0"),
    ("realsense_printed", 'To  "Infrared 2"', 'To  "Depth"', "rotation of the extrinsics must be 9"),
    ("oak", '"toCameraSocket": 2', '"toCameraSocket": -1', "a chain of links from socket 1 to 2"),
    ("ros", "  - 91.0\n", "  - 175.0\n", "the same in both. These are of single cameras"),
    ("ros", "projection_matrix:", "projektion:", "matrix must be specified in both files; got none"),
    ("all:ros_echo", "p: [", "p: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0] # [", "got zeros: the camera is not"),
    ("kalibr", "camera_model: pinhole", "camera_model: omni", "lens model of the left camera .* got omni"),
    ("orb_slam_rectified", "ThDepth: 35", "DepthMapFactor: 5000", "got a camera .* with a depth sensor"),
    ("orb_slam_rectified", "Camera.bf: 84.0", "", "with Stereo.T_c1_c2, or Camera.bf of rectified"),
    ("orb_slam_rectified", "Camera.k1: 0.0", "Camera.k1: 0.2", "Lens distortion of Camera must be zero"),
    ("orb_slam", "PinHole", "Rectified", "lens model of the left camera .* got Rectified"),
    ("orb_slam", "PinHole", "KannalaBrandt8", "Camera1.k3 must be a finite number"),
    ("all:colmap", "OPENCV 640", "SIMPLE_RADIAL 640", "of camera 1 must be 4 finite numbers; got 8"),
    ("all:colmap", "OPENCV 640", "FISHY 640", "model of camera 1 must be one of SIMPLE_PINH.*Undistort"),
    ("colmap", " 2 rig/right", " 7 rig/right", "with camera 7; got only 1, 2"),
    ("colmap", "\n3 1.0", "\n3 0.0", "must be a whole COLMAP model"),
    ("kalibr_openvins", "T_imu_cam", "T_wheel_cam", "no 'T_cn_cnm1'"),
    ("basalt", "pinhole-radtan8", "ds", "camera_type must be one of .*got ds. Calibrate with .*kb4"),
    ("vins", "PINHOLE", "MEI", "model_type must be one of PINHOLE, KANNALA_BRANDT; got MEI"),
    ("matlab", '"mm"', '"furlongs"', "WorldUnits must be one of .*got furlongs"),
    ("matlab", '"TranslationOfCamera2"', '"Shift"', "no 'TranslationOfCamera2'. It may be from "
                                                    "a different program"),
    ("cityscapes", '"baseline"', '"base"', "got no 'baseline'. It may be from a different program"),
    ("named", '"camera_matrix_left"', '"left_lens"', "P1, P2, or with K1, K2, R, T; got no K1"),
    ("okvis", "radialtangential", "fov", "lens model of the left camera .* got fov"),
    ("svo", "type: pinhole", "type: atan", "lens model of the left camera .* got atan"),
    ("stella", "model: perspective", "model: fisheye", "got setup stereo and model fisheye"),
    ("airslam", "distortion_type: 1", "distortion_type: 7", "distortion_type must be one of 0, 1, 2; got 7"),
    ("anipose", "[metadata]", "[third]\nmatrix = []\n[metadata]", r"of 0 \(cam0\), 1 \(cam1\), 2 \(third"),
    ("mrcal", "OPENCV4", "SPLINED_STEREOGRAPHIC_order=3", "must be one of .*mrcal-convert-lensmodel"),
    ("mrcal", "[ ", "[ __import__('os'), ", "a camera model of mrcal; got a different text"),
    ("argoverse", "_rect", "_raw", "rectified stereo pair; got image_raw_stereo_front_left"),
    ("ros_ini", "projection\n", "projections\n", "matrix must be specified in both files; got none"),
    ("nerf", '"k1"', '"k4": 0.1, "k1"', "k4 must be zero for OPENCV; got .0.1."),
]  # fmt: skip


@pytest.mark.parametrize(("sample", "old", "new", "said"), REFUSALS)
def test_a_wrong_entry_is_named(tmp_path, sample, old, new, said):
    everywhere, name = sample.startswith("all:"), sample.removeprefix("all:")
    *first, last = SAMPLES[name]
    texts = ([text.replace(old, new) for text in first] if everywhere else first) + [last.replace(old, new)]
    assert tuple(texts) != SAMPLES[name], "the sample has nothing of that kind"
    with pytest.raises(InputError, match=f"(?s){said}") as caught:
        of.read_texts(tmp_path, *texts, **choice(name))
    assert "file0.dat" in str(caught.value) and len(str(caught.value)) < 900


@pytest.mark.parametrize(
    ("sample", "given_", "said"),
    [
        ("kitti_projections", {"cameras": (0, 0)}, "two different cameras"),
        ("foundation_stereo", {"cameras": (0, 1)}, "cameras must be omitted"),
        ("kalibr", {"cameras": ("a", 1)}, "two different cameras.*got a,1"),
        ("kalibr", {"baseline_m": -1.0}, "baseline_m"),
        ("oak", {"image_size": (1280, 720)}, "640x480.*crop"),
        ("zed", {"image_size": None}, "1280x720, 2208x1242.*got no image"),
        ("zed", {"image_size": (2560, 720)}, "1280x720, 2208x1242"),
        ("nerf", {"image_names": ("left.jpg", "d.png")}, r"one of the 3.*got d\.png"),
        (
            "nerf",
            {"image_names": ("left.jpg", "left.jpg")},
            "two images of the file.* got ./rig/left.jpg for both",
        ),
        ("nerf", {"image_names": None}, "image_names must be specified"),
    ],
)
def test_a_wrong_choice_is_named(tmp_path, sample, given_, said):
    with pytest.raises(InputError, match=said):
        of.read_texts(tmp_path, *SAMPLES[sample], **(choice(sample) | given_))


def test_how_many_files_a_format_needs(tmp_path):
    for wrong in (3, (1, 2), None):
        with pytest.raises(TypeError, match="calibration must be a path"):
            read_calibration(wrong)
    K, text = SAMPLES["foundation_stereo"][0], SAMPLES["opencv"][0]
    path = written(tmp_path, (K,))
    assert read_calibration((path, path)).E[0, 3] == 0.12  # the same file twice is that file
    for texts, said in (
        ((K, K.replace("0.12", "0.2")), "a file of both cameras once"),
        ((text, text.replace("700.0", "701.0")), "K1 must be unique; got m1, m1, which differ"),
        ((K, SAMPLES["middlebury"][0]), "files of the same format; got foundation_stereo and middlebury"),
        *(
            ((SAMPLES[name][0],), "must be 2 files of this format, .*; got 1, .*Pass both: --calib twice")
            for name in ("mvsnet", "ros", "colmap")
        ),
    ):
        with pytest.raises(InputError, match=said):
            of.read_texts(tmp_path, *texts)


def test_an_archive_of_matrices_is_read_as_json_is(tmp_path):
    matrices = {"K1": of.K, "K2": of.K, "D1": np.zeros(5), "D2": np.zeros(5), "R": np.eye(3)}
    np.savez(tmp_path / "c.npz", T=[-0.12, 0, 0], images=np.zeros((400, 400)), **matrices)
    rig = read_calibration(tmp_path / "c.npz")
    np.testing.assert_allclose(rig.E, np.linalg.inv(of.RIG.T))
    np.savez(tmp_path / "pickled.npz", K1=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="pickled objects, which are never loaded. Save every matrix"):
        read_calibration(tmp_path / "pickled.npz")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"# oST version 5.0 parameters\n\n[image]\ncamera matrix\n", "Pass left.ini and right.ini"),
        (b'{"camera_data_": [{"key": "ring", "value": {"vehicle_SE3_camera_": {}}}]}', "stereo_info.json"),
        (b"P1: 600  # penalty\nP2: 2400\ncamera_fps: 30\n", "no K1, K2, R, T"),
        (b"1 0 0 0.1\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "got a pose.*pass it with --E"),
        (b"fx: 700\nfy: 700\ncx: 320\ncy: 240\n", "--baseline"),
        (b"image_width: 9\ncamera_matrix: {data: [1]}\ndistortion_model: plumb_bob\n", "--calib twice"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        (b"<!DOCTYPE html>\n<html><body>404</body></html>\n", "a web page.*Download it again"),
    ],
)
def test_errors_about_incomplete_files_state_what_to_give_instead(content, words, tmp_path):
    (tmp_path / "calib.dat").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_calibration(tmp_path / "calib.dat")


def test_a_file_of_one_camera_is_reported(tmp_path):
    for text in ('{"K": [[700, 0, 320], [0, 700, 240], [0, 0, 1]], "dist": [0, 0, 0, 0, 0]}',):
        with pytest.raises(InputError, match="It has a single camera. Pass the stereo calibration"):
            of.read_texts(tmp_path, text)
    chain = SAMPLES["kalibr"][0].partition("cam1:")[0]
    with pytest.raises(InputError, match="a calibration of two cameras; got one camera"):
        of.read_texts(tmp_path, chain)
