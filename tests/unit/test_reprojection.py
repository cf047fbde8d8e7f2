"""Depth in another camera, against rays that are cast at the same walls."""

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import InputError, MetricDepthOutput
from geodiff_plugin._reprojection import PosedCamera, depth_in_camera

K = np.array([[120.0, 0.5, 79.0], [0, 125.0, 58.0], [0, 0, 1]])
SIZE = (160, 120)
#: Walls as ``normal . X = 1``: one far and slanted, a screen before it that is 1 m wide.
FAR, SCREEN = np.array([0.02, -0.05, 0.25]), np.array([0.0, 0.0, 0.5])


def pose(*turn_deg: float, at: tuple[float, ...] = (0.0, 0.0, 0.0)) -> np.ndarray:
    E = np.eye(4)
    E[:3, :3] = Rotation.from_euler("xyz", turn_deg or (0, 0, 0), degrees=True).as_matrix()
    E[:3, 3] = at
    return E


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
]


@pytest.mark.parametrize(("K_to", "E", "size"), CAMERAS, ids=["same", "beside", "finer", "coarser"])
def test_another_camera_sees_what_rays_hit(K_to, E, size):
    depth = cast(K, np.eye(4), SIZE)[0].astype(np.float32)
    found = depth_in_camera(depth, K, PosedCamera(K_to, E, size))
    truth, points = cast(K_to, E, size)
    assert found.shape == size[::-1] and found.dtype == np.float32
    pixels = points / points[..., 2:] @ K.T
    seen = ((pixels[..., :2] > 1) & (pixels[..., :2] < np.array(SIZE) - 2)).all(-1)
    at_screen = np.abs(np.abs((points * (2.0 / points[..., 2:]))[..., 0]) - 0.5) * K[0, 0] / 2.0
    clear = at_screen > 2.0  # pixels of the left image from the edge of the screen
    around = np.ones((5, 5), np.uint8)  # no edge of the screen near it in the other image
    alone = cv2.dilate(truth, around) < 1.3 * cv2.erode(truth, around)
    there = seen & clear & alone & ~hidden(points)
    assert there.mean() > 0.4 and (found[there] > 0).mean() > 0.999
    there &= found > 0
    assert np.median(np.abs(found[there] / truth[there] - 1)) < 1e-5
    assert np.quantile(np.abs(found[there] / truth[there] - 1), 0.999) < 2e-3


def test_what_the_left_camera_does_not_see_has_no_depth():
    depth = cast(K, np.eye(4), SIZE)[0]
    E = pose(at=(0.3, 0.0, 0.0))
    found = depth_in_camera(depth, K, PosedCamera(K, E, SIZE))
    truth, points = cast(K, E, SIZE)
    behind = hidden(points) & (np.abs(np.abs((points * (2 / points[..., 2:]))[..., 0]) - 0.5) > 0.05)
    outside = (points / points[..., 2:] @ K.T)[..., 0] > SIZE[0] + 1
    assert behind.sum() > 500 and outside.sum() > 200
    assert (found[behind] == 0).all() and (found[outside] == 0).all()


def test_unknown_depth_stays_unknown_and_makes_no_surface():
    depth = np.full((40, 60), 2.0)
    depth[10:20, 15:30] = [0, np.nan, -1] * 5
    found = depth_in_camera(depth, K, PosedCamera(K, np.eye(4), (60, 40)))
    np.testing.assert_allclose(found, np.where(depth > 0, depth, 0), atol=1e-6)
    backwards = PosedCamera(K, pose(0, 180, 0), (60, 40))
    assert (depth_in_camera(depth, K, backwards) == 0).all()


def test_an_output_gives_its_depth_into_another_camera():
    depth = cast(K, np.eye(4), SIZE)[0].astype(np.float32)
    K_to, E, size = CAMERAS[2]
    expected = depth_in_camera(depth, K, PosedCamera(K_to, E, size))
    arrays = MetricDepthOutput(prediction=np.stack([depth, 2 * depth])[..., None], K=np.stack([K, K]))
    found = arrays.into(K_to, E, size)
    assert found.shape == (2, 300, 400, 1)
    np.testing.assert_array_equal(found[0, ..., 0], expected)
    tensors = MetricDepthOutput(prediction=torch.from_numpy(depth)[None, None], K=torch.from_numpy(K)[None])
    found = tensors.into(torch.from_numpy(K_to), E[:3], list(size))
    assert found.shape == (1, 1, 300, 400) and found.dtype == torch.float32
    np.testing.assert_array_equal(found[0, 0], expected)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ((np.eye(4), np.eye(4), SIZE), "into: K must be a 3x3 matrix"),
        ((K, np.eye(3), SIZE), "into: E must be a 4x4 matrix"),
        ((K, 2 * np.eye(4), SIZE), "into: E must be rigid"),
        ((K, np.eye(4), (0, 5)), "into: size must be between 1"),
        ((K, np.eye(4), None), "into: size must be a pair"),
    ],
)
def test_a_camera_that_is_none_gets_a_sentence(camera, words):
    output = MetricDepthOutput(prediction=np.ones((1, 4, 4, 1), np.float32), K=K[None])
    with pytest.raises(InputError, match=words):
        output.into(*camera)
