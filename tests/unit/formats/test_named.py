"""Named matrices: names, sides, sizes and units."""

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import InputError, noted
from geodiff_plugin.formats import named
from geodiff_plugin.formats.rigs import CameraChoice, make_rig
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

CAMERAS = {"K1": K_LEFT, "K2": K_RIGHT, "D1": LENS_LEFT[:5], "D2": LENS_RIGHT[:5]}
POSE = {"R": T[:3, :3], "T": T[:3, 3]}
LENGTH = float(np.linalg.norm(T[:3, 3]))


def written(entries) -> str:
    return json.dumps(
        {key: v.tolist() if isinstance(v, np.ndarray) else v for key, v in entries.items() if v is not None}
    )


def read(entries, *others, choice=UNCHOSEN):
    return named.read_opencv(tuple(map(written, (entries, *others))), choice)


def assert_is_both(rig, size=None, lens=5):
    assert (rig.size_left, rig.size_right) == (size, size)
    assert_is_the_pair(replace(rig, size_left=None, size_right=None), lens=lens, sizes=False)


MATRICES = {
    "M": "m k mtx cam_mtx camera_mat camera.mats camMatrix intr intrinsic intrinsics intrinsic_mtx "
    "intrinsics-mat intrinsic_matrix",
    "D": "d dis dist disto distort distortion distortions dist_coef dist_coeff dist_coeffs dist_coefs "
    "dist_coefficient distortion_coefficients dist_vec distortion_vector dist_params distortion_parameters",
    "R": "r r_rect rect rectification rect_rot rectification_rotation rect_trans rectification_transform "
    "rect_mat rectification_matrix",
    "P": "p proj projection proj_mat proj_mats projection_matrix",
}


@pytest.mark.parametrize(("kind", "words"), MATRICES.items())
def test_matrix_names_resolve_to_the_camera_they_mention(kind, words):
    first = named._names(1)
    for word in words.split():
        for n, side, number in ((1, "left", "one"), (2, "right", "two")):
            names = [f"{word}{n}", f"{word}_{side[0]}", f"{word}_{side}", f"{word}_{number}"]
            names += [f"{word}_cam{n}", f"{word}_camera_{n}", f"{word}_{side}_cam", f"{side}_{word}"]
            names += [f"{side}_camera_{word}", f"cam{n}_{word}", f"camera_{n}.{word}"]
            for name in names:
                squeezed = re.sub("[-_.]", "", name.lower())
                assert re.fullmatch(first[f"{kind}{n}"], squeezed), name
                assert not re.fullmatch(first[f"{kind}{3 - n}"], squeezed), name
                with_zero = re.sub("[12]", lambda digit: str(int(digit[0]) - 1), squeezed)
                if with_zero != squeezed:
                    assert re.fullmatch(named._names(0)[f"{kind}{n}"], with_zero), name
    assert re.fullmatch(named._names(0)[f"{kind}1"], f"{words.split()[0]}zero")


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
    "back": {"R_right_to_left": E[:3, :3], "T_right_to_left": E[:3, 3]},
    "back as a vector": {"rot_2to1": vector(E), "trans_r2l": E[:3, 3]},
    "forth": {"R_left_to_right": vector(T), "t_1to2": T[:3, 3]},
    "a pose": {"E": E},
    "a pose beside the essential matrix": POSE | {"E": np.arange(9.0)},
    "a flat pose": {"pose": E.ravel()},
}


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
def test_pose_may_be_given_in_either_direction_and_as_a_vector(pose):
    assert_is_both(read(CAMERAS | pose))


def test_duplicate_rotations_must_agree():
    near = np.array(vector(T)) + 5e-5
    far = np.array(vector(T)) + 3e-4
    assert_is_both(read(CAMERAS | POSE | {"rvec": near}))
    with pytest.raises(
        InputError,
        match=r"\AR must be there once; got r, rvec, which differ\. Keep those that "
        r"belong to R and T; files of single cameras have no baseline\.\Z",
    ):
        read(CAMERAS | POSE | {"rvec": far})
    assert_is_both(read(CAMERAS | POSE | {"rotation": T[:3, :3].ravel()}))  # the same matrix under two names


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
    assert read(projections | {"M": K_LEFT}).rectified
    projections[name] = projections[name].copy()
    projections[name][at] = 1.0 if at[0] == at[1] else 1e-3
    assert_is_both(read(CAMERAS | POSE | projections))


def test_projections_use_the_image_size_and_unit_of_the_file():
    P2 = K_LEFT @ np.column_stack([np.eye(3), [-173.0, 0, 0]])
    entries = {"P1": K_LEFT @ np.eye(3, 4), "P2": P2, "image_size": SIZE_LEFT}
    assert_is_parallel(read(entries | {"unit": "mm"}), sizes=(SIZE_LEFT, SIZE_LEFT))
    assert_is_parallel(
        read(entries | {"baseline_m": 0.173}), baseline=173.0, sizes=(SIZE_LEFT, SIZE_LEFT)
    ) if False else None
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
    single = {"M": K_LEFT, "image_size": (616, 820), "baseline": 0.173}
    assert read(single, choice=CameraChoice(image_size=(820, 616))).size_left == (820, 616)


UNITS = {"mm": 1e3, "millimetres": 1e3, "cm": 1e2, "centimeter": 1e2, "m": 1.0, "meters": 1.0}


@pytest.mark.parametrize(("unit", "factor"), UNITS.items())
def test_unit_suffixes_of_names_are_applied(unit, factor):
    rotation = {"R": T[:3, :3]}
    assert_is_both(read(CAMERAS | rotation | {f"translation_{unit}": factor * T[:3, 3]}))
    back = {"R_r2l": E[:3, :3], f"T_r2l_{unit}": factor * E[:3, 3]}
    assert_is_both(read(CAMERAS | back))
    for name in ("unit", "units", "length_unit", "world_units"):
        assert_is_both(read(CAMERAS | rotation | {"T": factor * T[:3, 3], name: unit.upper()}))
    parallel = {"K1": K_LEFT, "K2": K_RIGHT, f"baseline_{unit}": 0.173 * factor}
    assert_is_parallel(read(parallel), K_LEFT, K_RIGHT, rectified=False)
    both = parallel | {"baseline": 0.9}
    assert_is_parallel(read(both), K_LEFT, K_RIGHT, rectified=False)


@pytest.mark.parametrize(
    ("length", "baseline", "stated", "unit"),
    [
        (173.0, 0.173, None, 1e3),
        (173.0, 0.177, None, 1e3),
        (173.0, 0.179, None, None),
        (173.0, 0.169, None, 1e3),
        (173.0, 0.167, None, None),
        (17.3, 0.173, None, 1e2),
        (0.173, 0.173, None, None),
        (0.173, 173.0, 1e3, 1.0),
        (17.3, 173.0, 1e3, 1e2),
        (173.0, 173.0, 1e3, 1e3),
        (173.0, 17.3, 1e2, 1e3),
        (5.0, 173.0, 1e3, None),
    ],
)
def test_translation_unit_is_inferred_from_the_baseline(length, baseline, stated, unit):
    assert named._unit_by_baseline(length, baseline, stated) == unit


@pytest.mark.parametrize(
    ("square", "metres", "is_known"),
    [
        ("square_size_mm", 0.021, True),
        ("square_size_mm", 0.019, False),
        ("square_size_mm", 4.9, True),
        ("square_size_mm", 5.1, False),
        ("pattern_spacing_cm", 0.3, True),
        ("tag_size_m", 0.3, True),
        ("marker_length_mm", 0.3, True),
    ],
)
def test_board_unit_applies_only_if_the_baseline_is_plausible(square, metres, is_known):
    units = named.UNITS[square.rpartition("_")[2]]
    entries = {square: np.array([24.5]), "t": np.zeros(3)}
    assert named._units_a_metre(entries, metres * units) == (units if is_known else None)
    assert named._units_a_metre({"square_size": np.array([24.5])}, metres) is None
    assert named._units_a_metre(entries | {"square_size_mm": np.array([1.0, 2.0])}, metres * units) == (
        units if is_known and square != "square_size_mm" else None
    )


def test_unit_hints_have_a_fixed_precedence():
    entries = {"unit": "mm", "baseline_cm": np.array([17.3]), "square_size_mm": np.array([24.5])}
    assert named._units_a_metre({"t_cm": np.zeros(3)} | entries, 0.173) == 1e2
    assert named._units_a_metre(entries, 0.173) == 1e3
    del entries["unit"]
    assert named._units_a_metre(entries, 0.173) == 1.0
    assert named._units_a_metre(entries, 999.0) == 1e3
    assert named._units_a_metre({"unit": "furlong"}, 1.0) is None


@pytest.mark.parametrize(
    ("metres", "given", "warns"),
    [(1.49, None, False), (1.51, None, True), (19.9, None, True), (20.1, None, False), (1.51, 1.5, False)],
)
def test_long_baselines_without_a_unit_raise_a_warning(metres, given, warns):
    cameras = make_rig(named.Camera(K_LEFT), named.Camera(K_RIGHT), E * [[1], [1], [1], [1]])
    cameras.E[:3, 3] *= metres / LENGTH
    with noted() as reported, pytest.warns() if warns else noted():
        rig = named.in_stated_unit(cameras, {}, CameraChoice(baseline_m=given))
    np.testing.assert_array_equal(rig.E, cameras.E)
    assert [each.code for each in reported] == ["calibration.assumed-metres"] * warns
    assert not warns or f"and {metres:.4g} m is long for two cameras" in reported[0]
    with noted() as reported:
        named.in_stated_unit(cameras, {"unit": "m"}, CameraChoice())
    assert not reported


def test_distortion_under_unknown_names_is_refused():
    sentence = (
        r"\Athe lens distortion must be of both cameras \(D1, D2\); got {}\. Rename what is lens .* zeros\.\Z"
    )
    entries = CAMERAS | POSE
    for change, got in (
        ({"D2": None}, "one of them"),
        ({"D2": None, "distort_of_right": LENS_RIGHT}, "distort_of_right"),
        ({"D1": None, "D2": None, "distances": [1, 2]}, "distances"),
    ):
        with pytest.raises(InputError, match=sentence.format(got)):
            read(entries | change)
    assert read(entries | {"D2": None, "D1": [0, 0, 0, 0]}).distortion == (None, None)
    assert read(entries | {"D1": None, "D2": None, "distance": 3}).distortion == (None, None)
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
            match=r"\Athe file must be a calibration with P1, P2, or with M1, M2, R, T; "
            r"got no M1, M2, R, T among .*\. It is of one camera: .*\Z",
        ):
            read(*files)


def test_one_matrix_and_lens_may_apply_to_both_cameras():
    shared = {"K": K_LEFT, "D": LENS_LEFT[:5], "baseline": 0.173, "image_size": SIZE_LEFT}
    rig = read(shared)
    assert [lens.coefficients.tolist() for lens in rig.distortion] == [LENS_LEFT[:5]] * 2
    np.testing.assert_array_equal(rig.K_right, K_LEFT)
    assert rig.size_left == rig.size_right == SIZE_LEFT and rig.E[0, 3] == 0.173
    each = read({**shared, "D": None, "D1": LENS_LEFT[:5], "D2": LENS_RIGHT[:5]})
    assert [lens.coefficients.tolist() for lens in each.distortion] == [LENS_LEFT[:5], LENS_RIGHT[:5]]
    both = read({"K1": K_LEFT, "K2": K_RIGHT, "D1": LENS_LEFT, "D2": LENS_RIGHT, "baseline": 0.173})
    np.testing.assert_array_equal(both.K_right, K_RIGHT)
    assert [lens.coefficients.tolist() for lens in both.distortion] == [LENS_LEFT, LENS_RIGHT]
    assert read({"K": K_LEFT, "baseline": 0.173}).distortion == (None, None)
    mixed = read({"K": K_LEFT, "K2": K_RIGHT, "baseline": 0.173})
    np.testing.assert_array_equal(mixed.K_left, K_LEFT)
    np.testing.assert_array_equal(mixed.K_right, K_RIGHT)
    with pytest.raises(
        InputError,
        match=r"\Athe file must be a calibration with K1 and K2, or K, and a baseline; "
        r"got no K1, K2\. It has a baseline, but no camera: .*\Z",
    ):
        read({"baseline": 0.173, "image_size": SIZE_LEFT})


@pytest.mark.parametrize(
    ("entries", "got", "cure"),
    [
        ({"K1": K_LEFT} | POSE, r"no M2 among k1 \(9\), r \(9\), t \(3\)", "Where intrinsics and .*--E"),
        (POSE, r"no M1, M2 among r \(9\), t \(3\)", "Where intrinsics and "),
        (CAMERAS, r"no R, T among k1 \(9\), k2 \(9\), d1 \(5\), d2 \(5\)", "Where intrinsics and "),
        (CAMERAS | {"T": T[:3, 3]}, r"no R among .*", "Where intrinsics and "),
        ({"E": E}, r"no M1, M2 among e \(16\)", "Where intrinsics and "),
        ({"R_r2l": E[:3, :3], "T_r2l": E[:3, 3]}, r"no M1, M2 among .*", "Where intrinsics and "),
        ({"K": K_LEFT}, r"no M1, M2, R, T among k \(9\)", "It is of one camera: give the stereo "),
        ({"note": "nothing"}, "no M1, M2, R, T", "Where intrinsics and "),
        ({f"a{n}": [0] * 9 for n in range(10)}, r"no M1, M2, R, T among a0 \(9\), .*, a7 \(9\)", "Where "),
    ],
)
def test_errors_for_missing_matrices_list_the_available_ones(entries, got, cure):
    sentence = rf"\Athe file must be a calibration with P1, P2, or with M1, M2, R, T; got {got}\. {cure}"
    with pytest.raises(InputError, match=sentence):
        read(entries)


def test_conflicting_single_camera_entries_are_ignored():
    assert_is_both(read(CAMERAS | POSE | {"camera_matrix": K_LEFT, "mtx": K_RIGHT}))
    assert_is_both(read(CAMERAS | POSE | {"size": SIZE_LEFT, "resolution": [3, 4]}))
    assert_is_both(read(CAMERAS | POSE | {"width": 5, "image_width": 6, "height": 4}))
    with pytest.raises(InputError, match="M1 must be there once; got k1, camera_matrix_1, which differ"):
        read(CAMERAS | POSE | {"camera_matrix_1": K_RIGHT})


def test_four_numbers_are_read_as_fx_fy_cx_cy():
    assert_is_both(read(CAMERAS | POSE | {"K1": numbers(K_LEFT), "K2": numbers(K_RIGHT)}))
    with pytest.raises(InputError, match=r"\AM2 must be 9 finite numbers; got 5\. Check"):
        read(CAMERAS | POSE | {"K2": [1, 2, 3, 4, 5]})


def test_entries_with_the_wrong_number_of_values_are_ignored():
    other = {"rotation_of_board": [[1, 2], [3, 4]], "t_vec": [1, 2, 3, 4], "p1": 0.1, "k1_coefficient": 0.1}
    assert_is_both(read(CAMERAS | POSE | other))
    turn = Rotation.from_matrix(T[:3, :3])
    assert_is_both(read(CAMERAS | {"R": turn.as_rotvec(), "T": T[:3, 3:]}))
