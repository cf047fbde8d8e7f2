"""Depth and sigma in another camera, against rays that are cast at the same walls."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import InputError, MetricDepthOutput
from geodiff_plugin._internal import strips as _strips
from geodiff_plugin._internal.reprojection import _above_surface, _samples_per_side, maps_in_camera
from geodiff_plugin.cameras import Camera, PosedCamera

K = np.array([[120.0, 0.5, 79.0], [0, 125.0, 58.0], [0, 0, 1]])
SIZE = (160, 120)
#: Walls as ``normal . X = 1``: one far and slanted, a screen before it that is 1 m wide.
FAR, SCREEN = np.array([0.02, -0.05, 0.25]), np.array([0.0, 0.0, 0.5])


def pose(*turn_deg: float, at: tuple[float, ...] = (0.0, 0.0, 0.0)) -> np.ndarray:
    E = np.eye(4)
    E[:3, :3] = Rotation.from_euler("xyz", turn_deg or (0, 0, 0), degrees=True).as_matrix()
    E[:3, 3] = at
    return E


def target(K: np.ndarray, E: np.ndarray, size: tuple[int, int]) -> PosedCamera:
    return PosedCamera(K, size, E=E)


def depth_in_camera(depth: np.ndarray, camera: Camera, other: PosedCamera) -> np.ndarray:
    seen, sigma = maps_in_camera(depth, None, camera, other)
    assert sigma is None
    return seen


def cast(K: np.ndarray, E: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a camera that looks at both walls, and the points that it sees, in the left camera's frame."""
    v, u = np.mgrid[: size[1], : size[0]]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ E[:3, :3].T
    depth = np.full(u.shape, np.inf)
    for wall in (FAR, SCREEN):
        z = (1 - wall @ E[:3, 3]) / (rays @ wall)
        points = E[:3, 3] + rays * z[..., None]
        on = (z > 0) & ((wall is FAR) | (np.abs(points[..., 0]) < 0.5))
        depth = np.where(on & (z < depth), z, depth)
    return depth, E[:3, 3] + rays * depth[..., None]


def hidden(points: np.ndarray) -> np.ndarray:
    """Which points of the far wall the screen hides from the left camera, and which it does by a margin."""
    at_screen = points * (2.0 / points[..., 2:])
    return (points[..., 2] > 2.0 + 1e-6) & (np.abs(at_screen[..., 0]) < 0.5)


CAMERAS = [
    (K, pose(), SIZE),
    (K, pose(at=(0.1, 0.0, 0.0)), SIZE),
    (np.diag([2.5, 2.5, 1]) @ K, pose(2, -3, 4, at=(0.15, -0.05, 0.1)), (400, 300)),
    (np.diag([0.4, 0.4, 1]) @ K, pose(-1, 2, -8, at=(-0.2, 0.05, -0.3)), (64, 48)),
    (np.array([[90.0, 0, 24.0], [0, 90.0, 69.0], [0, 0, 1]]), pose(at=(0.1, 0.05, 0.0)), (50, 140)),
]


@pytest.mark.parametrize(
    ("K_to", "E", "size"), CAMERAS, ids=["same", "translated", "finer", "coarser", "portrait"]
)
def test_another_camera_sees_what_rays_hit(K_to, E, size):
    depth = cast(K, np.eye(4), SIZE)[0].astype(np.float32)
    found = depth_in_camera(depth, Camera(K), target(K_to, E, size))
    ground_truth, points = cast(K_to, E, size)
    assert found.shape == size[::-1] and found.dtype == np.float32
    pixels = points / points[..., 2:] @ K.T
    seen = ((pixels[..., :2] > 1) & (pixels[..., :2] < np.array(SIZE) - 2)).all(-1)
    at_screen = np.abs(np.abs((points * (2.0 / points[..., 2:]))[..., 0]) - 0.5) * K[0, 0] / 2.0
    clear = at_screen > 2.0  # pixels of the left image from the edge of the screen
    around = np.ones((5, 5), np.uint8)  # no edge of the screen near it in the other image
    alone = cv2.dilate(ground_truth, around) < 1.3 * cv2.erode(ground_truth, around)
    there = seen & clear & alone & ~hidden(points)
    assert there.mean() > 0.4 and (found[there] > 0).mean() > 0.999
    there &= found > 0
    assert np.median(np.abs(found[there] / ground_truth[there] - 1)) < 1e-5
    assert np.quantile(np.abs(found[there] / ground_truth[there] - 1), 0.999) < 2e-3


def test_what_the_left_camera_does_not_see_has_no_depth():
    depth = cast(K, np.eye(4), SIZE)[0]
    E = pose(at=(0.3, 0.0, 0.0))
    found = depth_in_camera(depth, Camera(K), target(K, E, SIZE))
    ground_truth, points = cast(K, E, SIZE)
    behind = hidden(points) & (np.abs(np.abs((points * (2 / points[..., 2:]))[..., 0]) - 0.5) > 0.05)
    outside = (points / points[..., 2:] @ K.T)[..., 0] > SIZE[0] + 1
    assert behind.sum() > 500 and outside.sum() > 200
    assert (found[behind] == 0).all() and (found[outside] == 0).all()


def test_unknown_depth_stays_unknown_and_makes_no_surface():
    depth = np.full((40, 60), 2.0)
    depth[10:20, 15:30] = [0, np.nan, -1] * 5
    found = depth_in_camera(depth, Camera(K), target(K, np.eye(4), (60, 40)))
    np.testing.assert_allclose(found, np.where(depth > 0, depth, 0), atol=1e-6)
    backwards = target(K, pose(0, 180, 0), (60, 40))
    assert (depth_in_camera(depth, Camera(K), backwards) == 0).all()


def test_an_output_gives_its_depth_reprojected_another_camera():
    depth = cast(K, np.eye(4), SIZE)[0].astype(np.float32)
    K_to, E, size = CAMERAS[2]
    expected = depth_in_camera(depth, Camera(K), target(K_to, E, size))
    arrays = MetricDepthOutput(prediction=np.stack([depth, 2 * depth])[..., None], K=np.stack([K, K]))
    found, sigma = arrays.reproject(K_to, E, size)
    assert found.shape == (2, 300, 400, 1) and sigma is None
    np.testing.assert_array_equal(found[0, ..., 0], expected)
    tensors = MetricDepthOutput(prediction=torch.from_numpy(depth)[None, None], K=torch.from_numpy(K)[None])
    found, sigma = tensors.reproject(torch.from_numpy(K_to), E[:3], list(size))
    assert found.shape == (1, 1, 300, 400) and found.dtype == torch.float32 and sigma is None
    np.testing.assert_array_equal(found[0, 0], expected)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ((np.eye(4), np.eye(4), SIZE), "reproject: K must be a 3x3 matrix"),
        ((K, np.eye(3), SIZE), "reproject: E must be a 4x4 matrix"),
        ((K, 2 * np.eye(4), SIZE), "reproject: E must be rigid"),
        ((K, np.eye(4), (0, 5)), "reproject: size must be between 1"),
        ((K, np.eye(4), None), "reproject: size must be a pair"),
    ],
)
def test_a_camera_that_is_none_gets_a_sentence(camera, words):
    output = MetricDepthOutput(prediction=np.ones((1, 4, 4, 1), np.float32), K=K[None])
    with pytest.raises(InputError, match=words):
        output.reproject(*camera)


#: Two cameras whose pixels are not square, in different directions, and further poses between them.
OBLIQUE = target(
    np.array([[150.0, 1.5, 70.0], [0, 110.0, 66.0], [0, 0, 1]]),
    pose(6, -9, 15, at=(0.25, -0.1, 0.2)),
    (150, 130),
)


@pytest.mark.parametrize("unit", [0.05, 1000.0])
def test_depth_in_another_unit_is_the_same_depth(unit):
    """Also of scenes that are nearer than 1."""
    depth, E = cast(K, np.eye(4), SIZE)[0], OBLIQUE.E.copy()
    E[:3, 3] *= unit
    found = depth_in_camera(depth * unit, Camera(K), replace(OBLIQUE, E=E))
    expected = depth_in_camera(depth, Camera(K), OBLIQUE)
    assert (expected > 0).mean() > 0.5
    np.testing.assert_allclose(found, unit * expected, rtol=1e-5)


def test_strips_of_any_height_give_the_same_depth(monkeypatch):
    depth = cast(K, np.eye(4), SIZE)[0]
    expected = depth_in_camera(depth, Camera(K), OBLIQUE)
    for pixels in (1000, 3333):
        monkeypatch.setattr(_strips, "STRIP_PIXELS", pixels)
        found = depth_in_camera(depth, Camera(K), OBLIQUE)
        off = np.abs(found - expected) / np.maximum(expected, 1)
        assert (off > 0).mean() < 0.02 and (off > 0.05).mean() < 1e-3  # a strip has its own number of samples


def test_a_camera_at_the_same_place_sees_the_same_pixels_elsewhere():
    """Moved by whole pixels, by a principal point of its own; each axis by another number."""
    depth = cast(K, np.eye(4), SIZE)[0].astype(np.float32)
    same = depth_in_camera(depth, Camera(K), target(K, np.eye(4), SIZE))
    np.testing.assert_allclose(same, depth, rtol=2e-3)
    assert (np.abs(same / depth - 1) < 1e-6).mean() > 0.99
    moved = K.copy()
    moved[:2, 2] += -7, 5
    found = depth_in_camera(depth, Camera(K), target(moved, np.eye(4), (140, 130)))
    np.testing.assert_allclose(found[5:125, :140], depth[:, 7:147], rtol=2e-3)
    assert not found[:5].any() and not found[125:].any()


def test_depth_comes_back_from_another_camera():
    depth = cast(K, np.eye(4), SIZE)[0]
    there = depth_in_camera(depth, Camera(K), OBLIQUE)
    back = depth_in_camera(there, Camera(OBLIQUE.K), target(K, np.linalg.inv(OBLIQUE.E), SIZE))
    both = back > 0
    assert both.mean() > 0.5
    off = np.abs(back / depth - 1)[both]
    assert np.median(off) < 1e-5 and (off < 2e-3).mean() > 0.97


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_a_depth_is_within_a_twentieth_of_the_nearest_point_in_its_pixel(scale):
    """At the edge of the screen a pixel shows the screen, though the ray of its centre may miss it."""
    depth = cast(K, np.eye(4), SIZE)[0]
    K_to, size = np.diag([scale, scale, 1.0]) @ OBLIQUE.K, (int(scale * 150), int(scale * 130))
    found = depth_in_camera(depth, Camera(K), replace(OBLIQUE, K=K_to, size=size))
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    points = (rays * depth[..., None] - OBLIQUE.E[:3, 3]) @ OBLIQUE.E[:3, :3]
    pixels = points @ K_to.T
    at = np.rint(pixels[..., :2] / pixels[..., 2:]).astype(int)
    width, height = size
    inside = ((at >= 0) & (at < [width, height])).all(-1)
    nearest = np.full((height, width), np.inf)
    np.minimum.at(nearest, (at[inside][:, 1], at[inside][:, 0]), points[inside][:, 2])
    hit = np.isfinite(nearest)
    assert hit.mean() > 0.3 and (found[hit] > 0).all() and (found[hit] <= 1.05 * nearest[hit] + 1e-5).all()


@pytest.mark.parametrize("ratio", [1.07, 1.09])
def test_a_step_in_depth_of_more_than_8_percent_is_no_surface(ratio):
    """A camera five times as fine sees the step as a slope or as a gap."""
    depth = np.full((12, 16), 2.0)
    depth[:, 8:] *= ratio
    small = np.array([[30.0, 0, 7.0], [0, 30.0, 5.5], [0, 0, 1]])
    found = depth_in_camera(depth, Camera(small), target(np.diag([5.0, 5.0, 1]) @ small, np.eye(4), (75, 55)))
    between = found[5:50, 36:40]  # columns 7.2 to 7.8 of the first camera
    assert ((between > 2.001) & (between < 2 * ratio - 0.001)).all() if ratio < 1.08 else (between == 0).all()


@pytest.mark.parametrize(
    ("finer", "roll", "count"),
    [
        ((0.5, 0.5), 0, 1),
        ((0.69, 0.6), 0, 1),
        ((0.6, 0.75), 0, 2),
        ((3.4, 1.0), 0, 5),
        ((1.0, 1.0), 45, 3),
        ((9.0, 2.0), 0, 8),
    ],
)
def test_a_cell_has_so_many_samples_that_a_finer_camera_sees_no_hole(finer, roll, count):
    """A sample every 0.7 pixels of the finer axis at most, but eight a side."""
    square = np.array([[80.0, 0, 20.0], [0, 80.0, 15.0], [0, 0, 1]])
    camera = target(np.diag([*finer, 1]) @ square, pose(0, 0, roll), (400, 300))
    px = np.stack([np.arange(5.0, 15.0), np.arange(4.0, 14.0)], 1)
    corners = [np.full(10, 0.5)] * 4
    assert _samples_per_side(px, corners, Camera(square), camera) == count
    if finer[0] < 8:
        return
    finest = replace(camera, K=np.diag([7.8, 7.8, 1]) @ square, size=(312, 234))
    found = depth_in_camera(np.full((30, 40), 2.0), Camera(square), finest)
    assert (found[:226, :304] > 0).all()


def test_surfaces_next_to_or_behind_the_other_camera_are_not_seen():
    """The camera stands in the middle of a slanted plane that it looks along."""
    wide = np.array([[30.0, 0, 40.0], [0, 30.0, 30.0], [0, 0, 1]])
    v, u = np.mgrid[:60, :80]
    depth = 2.0 + 0.02 * u
    camera = target(wide, pose(0, 90, 0, at=(0.3, 0.2, 2.5)), (80, 60))
    found = depth_in_camera(depth, Camera(wide), camera)
    points = np.stack([(u - 40) / 30 * depth, (v - 30) / 30 * depth, depth], -1).reshape(-1, 3)
    seen = (points - camera.E[:3, 3]) @ camera.E[:3, :3]
    ahead = seen[seen[:, 2] > 0]
    assert 0 < len(ahead) < len(points) and np.isfinite(found).all() and (found >= 0).all()
    assert found.max() <= ahead[:, 2].max() * 1.05


def test_the_nearest_part_of_a_surface_has_no_holes_though_most_of_it_is_far():
    """A camera ahead sees the near wall four times as large as the first one does, and the far one alike."""
    depth = np.full((40, 100), 12.0)
    depth[:, 80:] = 2.0
    square = np.array([[60.0, 0, 88.0], [0, 60.0, 19.5], [0, 0, 1]])
    found = depth_in_camera(depth, Camera(square), target(square, pose(at=(0, 0, 1.5)), (100, 40)))
    near = found[:, 60:]  # columns from 80.5 on of the first camera
    np.testing.assert_allclose(near, 0.5, rtol=1e-4)


def test_the_surface_is_known_inside_the_outermost_pixels():
    """Inverse depth is interpolated between four pixels, also next to the last row and column."""
    v, u = np.mgrid[:9, :12]
    inverse = 0.5 + 0.01 * u + 0.02 * v + 0.001 * u * v
    camera = Camera(np.array([[10.0, 0, 5.5], [0, 10, 4], [0, 0, 1]]))
    x, y = np.random.default_rng(0).uniform((-1, -1), (12, 9), (2000, 2)).T
    x[:4], y[:4] = (0, 10.999, 5, 6.5), (3, 2.5, 0, 7.999)
    points = np.c_[(x - 5.5) / 10, (y - 4) / 10, np.ones(len(x))] * 1.7
    found = _above_surface(points, inverse, camera)
    inside = (x >= 0) & (y >= 0) & (x < 11) & (y < 8)
    expected = 1 / (0.5 + 0.01 * x + 0.02 * y + 0.001 * x * y) - 1.7
    np.testing.assert_allclose(found[inside], expected[inside], rtol=1e-9)
    assert np.isinf(found[~inside]).all() and 0.5 < inside.mean() < 0.9


def test_sigma_is_that_of_the_surface_that_wins():
    """The two walls have different sigmas, also where one covers the other; each camera looks along its z."""
    depth, points = cast(K, np.eye(4), SIZE)
    on_screen = depth < 2.0 + 1e-6
    sigma = np.where(on_screen, 0.01, 0.3)
    for K_to, E, size in CAMERAS:
        seen, found = maps_in_camera(depth, sigma, Camera(K), target(K_to, E, size))
        assert found.shape == seen.shape and found.dtype == np.float32
        np.testing.assert_array_equal(np.isfinite(found), seen > 0)
        ground_truth, at = cast(K_to, E, size)
        shows_screen = np.abs(at[..., 2] - 2.0) < 1e-6
        # The depth of a point ``z r`` along the other camera's z axis is ``z (axis . r) - axis . t``.
        expected = np.where(shows_screen, 0.01, 0.3) * (at / at[..., 2:] @ E[:3, 2])
        around = np.ones((5, 5), np.uint8)
        alone = cv2.dilate(ground_truth, around) < 1.3 * cv2.erode(ground_truth, around)
        there = (seen > 0) & alone & ~hidden(at)
        assert there.mean() > 0.4 and 0.02 < shows_screen[there].mean() < 0.98
        close = np.abs(found / expected - 1)[there] < 0.01
        assert close.mean() > 0.995


def test_sigma_is_multiplied_by_the_change_of_depth_along_the_other_z_axis():
    """Of one point after the other: its depth is changed a little, and projected by hand."""
    depth = cast(K, np.eye(4), SIZE)[0]
    sigma = np.random.default_rng(0).uniform(0.01, 0.2, depth.shape)
    camera = target(K, pose(0, 25, 0), SIZE)
    seen, found = maps_in_camera(depth, sigma, Camera(K), camera)
    row, column = 60, 140
    ray = np.linalg.inv(K) @ [column, row, 1]
    shift = 1e-4
    near, far = ((ray * (depth[row, column] + step)) @ camera.E[:3, :3] for step in (0, shift))
    u, v = np.rint((K @ near / near[2])[:2]).astype(int)
    change = (far - near)[2] / shift
    assert abs(change - 1) > 0.1 and abs(seen[v, u] / near[2] - 1) < 0.01
    around = sigma[row - 1 : row + 2, column - 1 : column + 2] * change
    assert np.isclose(found[v, u], around, rtol=0.01).any()
    backwards = target(K, pose(0, 180, 0, at=(0, 0, 9)), SIZE)  # it looks at the walls from behind
    seen, found = maps_in_camera(depth, np.full_like(depth, 0.1), Camera(K), backwards)
    np.testing.assert_allclose(found[seen > 0], 0.1, rtol=1e-6)


def test_of_equal_depths_the_sigma_is_the_first_ones():
    """Of a wall, several pixels are in one of a camera of half the resolution."""
    sigma = np.arange(1.0, 65.0).reshape(8, 8)
    K_half = np.array([[20.0, 0, 2], [0, 20, 2], [0, 0, 1]])
    K_full = np.array([[40.0, 0, 4], [0, 40, 4], [0, 0, 1]])
    camera = target(K_half, np.eye(4), (4, 4))
    depth, found = maps_in_camera(np.full((8, 8), 2.0), sigma, Camera(K_full), camera)
    np.testing.assert_allclose(depth, 2.0)
    firsts = [2, 3, 6]  # columns and rows 3, 4 and 5 are rounded to 2
    np.testing.assert_allclose(found[1:, 1:], sigma[np.ix_(firsts, firsts)])


def test_an_unknown_sigma_and_pixels_without_depth_have_none():
    depth = np.full((40, 60), 2.0)
    sigma = np.full((40, 60), 0.1)
    depth[10:20, 15:30], sigma[25:30, 5:12] = 0, np.nan
    seen, found = maps_in_camera(depth, sigma, Camera(K), target(K, np.eye(4), (60, 40)))
    np.testing.assert_array_equal(seen == 0, depth == 0)
    np.testing.assert_allclose(found, np.where(depth > 0, sigma, np.nan), rtol=1e-6)
    seen, found = maps_in_camera(0 * depth, sigma, Camera(K), target(K, np.eye(4), (60, 40)))
    assert not seen.any() and np.isnan(found).all()


@pytest.mark.parametrize("scale", [0.4, 6.0])
def test_sigma_of_another_resolution_is_that_of_the_nearest_pixel(scale):
    rng = np.random.default_rng(1)
    depth, sigma = np.full((30, 40), 2.0), rng.uniform(0.01, 0.5, (30, 40)).astype(np.float32)
    size = int(40 * scale), int(30 * scale)
    camera = Camera(K, (40, 30)).resized(size)
    seen, found = maps_in_camera(depth, sigma, Camera(K), target(camera.K, np.eye(4), size))
    assert (seen > 0).mean() > 0.8
    rows, columns = np.nonzero(seen)
    off_px = 0.5 + 0.7 / min(scale, 1)
    for row, column in zip(rows[::7], columns[::7], strict=True):
        y, x = ((at + 0.5) / scale - 0.5 for at in (row, column))
        near = sigma[
            max(0, int(np.ceil(y - off_px))) : int(y + off_px) + 1,
            max(0, int(np.ceil(x - off_px))) : int(x + off_px) + 1,
        ]
        assert np.isin(found[row, column], near), (row, column)
