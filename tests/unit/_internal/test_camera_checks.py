"""Checks of cameras: what passes, what is doubtful and warned of, and what is rejected."""

import warnings

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal import camera_checks as c
from geodiff_plugin._internal.checks import InputError, captured_warnings

WIDTH, HEIGHT = 640, 400


def camera(fx=520.0, fy=500.0, cx=300.0, cy=210.0) -> np.ndarray:
    return np.array([[fx, 1.5, cx], [0, fy, cy], [0, 0, 1.0]])


def messages(check, *arguments) -> list:
    """What a check warns of."""
    with warnings.catch_warnings(), captured_warnings() as said:
        warnings.simplefilter("ignore")
        check(*arguments)
    return said


@pytest.mark.parametrize(
    "form",
    [
        np.asarray,
        np.float32,
        torch.tensor,
        lambda K: torch.tensor(K).bfloat16().requires_grad_(),
        np.ndarray.tolist,
    ],
)
def test_a_camera_matrix_of_any_form_is_copied_to_float64(form):
    K = camera()
    given = form(K)
    found = c.check_intrinsics(given)
    assert found.dtype == np.float64 and found.shape == (3, 3)
    np.testing.assert_allclose(found, K, rtol=0.01)
    found[0, 0] = -1
    np.testing.assert_allclose(c.check_intrinsics(given), K, rtol=0.01)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (
            (0, 0),
            0.0,
            r"K\[0, 0\] and K\[1, 1\] \(fx, fy\) must be positive focal lengths in pixels; got 0 and 500",
        ),
        ((1, 1), -2.0, "got 520 and -2"),
        ((1, 0), 2e-6, "upper triangular with last row"),
        ((1, 0), -2e-6, "upper triangular with last row"),
        ((2, 0), 2e-6, "upper triangular with last row"),
        ((2, 1), -2e-6, "upper triangular with last row"),
        ((2, 2), 1.1, "upper triangular with last row"),
        ((0, 2), np.nan, "K must be finite; got NaN or infinity. Check the calibration file"),
        ((1, 2), np.inf, "K must be finite"),
    ],
)
def test_a_non_camera_matrix_is_rejected(place, value, words):
    K = camera()
    K[place] = value
    with pytest.raises(InputError, match=words):
        c.check_intrinsics(K)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (np.eye(4), r"K must be a 3x3 matrix; got shape \(4, 4\)"),
        (5.0, "K must be a 3x3 matrix; got 5.0"),
        ("fx", "K must be a 3x3 matrix of numbers; got the string 'fx'"),
        ([[1, 2], [3]], "K must be a 3x3 matrix of numbers; got list"),
        (None, "K must be"),
    ],
)
def test_what_is_no_matrix_is_named(given, words):
    with pytest.raises(InputError, match=words):
        c.check_intrinsics(given)


def test_a_matrix_within_rounding_of_its_form_passes_and_focal_lengths_may_be_small():
    K = camera(fx=1e-3, fy=1e-3)
    K[1, 0], K[2, 0] = 0.9e-6, -0.9e-6
    np.testing.assert_array_equal(c.check_intrinsics(K), K)


@pytest.mark.parametrize(
    ("cx", "cy", "fits"),
    [
        (0, 200, True),
        (-0.1, 200, False),
        (WIDTH, HEIGHT, True),
        (WIDTH + 0.1, 200, False),
        (300, 0, True),
        (300, -0.1, False),
        (300, HEIGHT + 0.1, False),
        (HEIGHT + 100, 200, True),
    ],
)
def test_a_principal_point_lies_in_the_image(cx, cy, fits):
    """The image is not square, so that its sides cannot be swapped."""
    arguments = camera(cx=cx, cy=cy), WIDTH, HEIGHT, "K", "the left image"
    if fits:
        c.check_intrinsics_fit(*arguments)
        return
    place = rf"K has its principal point at \({cx:.1f}, {cy:.1f}\), outside the left image \(640x400 pixels\)"
    with pytest.raises(InputError, match=place):
        c.check_intrinsics_fit(*arguments)
    with pytest.raises(InputError, match=place):
        c.check_size_of(arguments[0], (HEIGHT, WIDTH), "K", "the left image")


def test_an_image_has_the_size_of_its_calibration():
    c.check_calibrated_size((640, 400), None, "left", "calib.json", "Resize it.")
    c.check_calibrated_size((640, 400), [640, 400], "left", "calib.json", "Resize it.")
    words = r"left must be 800x600 pixels, as in calib.json; got 640x400. Resize it."
    with pytest.raises(InputError, match=words):
        c.check_calibrated_size((640, 400), (800, 600), "left", "calib.json", "Resize it.")


@pytest.mark.parametrize(
    ("K", "words"),
    [
        (camera(), None),
        (camera(cx=0.21 * WIDTH), None),
        (
            camera(cx=0.19 * WIDTH),
            r"K has its principal point at \(121.6, 210.0\), near the border of it \(640x400 pixels\)",
        ),
        (camera(cx=0.79 * WIDTH), None),
        (camera(cx=0.81 * WIDTH), "near the border"),
        (camera(cy=0.21 * HEIGHT), None),
        (camera(cy=0.19 * HEIGHT), "near the border"),
        (camera(cy=0.79 * HEIGHT), None),
        (camera(cy=0.81 * HEIGHT), "near the border"),
        # Off the middle by nearly the same fraction of both sides: a camera of another size.
        (
            camera(cx=0.37 * WIDTH, cy=0.37 * HEIGHT),
            "where it would be in an image 0.74 times the size of it",
        ),
        (camera(cx=0.64 * WIDTH, cy=0.7 * HEIGHT), "where it would be in an image 1.3 times the size"),
        (camera(cx=0.39 * WIDTH, cy=0.37 * HEIGHT), None),
        (camera(cx=0.37 * WIDTH, cy=0.39 * HEIGHT), None),
        (camera(cx=0.28 * WIDTH, cy=0.37 * HEIGHT), None),
        (camera(cx=0.37 * WIDTH, cy=0.64 * HEIGHT), None),
        (camera(fx=1040, fy=521), None),
        (camera(fx=1040, fy=519), "K has fx 1040 and fy 519, but pixels are usually square"),
        (camera(fx=250, fy=499), None),
        (camera(fx=250, fy=501), "K has fx 250 and fy 501"),
        (camera(fx=0.135 * WIDTH, fy=100), None),
    ],
)
def test_a_camera_that_may_be_of_another_image_is_warned_of(K, words):
    said = messages(c.check_size_of, K, (HEIGHT, WIDTH), "K", "it")
    assert len(said) == (words is not None)
    if words:
        with pytest.warns(UserWarning, match=words):
            c.check_size_of(K, (HEIGHT, WIDTH), "K", "it")
        kind = "camera.aspect-ratio" if "fx" in words else "camera.principal-point"
        assert said[0].code == kind


def test_a_normalised_camera_is_rejected_by_its_width():
    words = r"K must be in pixels of the image \(640x400\); got fx = 85. If fx is in millimetres, multiply it"
    with pytest.raises(InputError, match=words):
        c.check_size_of(camera(fx=85.0, fy=85.0), (HEIGHT, WIDTH), "K", "the image")
    assert not messages(c.check_size_of, camera(fx=86.0, fy=86.0), (HEIGHT, WIDTH), "K", "the image")


def pose() -> np.ndarray:
    E = np.eye(4)
    E[:3, :3] = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
    E[:3, 3] = 0.3, -0.2, 1.5
    return E


@pytest.mark.parametrize("rows", [3, 4])
def test_a_pose_with_rounding_errors_becomes_the_nearest_rigid_one(rows):
    """The nearest rotation in the Frobenius norm, which SciPy finds as well; the translation stays."""
    given = pose()[:rows]
    given[:3, :3] += np.random.default_rng(0).normal(0, 1e-3, (3, 3))
    found = c.check_pose(given)
    assert found.shape == (4, 4) and found[3].tolist() == [0, 0, 0, 1]
    np.testing.assert_array_equal(found[:3, 3], given[:3, 3])
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)
    off = np.linalg.norm(found[:3, :3] - given[:3, :3])
    for axis in np.eye(3):
        for angle in (-1e-4, 1e-4):
            other = found[:3, :3] @ Rotation.from_rotvec(angle * axis).as_matrix()
            assert np.linalg.norm(other - given[:3, :3]) > off


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda E: E.T, r"rigid with last row \(0, 0, 0, 1\); got last row .*Is it transposed\?"),
        (
            lambda E: E * [[-1.0], [1], [1], [1]],
            "rigid, with a rotation as upper left 3x3 .*got determinant -1.0000",
        ),
        (lambda E: E * [[1.006], [1], [1], [1]], r"got determinant 1.0060, \|R R\^T - I\| up to 0.0120"),
        (lambda E: E * [[0.994], [1], [1], [1]], "got determinant 0.9940"),
        (lambda E: E[:3, :3], r"E must be a 4x4 matrix; got shape \(3, 3\)"),
        (lambda E: E + np.diag([0, 0, 0, 2e-6]) + 0 * E, None),
        (lambda E: E + np.diag([0, 0, 0, 2e-5]) + 0 * E, "last row"),
        (lambda E: np.full((4, 4), np.nan), "E must be finite"),
    ],
)
def test_a_non_pose_is_rejected(change, words):
    if words is None:
        np.testing.assert_allclose(c.check_pose(change(pose())), pose(), atol=1e-5)
        return
    with pytest.raises(InputError, match=words):
        c.check_pose(change(pose()))


def test_a_rotation_scaled_by_less_than_half_a_percent_is_made_one():
    given = pose()
    given[:3, :3] *= 1.004
    np.testing.assert_allclose(c.check_pose(given), pose(), atol=1e-9)


@pytest.mark.parametrize(
    ("at", "unit", "outcome"),
    [
        ((0.0, 0.0, 0.0), "m", "refused"),
        ((0.9e-6, 0.0, 0.0), None, "refused"),
        ((0.0, 0.0, 1.1e-6), "m", ""),
        ((-12.0, 0.0, 15.9), "m", ""),
        ((-12.0, 0.0, 16.1), "m", "warned"),
        ((0.0, 20.5, 0.0), None, ""),
    ],
)
def test_a_baseline_is_there_and_of_metres(at, unit, outcome):
    E = pose()
    E[:3, 3] = at
    if outcome == "refused":
        with pytest.raises(
            InputError,
            match="E must be a pose with a baseline .a camera centre that differs from the left camera's",
        ):
            c.check_baseline(E, "E", unit)
        return
    said = messages(c.check_baseline, E, "E", unit)
    assert [message.code for message in said] == ["baseline.long"] * (outcome == "warned")
    assert not said or "an implausible baseline of 20.08 m" in said[0]


def test_metres_are_floats():
    c.check_metres(np.ones((4, 5), np.float16), "depth")
    with pytest.raises(
        InputError, match="depth must be metres as floats; got dtype uint16. Divide integers by"
    ):
        c.check_metres(np.ones((4, 5), np.uint16), "depth")
    with pytest.raises(
        InputError, match="points must be metres as floats; got a file of counts. Divide millimetres by 1000"
    ):
        c.check_metres(np.ones((4, 3), np.int32), "points", "a file of counts")


@pytest.mark.parametrize("form", ["depths", "map", "points", "points with intensity", "map with confidence"])
def test_depths_that_may_be_millimetres_are_warned_of_in_every_form(form):
    def points(z) -> np.ndarray:
        z = np.array([*z, np.nan, 0.0, -5.0, np.inf])
        other = np.full_like(z, 0.5)
        columns = {"points": [other, other, z], "points with intensity": [other, other, z, other * 400]}
        if form in columns:
            return np.stack(columns[form], -1)
        if form == "map with confidence":
            return np.stack([z, other], -1).reshape(2, -1, 2)
        return z.reshape(-1, 2) if form == "map" else z[:, None]

    whole = [101.0, 99.0, 250.0, 300.0]
    near = [99.5, 250.5, 300.0, 101.0]
    far = [100.5, 250.5, 300.0, 101.0]
    for depths, words in (
        (whole, "of at least 99 m, all of them integers."),
        (far, "of at least 100.5 m."),
        (near, None),
    ):
        said = messages(c.warn_of_far_points, points(depths), "points")
        assert len(said) == (words is not None) and (
            not said or (words in said[0] and said[0].code == "points.far")
        )
    for depths in ([50.0, 60.0, 70.0, 800.0], [2.0, 3.5, 4.0, 1.0], []):
        few = points(depths) if len(depths) else points([np.nan] * 4)
        assert not messages(c.warn_of_far_points, few, "points")
