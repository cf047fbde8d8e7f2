"""Every entry of CALIBRATION_FORMATS: any rig is read as it was written, and bad files get a sentence."""

import json
import re

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import CALIBRATION_FORMATS, read_calibration, rig_from_parameters
from tests.contracts import calibrations as of
from tests.contracts.calibrations import SAMPLES, choice, rigid, written

TAKE = settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
#: Files that only warn: doffs cut to fewer digits disagrees with cam1; a rig of metres that says no unit.
pytestmark = pytest.mark.filterwarnings("ignore:cam1", "ignore:The calibration does not say its unit")


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
    kind = None if write is of.mvsnet else "fisheye" if "fisheye" in write.__name__ else "opencv"
    for lens, expected in zip(rig.distortion if kind else (), drawn.lenses, strict=bool(kind)):
        numbers = lens.coefficients.tolist()
        assert lens.model == kind and numbers[:4] == expected and not any(numbers[4:])


@pytest.mark.parametrize("write", of.RECTIFIED, ids=lambda write: write.__name__)
@TAKE
@given(drawn=rigs(turned=False))
def test_a_rectified_rig_is_read_as_it_was_written(tmp_path, write, drawn):
    rig = of.read_texts(tmp_path, *write(drawn), distorted=True, **choice(write.__name__))
    without_size = (of.kitti_projections, of.booster, of.vkitti, of.argoverse, of.robotcar)
    check(rig, drawn, None if write in without_size else drawn.size)
    assert rig.rectified == (write is not of.stereodemo) and rig.distortion == (None, None)


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


def test_every_format_has_a_sample():
    assert all(any(sample.startswith(name) for sample in SAMPLES) for name in CALIBRATION_FORMATS)


@pytest.mark.parametrize("sample", SAMPLES)
def test_a_cut_off_file_is_a_sentence_that_names_it_or_a_whole_rig(sample, tmp_path):
    *others, last = SAMPLES[sample]
    cuts, refused = range(1, len(last), 7), 0
    for cut in cuts:
        try:
            rig = of.read_texts(tmp_path, *others, last[:cut], **choice(sample))
        except ValueError as error:
            assert isinstance(error, InputError) and re.search(r"must be .*; got .*", str(error), re.DOTALL)
            refused += 1
        else:
            assert np.isfinite(rig.E).all() and rig.K_right[0, 0] > 0
    assert refused > 0.5 * len(cuts)


#: A sample, what is replaced in its last file (or in all, for "all:"), by what, and what is said.
REFUSALS = [
    ("middlebury", "baseline=120.0\n", "", "no 'baseline'. Is it of another program"),
    ("middlebury", "line=120.0\nwidth=640\nheight=480\nndisp=64\n", "", "no 'baseline'. Is the file cut off"),
    ("middlebury", "baseline=120.0", "baseline=0", "baseline must be above 0"),
    ("middlebury", "200.0; 0.0 0.0 1.0]\ndoffs", "200.0; 0.0 0.0\ndoffs", "cam1 must be"),
    ("kitti_projections", "P1:", "X1:", "the file must be of two cameras"),
    ("foundation_stereo", "0.12", "", "9 numbers of K and the baseline in metres; got 9 numbers.*--K"),
    ("stereodemo", '"fx": 700.0', '"fx": "a"', r"fx, fy, cx, cy must be 4 finite numbers; got \('a', 700"),
    ("stereodemo", "700.0", "9" * 5000, "must be a whole stereodemo JSON"),
    ("opencv", "1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0", "1.5, 0, 0, 0, 1.5, 0, 0, 0, 1.5",
     "R, T must be rigid.*rotation"),
    ("opencv", "[ 0.0, 0.0, 0.0, 0.0 ]\nM2", "[ 0.1, 0.0, 0.0, 0.0 ]\nM2", "of the left .*rectify"),
    ("opencv", "[ 0.0, 0.0, 0.0, 0.0 ]\nR", "[ 1, 2, 3 ]\nR", "right camera must be 4, 5, 8, 12, 14 co"),
    ("opencv", "D2:", "dist_of_right:", r"both cameras \(D1, D2\); got dist_of_right. Rename"),
    ("opencv", "0.0, 0.0, 0.0, 0.0 ]\nR", "0.1, 0.0, 0.0, 0.0 ]\nD1: 3\nR", r"\(D1, D2\); got one of them"),
    ("opencv", "D2:", "mtxL:", "M1 must be there once; got m1, mtxl, which differ"),
    ("booster", "<opencv_storage>", '<!DOCTYPE x [<!ENTITY a "b">]><opencv_storage>', "entities"),
    ("booster", "</opencv_storage>", "", "must be a whole Booster xml"),
    ("mvsnet", "0.0 0.0 0.0 1.0\n\nintrinsic", "1.0 0.0 0.0 1.0\n\nintrinsic", "last row .*transposed"),
    ("realsense", '"translation"', '"moved"', "their extrinsics alone; got 2 and 0"),
    ("realsense_printed", 'To  "Infrared 2"', 'To  "Depth"', "rotation of the extrinsics must be 9"),
    ("oak", '"toCameraSocket": 2', '"toCameraSocket": -1', "a way from socket 1 to 2"),
    ("ros", "  - 91.0\n", "  - 175.0\n", "the same in both. These are of single cameras"),
    ("ros", "projection_matrix:", "projektion:", "projection_matrix must be in both files; got none"),
    ("all:ros_echo", "p: [", "p: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0] # [", "focal lengths in pixels; got 0"),
    ("kalibr", "camera_model: pinhole", "camera_model: omni", "lens model of the left camera .* got omni"),
    ("orb_slam_rectified", "ThDepth: 35", "DepthMapFactor: 5000", "got of .* with a depth sensor"),
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
    ("matlab", '"TranslationOfCamera2"', '"Shift"', "no 'TranslationOfCamera2'. Is it of another program"),
    ("cityscapes", '"baseline"', '"base"', "got no 'baseline'. Is it of another program"),
    ("named", '"camera_matrix_left"', '"left_lens"', "P1, P2, or with M1, M2, R, T; got no M1"),
    ("okvis", "radialtangential", "fov", "lens model of the left camera .* got fov"),
    ("svo", "type: pinhole", "type: atan", "lens model of the left camera .* got atan"),
    ("stella", "model: perspective", "model: fisheye", "got of setup stereo and model fisheye"),
    ("airslam", "distortion_type: 1", "distortion_type: 7", "distortion_type must be one of 0, 1, 2; got 7"),
    ("anipose", "[metadata]", "[third]\nmatrix = []\n[metadata]", r"of 0 \(cam0\), 1 \(cam1\), 2 \(third"),
    ("mrcal", "OPENCV4", "SPLINED_STEREOGRAPHIC_order=3", "must be one of .*mrcal-convert-lensmodel"),
    ("mrcal", "[ ", "[ __import__('os'), ", "a camera model of mrcal; got another text"),
    ("argoverse", "_rect", "_raw", "rectified stereo pair; got image_raw_stereo_front_left"),
    ("ros_ini", "projection\n", "projections\n", "projection_matrix must be in both files; got none"),
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
        ("foundation_stereo", {"cameras": (0, 1)}, "cameras must be left out"),
        ("kalibr", {"cameras": ("a", 1)}, "two different cameras.*got a,1"),
        ("kalibr", {"baseline_m": -1.0}, "baseline_m"),
        ("oak", {"image_size": (1280, 720)}, "640x480.*crop"),
        ("zed", {"image_size": None}, "1280x720, 2208x1242.*got no image"),
        ("zed", {"image_size": (2560, 720)}, "1280x720, 2208x1242"),
        ("nerf", {"image_names": ("left.jpg", "d.png")}, r"one of the 3.*got d\.png"),
        ("nerf", {"image_names": ("left.jpg", "left.jpg")}, "two of those.* got ./rig/left.jpg for both"),
        ("nerf", {"image_names": None}, "image_names must be given"),
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
        ((K, K.replace("0.12", "0.2")), "is given once"),
        ((text, text.replace("700.0", "701.0")), "M1 must be there once; got m1, m1, which differ"),
        ((K, SAMPLES["middlebury"][0]), "files of one format; got foundation_stereo and middlebury"),
        *(
            ((SAMPLES[name][0],), "must be 2 files of this format, .*; got 1, .*Give both: --calib twice")
            for name in ("mvsnet", "ros", "colmap")
        ),
    ):
        with pytest.raises(InputError, match=said):
            of.read_texts(tmp_path, *texts)


@pytest.mark.parametrize(
    ("at", "value", "name"),
    [(0, 0, "fx"), (1, -5.0, "fy"), (2, np.nan, "cx"), (4, 0, "baseline"), (4, np.inf, "baseline")],
)
def test_parameters_of_a_data_sheet_are_checked(at, value, name):
    arguments = [700, 701, 320, 240, 0.12]
    rig = rig_from_parameters(*arguments, cx_right=350, size=(640, 480))
    np.testing.assert_array_equal(rig.K_right, [[700, 0, 350], [0, 701, 240], [0, 0, 1]])
    assert rig.E[0, 3] == 0.12 and rig.size_right == (640, 480)
    arguments[at] = value
    with pytest.raises(ValueError, match=name):
        rig_from_parameters(*arguments)


def test_an_archive_of_matrices_is_read_as_json_is(tmp_path):
    matrices = {"K1": of.K, "K2": of.K, "D1": np.zeros(5), "D2": np.zeros(5), "R": np.eye(3)}
    np.savez(tmp_path / "c.npz", T=[-0.12, 0, 0], images=np.zeros((400, 400)), **matrices)
    rig = read_calibration(tmp_path / "c.npz")
    np.testing.assert_allclose(rig.E, np.linalg.inv(of.RIG.T))
    np.savez(tmp_path / "pickled.npz", K1=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="pickled objects, which are never loaded. Save every matrix"):
        read_calibration(tmp_path / "pickled.npz")


def test_spring_chooses_a_line_by_the_number_of_the_image(tmp_path):
    text = "2000 2000 960 540\n2100 2100 960 540\n"
    names = ("frame_left_0002.png", "frame_right_0002.png")
    assert of.read_texts(tmp_path, text, image_names=names).K_left[0, 0] == 2100
    assert of.read_texts(tmp_path, text, image_names=names).E[0, 3] == 0.065
    with pytest.raises(InputError, match="named by its number, 1 to 2"):
        of.read_texts(tmp_path, text, image_names=("frame_left_0003.png", "frame_right_0003.png"))


def test_sceneflow_has_the_lens_that_its_folder_names(tmp_path):
    text = SAMPLES["sceneflow"][0]
    for folder, focal in (("15mm_focallength/left", 450.0), ("35mm_focallength/left", 1050.0)):
        rig = of.read_texts(tmp_path, text, image_names=(f"{folder}/0005.png", "0005.png"), baseline_m=1.0)
        np.testing.assert_array_equal(rig.K_left, [[focal, 0, 479.5], [0, focal, 269.5], [0, 0, 1]])
        assert rig.size_left == (960, 540)
    with pytest.warns(UserWarning, match="35 mm lens"):
        of.read_texts(tmp_path, text, image_names=("left/0005.png", "right/0005.png"), baseline_m=1.0)
    with pytest.raises(InputError, match="named by its frame, 5 to 6"):
        of.read_texts(tmp_path, text, image_names=("left/0009.png", "right/0009.png"))


def test_sockets_of_an_oak_may_have_names(tmp_path):
    text = SAMPLES["oak"][0]
    data = json.loads(text)
    letters = {0: "CAM_A", 1: "CAM_B", 2: "CAM_C", -1: "AUTO"}
    for _, camera in data["cameraData"]:
        camera["extrinsics"]["toCameraSocket"] = letters[camera["extrinsics"]["toCameraSocket"]]
    data["cameraData"] = {letters[socket]: camera for socket, camera in data["cameraData"]}
    rig = of.read_texts(tmp_path, json.dumps(data))
    np.testing.assert_allclose(rig.E, of.read_texts(tmp_path, text).E)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + bytes(90), "jsonencode"),
        (b"\x89HDF\r\n\x1a\n" + bytes(90), "jsonencode"),
        (b"\x80\x04\x95" + bytes(20), "never loaded. In Python: np.savez"),
        (b"\x93NUMPY\x01\0" + bytes(90), "Give it as --K or --E"),
        (b"PIEH" + bytes(90), "MPI Sintel"),
        (b"# oST version 5.0 parameters\n\n[image]\ncamera matrix\n", "Give left.ini and right.ini"),
        (b'<?xml version="1.0"?>\n<opencv_storage>\n<imagelist>\n"l0.jpg"\n"r0.jpg"\n', "intrinsics.yml"),
        (b"RadTan 0.61 0.95 0.49 0.52 -0.28 0.07 0 0\n752 480\ncrop\n752 480\n", "camera.txt of DSO"),
        (b"Calibration results\n===\nCamera-system parameters:\n cam0\n", "Give the camchain.yaml"),
        (b'<?xml version="1.0"?>\n<calibration>\n  <projection>frame</projection>\n', "of one camera"),
        (b"%YAML:1.0\n---\nmodel_type: PINHOLE\nimage_width: 752\n", "names both cameras"),
        (b"Device info: \n    Name : \tIntel RealSense D435\n", "rs-enumerate-devices -c"),
        (b"# Bundle file v0.3\n2 0\n", "geodiff capture"),
        (b'<?xml version="1.0"?>\n<document version="2.0.0">\n<chunk label="1">', "geodiff capture"),
        (b'[{"cameras": {}, "shots": {}}]', "geodiff capture"),
        (b'{"camera_data_": [{"key": "ring", "value": {"vehicle_SE3_camera_": {}}}]}', "stereo_info.json"),
        (b'[{"cameras": [{"intrinsics": {"distortion_model": "pinhole"}, "transform": []}]}]', "cuVSLAM"),
        (b'{"CalibrationInformation": {"Cameras": []}}', "Azure Kinect.*--points"),
        (b'{"calibDataSource": "x", "cameras": [{"K": [], "R": []}]}', "centimetres. Give K of both"),
        (b'{"class_name": "PinholeCameraParameter", "extrinsic_r": [], "world2cam": true}', "world2cam"),
        (b'[{"token": "a", "camera_intrinsic": []}]', "nuScenes"),
        (b'{"extrinsics": [{"rotation": {"qw": 1.0}}], "intrinsics": [{"fx": 9}]}', "DGP"),
        (b"fu = 620.5\nfv = 622.1\ncu = 526\ncv = 374\nu_direction = 1 0 0\n", "Ames.*camera to the world"),
        (b"https://www.youtube.com/watch?v=a\n52553 " + b"0.5 " * 18 + b"\n", "RealEstate10K.*shares"),
        (b"1 0 0 0.1\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "got a pose.*it as --E"),
        (b"fx: 700\nfy: 700\ncx: 320\ncy: 240\n", "--baseline"),
        (b"image_width: 9\ncamera_matrix: {data: [1]}\ndistortion_model: plumb_bob\n", "--calib twice"),
        (b'{"intrinsic_matrix": [1, 0, 0, 0, 1, 0, 5, 5, 1], "width": 9}', "Open3D"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        (b"<!DOCTYPE html>\n<html><body>404</body></html>\n", "a web page.*fetch it again"),
    ],
)
def test_formats_that_are_not_read_are_named_with_what_to_give_instead(content, words, tmp_path):
    (tmp_path / "calib.dat").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_calibration(tmp_path / "calib.dat")


def test_a_file_of_one_camera_says_so(tmp_path):
    for text in ('{"K": [[700, 0, 320], [0, 700, 240], [0, 0, 1]], "dist": [0, 0, 0, 0, 0]}',):
        with pytest.raises(InputError, match="It is of one camera: give the stereo calibration"):
            of.read_texts(tmp_path, text)
    chain = SAMPLES["kalibr"][0].partition("cam1:")[0]
    with pytest.raises(InputError, match="of two cameras; got one of one camera"):
        of.read_texts(tmp_path, chain)


def test_lists_may_stand_tight_behind_their_names(tmp_path):
    """As in the settings of ORB-SLAM2, which OpenCV reads."""
    text = SAMPLES["opencv_projections"][0]
    rig = of.read_texts(tmp_path, text.replace("data: [", "data:["))
    np.testing.assert_array_equal(rig.E, of.read_texts(tmp_path, text).E)


def test_matrices_may_lie_deep_below_the_names_of_sides(tmp_path):
    camera = {"intrinsics": {"K": of.K.tolist()}, "lens": {"D": [0.0] * 5}}
    entries = {
        "rig": {"cameras": {"left": camera, "right": camera}, "R": np.eye(3).tolist(), "T": [-0.12, 0, 0]}
    }
    rig = of.read_texts(tmp_path, json.dumps(entries))
    np.testing.assert_allclose(rig.E, np.linalg.inv(of.RIG.T))
    np.testing.assert_array_equal(rig.K_right, of.K)


def test_matrices_of_other_cameras_beside_those_of_the_pair_are_left_out(tmp_path):
    entries = {"K1": of.K.tolist(), "K2": of.K.tolist(), "R": np.eye(3).tolist(), "T": [-0.12, 0, 0]}
    others = {"colour": {"camera_matrix": (2 * of.K).tolist()}, "depth": {"intrinsics": (3 * of.K).tolist()}}
    rig = of.read_texts(tmp_path, json.dumps(entries | others))
    np.testing.assert_array_equal(rig.K_left, of.K)


def test_of_two_cameras_without_sides_none_is_taken_for_both(tmp_path):
    cameras = {"cam_a": {"K": of.K.tolist()}, "cam_b": {"K": (2 * of.K).tolist()}}
    with pytest.raises(InputError, match="K1 and K2, or K, and a baseline; got no K1, K2"):
        of.read_texts(tmp_path, json.dumps(cameras | {"baseline": 0.12}))
    rig = of.read_texts(tmp_path, json.dumps(cameras | {"baseline": 0.12, "K": of.K.tolist()}))
    np.testing.assert_array_equal(rig.K_right, of.K)


@pytest.mark.parametrize("names", [("K_left", "K_right"), ("K",), ("camera_matrix",)])
@pytest.mark.parametrize("baseline", ["baseline", "baseline_m"])
def test_parallel_cameras_need_only_their_baseline(names, baseline, tmp_path):
    K_right = of.K + [[0, 0, 7.0], [0, 0, 0], [0, 0, 0]]
    matrices = dict(zip(names, (of.K.tolist(), K_right.tolist()), strict=False))
    rig = of.read_texts(tmp_path, json.dumps(matrices | {baseline: 0.12}))
    np.testing.assert_array_equal(rig.K_right, K_right if len(names) == 2 else of.K)
    np.testing.assert_allclose(rig.E[:3, 3], [0.12, 0, 0])
    lens = {"dist": [0.1, 0, 0, 0, 0]}
    if len(names) == 1:
        read = of.read_texts(tmp_path, json.dumps(matrices | lens | {baseline: 0.12}), distorted=True)
        assert [each.coefficients[0] for each in read.distortion] == [0.1, 0.1]
    with pytest.raises(InputError, match="baseline must be above 0"):
        of.read_texts(tmp_path, json.dumps(matrices | {baseline: -0.12}))


def test_a_pose_of_a_sensor_may_be_a_plain_list(tmp_path):
    """As in Kimera's files."""
    texts = []
    for text in SAMPLES["euroc"]:
        sensor = yaml.safe_load(text)
        sensor |= {"T_BS": sensor["T_BS"]["data"], "distortion_model": "radial_tangential"}
        texts.append("%YAML:1.0\n" + yaml.safe_dump(sensor))
    np.testing.assert_allclose(of.read_texts(tmp_path, *texts).E, np.linalg.inv(of.RIG.T))


def test_virtual_kitti_is_read_by_frame_and_poses_of_another_direction_are_refused(tmp_path):
    K, T = SAMPLES["vkitti"]
    with pytest.raises(InputError, match="named by its frame, 0 to 2"):
        of.read_texts(tmp_path, K, T, image_names=("rgb_00009.jpg", "rgb_00009.jpg"))
    head, *lines = T.splitlines()
    turn = rigid([0, np.pi / 2, 0], [0, 0, 0])
    places = {"0": turn, "1": turn @ rigid([0, 0, 0], [0.12, 0, 0])}  # camera-to-world
    inverted = [" ".join([*line.split()[:2], of.words(places[line.split()[1]])]) for line in lines]
    with pytest.raises(InputError, match="world-to-camera poses of a rectified pair"):
        of.read_texts(tmp_path, K, "\n".join([head, *inverted]), **choice("vkitti"))


BOMB = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize("text", [BOMB, "a: &a [1, [2, *a]]\n", "a: &a [1]\nb: [" + "*a, " * 40 + "*a]\n"])
def test_aliases_that_grow_without_end_are_refused(text, tmp_path):
    """A kilobyte of them stood for 10 GB; a few of plain lists, as dumps of programs have, are read."""
    chain = SAMPLES["kalibr"][0]
    with pytest.raises(InputError, match="aliases at most.*Write out what its aliases"):
        of.read_texts(tmp_path, text + chain)
    shared = chain.replace("cam_overlaps:", "shared: &s [0, 1]\n  again: *s\n  cam_overlaps:", 1)
    assert of.read_texts(tmp_path, shared).E[0, 3] == pytest.approx(0.12)
