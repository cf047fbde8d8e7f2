"""Cameras: what resizing, cropping and projecting do, as laws that hold for any camera."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geodiff_plugin.cameras import (
    BEHIND_CAMERA_PX,
    Camera,
    Distortion,
    PosedCamera,
    PosedViews,
    View,
    is_rectified,
    keep_nearest,
    pixels_of_rays,
    rays_of_pixels,
    resized_px,
    scaled_size,
    size_within,
)
from tests.unit.lens_models import LENSES, SIZE, K, lens_of, matrix_of, taken_pixels

#: With pixels that are not square, and a skew.
SKEWED = np.array([[31.0, 7.0, 14.2], [0.0, 28.0, 12.7], [0.0, 0.0, 1.0]])
sizes = st.tuples(st.integers(1, 4000), st.integers(1, 3000))


@st.composite
def cameras(draw) -> Camera:
    """With a skew, pixels that are not square and a principal point anywhere near the image."""
    width, height = size = draw(sizes)
    fx, fy = (draw(st.floats(0.3, 5.0)) * max(size) for _ in range(2))
    cx, cy = (draw(st.floats(-0.5, 1.5)) * side for side in size)
    skew = draw(st.floats(-0.05, 0.05)) * fx
    return Camera(np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), size)


def some_px(camera: Camera) -> np.ndarray:
    """``(3, 4, 2)`` pixels in and near the image."""
    at = np.random.default_rng(0).uniform(-0.2, 1.2, (3, 4, 2))
    return at * np.array(camera.size)


def assert_same(one: Camera, other: Camera) -> None:
    np.testing.assert_allclose(one.K, other.K, rtol=1e-9, atol=1e-9 * one.K.max())
    assert one.size == other.size


@given(cameras(), st.floats(1e-3, 1e6))
def test_projecting_a_ray_gives_its_pixel(camera, depth):
    px = some_px(camera)
    points = camera.rays(px) * depth
    found, z = camera.project(points)
    np.testing.assert_allclose(found, px, atol=1e-9 * camera.K.max())
    np.testing.assert_allclose(z, depth)
    seen = points @ camera.K.T  # the definition of K
    np.testing.assert_allclose(found, seen[..., :2] / seen[..., 2:], atol=1e-9 * camera.K.max())


@given(cameras(), sizes, sizes)
def test_resizing_twice_is_resizing_once_and_back_is_the_camera(camera, size, other):
    assert_same(camera.resized(size).resized(other), camera.resized(other))
    assert_same(camera.resized(size).resized(camera.size), camera)


@given(cameras(), sizes)
def test_a_resized_camera_sees_a_ray_at_the_same_place_of_the_image(camera, size):
    """Positions are fractions of the image between its outer edges, half a pixel beyond the centres."""
    px = some_px(camera)
    found, _ = camera.resized(size).project(camera.rays(px))
    places = (px + 0.5) / camera.size
    np.testing.assert_allclose((found + 0.5) / size, places, atol=1e-8 * camera.K.max() / min(camera.size))


@given(cameras(), *(st.integers(0, 50) for _ in range(4)))
def test_cropping_what_was_padded_is_the_camera(camera, left, top, right, bottom):
    width, height = camera.size
    padded = camera.cropped((-left, -top, width + right, height + bottom))
    assert padded.size == (left + width + right, top + height + bottom)
    assert_same(padded.cropped((left, top, left + width, top + height)), camera)


@given(cameras(), st.integers(-9, 9), st.integers(-9, 9))
def test_a_cropped_camera_sees_a_ray_in_the_same_pixel(camera, left, top):
    px = some_px(camera)
    found, _ = camera.cropped((left, top, 30, 20)).project(camera.rays(px))
    np.testing.assert_allclose(found, px - (left, top), atol=1e-9 * camera.K.max())


@given(cameras(), st.floats(1e-3, 1e6))
def test_the_points_of_a_depth_map_project_to_their_pixels(camera, depth):
    shape = min(camera.size[1], 5), min(camera.size[0], 7)
    found, z = camera.project(camera.unproject(np.full(shape, depth)))
    np.testing.assert_allclose(found, np.moveaxis(np.indices(shape)[::-1], 0, -1), atol=1e-9 * camera.K.max())
    np.testing.assert_allclose(z, depth)


@given(st.integers(0, 99))
def test_a_world_is_left_and_entered_by_one_pose(seed):
    rng, E = np.random.default_rng(seed), np.eye(4)
    E[:3, :3], E[:3, 3] = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    camera, points = PosedCamera(K, SIZE, E=E), rng.normal(size=(3, 4, 3))
    np.testing.assert_allclose(camera.from_world(camera.to_world(points)), points, atol=1e-12)
    np.testing.assert_allclose(camera.to_world(np.zeros(3)), E[:3, 3])
    np.testing.assert_allclose(camera.to_world(np.array([0.0, 0.0, 1.0])) - E[:3, 3], E[:3, 2], atol=1e-12)


@given(st.permutations([(0, 3.0), (1, 2.0), (1, 5.0), (3, 1.5), (3, 1.0)]), st.integers(0, 5))
def test_the_nearest_point_of_a_cell_counts_in_any_order_and_in_parts(points, part):
    buffer, (cells, z) = torch.full((4,), torch.inf), map(torch.tensor, zip(*points, strict=True))
    for of in (slice(part), slice(part, None)):
        keep_nearest(buffer, cells[of], z[of])
    assert buffer.tolist() == [3.0, 2.0, torch.inf, 1.0]


def test_an_integer_is_a_pixel_centre_and_edges_are_half_a_pixel_beyond():
    camera = Camera(np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]]), (640, 480))
    half = camera.resized((320, 240))
    assert half.K.tolist() == [[250.0, 0, 159.5], [0, 250.0, 119.5], [0, 0, 1]] and half.size == (320, 240)
    inside = [(0, 0), (639, 479), (-0.49, 479.49)]
    outside = [(-0.51, 3), (3, -0.51), (639.51, 3), (3, 479.51)]
    assert camera.contains(np.array(inside)).all() and not camera.contains(np.array(outside)).any()


def test_arithmetic_is_in_the_dtype_of_K():
    single = Camera(K.astype(np.float32), SIZE)
    assert single.resized((45, 31)).K.dtype == single.cropped((3, 4, 9, 9)).K.dtype == np.float32
    assert single.rays(np.zeros((2, 2), np.float32)).dtype == np.float32
    assert Camera(K, SIZE).resized((45, 31)).K.dtype == np.float64


def test_points_at_or_behind_the_camera_are_outside_of_any_image():
    points = np.array([[0.1, 0.2, 0.0], [0.0, 0.0, -1.0], [0.1, 0.1, 1e-9], [0.0, 0.0, 2.0]])
    px, z = Camera(K).project(points)
    assert (px[:3] == BEHIND_CAMERA_PX).all() and px[3].tolist() == K[:2, 2].tolist()
    assert z.tolist() == points[:, 2].tolist()


def test_tensors_of_a_batch_are_projected_as_arrays_are():
    """With one camera for each image, and gradients."""
    skewed = np.array([[60.0, 2.0, 30.0], [0.0, 55.0, 21.0], [0.0, 0.0, 1.0]])
    px = some_px(Camera(K, SIZE))
    Ks = torch.from_numpy(np.stack([K, skewed]))[:, None, None]
    u, v = (torch.from_numpy(px[None, ..., axis]).requires_grad_() for axis in (0, 1))
    x, y = rays_of_pixels(Ks, u, v)
    back = torch.stack(pixels_of_rays(Ks, x, y), -1)
    for b, matrix in enumerate((K, skewed)):
        of_arrays = Camera(matrix).rays(px)[..., :2]
        np.testing.assert_array_equal(torch.stack([x[b], y[b]], -1).detach(), of_arrays)
        np.testing.assert_allclose(back[b].detach(), px, atol=1e-9)
    (by_u,) = torch.autograd.grad(x.sum(), u)
    np.testing.assert_allclose(by_u, np.full(u.shape, 1 / K[0, 0] + 1 / 60.0))


def test_sizes_are_scaled_by_axis_and_bounded_by_one_factor():
    assert scaled_size((100, 30), 0.25, 2.5) == (25, 75)
    assert scaled_size((100, 30), 0.001, 0.01) == (1, 1)
    assert size_within((300, 400), 120_000) == (300, 400) == size_within((300, 400), 10**9)
    assert size_within((300, 400), 30_000) == (150, 200)
    assert size_within((640, 480), 640 * 480 // 4 + 1) == (320, 240)


def test_pixels_go_where_a_resized_image_has_them():
    px = np.array([[-0.5, -0.5], [639.5, 479.5], [0.0, 0.0]])
    found = resized_px(px, (640, 480), (320, 120))
    assert found.tolist() == [[-0.5, -0.5], [319.5, 119.5], [-0.25, -0.375]]


def test_a_view_in_float32_has_the_size_of_its_image():
    view = View.single(torch.rand(3, 24, 32), Camera(SKEWED), np.eye(4))
    assert view.size == (24, 32) and view.camera.size == (32, 24)
    assert view.camera.K.dtype == view.T_right_from_left.dtype == np.float32
    assert PosedViews(view, ()).size == (24, 32)


def test_a_resized_image_does_not_alias_and_keeps_its_camera():
    stripes = torch.zeros(2, 24, 32)
    stripes[0, :, ::2] = 1.0
    stripes[1] = torch.arange(32.0)
    view = View.single(stripes, Camera(SKEWED), np.eye(4))
    small = view.resized((12, 8))
    assert small.size == (12, 8)
    np.testing.assert_allclose(small.image_01[0, :, 1:-1], 0.5, atol=0.03)
    np.testing.assert_allclose(small.image_01[1, 5, 1:-1], (np.arange(1, 7) + 0.5) * 4 - 0.5, atol=1e-4)
    assert_same(small.camera, view.camera.resized((8, 12)))
    assert small.T_right_from_left is view.T_right_from_left
    assert view.resized((24, 32)) is view


@pytest.mark.parametrize(
    ("focal", "size"),
    [
        ((31.0, 28.0), (24, 32)),
        ((20.0, 28.0), (24, 32)),
        ((62.0, 28.0), (24, 16)),
        ((31.0, 84.0), (8, 32)),
        ((124.0, 14.0), (24, 8)),
    ],
)
def test_a_finer_image_is_shrunk_along_each_axis_to_the_pixels_per_radian_of_the_left_one(focal, size):
    K_right = np.diag([*focal, 1.0])
    K_right[:2, 2] = 13.0, 11.0
    view = View.single(torch.rand(3, 24, 32), Camera(K_right), np.eye(4))
    found = view.as_fine_as(Camera(SKEWED))
    assert found.size == size
    assert_same(found.camera, view.camera.resized(size[::-1]))
    assert found.camera.K[0, 0] <= 31.0 + 1e-5 and found.camera.K[1, 1] <= 28.0 + 1e-5


def single_changes() -> list:
    """A K or a T, the entry that changes and to what or by how much, and whether a pair stays rectified."""
    cases = []
    for sign in (1, -1):
        off = [(i, j) for i in range(3) for j in range(3) if i != j]
        cases += [("T", at, sign * size, ok) for at in off for size, ok in ((0.9e-3, True), (1.1e-3, False))]
        cases += [
            ("T", (i, 3), sign * size, ok) for i in (1, 2) for size, ok in ((0.0009, True), (0.0011, False))
        ]
        for at in ((0, 0), (0, 1), (1, 1), (1, 2)):
            cases += [("K", at, sign * 0.026, True), ("K", at, sign * 0.030, False)]
        cases += [("K", (0, 2), sign * 5.0, True)]
    return cases


@pytest.mark.parametrize(("which", "at", "change", "expected"), single_changes())
def test_a_pair_is_rectified_within_its_tolerances(which, at, change, expected):
    K_right, T = SKEWED.copy(), np.eye(4)
    T[0, 3] = -0.1
    (T if which == "T" else K_right)[at] += change
    assert is_rectified(Camera(SKEWED), Camera(K_right), T) is expected


@pytest.mark.parametrize(
    ("shift", "expected"),
    [((0.3, 0.0), True), ((-1e-3, 4e-6), True), ((-0.1, 0.0), True), ((0.0, 0.0), False)],
)
def test_a_rectified_pair_has_a_baseline_to_either_side(shift, expected):
    T = np.eye(4)
    T[:2, 3] = shift
    assert is_rectified(Camera(SKEWED), Camera(SKEWED), T) is expected


@pytest.mark.parametrize("model", LENSES)
def test_distortion_is_undone(model):
    camera = Camera(matrix_of(model), SIZE, lens_of(model))
    flat = np.random.default_rng(0).uniform(-0.45, 0.45, (3, 10, 2))
    rays = np.concatenate([flat, np.ones((3, 10, 1))], -1)
    taken, _ = camera.project(2.5 * rays)
    np.testing.assert_allclose(taken.reshape(-1, 2), taken_pixels(flat.reshape(-1, 2), model), atol=1e-6)
    np.testing.assert_allclose(camera.rays(taken), rays, atol=3e-4)
    np.testing.assert_allclose(camera.resized((45, 32)).rays((taken + 0.5) / 2 - 0.5), rays, atol=3e-4)
    cropped = camera.cropped((5, -7, 50, 60))
    np.testing.assert_allclose(cropped.rays(taken - (5, -7)), rays, atol=3e-4)


@pytest.mark.parametrize("model", LENSES)
def test_undistorted_pixels_match_their_rays(model):
    rays = np.random.default_rng(0).uniform(-0.45, 0.45, (30, 2))
    matrix = matrix_of(model)
    straight = rays * matrix.diagonal()[:2] + matrix[:2, 2]
    taken = taken_pixels(rays, model)
    assert np.abs(taken - straight).max() > 0.5
    found = Camera(matrix, lens=lens_of(model)).undistorted_px(taken)
    np.testing.assert_allclose(found, straight, atol=0.02)
    assert Camera(matrix, lens=lens_of(model)).undistorted_px(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_pixels_without_a_ray_become_nan(model):
    """Strong barrel distortion folds back, so that no ray exists beyond its rim."""
    coefficients = [-0.6, 0, 0, 0] if model == "opencv" else [-0.9, 0, 0, 0]
    lens = Distortion(model, np.array(coefficients))
    pixels = np.array([[42.0, 37.0], [400.0, 300.0], [41, 36], [-500, 36]])
    found = Camera(K, lens=lens).undistorted_px(pixels)
    assert np.isnan(found).all(1).tolist() == [False, True, False, True]
    np.testing.assert_allclose(found[[0, 2]], pixels[[0, 2]], atol=0.1)


@pytest.mark.parametrize("model", LENSES)
def test_a_lens_displaces_the_same_part_of_an_image_after_one_side_is_halved(model):
    camera = Camera(matrix_of(model), SIZE, lens_of(model))
    halved = (SIZE[0], SIZE[1] // 2)
    pixels = np.array([[10.0, 12.0], [41.0, 30.0], [60.0, 50.0]])
    resized = resized_px(pixels, SIZE, halved)
    rays = camera.rays(pixels)
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(camera.resized(halved).rays(resized), rays, atol=1e-6)
    np.testing.assert_allclose(camera.resized(halved).project(rays)[0], resized, atol=1e-4)


def test_pixels_just_beyond_the_rim_of_a_lens_become_nan():
    """``r (1 - 0.6 r^2)`` is largest at ``r = sqrt(1 / 1.8)``."""
    lens, r = Distortion("opencv", np.array([-0.6, 0, 0, 0])), np.sqrt(1 / 1.8)
    rim = K[0, 2] + K[0, 0] * r * (1 - 0.6 * r**2)
    pixels = np.column_stack([rim + np.array([-0.3, -0.05, 0.05, 0.3]), np.full(4, K[1, 2])])
    found = Camera(K, lens=lens).undistorted_px(pixels)
    assert np.isnan(found).any(1).tolist() == [False, False, True, True]
