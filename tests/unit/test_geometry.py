"""Cameras, projection, warping: against ``z (u, v, 1) = K p`` in NumPy, with a skew and in any pose."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin import geometry as g
from geodiff_plugin.cameras import Camera

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


def rays_of(depth_m: torch.Tensor, K_left, K_right, T) -> g.PlaneRays:
    """The rays of one image, or of each of a batch."""
    batch = (each.reshape(-1, *each.shape[-2:]) for each in (K_left, K_right, T))
    K_left, K_right, T = batch
    return g.plane_rays(depth_m, list(map(Camera, K_left)), list(map(Camera, K_right)), T)


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
    T, right = T_of(**pose), Camera(K_RIGHT, SIZE[::-1]).resized(size_right[::-1])
    points = points_of(depth, K)
    in_right = np.einsum("ij,jhw->ihw", T[:3, :3], points) + T[:3, 3, None, None]
    expected = uv_of(in_right, right.K)
    depth_m = tensor(depth)[None]
    rays = rays_of(depth_m, K, right.K, T)
    moved = tensor(in_right).permute(0, 2, 3, 1)
    for uv, z in (g.project(moved, right), g.project_rays(depth_m, rays)):
        np.testing.assert_allclose(last(uv), expected, atol=1e-9)
        np.testing.assert_allclose(z[0], in_right[2], atol=1e-12)
    by_arrays, z = right.project(in_right.transpose(1, 2, 0))
    np.testing.assert_allclose(by_arrays.transpose(2, 0, 1), expected, atol=1e-9)
    np.testing.assert_allclose(z, in_right[2], atol=1e-12)
    # An image that is its own coordinates reads back the right pixel.
    warped = g.warp_right_to_left(tensor(pixels(size_right)[:2]), depth_m, rays)
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
    camera_8 = Camera(camera(cx=3.5, cy=1.5), (8, 4))

    ahead = rays_of(depth, camera_8.K, camera_8.K, T_of(at=(0.0, 0.0, 0.25)))
    image = torch.rand(1, 1, 4, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    warped = g.warp_right_to_left(image, depth, ahead)
    directions = tensor(points_of(np.ones((4, 8)), camera_8.K)).permute(0, 2, 3, 1)
    uv, _ = g.project(directions * depth[:, 0, ..., None] - tensor([0.0, 0.0, 0.25]), camera_8)
    by_rays, _ = g.project_rays(depth, ahead)
    (gradient,) = torch.autograd.grad(warped.image.sum() + by_rays.sum() + uv.sum(), depth)
    behind = values <= 0.25 + 1e-6
    assert all(torch.isfinite(x).all() for x in (warped.image, by_rays, uv, gradient))
    assert not warped.visible[..., behind].any() and (gradient[..., behind] == 0).all()
    assert warped.visible[..., 7].all()  # a point at infinity is seen
    away = rays_of(depth, camera_8.K, camera_8.K, T_of(angle=np.pi))
    assert not g.warp_right_to_left(image, depth.detach().abs() + 1, away).visible.any()


@pytest.mark.parametrize("size_right", [(40, 60), (80, 120), (20, 30)])
def test_a_near_square_occludes_the_strip_next_to_it(size_right):
    """Right camera at +x: the square shifts left by more than the wall, and covers a strip at its left."""
    size = (40, 60)
    depth = torch.full((1, 1, *size), 4.0)
    depth[..., 10:30, 25:40] = 2.0
    wide = Camera(camera(40.0, 29.5, 19.5), size[::-1])
    rays = rays_of(depth, wide.K, wide.resized(size_right[::-1]).K, T_of(at=(0.6, 0, 0)))
    hidden = g.occluded_in_right(depth, rays, size_right)[0, 0]
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
    depth_m, ramp = batch(depth)[:, None], batch(pixels(size_right)[:2])[None].repeat(3, 1, 1, 1)
    ramp = ramp * torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64).view(3, 1, 1, 1)
    rays = rays_of(depth_m, BATCH_K, BATCH_K_RIGHT, BATCH_T)
    warped = g.warp_right_to_left(ramp, depth_m, rays)
    by_rays = g.project_rays(depth_m, rays)
    for b in range(3):
        points = points_of(depth[b], BATCH_K[b])
        in_right = np.einsum("ij,jhw->ihw", BATCH_T[b, :3, :3], points) + BATCH_T[b, :3, 3, None, None]
        expected = uv_of(in_right, BATCH_K_RIGHT[b])
        np.testing.assert_allclose(by_rays[0][b].permute(2, 0, 1), expected, atol=1e-9)
        np.testing.assert_allclose(by_rays[1][b], in_right[2], atol=1e-12)
        inside = ((expected >= 0) & (expected <= np.array([19, 29])[:, None, None])).all(0)
        assert 0.1 < inside.mean() < 1 and warped.visible[b, 0].numpy()[inside].all()
        np.testing.assert_allclose(
            warped.image[b].numpy()[:, inside], (b + 1) * expected[:, inside], atol=1e-9
        )


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
    rays = rays_of(depth, K_left, K_r, T)
    found = g.occluded_in_right(depth, rays, (50, 110))
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
        again = g.occluded_in_right(flipped, rays_of(flipped, *mirrored, mirror @ T @ mirror), (50, 110))
        assert (again.flip(3 - axis) != found).sum() == 0


@pytest.mark.parametrize("axis", [0, 1])
def test_a_strip_that_is_hidden_is_not_a_pixel_wider_than_by_rays(axis):
    """Disparities of 12.1 and 6.05 px: the square begins at 12.4, where pixel 18 of the wall is at 11.95."""
    depth = torch.full((1, 1, 60, 60), 4.0)
    depth[..., 25:40, 25:40] = 2.0
    wide = camera(40.0, 29.5, 29.5)
    at = np.roll([0.605, 0.0, 0.0], axis)
    hidden = g.occluded_in_right(depth, rays_of(depth, wide, wide, T_of(at)), (60, 60))[0, 0]
    row = hidden[30] if axis == 0 else hidden[:, 30]
    assert row.nonzero()[:, 0].tolist() == list(range(19, 25))


@pytest.mark.parametrize(("ratio", "hides"), [(1.045, False), (1.06, True)])
def test_only_a_depth_nearer_by_more_than_a_margin_hides(ratio, hides):
    depth = torch.full((1, 1, 20, 40), 2.0)
    depth[..., 20:] = 2.0 / ratio
    wide, aside = (camera(400.0, cx, 9.5) for cx in (19.5, 61.5))
    found = g.occluded_in_right(depth, rays_of(depth, wide, aside, T_of((0.2, 0, 0))), (20, 40))
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


F, B, Z = 40.0, 0.12, 2.0
CAMERA = Camera(np.array([[F, 0, 15.5], [0, F, 11.5], [0, 0, 1]]), SIZE[::-1])


def rig(x=0.0, y=0.0, z=0.0):
    E = np.eye(4)
    E[:3, 3] = x, y, z
    return np.linalg.inv(E)


def rays_of_of_conventions(depth_m, T, right=CAMERA):
    return g.plane_rays(depth_m, [CAMERA], [right], [T])


def uv_of_of_conventions(T, depth=Z, right=CAMERA):
    depth_m = torch.full((1, 1, *SIZE), depth)
    return g.project_rays(depth_m, rays_of_of_conventions(depth_m, T, right))


def test_convention_camera_frame_is_x_right_y_down_z_forward():
    points = Z * CAMERA.rays(np.stack(np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0])), -1))
    assert points[0, -1, 0] > 0 > points[0, 0, 0]
    assert points[-1, 0, 1] > 0 > points[0, 0, 1]
    assert (points[..., 2] == Z).all() and np.linalg.norm(points[0, 0]) > Z  # z is not the length of the ray


def test_convention_integer_pixel_is_the_centre_of_a_pixel():
    image = torch.arange(12.0).view(1, 1, 3, 4)
    assert g.sample_at(image, torch.tensor([[[[0.0, 0.0]]]])).item() == 0.0
    assert g.sample_at(image, torch.tensor([[[[3.0, 2.0]]]])).item() == 11.0
    assert g.sample_at(image, torch.tensor([[[[0.5, 0.0]]]])).item() == pytest.approx(0.5)


def test_convention_intrinsics_follow_a_resize_with_the_half_pixel_shift():
    K_640 = np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]])
    K_320 = Camera(K_640, (640, 480)).resized((320, 240)).K
    assert K_320.tolist() == [[250.0, 0.0, 159.5], [0.0, 250.0, 119.5], [0, 0, 1]]


def test_convention_E_is_camera_to_world_and_T_maps_left_points_to_the_right_frame():
    assert rig(x=B)[0, 3] == pytest.approx(-B)
    assert rig(x=B) @ [B, 0.0, 0.0, 1.0] == pytest.approx([0.0, 0.0, 0.0, 1.0])


def test_convention_right_camera_at_plus_x_sees_content_shifted_left_by_f_b_over_z():
    uv, _ = uv_of_of_conventions(rig(x=B))
    u = torch.arange(SIZE[1], dtype=torch.float32).expand(SIZE)
    torch.testing.assert_close(uv[0, ..., 0], u - F * B / Z)
    # the same, seen in images: the left image's content lies f * b / z = 2.4 px further left in the right one
    columns = torch.arange(SIZE[1], dtype=torch.float32).view(1, 1, 1, -1).expand(1, 1, *SIZE)
    depth_m = torch.full((1, 1, *SIZE), Z)
    warped = g.warp_right_to_left(columns, depth_m, rays_of_of_conventions(depth_m, rig(x=B)))
    assert warped.image[0, 0, 5, 20].item() == pytest.approx(20 - 2.4, abs=1e-4)
    assert not warped.visible[..., :2].any() and warped.visible[..., 3:].all()


def test_convention_right_camera_ahead_sees_nearer_points():
    _, z = uv_of_of_conventions(rig(z=0.5))
    assert (z == Z - 0.5).all()
    below, _ = uv_of_of_conventions(rig(y=B))  # and a right camera below sees content shifted up
    assert below[0, 10, 5, 1].item() == pytest.approx(10 - F * B / Z, abs=1e-4)


def test_convention_doffs_is_the_difference_of_principal_points():
    doffs = 3.0
    uv, _ = uv_of_of_conventions(rig(x=B), right=CAMERA.cropped((-3, 0, 32, 24)))
    disparity = 20 - uv[0, 5, 20, 0].item()
    assert F * B / (disparity + doffs) == pytest.approx(Z, rel=1e-5)


def test_convention_tuple_is_left_and_right_and_poses_are_camera_to_world():
    K_left, K_right, E_left, E_right = CAMERA.K, CAMERA.K.copy(), np.eye(4), np.eye(4)
    K_right[0, 2] += 3.0
    E_left[:3, 3], E_right[:3, 3] = (1.0, -2.0, 0.5), (1.0 + B, -2.0, 0.5)
    right = np.zeros((*(2 * side for side in SIZE), 3), np.float32)
    (rig,) = GeometryGuidance(right, (K_left, K_right), (E_left, E_right), cropped=True).rigs
    assert rig.K_right[0, 2] - rig.K_left[0, 2] == pytest.approx(3.0)
    assert (rig.E[0, 3], rig.T_right_from_left[0, 3]) == pytest.approx((B, -B), abs=1e-6)


def test_convention_masks_are_boolean_and_nothing_is_nan():
    depth_m = torch.full((1, 1, *SIZE), Z)
    depth_m[..., :4] = 0.01  # leaves the right image
    rays = rays_of_of_conventions(depth_m, rig(x=B, z=0.5))
    warped = g.warp_right_to_left(torch.rand(1, 3, *SIZE), depth_m, rays)
    uv, z_right = g.project_rays(depth_m, rays)
    assert warped.visible.dtype == torch.bool and 0 < warped.visible.float().mean() < 1
    assert all(torch.isfinite(values).all() for values in (warped.image, uv, z_right))


def test_convention_one_entry_an_image_and_networks_in_bfloat16_with_metres_in_float32(
    make_pipeline, textured_plane
):
    plane, pipe = textured_plane, enable_geometry_guidance(make_pipeline().to(torch.bfloat16))
    guidance = GeometryGuidance([plane.right] * 2, [plane.K] * 2, [plane.E] * 2, guidance_steps=1)
    out = pipe([plane.left] * 2, guidance=guidance, num_inference_steps=1, output_type="pt")
    assert pipe.unet.dtype == torch.bfloat16 and out.prediction.shape[0] == 2
    made = [out.prediction, out.scale, out.shift, out.global_scale]
    made += [values for report in out.history for values in (report.loss, report.s_hat, report.g_s)]
    assert {values.dtype for values in made} == {torch.float32}
