"""Matrices by name, as programs that copy OpenCV's samples write them: names, units, sides and mistakes."""

import json

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import InputError, noted
from geodiff_plugin.formats import read_calibration
from tests.contracts.calibrations import SAMPLES, read_texts

LEFT = [[811.0, 0, 402.5], [0, 809.0, 301.25], [0, 0, 1]]
RIGHT = [[807.0, 0, 395.5], [0, 806.0, 298.75], [0, 0, 1]]
TURN = Rotation.from_rotvec([0.01, -0.03, 0.02])
R = TURN.as_matrix().tolist()
SHIFT_M = [-0.0734, 0.0012, -0.0021]
LENS = [-0.21, 0.08, 0.001, -0.002, 0.01]
#: The right camera's pose in the left camera's frame: x_right = R x_left + T.
POSE = np.eye(4)
POSE[:3, :3] = TURN.as_matrix().T
POSE[:3, 3] = -TURN.as_matrix().T @ SHIFT_M


def in_unit(units_a_metre: float) -> list[float]:
    return [units_a_metre * metres for metres in SHIFT_M]


def read(folder, entries, write=json.dumps):
    return read_texts(folder, write(entries), distorted=True)


def is_the_rig(rig) -> None:
    np.testing.assert_allclose(rig.E, POSE, atol=1e-9)
    np.testing.assert_array_equal(rig.K_left, LEFT)
    np.testing.assert_array_equal(rig.K_right, RIGHT)
    for lens in rig.distortion:
        np.testing.assert_array_equal(lens.coefficients[:5], LENS)


SETS_OF_NAMES = [
    ("K1", "K2", "D1", "D2", "R", "T"),
    ("mtx_l", "mtx_r", "dist_l", "dist_r", "R", "T"),
    ("camera_mat_left", "camera_mat_right", "distortion_left", "distortion_right", "rotation_mat", "t_vec"),
    ("left_camera_matrix", "right_camera_matrix", "left_dist_coeff", "right_dist_coeff", "rotation", "trans"),
    ("cam_mats_left", "cam_mats_right", "dist_coefs_left", "dist_coefs_right", "rot_mat", "trans_vec"),
    ("cameraMatrix1", "cameraMatrix2", "distCoeffs1", "distCoeffs2", "stereo_R", "stereo_T"),
    ("left_intrinsics", "right_intrinsics", "left_distortion_coefficients", "right_distortion_coefficients",
     "rotation_left_to_right", "translation_left_to_right"),
    ("K0", "K1", "D0", "D1", "Rotate", "Trans"),
    ("camera_matrix_one", "camera_matrix_two", "dist_one", "dist_two", "R", "T"),
    ("intrinsic_matrix_cam1", "intrinsic_matrix_cam2", "dist_cam1", "dist_cam2", "R_l2r", "T_l2r"),
]  # fmt: skip


@pytest.mark.parametrize("names", SETS_OF_NAMES, ids=lambda names: names[0])
@pytest.mark.parametrize("write", [json.dumps, yaml.safe_dump], ids=["json", "yaml"])
def test_names_that_programs_use_are_understood(tmp_path, names, write):
    values = (LEFT, RIGHT, [LENS], [LENS], R, [[x] for x in SHIFT_M])
    is_the_rig(read(tmp_path, dict(zip(names, values, strict=True)), write))


@pytest.mark.parametrize(
    "sides", [("left", "right"), ("cam0", "cam1"), ("camera_1", "camera_2"), ("right_cam", None)]
)
def test_outer_names_say_which_camera_is_which(tmp_path, sides):
    left, right = sides
    if right is None:  # the order in a file says nothing
        left, right = "left_cam", "right_cam"
    cameras = {
        right: {"camera_matrix": RIGHT, "distortion": LENS},
        left: {"camera_matrix": LEFT, "distortion": LENS},
    }
    is_the_rig(read(tmp_path, cameras | {"stereo": {"R": R, "T": SHIFT_M}}))


def test_a_rotation_vector_beside_its_matrix_is_no_contradiction(tmp_path):
    cameras = {"K1": LEFT, "K2": RIGHT, "D1": LENS, "D2": LENS, "R": R, "T": SHIFT_M}
    is_the_rig(read(tmp_path, cameras | {"rvec": TURN.as_rotvec().tolist()}))
    with pytest.raises(InputError, match="R must be there once; got r, rvec, which differ"):
        read(tmp_path, cameras | {"rvec": (2 * TURN.as_rotvec()).tolist()})


def test_projections_of_images_as_taken_are_not_those_of_rectified_ones(tmp_path):
    """``K [R | t]``, which programs that triangulate keep."""
    P1 = np.column_stack([LEFT, np.zeros(3)])
    P2 = np.array(RIGHT) @ np.column_stack([R, SHIFT_M])
    cameras = {"K1": LEFT, "K2": RIGHT, "D1": LENS, "D2": LENS, "R": R, "T": SHIFT_M}
    is_the_rig(read(tmp_path, cameras | {"P1": P1.tolist(), "P2": P2.tolist()}))


@pytest.mark.parametrize(("written", "expected"), [((800, 600), (800, 600)), ((600, 800), (800, 600))])
def test_a_size_may_be_written_height_first(tmp_path, written, expected):
    cameras = {"K1": LEFT, "K2": RIGHT, "D1": LENS, "D2": LENS, "R": R, "T": SHIFT_M, "image_size": written}
    assert read(tmp_path, cameras).size_left == written
    for image_size in ((800, 600), (400, 300)):
        rig = read_texts(tmp_path, json.dumps(cameras), distorted=True, image_size=image_size)
        assert rig.size_left == expected
    turned = read_texts(tmp_path, json.dumps(cameras), distorted=True, image_size=(600, 800))
    assert turned.size_left == written


def test_arrays_of_objects_in_an_archive_are_left_out_and_not_unpickled(tmp_path):
    arrays = {"K1": LEFT, "K2": RIGHT, "D1": LENS, "D2": LENS, "R": R, "T": SHIFT_M}
    corners = np.empty(2, dtype=object)
    corners[:] = [np.zeros((3, 2)), None]
    np.savez(tmp_path / "calib.npz", corners=corners, **arrays)
    is_the_rig(read_calibration(tmp_path / "calib.npz", distorted=True))


def test_a_pose_from_the_right_camera_to_the_left_one_is_not_inverted(tmp_path):
    cameras = {"K_left": LEFT, "K_right": RIGHT, "D_left": LENS, "D_right": LENS}
    back = {"R_right_to_left": POSE[:3, :3].tolist(), "T_right_to_left": POSE[:3, 3].tolist()}
    is_the_rig(read(tmp_path, cameras | back))


def test_a_rotation_may_be_a_vector_and_a_matrix_four_numbers(tmp_path):
    cameras = {"K_left": [811.0, 809.0, 402.5, 301.25], "K_right": [807.0, 806.0, 395.5, 298.75]}
    entries = cameras | {"D_left": LENS, "D_right": LENS, "rvec": TURN.as_rotvec().tolist(), "tvec": SHIFT_M}
    is_the_rig(read(tmp_path, entries))


@pytest.mark.parametrize(
    ("unit", "said"),
    [
        (1000, {}),
        (1000, {"T": None, "translation_mm": in_unit(1000)}),
        (100, {"T": None, "T_cm": in_unit(100)}),
        (1000, {"baseline_mm": float(1000 * np.linalg.norm(SHIFT_M))}),
        (100, {"baseline_mm": float(1000 * np.linalg.norm(SHIFT_M))}),
        (1000, {"baseline": float(np.linalg.norm(SHIFT_M))}),
        (1, {"baseline_cm": float(100 * np.linalg.norm(SHIFT_M))}),
        (1000, {"square_size_mm": 24.5}),
        (1, {"square_size_mm": 24.5}),
        (1000, {"unit": "millimeters"}),
    ],
)
def test_a_unit_that_the_file_says_is_taken(tmp_path, unit, said):
    entries = {"K1": LEFT, "K2": RIGHT, "D1": LENS, "D2": LENS, "R": R, "T": in_unit(unit)} | said
    rig = read(tmp_path, {name: value for name, value in entries.items() if value is not None})
    if said:
        is_the_rig(rig)
    else:  # 73 metres, of which the check of the baseline warns
        np.testing.assert_allclose(rig.E[:3, 3], 1000 * POSE[:3, 3], atol=1e-6)


@pytest.mark.parametrize("metres", [1.4, 2.9, 16.0])
def test_a_long_baseline_of_no_unit_is_never_trusted_unless_it_is_given(tmp_path, metres):
    entries = {"K1": LEFT, "K2": LEFT, "R": np.eye(3).tolist(), "T": [-metres, 0, 0]}
    with noted() as said, pytest.warns() if metres > 1.5 else noted():
        assert read(tmp_path, entries).E[0, 3] == metres
    assert [message.code for message in said if message.forbids_trust] == ["calibration.assumed-metres"] * (
        metres > 1.5
    )
    with noted() as said:
        read_texts(tmp_path, json.dumps(entries), baseline_m=metres)
    assert not said


def test_projections_are_in_the_unit_that_the_file_says(tmp_path):
    P1, P2 = (np.column_stack([np.array(LEFT), [x, 0, 0]]).tolist() for x in (0.0, -811.0 * 73.4))
    rig = read(
        tmp_path, {"left": {"projection_matrix": P1}, "right": {"projection_matrix": P2}, "baseline_mm": 73.4}
    )
    np.testing.assert_allclose(rig.E[:3, 3], [0.0734, 0, 0], atol=1e-12)


def test_toml_is_read_as_json_is(tmp_path):
    text = f"[left]\nK = {LEFT}\nD = {LENS}\n[right]\nK = {RIGHT}\nD = {LENS}\n"
    text += f"[stereo]\nR = {R}\nT = {SHIFT_M}\n"
    is_the_rig(read_texts(tmp_path, text, distorted=True))


@pytest.mark.parametrize(
    ("old", "new"),
    [("image_width: 640", "image_width:640"), ("D2: [", "D2:["), ("D2: [", "D2:\t["), ("0.08,", "0.08,\n\t")],
)
def test_what_opencv_reads_and_yaml_does_not_is_read(tmp_path, old, new):
    entries = {"K1": LEFT, "K2": RIGHT, "R": R, "T": SHIFT_M}
    text = "%YAML:1.0\n---\n" + yaml.safe_dump(entries)
    text += f"D1: {LENS}\nD2: {LENS}\nimage_width: 640\nimage_height: 480\n"
    assert old in text
    is_the_rig(read_texts(tmp_path, text.replace(old, new), distorted=True))


def test_a_line_that_is_no_yaml_is_named(tmp_path):
    with pytest.raises(InputError, match=r"got 'K2 \[1, 2' in line 2 .*Correct the line"):
        read_texts(tmp_path, "K1: [1, 2]\nK2 [1, 2\nR: [1]\n")


def test_two_files_of_single_cameras_say_what_is_missing(tmp_path):
    texts = [yaml.safe_dump({"camera_matrix": K, "distortion_coefficients": [LENS]}) for K in (LEFT, RIGHT)]
    with pytest.raises(InputError, match=r"no M1, M2, R, T among camera_matrix \(9\).*of one camera"):
        read_texts(tmp_path, *texts)


def test_names_that_nobody_knows_are_listed(tmp_path):
    with pytest.raises(
        InputError, match=r"no M1, M2 among tele_lens \(9\), wide_lens \(9\), r \(9\), t \(3\)\. .*rename"
    ):
        read(tmp_path, {"tele_lens": LEFT, "wide_lens": RIGHT, "R": R, "T": SHIFT_M})


def test_four_numbers_of_one_camera_are_not_spring(tmp_path):
    """As ETH3D's SLAM sets have them: the distance of the cameras is not in the file."""
    with pytest.raises(InputError, match="--fx 711.5 --fy 712.5 --cx 352 --cy 203 --baseline METRES"):
        read_texts(tmp_path, "711.5 712.5 352.0 203.0\n", image_names=("rgb/0001.png", "rgb2/0001.png"))
    rig = read_texts(tmp_path, "711.5 712.5 352.0 203.0\n", image_names=("a.png", "b.png"), baseline_m=0.2)
    assert rig.E[0, 3] == pytest.approx(0.2) and rig.K_left[0, 0] == 711.5


def test_a_whole_file_is_never_asked_whether_it_was_cut_off(tmp_path):
    for text in (
        "cam0:\n  camera_model: pinhole\ncam1:\n  camera_model: pinhole\n",
        '{"cameraData": []}',
        "fx: 500\nfy: 500\ncx: 1\ncy: 1\n",
        "[LEFT_CAM_HD]\nfx=1\n[RIGHT_CAM_HD]\nfx=1\n",
    ):
        with pytest.raises(InputError) as caught:
            read_texts(tmp_path, text, image_size=(1280, 720))
        assert "cut off" not in str(caught.value)
    for text in (
        '{"cameraData": [[1, {"intr',
        "cam0:\n  camera_model: pinhole\ncam1:\n  intrinsics: [458.6, 45",
    ):
        with pytest.raises(InputError, match="cut off"):
            read_texts(tmp_path, text)


def test_archives_with_names_of_stereo_tutorials(tmp_path):
    arrays = {
        "mtxL": LEFT,
        "mtxR": RIGHT,
        "distL": [LENS],
        "distR": [LENS],
        "R": R,
        "T": np.reshape(SHIFT_M, (3, 1)),
    }
    np.savez(tmp_path / "stereo.npz", **{name: np.array(value) for name, value in arrays.items()})
    is_the_rig(read_calibration(tmp_path / "stereo.npz", distorted=True))


def test_a_folder_of_arrays_is_a_calibration(tmp_path):
    """As StereoVision and StereoPi's tutorial keep one."""
    folder = tmp_path / "calib_result"
    folder.mkdir()
    arrays = {
        "cam_mats_left": LEFT,
        "cam_mats_right": RIGHT,
        "rot_mat": R,
        "trans_vec": np.reshape(SHIFT_M, (3, 1)),
    }
    arrays |= {"dist_coefs_left": [LENS], "dist_coefs_right": [LENS], "e_mat": np.eye(3)}
    for name, values in arrays.items():
        np.save(folder / f"{name}.npy", np.array(values))
    np.save(folder / "pickled.npy", np.array([{}], dtype=object), allow_pickle=True)
    np.save(folder / "left_map.npy", np.zeros((480, 640), np.float32))
    is_the_rig(read_calibration(folder, distorted=True))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="the folder .*empty. Name the file inside it"):
        read_calibration(tmp_path / "empty")


def test_both_cameras_of_ros_may_lie_in_one_file(tmp_path):
    left, right = SAMPLES["ros_ini"]
    rig = read_texts(tmp_path, left + right)
    np.testing.assert_allclose(rig.E[:3, 3], [0.12, 0, 0], atol=1e-12)
    with pytest.raises(InputError, match="Give left.ini and right.ini"):
        read_texts(tmp_path, left)


def test_cameras_of_many_are_chosen_by_their_numbers(tmp_path):
    text = SAMPLES["anipose"][0]
    third = text.partition("[cam_1]")[0].replace("[cam_0]", "[cam_2]")
    text = text.replace("[metadata]", third + "[metadata]")
    np.testing.assert_allclose(read_texts(tmp_path, text, cameras=(0, 1)).E[0, 3], 0.12)
    np.testing.assert_allclose(read_texts(tmp_path, text, cameras=(1, 2)).E[0, 3], -0.12)


def test_a_rectifier_of_stella_describes_pictures_as_taken_too(tmp_path):
    content = yaml.safe_load(SAMPLES["stella"][0])
    made = {"K_left": LEFT, "K_right": RIGHT, "D_left": LENS, "D_right": LENS}
    made |= {"R_left": np.eye(3).ravel().tolist(), "R_right": TURN.as_matrix().ravel().tolist()}
    rig = read_texts(tmp_path, yaml.safe_dump(content | {"StereoRectifier": made}))
    assert rig.rectified and rig.E[0, 3] == pytest.approx(0.12)
    expected = rig.E.copy()
    expected[:3, :3] = TURN.as_matrix()
    np.testing.assert_allclose(rig.as_taken.E, expected, atol=1e-9)
    fisheye = made | {"model": "fisheye", "D_left": LENS[:4], "D_right": LENS[:4]}
    taken = read_texts(tmp_path, yaml.safe_dump(content | {"StereoRectifier": fisheye})).as_taken
    assert [lens.model for lens in taken.distortion] == ["fisheye", "fisheye"]


def test_eight_numbers_are_of_one_camera_of_droid_slam(tmp_path):
    with pytest.raises(InputError, match="k1 k2 p1 p2 of one camera. Give .* --distortion --baseline"):
        read_texts(tmp_path, "711.5 712.5 352.0 203.0 -0.28 0.07 0.0002 0.00002\n")


def test_lines_of_mac_vo_name_the_baseline_bl(tmp_path):
    text = (
        "type: GeneralStereo\nargs:\n  camera:\n    fx: 735.5\n    fy: 734.5\n    cx: 642.5\n    cy: 362.25\n"
    )
    rig = read_texts(tmp_path, text + "  bl: 0.131    # Unit: meter\n  format: png\n")
    assert rig.E[0, 3] == 0.131 and rig.K_left[1, 2] == 362.25


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_left_right_and_pose_may_be_three_files(tmp_path, order):
    def camera(K):
        return {"camera_matrix": K, "distortion_coefficients": LENS, "image_width": 800, "image_height": 600}

    files = [camera(LEFT), camera(RIGHT), {"R": R, "translation_mm": in_unit(1000)}]
    rig = read_texts(tmp_path, *(yaml.safe_dump(files[n]) for n in order), distorted=True)
    is_the_rig(rig)
    assert rig.size_left == rig.size_right == (800, 600)


def test_a_translation_that_counts_squares_is_not_taken_for_millimetres(tmp_path):
    entries = {"K1": LEFT, "K2": RIGHT, "R": R, "T": [-7.1, 0, 0], "square_size_mm": 24.5}
    with noted() as said, pytest.warns(UserWarning, match="squares of the board"):
        read(tmp_path, entries)
    assert [message.code for message in said] == ["calibration.assumed-metres"]


def test_the_matrix_of_undistorted_pictures_is_not_that_of_the_camera(tmp_path):
    """As getOptimalNewCameraMatrix gives it, which tutorials save beside the camera's."""
    cameras = {"mtx_left": LEFT, "mtx_right": RIGHT, "new_mtx_left": RIGHT, "new_camera_matrix_right": LEFT}
    is_the_rig(read(tmp_path, cameras | {"dist_left": LENS, "dist_right": LENS, "R": R, "T": SHIFT_M}))
