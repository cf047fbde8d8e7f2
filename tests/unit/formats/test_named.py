"""Named matrices: dialects, sides, sizes and units."""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import named
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.calibrated_pair import (
    K_LEFT,
    K_RIGHT,
    LENS_LEFT,
    LENS_RIGHT,
    SIZE_LEFT,
    UNCHOSEN,
    E,
    T,
    assert_is_parallel,
    assert_is_the_pair,
    numbers,
    vector,
)
from tests.views import lenses_of

CAMERAS = {"K1": K_LEFT, "K2": K_RIGHT, "D1": LENS_LEFT[:5], "D2": LENS_RIGHT[:5]}
POSE = {"R": T[:3, :3], "T": T[:3, 3]}
LENGTH = float(np.linalg.norm(T[:3, 3]))


def written(entries) -> str:
    return json.dumps(
        {key: v.tolist() if isinstance(v, np.ndarray) else v for key, v in entries.items() if v is not None}
    )


def read(entries, *others, choice=UNCHOSEN):
    return named.read_named(tuple(map(written, (entries, *others))), choice)


def assert_is_both(rig, size=None, lens=5):
    assert (rig.size_left, rig.size_right) == (size, size)
    assert_is_the_pair(rig.sized(None, None), lens=lens, sizes=False)


def values_of(dialect) -> dict:
    """The matrices of the pair by the fields of a dialect, left and right for those of one camera."""
    made = rectified()
    return {
        "K": (K_LEFT, K_RIGHT),
        "lens": (LENS_LEFT[:5], LENS_RIGHT[:5]),
        "projection": (made["P1"], made["P2"]),
        "rectifying": (made["R1"], made["R2"]),
        "rotation": vector(T) if dialect.rotation in ("rvec", "om") else T[:3, :3],
        "translation": T[:3, 3],
    }


@pytest.mark.parametrize("dialect", named.DIALECTS, ids=lambda each: each.programs)
@pytest.mark.parametrize(
    ("sides", "place"),
    [
        *((sides, "behind") for sides in (*named.BEHIND, *named.NUMBERED.values())),
        *((sides, "in front") for sides in (*named.IN_FRONT, *named.NUMBERED.values())),
        *((sides, "above") for sides in (*named.IN_FRONT, *named.NUMBERED.values())),
    ],
)
def test_every_name_of_a_dialect_is_read(dialect, sides, place):
    """Others than its own are those of the documentation."""
    values, fields = values_of(dialect), dialect._asdict()
    for field in ("K", "lens", "rotation", "translation", "rectifying", "projection"):
        for name in fields[field].split():
            names = {"K": "K", "lens": "D", "rotation": "R", "translation": "T"} | {field: name}
            cameras, pose = {}, {}
            for key, value in ((names[each], values[each]) for each in names):
                if not isinstance(value, tuple):
                    pose[key] = value
                    continue
                for side, number in zip(sides, value, strict=True):
                    if place == "above":
                        outer = side if side in ("left", "right") else f"cam{side}"
                        cameras.setdefault(outer, {})[key] = np.asarray(number).tolist()
                    else:
                        cameras[f"{key}_{side}" if place == "behind" else f"{side}.{key}"] = number
            rig = read(cameras | pose)
            if field == "projection":
                assert rig.rectified and rig.as_taken is not None
            else:
                assert_is_both(rig)


#: Names as public programs and scripts mix them.
MIXED = [
    ("mtx_l", "mtx_r", "dist_l", "dist_r", "R", "T"),
    ("camera_mat_left", "camera_mat_right", "distortion_left", "distortion_right", "rotation_mat", "t_vec"),
    ("left_camera_matrix", "right_camera_matrix", "left_dist_coeff", "right_dist_coeff", "rotation", "trans"),
    ("cam_mats_left", "cam_mats_right", "dist_coefs_left", "dist_coefs_right", "rot_mat", "trans_vec"),
    ("cameraMatrix1", "cameraMatrix2", "distCoeffs1", "distCoeffs2", "stereo_R", "stereo_T"),
    ("left_intrinsics", "right_intrinsics", "distortion_left", "distortion_right",
     "rotation_left_to_right", "translation_left_to_right"),
    ("left_camera_Matrix", "right_camera_Matrix", "left_camera_distCoeffs", "right_camera_distCoeffs",
     "Rotate_Matrix", "Translate_Matrix"),
    ("K0", "K1", "D0", "D1", "Rotate", "Trans"),
    ("camera_matrix_one", "camera_matrix_two", "dist_one", "dist_two", "R", "T"),
    ("Camera_Matrix_1", "Camera_Matrix_2", "Distortion_Coeffs_1", "Distortion_Coeffs_2", "rotation",
     "Translation_Vector"),
    ("KL", "KR", "DL", "DR", "rot", "trans"),
]  # fmt: skip


@pytest.mark.parametrize("names", MIXED, ids=lambda names: names[0])
def test_names_that_programs_mix_are_read(names):
    values = (K_LEFT, K_RIGHT, LENS_LEFT[:5], LENS_RIGHT[:5], T[:3, :3], T[:3, 3])
    assert_is_both(read(dict(zip(names, values, strict=True))))


@pytest.mark.parametrize(
    "sides", [("left", "right"), ("cam0", "cam1"), ("camera_1", "camera_2"), ("left_cam", "right_cam")]
)
def test_cameras_may_be_objects_whose_names_state_the_sides(sides):
    """Their order in the file means nothing."""
    left, right = sides
    cameras = {
        right: {"camera_matrix": K_RIGHT.tolist(), "distortion": LENS_RIGHT[:5]},
        left: {"camera_matrix": K_LEFT.tolist(), "distortion": LENS_LEFT[:5]},
    }
    stereo = {key: value.tolist() for key, value in POSE.items()}
    assert_is_both(read(cameras | {"stereo": stereo}))


def test_the_matrix_of_undistorted_images_is_not_that_of_the_camera():
    """As getOptimalNewCameraMatrix gives it, which tutorials save next to the camera's."""
    cameras = {
        "mtx_left": K_LEFT,
        "mtx_right": K_RIGHT,
        "dist_left": LENS_LEFT[:5],
        "dist_right": LENS_RIGHT[:5],
    }
    assert_is_both(read(cameras | POSE | {"new_mtx_left": K_RIGHT, "new_camera_matrix_right": K_LEFT}))


def test_opencv_names_are_read():
    assert_is_both(read(CAMERAS | POSE))
    assert_is_both(read(CAMERAS | POSE | {"image_size": list(SIZE_LEFT)}), SIZE_LEFT)
    sides = {"image_width": SIZE_LEFT[0], "image_height": SIZE_LEFT[1]}
    assert_is_both(read(CAMERAS | POSE | sides), SIZE_LEFT)
    assert_is_both(read(CAMERAS | POSE | {"image_size": [1, 2, 3]}), None)
    assert_is_both(read(CAMERAS | POSE | {"image_size": [1, 2, 3]} | sides), SIZE_LEFT)
    assert_is_both(read(CAMERAS | POSE | {"image_width": 820}), None)
    assert_is_both(read(CAMERAS, POSE))
    without_lens = {"K1": K_LEFT, "K2": K_RIGHT} | POSE
    assert_is_both(read(without_lens), lens=None)


def test_numbering_may_start_at_zero():
    entries = {"K0": K_LEFT, "K1": K_RIGHT, "D0": LENS_LEFT[:5], "D1": LENS_RIGHT[:5]}
    assert_is_both(read(entries | POSE))
    entries = {
        f"{side}_{key}": v
        for side, pair in (
            ("cam0", ("K", K_LEFT, "dist", LENS_LEFT)),
            ("cam1", ("K", K_RIGHT, "dist", LENS_RIGHT)),
        )
        for key, v in zip(pair[::2], pair[1::2], strict=True)
    }
    assert_is_both(read(entries | POSE), lens=8)
    assert_is_both(read(CAMERAS | POSE | {"k0": 0.5}))  # a coefficient, not a matrix of camera 0


POSES = {
    "R and T": POSE,
    "vectors": {"rvec": vector(T), "tvec": T[:3, 3]},
    "Bouguet's om": {"om": vector(T), "T": T[:3, 3]},
    "depthai": {"rotation_left_to_right": T[:3, :3], "translation_left_to_right": T[:3, 3]},
    "a pose": {"E": E},
    "a pose beside the essential matrix": POSE | {"E": np.arange(9.0)},
    "a flat pose": {"pose": E.ravel()},
}


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
def test_the_pose_may_be_a_matrix_or_a_vector(pose):
    assert_is_both(read(CAMERAS | pose))


def test_a_matrix_goes_before_a_rotation_vector():
    for turn in (vector(T), [0.1, 0.2, 0.3]):
        assert_is_both(read(CAMERAS | POSE | {"rvec": turn}))
    assert_is_both(read(CAMERAS | POSE | {"rotation": T[:3, :3].ravel()}))  # the same matrix under two names
    with pytest.raises(
        InputError,
        match=r"\AR must be unique; got r, rotation, which differ\. Keep the ones that match R and T; "
        r"files of single cameras have no baseline\.\Z",
    ):
        read(CAMERAS | POSE | {"rotation": E[:3, :3]})


def rectified(size=SIZE_LEFT):
    """The pair as OpenCV rectifies it."""
    D_left, D_right = np.array(LENS_LEFT[:5]), np.array(LENS_RIGHT[:5])
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        K_LEFT, D_left, K_RIGHT, D_right, size, T[:3, :3], T[:3, 3:], alpha=0, newImageSize=(900, 700)
    )
    return {"R1": R1, "R2": R2, "P1": P1, "P2": P2}


@pytest.mark.parametrize("pose", [POSE, {}], ids=["by R and T", "by R1 and R2"])
def test_rectified_calibrations_keep_the_original_cameras(pose):
    made = rectified()
    rig = read(CAMERAS | pose | made | {"image_size": SIZE_LEFT})
    assert_is_parallel(
        rig, made["P1"][:, :3], made["P2"][:, :3], baseline=LENGTH, sizes=(SIZE_LEFT, SIZE_LEFT)
    )
    assert_is_both(rig.as_taken, SIZE_LEFT)
    without = read({"K1": K_LEFT, "K2": K_RIGHT} | pose | made)
    assert without.as_taken is None
    assert read(CAMERAS | {"P1": made["P1"], "P2": made["P2"]}).as_taken is None
    unreadable = read({**CAMERAS, "D1": [1, 2, 3]} | pose | made)
    assert unreadable.as_taken is None and unreadable.rectified


@pytest.mark.parametrize("at", [(0, 0), (1, 1), (1, 0), (2, 0), (2, 1)])
@pytest.mark.parametrize("name", ["P1", "P2"])
def test_projections_of_unrectified_images_are_ignored(name, at):
    projections = {"P1": K_LEFT @ np.eye(3, 4), "P2": K_RIGHT @ T[:3]}
    projections["P2"][:, :3] = K_RIGHT
    assert read(CAMERAS | POSE | projections).rectified
    assert read(projections | {"K": K_LEFT}).rectified
    projections[name] = projections[name].copy()
    projections[name][at] = 1.0 if at[0] == at[1] else 1e-3
    assert_is_both(read(CAMERAS | POSE | projections))


def test_projections_use_the_image_size_and_unit_of_the_file():
    P2 = K_LEFT @ np.column_stack([np.eye(3), [-173.0, 0, 0]])
    entries = {"P1": K_LEFT @ np.eye(3, 4), "P2": P2, "image_size": SIZE_LEFT}
    assert_is_parallel(read(entries | {"unit": "mm"}), sizes=(SIZE_LEFT, SIZE_LEFT))
    assert read(entries | {"baseline_cm": 17.3}).E[0, 3] == pytest.approx(0.173)


@pytest.mark.parametrize(
    ("written_size", "image_size", "turned"),
    [
        ((616, 820), (820, 616), True),
        ((616, 820), (1640, 1232), True),
        ((616, 820), (616, 820), False),
        ((616, 820), None, False),
        ((820, 616), (616, 820), False),
        ((820, 616), (820, 616), False),
    ],
)
def test_height_first_sizes_are_detected_from_image_and_principal_points(written_size, image_size, turned):
    expected = written_size[::-1] if turned else written_size
    for K in ((K_LEFT, K_RIGHT * [[1, 0, 0.8], [0, 1, 0.9], [0, 0, 1]]), (numbers(K_LEFT), numbers(K_LEFT))):
        entries = CAMERAS | POSE | {"K1": K[0], "K2": K[1], "image_size": written_size}
        rig = read(entries, choice=CameraChoice(image_size=image_size))
        assert rig.size_left == rig.size_right == expected


def test_ambiguous_sizes_are_kept_as_written():
    """The principal point is equally far from the centre of either orientation."""
    K = np.array([[800.0, 0, 359.0], [0, 800, 359], [0, 0, 1]])
    entries = {"K1": K, "K2": K, "image_size": (616, 820)} | POSE
    assert read(entries, choice=CameraChoice(image_size=(820, 616))).size_left == (616, 820)
    single = {"K": K_LEFT, "image_size": (616, 820), "baseline": 0.173}
    assert read(single, choice=CameraChoice(image_size=(820, 616))).size_left == (820, 616)


UNITS = {"mm": 1e3, "millimetres": 1e3, "cm": 1e2, "centimeter": 1e2, "m": 1.0, "meters": 1.0}


@pytest.mark.parametrize(("unit", "factor"), UNITS.items())
def test_unit_suffixes_of_names_are_applied(unit, factor):
    rotation = {"R": T[:3, :3]}
    assert_is_both(read(CAMERAS | rotation | {f"translation_{unit}": factor * T[:3, 3]}))
    for name in ("unit", "units", "length_unit", "world_units"):
        assert_is_both(read(CAMERAS | rotation | {"T": factor * T[:3, 3], name: unit.upper()}))
    parallel = {"K1": K_LEFT, "K2": K_RIGHT, f"baseline_{unit}": 0.173 * factor}
    assert_is_parallel(read(parallel), K_LEFT, K_RIGHT, rectified=False)
    both = parallel | {"baseline": 0.9}
    assert_is_parallel(read(both), K_LEFT, K_RIGHT, rectified=False)


def test_distortion_under_unknown_names_is_rejected():
    sentence = (
        r"\Athe lens distortion must be specified for both cameras \(D1, D2\); got {}\. "
        r"Name lens .* differently\.\Z"
    )
    entries = CAMERAS | POSE
    for change, got in (
        ({"D2": None}, "for one of them"),
        ({"D2": None, "distort_of_right": LENS_RIGHT}, "distort_of_right"),
        ({"D1": None, "D2": None, "distances": [1, 2]}, "distances"),
        ({"D1": None, "D2": None, "DistortionOfRight": LENS_RIGHT}, "distortionofright"),
        ({"D1": None, "D2": None, "D": LENS_RIGHT}, "for one of them"),
    ):
        with pytest.raises(InputError, match=sentence.format(got)):
            read(entries | change)
    assert lenses_of(read(entries | {"D2": None, "D1": [0, 0, 0, 0]})) == (None, None)
    assert lenses_of(read(entries | {"D1": None, "D2": None, "distance": 3})) == (None, None)
    assert_is_both(read(entries | {"undistorted": [1, 2]}))


def camera_file(K, lens):
    size = {"image_width": SIZE_LEFT[0], "image_height": SIZE_LEFT[1]}
    return {"camera_matrix": K, "distortion_coefficients": lens} | size


def test_cameras_may_come_in_separate_files():
    left, right = camera_file(K_LEFT, LENS_LEFT[:5]), camera_file(K_RIGHT, LENS_RIGHT[:5])
    for files in ((left, right, POSE), (POSE, left, right), (left, POSE, right)):
        assert_is_both(read(*files), SIZE_LEFT)
    made = rectified()
    pair = [
        {**file, "projection_matrix": made[f"P{n}"], "rectification_matrix": made[f"R{n}"]}
        for n, file in ((1, left), (2, right))
    ]
    rig = read(*pair)
    np.testing.assert_allclose(rig.K_left, made["P1"][:, :3])
    np.testing.assert_allclose(rig.E[:3, 3], [LENGTH, 0, 0], atol=1e-9)
    assert_is_both(rig.as_taken, SIZE_LEFT)
    for files in ((left, right), (left, right, left)):
        with pytest.raises(
            InputError,
            match=r"\Athe file must be a calibration with P1, P2, or with K1, K2, R, T; "
            r"got no K1, K2, R, T among .*\. It has a single camera\. Pass .*\Z",
        ):
            read(*files)


def test_one_matrix_and_lens_may_apply_to_both_cameras():
    shared = {"K": K_LEFT, "D": LENS_LEFT[:5], "baseline": 0.173, "image_size": SIZE_LEFT}
    rig = read(shared)
    assert [lens.coefficients.tolist() for lens in lenses_of(rig)] == [LENS_LEFT[:5]] * 2
    np.testing.assert_array_equal(rig.K_right, K_LEFT)
    assert rig.size_left == rig.size_right == SIZE_LEFT and rig.E[0, 3] == 0.173
    each = read({**shared, "D": None, "D1": LENS_LEFT[:5], "D2": LENS_RIGHT[:5]})
    assert [lens.coefficients.tolist() for lens in lenses_of(each)] == [LENS_LEFT[:5], LENS_RIGHT[:5]]
    both = read({"K1": K_LEFT, "K2": K_RIGHT, "D1": LENS_LEFT, "D2": LENS_RIGHT, "baseline": 0.173})
    np.testing.assert_array_equal(both.K_right, K_RIGHT)
    assert [lens.coefficients.tolist() for lens in lenses_of(both)] == [LENS_LEFT, LENS_RIGHT]
    assert lenses_of(read({"K": K_LEFT, "baseline": 0.173})) == (None, None)
    mixed = read({"K": K_LEFT, "K2": K_RIGHT, "baseline": 0.173})
    np.testing.assert_array_equal(mixed.K_left, K_LEFT)
    np.testing.assert_array_equal(mixed.K_right, K_RIGHT)
    with pytest.raises(
        InputError,
        match=r"\Athe file must be a calibration with K1 and K2, or K, and a baseline; "
        r"got no K1, K2\. It has a baseline but no cameras; pass .*\Z",
    ):
        read({"baseline": 0.173, "image_size": SIZE_LEFT})


@pytest.mark.parametrize(
    ("entries", "got", "hint"),
    [
        (
            {"K1": K_LEFT} | POSE,
            r"no K2 among k1 \(9\), r \(9\), t \(3\)",
            "If intrinsics and .*docs/reference/calibration.md.*--E",
        ),
        (POSE, r"no K1, K2 among r \(9\), t \(3\)", "If intrinsics and "),
        (CAMERAS, r"no R, T among k1 \(9\), k2 \(9\), d1 \(5\), d2 \(5\)", "If intrinsics and "),
        (CAMERAS | {"T": T[:3, 3]}, r"no R among .*", "If intrinsics and "),
        ({"E": E}, r"no K1, K2 among e \(16\)", "If intrinsics and "),
        ({"K": K_LEFT}, r"no K1, K2, R, T among k \(9\)", "It has a single camera. Pass the stereo "),
        ({"finding": "nothing"}, "no K1, K2, R, T", "If intrinsics and "),
        ({f"a{n}": [0] * 9 for n in range(10)}, r"no K1, K2, R, T among a0 \(9\), .*, a7 \(9\)", "If "),
    ],
)
def test_errors_for_missing_matrices_list_the_available_ones(entries, got, hint):
    sentence = rf"\Athe file must be a calibration with P1, P2, or with K1, K2, R, T; got {got}\. {hint}"
    with pytest.raises(InputError, match=sentence):
        read(entries)


def test_conflicting_single_camera_entries_are_ignored():
    assert_is_both(read(CAMERAS | POSE | {"camera_matrix": K_LEFT, "mtx": K_RIGHT}))
    assert_is_both(read(CAMERAS | POSE | {"size": SIZE_LEFT, "resolution": [3, 4]}))
    assert_is_both(read(CAMERAS | POSE | {"width": 5, "image_width": 6, "height": 4}))
    with pytest.raises(InputError, match="K1 must be unique; got k1, camera_matrix_1, which differ"):
        read(CAMERAS | POSE | {"camera_matrix_1": K_RIGHT})


def test_four_numbers_are_read_as_fx_fy_cx_cy():
    assert_is_both(read(CAMERAS | POSE | {"K1": numbers(K_LEFT), "K2": numbers(K_RIGHT)}))
    with pytest.raises(InputError, match=r"\AK2 must be 9 finite numbers; got 5\. Check"):
        read(CAMERAS | POSE | {"K2": [1, 2, 3, 4, 5]})


def test_entries_with_the_wrong_number_of_values_are_ignored():
    other = {"rotation_of_board": [[1, 2], [3, 4]], "t_vec": [1, 2, 3, 4], "p1": 0.1, "k1_coefficient": 0.1}
    assert_is_both(read(CAMERAS | POSE | other))
    turn = Rotation.from_matrix(T[:3, :3])
    assert_is_both(read(CAMERAS | {"R": turn.as_rotvec(), "T": T[:3, 3:]}))
