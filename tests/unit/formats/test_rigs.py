"""Validation of raw numbers, and the rigs built from them."""

import json
import math
import re
import sys
from dataclasses import FrozenInstanceError
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import NEGATIVE_BASELINE, InputError, InputFileError
from geodiff_plugin.cameras import Distortion
from geodiff_plugin.formats import rigs
from geodiff_plugin.formats.rigs import CameraChoice, RawCamera
from tests.unit.formats.calibrated_pair import (
    K_LEFT,
    K_RIGHT,
    LENS_LEFT,
    LENS_RIGHT,
    SIZE_LEFT,
    SIZE_RIGHT,
    E,
    assert_is_parallel,
    assert_is_the_pair,
    pose,
)

EDGE = "Check the calibration file."


def refused(words: str):
    """Expect an input error whose whole message matches."""
    return pytest.raises(InputError, match=rf"(?s)\A{words}\Z")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('{"a": [1, 2]}', False),
        ('{"a": [1, 2]', True),
        ('{"a": [1, 2}', True),
        ("one line without its end", False),
        ("two\nlines without an end", True),
        ("two\nlines\n", False),
        ("[a]\nb = [1]", False),
        ("{\n}", False),
        ("<a>\n</a>", False),
        ("closed] more\n", False),
        ("[[[ and ]]\n", True),
    ],
)
def test_truncated_text_has_an_open_bracket_or_an_unfinished_last_line(text, expected):
    assert rigs.is_cut_off(text) is expected


def _error(make) -> Exception:
    with pytest.raises(Exception) as caught:  # noqa: PT011  (whatever the parser raises)
        make()
    return caught.value


ENDED = [
    (lambda: json.loads('{"a": '), True),
    (lambda: json.loads('{"a": \n '), True),
    (lambda: json.loads('{"a": x}'), False),
    (lambda: json.loads('{"a": 1} 2'), False),
    (lambda: yaml.safe_load("a: [1, 2"), True),
    (lambda: ElementTree.fromstring("<a>"), True),
    (lambda: {}["K"], False),
    (lambda: float("x"), False),
    (lambda: [][3], False),
]


@pytest.mark.parametrize(("make", "ended"), ENDED)
def test_parser_errors_become_input_errors_that_name_the_file(make, ended):
    """A parser error at the end of the text suggests a truncated file; any other error offers the hint."""
    error = _error(make)
    with pytest.raises(InputError) as caught, rigs.reading_file("FILE", "calibration", "x", hint="A cure."):
        raise error
    reported = str(caught.value)
    got = str(error) if isinstance(error, ValueError) else "other entries"
    got = "no 'K'" if isinstance(error, KeyError) else " ".join(got.split())
    assert reported == (
        f"FILE must be a whole calibration; got {got}. {'The file seems truncated.' if ended else 'A cure.'}"
    )
    assert caught.value.__suppress_context__ is False


def test_input_errors_pass_through_with_the_file_name_in_front():
    with pytest.raises(InputError, match=r"\AFILE: K is bad\Z"), rigs.reading_file("FILE", "calibration"):
        raise InputError("K is bad")
    with pytest.raises(InputFileError, match=r"\Athe disk\Z"), rigs.reading_file("FILE", "calibration"):
        raise InputFileError("the disk")
    sentence = r"FILE must be a whole x; got other entries\. "
    with (
        refused(rf"{sentence}Check that it is the correct kind of file\."),
        rigs.reading_file("FILE", "x", "whole\n"),
    ):
        raise IndexError("3")
    with (
        refused(
            rf"{sentence}The file seems "
            rf"truncated\."
        ),
        rigs.reading_file("FILE", "x", "whole\n", "{cut"),
    ):
        raise IndexError("3")
    with rigs.reading_file("FILE", "x", "{cut"):
        pass


def test_numbers_and_numeric_text_become_arrays_of_the_requested_shape():
    six = rigs.array_of(["1", "2.5", 3, "4e1", 5, 6], (2, 3), "six")
    np.testing.assert_array_equal(six, [[1, 2.5, 3], [40, 5, 6]])
    assert six.dtype == np.float64
    np.testing.assert_array_equal(rigs.array_of([[1], [2]], (-1,), "any"), [1, 2])
    assert rigs.array_of("7.5", (), "one") == 7.5 and rigs.array_of([2], (), "one").shape == ()
    assert rigs.array_of((), (-1,), "none").shape == (0,)
    for value, shape, words in (
        ("a", (), r"one must be a finite number; got 'a'\."),
        ([1, 2], (), r"one must be a finite number; got 2\."),
        (math.inf, (), r"one must be a finite number; got inf\."),
        ([1, math.nan, 3], (3,), r"one must be 3 finite numbers; got \[1, nan, 3\]\."),
        ([1, None, 3], (3,), r"one must be 3 finite numbers; got \[1, None, 3\]\."),
        ([1, 2, 3, 4], (3,), r"one must be 3 finite numbers; got 4\."),
        ([1, 2], (1, 2, 2), r"one must be 4 finite numbers; got 2\."),
        ([[1, 2], [3]], (-1,), r"one must be finite numbers; got \[\[1, 2\], \[3\]\]\."),
        ([10**400], (1,), r"one must be a finite number; got \[10{350,}\.\.\.\."),
    ):
        with refused(f"{words} {EDGE}"):
            rigs.array_of(value, shape, "one")


def test_camera_matrices_and_poses_are_built_from_flat_numbers():
    K = rigs.intrinsics("811.5", 793.25, 402.25, 305.5)
    np.testing.assert_array_equal(K, K_LEFT)
    with refused(rf"fx, fy, cx, cy must be 4 finite numbers; got \(1, 'x', 2, 3\)\. {EDGE}"):
        rigs.intrinsics(1, "x", 2, 3)
    for form in (E[:3].ravel(), E[:3], E, E.ravel().tolist()):
        np.testing.assert_allclose(rigs.rigid(form, "E"), E, atol=1e-12)
    near = E.copy()
    near[:3, :3] += 3e-4 * np.arange(9).reshape(3, 3)
    U, _, Vt = np.linalg.svd(near[:3, :3])
    read = rigs.rigid(near, "E")
    np.testing.assert_allclose(read[:3, :3], U @ Vt, atol=1e-12)
    np.testing.assert_array_equal(read[:3, 3], E[:3, 3])
    np.testing.assert_allclose(rigs.transform(E[:3, :3].ravel(), E[:3, 3:], "E"), E, atol=1e-12)
    np.testing.assert_allclose(rigs.pose_of(Rotation.from_matrix(E[:3, :3]), E[:3, 3]), E, atol=1e-12)
    for make, words in (
        (
            lambda: rigs.rigid(E[:, :3], "E"),
            r"E must be rigid, .*; got .* Check for swapped rows and columns, .*",
        ),
        (lambda: rigs.rigid(range(11), "E"), rf"E must be 16 finite numbers; got 11\. {EDGE}"),
        (
            lambda: rigs.rigid(2 * E[:3], "E"),
            r"E must be rigid, .* Check for swapped rows and columns, or a scale factor\.",
        ),
        (
            lambda: rigs.rigid(E.T, "E"),
            r"E must be rigid with last row .* Check for swapped rows and columns, .*",
        ),
        (
            lambda: rigs.transform([1, 2], (0, 0, 0), "E"),
            rf"the rotation of E must be 9 finite numbers; got 2\. {EDGE}",
        ),
        (
            lambda: rigs.transform(np.eye(3), (0, 0), "E"),
            rf"the translation of E must be 3 finite numbers; got 2\. {EDGE}",
        ),
        (
            lambda: rigs.pose_of(Rotation.identity(), "x"),
            rf"a place must be 3 finite numbers; got 'x'\. {EDGE}",
        ),
    ):
        with refused(words):
            make()


def test_central_camera_puts_the_principal_point_midway_between_the_image_edges():
    camera = rigs.central_camera(700.0, 650.0, (641, 480), (0.1, 0.2, 0.0, 0.0))
    u, v = camera.K[:2, 2]
    assert u + 0.5 == 641 - (u + 0.5) and v + 0.5 == 480 - (v + 0.5)
    assert (camera.K[0, 0], camera.K[1, 1], camera.size) == (700, 650, (641, 480))
    assert camera.coefficients == (0.1, 0.2, 0.0, 0.0) and camera.model == "opencv"
    with pytest.raises(FrozenInstanceError):
        camera.size = (1, 1)
    assert tuple(rigs.central_camera(1, 1, (4, 2)).coefficients) == ()


def test_resizing_keeps_every_point_at_the_same_fraction_of_the_image():
    K = K_LEFT.copy()
    K[0, 1] = 7.25
    camera = RawCamera(K, SIZE_LEFT, LENS_LEFT, "radtan")
    size = (1230, 920)  # 1.5 times, apart from rounding of the height
    other = rigs.resized(camera, size, "the image", "Crop?")
    assert other.size == size and other.coefficients == LENS_LEFT and other.model == "radtan"
    rays = np.column_stack([np.random.default_rng(0).uniform(-0.4, 0.4, (20, 2)), np.ones(20)])
    before, after = (((rays @ M.T)[:, :2] + 0.5) / s for M, s in ((K, SIZE_LEFT), (other.K, size)))
    np.testing.assert_allclose(after, before, atol=1e-12)
    without_size = rigs.resized(RawCamera(K), (30, 40), "the image", "Crop?")
    np.testing.assert_array_equal(without_size.K, K)
    assert without_size.size == (30, 40)


@pytest.mark.parametrize(
    ("size", "fits"), [((1008, 500), True), ((1012, 500), False), ((990, 500), False), ((992, 500), True)]
)
def test_aspect_ratios_that_differ_by_more_than_one_percent_are_rejected_as_crops(size, fits):
    camera = RawCamera(K_LEFT, (1000, 500))
    if fits:
        assert rigs.resized(camera, size, "the image", "Crop?").size == size
        return
    words = (
        r"the image must be of the aspect ratio of its camera's images \(1000x500\); "
        rf"got {size[0]}x500\. Crop\?"
    )
    with refused(words):
        rigs.resized(camera, size, "the image", "Crop?")


def test_entries_are_selected_by_image_size():
    entries = {(640, 480): "small", (1280, 720): "large"}
    assert rigs.of_size(entries, CameraChoice(image_size=(1280, 720))) == "large"
    assert rigs.of_size({(640, 480): "only"}, CameraChoice()) == "only"
    name = r"the left image must be of a size in the file \(640x480, 1280x720\); got "
    with refused(f"{name}no image\\."):
        rigs.of_size(dict(reversed(entries.items())), CameraChoice())
    with refused(f"{name}2560x720\\. A side-by-side image contains two images\\."):
        rigs.of_size(entries, CameraChoice(image_size=(2560, 720)))
    with refused(
        r"the left image must be of a size in the file \(640x480\); got 480x640\. A .* two images\."
    ):
        rigs.of_size({(640, 480): "only"}, CameraChoice(image_size=(480, 640)))
    with refused(r"the left image must be of a size in the file \(none\); got no image\."):
        rigs.of_size({}, CameraChoice())


def test_two_cameras_must_differ_and_exist_in_the_file():
    assert rigs.two_cameras(CameraChoice(), (0, 2, 5), (2, 5)) == (2, 5)
    assert rigs.two_cameras(CameraChoice((5, 0)), (0, 2, 5), (2, 5)) == (5, 0)
    for available, chosen, words in (
        (
            [4],
            (0, 1),
            "the file must be a calibration of two cameras; got one camera. Pass the stereo calibration, "
            "which has the pose of one camera relative to the other.",
        ),
        ([4, 0, 2], (2, 2), "cameras must be two different cameras of the file (0, 2, 4); got 2,2."),
        ([4, 0, 2], (2, 3), "cameras must be two different cameras of the file (0, 2, 4); got 2,3."),
        ([4, 0, 2], (3, 2), "cameras must be two different cameras of the file (0, 2, 4); got 3,2."),
        ([], (0, 1), "cameras must be two different cameras of the file (none); got 0,1."),
    ):
        with pytest.raises(InputError) as caught:
            rigs.two_cameras(CameraChoice(chosen), available, (0, 1))
        assert str(caught.value) == words


def test_image_names_match_by_trailing_path_components():
    names = ["a/one/left.png", "b/one/left.png", "a/right", "c\\two\\right.jpg", "../up/third.png"]
    names.append("c/one/left.png")

    def pair(left, right):
        return rigs.names_of_pair(names, CameraChoice(image_names=(left, right)))

    assert pair("/set/b/one/left.png", "two/right.jpg") == (names[1], names[3])
    assert pair("a/one/left.png", "/set/a/right.png") == (names[0], names[2])
    assert pair("../../up/third.png", "C:\\set\\c\\two\\right.jpg") == (names[4], names[3])
    assert pair("third.png", "a\\right.jpeg") == (names[4], names[2])
    for left, right, words in (
        (
            "one/left.png",
            "right",
            r"the image must be one image of the file; got one/left\.png, which may be "
            r"a/one/left\.png and b/one/left\.png\. Include its folder\.",
        ),
        (
            "third.png",
            "none.png",
            r"the image must be one of the 6 in the file \(\.\./up/third\.png, a/one/left"
            r"\.png, a/right, \.\.\.\); got none\.png\. Check its name\.",
        ),
        (
            "up/third.png",
            "third.png",
            r"the images must be two images of the file; got \.\./up/third\.png "
            r"for both\. Check their names\.",
        ),
        ("x/third.png", "third.png", r"the image must be one of .*; got x/third\.png\. Check its name\."),
    ):
        with refused(words):
            pair(left, right)
    with refused(
        r"image_names must be specified for a file of many images, such as \('left\.jpg', 'right\.jpg'\); "
        r"got none\."
    ):
        rigs.names_of_pair(names, CameraChoice())


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        (None, False),
        (Distortion("opencv", np.array([0, 0, 9e-7, 0])), False),
        (Distortion("opencv", np.array([0, 0, -1.1e-6, 0])), True),
        (Distortion("opencv", np.array([1.1e-6, 0, 0, 0, 0])), True),
        (Distortion("opencv", np.array([])), False),
        (Distortion("fisheye", np.zeros(4)), True),
        (Distortion("FOV", np.zeros(1)), True),
    ],
)
def test_distortion_below_the_tolerance_counts_as_none(lens, expected):
    assert rigs.is_distorted(lens) == expected


@pytest.mark.parametrize(
    ("model", "counts"), [("opencv", {4, 5, 8, 12, 14}), ("fisheye", {4}), ("radtan", {4, 5, 8, 12, 14})]
)
def test_coefficient_counts_are_the_ones_opencv_accepts(model, counts):
    for count in range(1, 16):
        camera = RawCamera(K_LEFT, coefficients=[0.25 + 0.5 * n for n in range(count)], model=model)
        if count in counts:
            lens = rigs.lens_of(camera, "it")
            assert lens.model == {"radtan": "opencv"}.get(model, model)
            np.testing.assert_array_equal(lens.coefficients, camera.coefficients)
            if lens.model == "opencv":  # OpenCV accepts this count
                cv2.undistortPoints(np.zeros((1, 1, 2)), K_LEFT, lens.coefficients)
            continue
        kind = "fisheye" if model == "fisheye" else "opencv"
        listed = "4" if kind == "fisheye" else "4, 5, 8, 12, 14"
        with refused(
            rf"the lens distortion of it must be {listed} coefficients in OpenCV's order \({kind}\); "
            rf"got \[0\.25.*\]\. {EDGE}"
        ):
            rigs.lens_of(camera, "it")


def test_zero_coefficients_mean_no_distortion_except_for_a_fisheye():
    assert rigs.lens_of(RawCamera(K_LEFT, coefficients=[0, 0, 0]), "it") is None
    assert rigs.lens_of(RawCamera(K_LEFT), "it") is None
    fisheye = rigs.lens_of(
        RawCamera(K_LEFT, coefficients=[0.1, 0, 0, 0.2, *[0] * 10], model="Equidistant"), "it"
    )
    assert fisheye.model == "fisheye" and fisheye.coefficients.tolist() == [0.1, 0, 0, 0.2]
    straight = rigs.lens_of(RawCamera(K_LEFT, coefficients=[0] * 4, model="KannalaBrandt8"), "it")
    assert straight.coefficients.tolist() == [0] * 4
    with refused(r"the lens model of it must be opencv or fisheye; got omni\. OpenCV lacks .*"):
        rigs.lens_of(RawCamera(K_LEFT, model="omni"), "it")
    with refused(rf"the lens distortion of it must be finite numbers; got 'x'\. {EDGE}"):
        rigs.lens_of(RawCamera(K_LEFT, coefficients="x"), "it")
    with refused(rf"the lens distortion of it must be 4 coefficients in .*fisheye\); got .*\. {EDGE}"):
        rigs.lens_of(RawCamera(K_LEFT, coefficients=[1, 2, 3, 4, 5], model="fisheye"), "it")


@pytest.mark.parametrize("model", rigs.COLMAP_LENSES)
def test_colmap_models_have_as_many_coefficients_as_in_pycolmap(model, monkeypatch):
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 8, 8)
    count = len(camera.extra_params_idxs())
    numbers = (0.1 * np.arange(1, count + 1)).tolist()
    lens = rigs.lens_of(RawCamera(K_LEFT, coefficients=numbers, model=model), "it")
    assert (lens.model, lens.coefficients.tolist()) == (model, numbers)
    with pytest.raises(InputError, match=rf"\Athe lens distortion of it must be .*; got {count + 1}\. Check"):
        rigs.lens_of(RawCamera(K_LEFT, coefficients=[*numbers, 0.1], model=model), "it")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.setattr(rigs, "find_spec", lambda name: None)
    with refused(
        rf"the lens model of it must be opencv or fisheye without pycolmap; got {model}\. Run: pip .*"
    ):
        rigs.lens_of(RawCamera(K_LEFT, coefficients=numbers, model=model), "it")


def test_make_rig_keeps_each_cameras_own_matrix_size_and_lens():
    left = RawCamera(K_LEFT, SIZE_LEFT, LENS_LEFT[:5])
    right = RawCamera(K_RIGHT, [str(side) for side in SIZE_RIGHT], LENS_RIGHT[:5])
    assert_is_the_pair(rigs.make_rig(left, right, E))
    with pytest.raises(TypeError, match="positional"):
        rigs.make_rig(left, right, E, True)
    assert_is_the_pair(rigs.make_rig(left=left, right=right, pose=E))
    for rectified in (True, False):
        assert not rigs.make_rig(left, RawCamera(K_RIGHT), E, rectified=rectified).rectified
        assert not rigs.make_rig(RawCamera(K_LEFT), right, E, rectified=rectified).rectified
        both = rigs.make_rig(RawCamera(K_LEFT), RawCamera(K_RIGHT), 0.173, rectified=rectified)
        assert_is_parallel(both, K_LEFT, K_RIGHT, rectified=rectified)
    assert rigs.make_rig(RawCamera(K_LEFT, (None, None)), right, 1.0).size_left is None
    one = rigs.make_rig(left, RawCamera(K_RIGHT, (1, 1)), 1.0)
    assert one.size_right == (1, 1) and one.right.lens is None


@pytest.mark.parametrize(
    ("left", "right", "pose_", "words"),
    [
        (RawCamera(K_LEFT), RawCamera(K_RIGHT), 0.0, rf"the baseline must be positive; got 0\.0\. {EDGE}"),
        (
            RawCamera(K_LEFT),
            RawCamera(K_RIGHT),
            "x",
            rf"the baseline must be a finite number; got 'x'\. {EDGE}",
        ),
        (
            RawCamera(K_LEFT),
            RawCamera(K_RIGHT),
            [1, 2],
            rf"the pose must be 16 finite numbers; got 2\. {EDGE}",
        ),
        (
            RawCamera([1]),
            RawCamera(K_RIGHT),
            1.0,
            rf"K of the left camera must be 9 finite numbers; got 1\. {EDGE}",
        ),
        (
            RawCamera(K_LEFT),
            RawCamera(-K_RIGHT),
            1.0,
            r"K of the right camera\[0, 0\] and .* must be positive .*",
        ),
        (
            RawCamera(K_LEFT, (0, 5)),
            RawCamera(K_RIGHT),
            1.0,
            r"the width and height of the left camera must be whole numbers of pixels; got \[0, "
            rf"5\]\. {EDGE}",
        ),
        (
            RawCamera(K_LEFT),
            RawCamera(K_RIGHT, (5, 0.5)),
            1.0,
            r"the width and height of the right camera must be whole numbers of pixels; got \[5, "
            rf"0\.5\]\. {EDGE}",
        ),
        (
            RawCamera(K_LEFT),
            RawCamera(K_RIGHT, (6.5, 5)),
            1.0,
            r"the width and height of the right camera .*",
        ),
        (RawCamera(K_LEFT, (5, 6.5)), RawCamera(K_RIGHT), 1.0, r"the width and height of the left camera .*"),
        (
            RawCamera(K_LEFT, (5, None)),
            RawCamera(K_RIGHT),
            1.0,
            rf"the width and height of the left camera must be 2 finite numbers; got \(5, None\)\. {EDGE}",
        ),
        (
            RawCamera(K_LEFT),
            RawCamera(K_RIGHT, model="omni"),
            1.0,
            r"the lens model of the right camera must be .*",
        ),
    ],
)
def test_make_rig_errors_name_the_camera_at_fault(left, right, pose_, words):
    with refused(words):
        rigs.make_rig(left, right, pose_)


def test_rectified_projections_give_camera_centres_and_baseline():
    places = np.array([[0.3, -0.2, 0.1], [0.9, 0.15, -0.25]])
    P_left, P_right = (
        K @ np.column_stack([np.eye(3), -place]) for K, place in zip((K_LEFT, K_RIGHT), places, strict=True)
    )
    rig = rigs.projected(P_left.ravel().tolist(), P_right, SIZE_LEFT, SIZE_RIGHT)
    np.testing.assert_allclose(rig.E[:3, 3], places[1] - places[0], atol=1e-12)
    np.testing.assert_array_equal(rig.E[:3, :3], np.eye(3))
    np.testing.assert_array_equal(rig.K_left, K_LEFT)
    np.testing.assert_array_equal(rig.K_right, K_RIGHT)
    assert (rig.size_left, rig.size_right, rig.rectified) == (SIZE_LEFT, SIZE_RIGHT, True)
    assert rigs.projected(P_left, P_right).size_left is None
    with refused(rf"the right projection must be 12 finite numbers; got 1\. {EDGE}"):
        rigs.projected(P_left, [1])
    with refused(r"K of the left camera\[0, 0\] and .*"):
        rigs.projected(-P_left, P_right)


def test_in_units_converts_every_length_to_metres():
    left, right = RawCamera(K_LEFT, SIZE_LEFT), RawCamera(K_RIGHT, SIZE_RIGHT)
    in_mm = pose((11, -17, 23), (173.0, -41.0, 29.0))
    rectified = rigs.rectified_from(
        rigs.projected(K_LEFT @ np.eye(3, 4), K_RIGHT @ np.eye(3, 4)), left, right, (np.eye(3), np.eye(3))
    )
    rig = rigs.make_rig(left, right, in_mm)
    assert_is_the_pair(rigs.in_units(rig, 1000.0), lens=None)
    np.testing.assert_array_equal(rig.E, in_mm)  # the input is not modified
    taken = rigs.in_units(rigs.replace(rectified, E=in_mm, as_taken=rig), 1000.0).as_taken
    assert_is_the_pair(taken, lens=None)


def test_rectifying_rotations_lead_back_to_the_original_cameras():
    """As in ``stereoRectify``, R maps directions of an original camera to the rectified camera."""
    R_left, R_right, *_ = cv2.stereoRectify(
        K_LEFT,
        np.zeros(5),
        K_RIGHT,
        np.zeros(5),
        SIZE_LEFT,
        np.linalg.inv(E)[:3, :3],
        np.linalg.inv(E)[:3, 3:],
        flags=0,
    )
    rectified = rigs.make_rig(
        RawCamera(K_LEFT), RawCamera(K_LEFT), float(np.linalg.norm(E[:3, 3])), rectified=True
    )
    cameras = RawCamera(K_LEFT, SIZE_LEFT, LENS_LEFT[:5]), RawCamera(K_RIGHT, SIZE_RIGHT, LENS_RIGHT[:5])
    rig = rigs.rectified_from(rectified, *cameras, (R_left.ravel().tolist(), R_right))
    assert_is_the_pair(rig.as_taken)
    np.testing.assert_array_equal(rig.E, rectified.E)
    with refused(rf"the rotation of the rectifying rotation must be 9 finite numbers; got 2\. {EDGE}"):
        rigs.rectified_from(rectified, *cameras, (R_left, [1, 2]))


def test_data_sheet_parameters_make_a_parallel_rig():
    K_right = K_LEFT + [[0, 0, 31], [0, 0, 0], [0, 0, 0]]
    numbers = (811.5, 793.25, 402.25, 305.5, 0.173)
    rig = rigs.rig_from_parameters(*numbers, cx_right=433.25, size=SIZE_LEFT)
    assert_is_parallel(rig, K_LEFT, K_right, sizes=(SIZE_LEFT, SIZE_LEFT), rectified=False)
    assert_is_parallel(rigs.rig_from_parameters(*numbers), rectified=False)
    assert rigs.rig_from_parameters(*numbers, cx_right=0.0).K_right[0, 2] == 0
    by_name = dict(zip(("fx", "fy", "cx", "cy", "baseline_m"), numbers, strict=True))
    assert_is_parallel(rigs.rig_from_parameters(**by_name), rectified=False)
    with pytest.raises(TypeError, match="positional"):
        rigs.rig_from_parameters(*numbers, 433.25)
    for at, words in (
        (0, r"fx must be a finite number of pixels above 0; got -1\."),
        (1, r"fy must be a finite number of pixels above 0; got -1\."),
        (4, rf"baseline must be a finite number of metres above 0; got -1\. {re.escape(NEGATIVE_BASELINE)}"),
    ):
        with refused(words):
            rigs.rig_from_parameters(*numbers[:at], -1, *numbers[at + 1 :])


@pytest.mark.parametrize(
    ("first", "second", "shared"),
    [
        ("a/b/c.png", "c.png", 1),
        ("a/b/c.png", "b/c.png", 2),
        ("x/b/c.png", "b/c.png", 2),
        ("b/c.png", "x/b/c.png", 2),
        ("a/b/c.png", "x/b/c.png", 0),
        ("a/b/c", "b/c.jpg", 2),
        ("b/c.jpg", "a/b/c", 0),
        ("a\\b\\c.png", "a/b/c.png", 3),
        ("../c.png", "a/../c.png", 1),
        ("c.png", "d.png", 0),
        ("", "c.png", 0),
        ("c.png", "", 0),
    ],
)
def test_common_path_components_are_counted_from_the_end(first, second, shared):
    assert rigs._parts_in_common(first, second) == shared


def test_defaults_of_the_dataclasses():
    assert CameraChoice() == CameraChoice(None, None, None, None, None)
    camera = RawCamera(K_LEFT)
    assert (camera.size, tuple(camera.coefficients), camera.model) == (None, (), "opencv")
    entry = rigs.CalibrationFormat("s", "m", lambda texts, choice: None)
    assert (entry.file_counts, entry.uses_cameras, entry.by_image, entry.as_stored, entry.companions) == (
        *((1,), False, False, False, None),
    )
