"""Cameras, projection, warping: against ``z (u, v, 1) = K p`` in NumPy, with a skew and in any pose."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import geometry as g

SIZE = (24, 32)
K = np.array([[31.0, 7.0, 14.2], [0.0, 28.0, 12.7], [0.0, 0.0, 1.0]])
K_RIGHT = np.array([[36.0, -4.0, 17.0], [0.0, 33.0, 10.0], [0.0, 0.0, 1.0]])


def camera(f=30.0, cx=15.5, cy=11.5) -> np.ndarray:
    return np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])


def T_of(at=(0.0, 0.0, 0.0), axis=(0, 1, 0), angle=0.0) -> np.ndarray:
    """``T_right_from_left`` of a right camera at a place, turned about an axis."""
    E = np.eye(4)
    E[:3, :3] = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    E[:3, 3] = at
    return np.linalg.inv(E)


def tensor(x) -> torch.Tensor:
    return torch.as_tensor(np.asarray(x), dtype=torch.float64)[None]


def pixels(size) -> np.ndarray:
    """``(3, H, W)`` homogeneous."""
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    return np.stack([u, v, np.ones_like(u)])


def points_of(depth_m, K) -> np.ndarray:
    return np.einsum("ij,jhw->ihw", np.linalg.inv(K), pixels(depth_m.shape)) * depth_m


def uv_of(points, K) -> np.ndarray:
    seen = np.einsum("ij,jhw->ihw", K, points)
    return seen[:2] / seen[2]


def last(x: torch.Tensor) -> np.ndarray:
    """``(1, H, W, C)`` as ``(C, H, W)``."""
    return x[0].permute(2, 0, 1).numpy()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("pose", "size_right"),
    [
        ({"at": (0.2, -0.05, 0.3)}, (24, 32)),
        ({"axis": (0.2, 1, 0.1), "angle": 0.15}, (48, 64)),
        ({}, (30, 20)),
    ],
)
def test_projection_and_warp_are_the_definition(seed, pose, size_right):
    depth = 1.0 + 3.0 * np.random.default_rng(seed).random(SIZE)
    T, K_r = T_of(**pose), g.resize_intrinsics(tensor(K_RIGHT), SIZE, size_right)[0].numpy()
    points = points_of(depth, K)
    in_right = np.einsum("ij,jhw->ihw", T[:3, :3], points) + T[:3, 3, None, None]
    expected = uv_of(in_right, K_r)
    cloud = g.unproject(tensor(depth)[None], tensor(K))
    np.testing.assert_allclose(last(cloud), points, atol=1e-12)
    moved = g.transform(cloud, tensor(T))
    np.testing.assert_allclose(last(moved), in_right, atol=1e-12)
    rays = g.plane_rays(tensor(K), tensor(K_r), tensor(T), SIZE)
    for uv, z in (g.project(moved, tensor(K_r)), g.project_rays(tensor(depth)[None], rays)):
        np.testing.assert_allclose(last(uv), expected, atol=1e-9)
        np.testing.assert_allclose(z[0], in_right[2], atol=1e-12)
    # An image that is its own coordinates reads back the right pixel.
    ramp = tensor(pixels(size_right)[:2])
    for known in ({}, {"rays": rays}):
        warped = g.warp_right_to_left(ramp, tensor(depth)[None], tensor(K), tensor(K_r), tensor(T), **known)
        limits = np.array([size_right[1] - 1, size_right[0] - 1])[:, None, None]
        inside = ((expected >= -0.01) & (expected <= limits + 0.01)).all(0)  # to a hundredth of a pixel
        np.testing.assert_array_equal(warped.visible[0, 0], inside)
        assert inside.mean() > 0.3
        np.testing.assert_allclose(
            warped.image[0].numpy()[:, inside], np.clip(expected, 0, limits)[:, inside], atol=1e-9
        )


def test_depth_at_and_behind_the_camera_is_finite_invisible_and_without_gradient():
    values = torch.tensor([2.0, 0.5, 0.25, 0.0, -1.0, 1e-9, 0.25 + 1e-12, 1e9])
    depth = values.repeat(1, 1, 4, 1).double().requires_grad_()
    camera_8, ahead = tensor(camera(cx=3.5, cy=1.5)), tensor(T_of(at=(0.0, 0.0, 0.25)))
    image = torch.rand(1, 1, 4, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    warped = g.warp_right_to_left(image, depth, camera_8, camera_8, ahead)
    uv, _ = g.project(g.transform(g.unproject(depth, camera_8), ahead), camera_8)
    by_rays, _ = g.project_rays(depth, g.rays_of(depth, camera_8, camera_8, ahead))
    (gradient,) = torch.autograd.grad(warped.image.sum() + by_rays.sum() + uv.sum(), depth)
    behind = values <= 0.25 + 1e-6
    assert all(torch.isfinite(x).all() for x in (warped.image, by_rays, uv, gradient))
    assert not warped.visible[..., behind].any() and (gradient[..., behind] == 0).all()
    assert warped.visible[..., 7].all()  # a point at infinity is seen
    away = tensor(T_of(angle=np.pi))
    assert not g.warp_right_to_left(image, depth.detach().abs() + 1, camera_8, camera_8, away).visible.any()


@pytest.mark.parametrize("size_right", [(40, 60), (80, 120), (20, 30)])
def test_a_near_square_hides_the_strip_beside_it(size_right):
    """Right camera at +x: the square shifts left by more than the wall, and covers a strip at its left."""
    size = (40, 60)
    depth = torch.full((1, 1, *size), 4.0)
    depth[..., 10:30, 25:40] = 2.0
    wide = tensor(camera(40.0, 29.5, 19.5)).float()
    K_right = g.resize_intrinsics(wide, size, size_right)
    hidden = g.hidden_in_right(depth, wide, K_right, tensor(T_of(at=(0.6, 0, 0))).float(), size_right)[0, 0]
    # disparities 12 and 6 px: wall pixels u with u - 6 in [25 - 12, 40 - 12), that is columns 19..24
    expected = torch.zeros(size, dtype=torch.bool)
    expected[10:30, 19:25] = True
    coarse = max(1, size[1] // size_right[1])  # a buffer cell covers that many left pixels
    assert (hidden != expected).sum() <= 2 * (20 + 6) * coarse
    assert hidden[12:28, 20:24].all()
    assert not hidden[12:28, 25 + coarse :].any() and not hidden[:, : 19 - coarse].any()


#: Three cameras of a batch, no two alike, and where their right ones stand.
BATCH_K = np.stack([K, K_RIGHT, np.array([[27.0, 2.0, 16.1], [0, 35.0, 9.4], [0, 0, 1]])])
BATCH_K_RIGHT = BATCH_K[[1, 2, 0]] * [[[1.1], [0.9], [1.0]]]
BATCH_T = np.stack(
    [
        T_of((0.2, -0.05, 0.1), (0.2, 1, 0.1), 0.15),
        T_of((-0.1, 0.2, -0.2), (1, 0.3, -0.5), -0.2),
        T_of((0.05, 0.1, 0.3), (0.1, -0.2, 1), 0.4),
    ]
)


def batch(x) -> torch.Tensor:
    return torch.as_tensor(np.asarray(x), dtype=torch.float64)


def test_every_image_of_a_batch_has_its_own_cameras():
    size_right = (30, 20)
    depth = 1.5 + 2.0 * np.random.default_rng(0).random((3, *SIZE))
    K_left, K_r, T = map(batch, (BATCH_K, BATCH_K_RIGHT, BATCH_T))
    depth_m, ramp = batch(depth)[:, None], batch(pixels(size_right)[:2])[None].repeat(3, 1, 1, 1)
    ramp = ramp * torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64).view(3, 1, 1, 1)
    cloud = g.unproject(depth_m, K_left)
    moved = g.transform(cloud, T)
    warped = g.warp_right_to_left(ramp, depth_m, K_left, K_r, T)
    by_rays = g.project_rays(depth_m, g.rays_of(depth_m, K_left, K_r, T))
    for b in range(3):
        points = points_of(depth[b], BATCH_K[b])
        in_right = np.einsum("ij,jhw->ihw", BATCH_T[b, :3, :3], points) + BATCH_T[b, :3, 3, None, None]
        expected = uv_of(in_right, BATCH_K_RIGHT[b])
        np.testing.assert_allclose(cloud[b].permute(2, 0, 1), points, atol=1e-12)
        np.testing.assert_allclose(moved[b].permute(2, 0, 1), in_right, atol=1e-12)
        for uv, z in (g.project(moved, K_r), by_rays):
            np.testing.assert_allclose(uv[b].permute(2, 0, 1), expected, atol=1e-9)
            np.testing.assert_allclose(z[b], in_right[2], atol=1e-12)
        inside = ((expected >= 0) & (expected <= np.array([19, 29])[:, None, None])).all(0)
        assert 0.1 < inside.mean() < 1 and warped.visible[b, 0].numpy()[inside].all()
        np.testing.assert_allclose(
            warped.image[b].numpy()[:, inside], (b + 1) * expected[:, inside], atol=1e-9
        )


def test_resized_intrinsics_project_where_the_resized_pixels_are():
    """With a factor of its own for each axis, a skew, and the dtype that came."""
    before, after = (24, 32), (60, 20)
    point = np.array([0.3, -0.2, 1.7])
    found = g.resize_intrinsics(torch.tensor(BATCH_K, dtype=torch.float32), before, after)
    assert found.dtype == torch.float32 and found.shape == (3, 3, 3)
    for matrix, resized in zip(BATCH_K, found.double().numpy(), strict=True):
        (u, v, w), (u_new, v_new, w_new) = matrix @ point, resized @ point
        assert u_new / w_new == pytest.approx((u / w + 0.5) * 20 / 32 - 0.5, abs=1e-5)
        assert v_new / w_new == pytest.approx((v / w + 0.5) * 60 / 24 - 0.5, abs=1e-5)


def test_cameras_that_are_being_optimised_are_decided_on_by_their_values():
    left, right, T = (batch(each).requires_grad_() for each in (BATCH_K, BATCH_K_RIGHT, BATCH_T))
    assert not g.is_rectified(left, right, T).any()
    np.testing.assert_allclose(g.resize_intrinsics(left, SIZE, (12, 16))[:, 0, 0], BATCH_K[:, 0, 0] / 2)
    image, _ = g.as_fine_as(torch.zeros(1, 40, 50), 2 * left[0], left[0])
    assert image.shape == (1, 20, 25)


def test_sizes_are_scaled_by_axis_and_bounded_by_one_factor():
    assert g.scaled_size((100, 30), 0.25, 2.5) == (25, 75)
    assert g.scaled_size((100, 30), 0.001, 0.01) == (1, 1)
    assert g.size_within((300, 400), 120_000) == (300, 400) == g.size_within((300, 400), 10**9)
    assert g.size_within((300, 400), 30_000) == (150, 200)
    assert g.size_within((640, 480), 640 * 480 // 4 + 1) == (320, 240)
    assert g.image_size(torch.zeros(2, 3, 5, 7)) == (5, 7)


def test_a_resized_image_does_not_alias_and_keeps_its_camera():
    stripes = torch.zeros(2, 24, 32)
    stripes[0, :, ::2] = 1.0
    stripes[1] = torch.arange(32.0)
    image, camera_new = g.resize_image(stripes, tensor(K)[0], (12, 8))
    assert image.shape == (2, 12, 8)
    np.testing.assert_allclose(image[0, :, 1:-1], 0.5, atol=0.03)
    np.testing.assert_allclose(image[1, 5, 1:-1], (np.arange(1, 7) + 0.5) * 4 - 0.5, atol=1e-4)
    np.testing.assert_allclose(camera_new, g.resize_intrinsics(tensor(K), (24, 32), (12, 8))[0])
    same, camera_same = g.resize_image(stripes, camera_new, (24, 32))
    assert same is stripes and camera_same is camera_new


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
    right = np.diag([*focal, 1.0])
    right[:2, 2] = 13.0, 11.0
    image, found = g.as_fine_as(torch.rand(3, 24, 32), tensor(right)[0], tensor(K)[0])
    assert tuple(image.shape[1:]) == size
    expected = g.resize_intrinsics(tensor(right), (24, 32), size)[0]
    np.testing.assert_allclose(found, expected)
    assert found[0, 0] <= 31.0 + 1e-9 and found[1, 1] <= 28.0 + 1e-9


def test_a_pair_is_rectified_within_its_tolerances():
    """A table of single changes, on either side of each tolerance and in both signs, as one batch."""
    cases = [(("T", 0, 3), 0.3, True), (("T", 0, 3), -1e-3, True)]
    for sign in (1, -1):
        cases += [(("T", i, j), sign * 0.9e-3, True) for i in range(3) for j in range(3) if i != j]
        cases += [(("T", i, j), sign * 1.1e-3, False) for i in range(3) for j in range(3) if i != j]
        cases += [
            (("T", i, 3), sign * size, ok) for i in (1, 2) for size, ok in ((0.0009, True), (0.0011, False))
        ]
        for i, j in ((0, 0), (0, 1), (1, 1), (1, 2)):
            cases += [(("K", i, j), sign * 0.026, True), (("K", i, j), sign * 0.030, False)]
        cases += [(("K", 0, 2), sign * 5.0, True)]
    K_left, K_r, T = (np.tile(matrix, (len(cases), 1, 1)) for matrix in (K, K, T_of((0.1, 0, 0))))
    for n, ((which, i, j), change, _) in enumerate(cases):
        target = T if which == "T" else K_r
        target[n, i, j] = change if (i, j) == (0, 3) else target[n, i, j] + change
    for n in (0, 1):
        T[n, 1:3, 3] = 0.5 * 0.01 * abs(T[n, 0, 3])
    found = g.is_rectified(*map(batch, (K_left, K_r, T)))
    assert found.shape == (len(cases),) and found.tolist() == [ok for *_, ok in cases]
    assert bool(g.is_rectified(tensor(K)[0], tensor(K)[0], tensor(T_of((-0.1, 0, 0)))[0]))
    assert not g.is_rectified(tensor(K), tensor(K), tensor(np.eye(4))).any()  # without a baseline


def test_values_are_sampled_between_pixel_centres_and_the_edge_is_repeated():
    image = torch.arange(35.0).view(1, 1, 5, 7)
    uv = torch.tensor(
        [[2.25, 3.5], [-9.0, 1.0], [99.0, 2.0], [3.0, -50.0], [6.0, 4.0], [-1e6, -1e6], [5.4, 1.6]]
    )
    found = g.sample_at(image, uv[None, None])[0, 0, 0]
    expected = [2.25 + 7 * 3.5, 7, 20, 3, 34, 0, 5.4 + 7 * 1.6]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    nearest = g.sample_at(image, uv[None, None], mode="nearest")[0, 0, 0]
    assert nearest.tolist() == [2 + 7 * 4, 7, 20, 3, 34, 0, 5 + 7 * 2]
    for shape in ((1, 7), (5, 1), (1, 1)):
        thin = torch.arange(float(shape[0] * shape[1])).view(1, 1, *shape)
        at = torch.tensor([[[[shape[1] - 1.0, shape[0] - 1.0]]]])
        assert g.sample_at(thin, at).item() == thin[..., -1, -1].item()


@pytest.mark.parametrize(("off", "inside"), [(0.0, True), (9e-3, True), (1.1e-2, False)])
def test_a_point_is_visible_within_the_pixel_centres_at_the_edges(off, inside):
    """Of each edge of an image that is not square, and not behind the camera."""
    for u, v, outwards in ((0, 7, (-1, 0)), (19, 7, (1, 0)), (11, 0, (0, -1)), (11, 29, (0, 1))):
        uv = torch.tensor([u + outwards[0] * off, v + outwards[1] * off], dtype=torch.float64).view(
            1, 1, 1, 2
        )
        z = torch.tensor([[[2.0]]])
        assert g._inside(uv, z, (30, 20)).item() == inside
        assert not g._inside(uv, -z, (30, 20)).item() and not g._inside(uv, 1e-5 * z, (30, 20)).item()


def hidden_by_a_screen(K_left, K_r, T, screen, z_screen, z_wall) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a wall and a rectangular screen before it, and which wall pixels the screen hides, by rays.

    Unclear pixels, at the edges of the screen in either view, are marked by 2.
    """

    def on_screen(origin, through, slack):
        at = origin + (through - origin) * ((z_screen - origin[2]) / (through[2] - origin[2]))
        low, high = np.array(screen).T[..., None, None]
        return ((at[:2] > low + slack) & (at[:2] < high - slack)).all(0)

    rays = points_of(np.ones((60, 80)), K_left)
    zero = np.zeros((3, 1, 1))
    is_screen = [on_screen(zero, rays * z_wall, slack) for slack in (0.0, 0.06, -0.06)]
    depth = np.where(is_screen[0], z_screen, z_wall)
    points = rays * depth
    centre = np.linalg.inv(T)[:3, 3, None, None]
    hidden = [~is_screen[0] & on_screen(centre, points, slack) for slack in (0.06, -0.06)]
    seen = np.einsum("ij,jhw->ihw", T[:3, :3], points) + T[:3, 3, None, None]
    uv = uv_of(seen, K_r)
    inside = ((uv >= 0) & (uv <= np.array([109, 49])[:, None, None])).all(0)
    marks = np.where(hidden[0] & inside, 1, 0)
    marks[(hidden[0] != hidden[1]) | (is_screen[1] != is_screen[2])] = 2
    return depth, marks


def test_a_screen_hides_what_rays_of_the_right_camera_do_not_reach():
    """Two images with screens, cameras and poses of their own; the right images have another size."""
    K_left = np.array(
        [[[70.0, 0, 38.0], [0, 60.0, 31.0], [0, 0, 1]], [[62.0, 1.0, 41.0], [0, 75.0, 27.0], [0, 0, 1]]]
    )
    K_r = np.array(
        [[[90.0, 0, 52.0], [0, 50.0, 26.0], [0, 0, 1]], [[80.0, 0, 60.0], [0, 66.0, 22.0], [0, 0, 1]]]
    )
    T = np.stack([T_of((0.5, 0.1, 0.1), (0.3, 1, 0.2), -0.1), T_of((-0.5, 0.3, -0.1), (1, -0.4, 0.3), -0.12)])
    made = [
        hidden_by_a_screen(K_left[0], K_r[0], T[0], ((-0.5, 0.4), (-0.6, 0.5)), 2.0, 5.0),
        hidden_by_a_screen(K_left[1], K_r[1], T[1], ((-0.4, 0.6), (-0.5, 0.4)), 2.5, 6.0),
    ]
    depth = batch([each for each, _ in made])[:, None]
    cameras = [batch(each) for each in (K_left, K_r, T)]
    for rays in (None, g.rays_of(depth, *cameras)):
        found = g.hidden_in_right(depth, *cameras, (50, 110), rays)
        assert found.shape == (2, 1, 60, 80) and found.dtype == torch.bool
        for b, (_, marks) in enumerate(made):
            clear, hidden = marks < 2, found[b, 0].numpy()
            assert (marks == 1).sum() > 60
            assert (hidden[clear] == (marks[clear] == 1)).mean() > 0.995
            assert hidden[marks == 1].mean() > 0.97
    # The same in a mirror, for either axis.
    for axis, (side, side_right) in enumerate(((80, 110), (60, 50))):
        mirror = np.eye(4)
        mirror[axis, axis] = -1
        mirrored = [mirror[:3, :3] @ each @ mirror[:3, :3] for each in (K_left, K_r)]
        for each, last in zip(mirrored, (side - 1, side_right - 1), strict=True):
            each[:, axis, 2] += last
        flipped = depth.flip(3 - axis)
        again = g.hidden_in_right(flipped, *map(batch, (*mirrored, mirror @ T @ mirror)), (50, 110))
        assert (again.flip(3 - axis) != found).sum() == 0


@pytest.mark.parametrize("axis", [0, 1])
def test_a_strip_that_is_hidden_is_not_a_pixel_wider_than_by_rays(axis):
    """Disparities of 12.1 and 6.05 px: the square begins at 12.4, where pixel 18 of the wall is at 11.95."""
    depth = torch.full((1, 1, 60, 60), 4.0)
    depth[..., 25:40, 25:40] = 2.0
    wide = tensor(camera(40.0, 29.5, 29.5)).float()
    at = np.roll([0.605, 0.0, 0.0], axis)
    hidden = g.hidden_in_right(depth, wide, wide, tensor(T_of(at)).float(), (60, 60))[0, 0]
    row = hidden[30] if axis == 0 else hidden[:, 30]
    assert row.nonzero()[:, 0].tolist() == list(range(19, 25))


@pytest.mark.parametrize(("ratio", "hides"), [(1.045, False), (1.06, True)])
def test_only_a_depth_nearer_by_more_than_a_margin_hides(ratio, hides):
    depth = torch.full((1, 1, 20, 40), 2.0)
    depth[..., 20:] = 2.0 / ratio
    wide, aside = (tensor(camera(400.0, cx, 9.5)).float() for cx in (19.5, 61.5))
    found = g.hidden_in_right(depth, wide, aside, tensor(T_of((0.2, 0, 0))).float(), (20, 40))
    assert bool(found.any()) == hides


def test_helpers_keep_types_and_copy_only_what_they_must():
    one = torch.arange(6.0).view(2, 3)
    assert g.stacked([one]).data_ptr() == one.data_ptr() and g.stacked([one]).shape == (1, 2, 3)
    assert g.stacked([one.T]).is_contiguous() and torch.equal(g.stacked([one, one + 1])[1], one + 1)
    like = torch.zeros(2, dtype=torch.float64)
    assert (
        g.constant_like(like, 3, 0.1).tolist() == [3.0, 0.1]
        and g.constant_like(like, 1).dtype == torch.float64
    )
    reversed_rows = np.arange(6.0)[::-1]
    assert torch.equal(g.to_device_of(one, reversed_rows), torch.arange(5.0, -1, -1, dtype=torch.float64))
    assert g.to_device_of(one, one) is one
