"""Every line of docs/reference/conventions.md that can be tested, one test a line."""

import numpy as np
import pytest
import torch
from kornia.geometry.linalg import relative_transformation

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin import geometry as g

F, B, Z = 40.0, 0.12, 2.0
K = torch.tensor([[[F, 0, 15.5], [0, F, 11.5], [0, 0, 1]]])
SIZE = (24, 32)


def rig(x=0.0, y=0.0, z=0.0):
    E = torch.eye(4)[None]
    E[0, :3, 3] = torch.tensor([x, y, z])
    return relative_transformation(E, torch.eye(4)[None])


def uv_of(T, depth=Z, K_right=K):
    return g.project_rays(torch.full((1, 1, *SIZE), depth), g.plane_rays(K, K_right, T, SIZE))


def test_convention_camera_frame_is_x_right_y_down_z_forward():
    points = g.unproject(torch.full((1, 1, *SIZE), Z), K)[0]
    assert points[0, -1, 0] > 0 > points[0, 0, 0]
    assert points[-1, 0, 1] > 0 > points[0, 0, 1]
    assert (points[..., 2] == Z).all() and points[0, 0].norm() > Z  # depth is z, not the length of the ray


def test_convention_integer_pixel_is_the_centre_of_a_pixel():
    image = torch.arange(12.0).view(1, 1, 3, 4)
    assert g.sample_at(image, torch.tensor([[[[0.0, 0.0]]]])).item() == 0.0
    assert g.sample_at(image, torch.tensor([[[[3.0, 2.0]]]])).item() == 11.0
    assert g.sample_at(image, torch.tensor([[[[0.5, 0.0]]]])).item() == pytest.approx(0.5)


def test_convention_intrinsics_follow_a_resize_with_the_half_pixel_shift():
    K_640 = torch.tensor([[[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]]])
    K_320 = g.resize_intrinsics(K_640, (480, 640), (240, 320))
    assert K_320[0, 0].tolist() == [250.0, 0.0, 159.5] and K_320[0, 1].tolist() == [0.0, 250.0, 119.5]


def test_convention_E_is_camera_to_world_and_T_maps_left_points_to_the_right_frame():
    assert rig(x=B)[0, 0, 3].item() == pytest.approx(-B)
    at_right_camera = g.transform(torch.tensor([[[[B, 0.0, 0.0]]]]), rig(x=B))
    assert at_right_camera.abs().max() < 1e-7


def test_convention_right_camera_at_plus_x_sees_content_shifted_left_by_f_b_over_z():
    uv, _ = uv_of(rig(x=B))
    u = torch.arange(SIZE[1], dtype=torch.float32).expand(SIZE)
    torch.testing.assert_close(uv[0, ..., 0], u - F * B / Z)
    # the same, seen in images: the left image's content lies f * b / z = 2.4 px further left in the right one
    columns = torch.arange(SIZE[1], dtype=torch.float32).view(1, 1, 1, -1).expand(1, 1, *SIZE)
    warped = g.warp_right_to_left(columns, torch.full((1, 1, *SIZE), Z), K, K, rig(x=B))
    assert warped.image[0, 0, 5, 20].item() == pytest.approx(20 - 2.4, abs=1e-4)
    assert not warped.visible[..., :2].any() and warped.visible[..., 3:].all()


def test_convention_right_camera_ahead_sees_nearer_points():
    _, z = uv_of(rig(z=0.5))
    assert (z == Z - 0.5).all()
    below, _ = uv_of(rig(y=B))  # and a right camera below sees content shifted up
    assert below[0, 10, 5, 1].item() == pytest.approx(10 - F * B / Z, abs=1e-4)


def test_convention_doffs_is_the_difference_of_principal_points():
    doffs = 3.0
    uv, _ = uv_of(rig(x=B), K_right=K + doffs * torch.tensor([[0, 0, 1], [0, 0, 0], [0, 0, 0]]))
    disparity = 20 - uv[0, 5, 20, 0].item()
    assert F * B / (disparity + doffs) == pytest.approx(Z, rel=1e-5)


def test_convention_tuple_is_left_and_right_and_poses_are_camera_to_world():
    K_left, K_right, E_left, E_right = np.array(K[0]), np.array(K[0]), np.eye(4), np.eye(4)
    K_right[0, 2] += 3.0
    E_left[:3, 3], E_right[:3, 3] = (1.0, -2.0, 0.5), (1.0 + B, -2.0, 0.5)
    right = np.zeros((*(2 * side for side in SIZE), 3), np.float32)
    (rig,) = GeometryGuidance(right, (K_left, K_right), (E_left, E_right), cropped=True).rigs
    assert rig.K_right[0, 2] - rig.K_left[0, 2] == pytest.approx(3.0)
    assert (rig.E[0, 3], rig.T_right_from_left[0, 3]) == pytest.approx((B, -B), abs=1e-6)


def test_convention_masks_are_boolean_and_nothing_is_nan():
    depth_m = torch.full((1, 1, *SIZE), Z)
    depth_m[..., :4] = 0.01  # leaves the right image
    cameras = K, K, rig(x=B, z=0.5)
    warped = g.warp_right_to_left(torch.rand(1, 3, *SIZE), depth_m, *cameras)
    uv, z_right = g.project_rays(depth_m, g.rays_of(depth_m, *cameras))
    assert warped.visible.dtype == torch.bool and 0 < warped.visible.float().mean() < 1
    assert all(torch.isfinite(values).all() for values in (warped.image, uv, z_right))


def test_convention_one_entry_an_image_and_networks_in_bfloat16_with_metres_in_float32(
    make_pipeline, textured_plane
):
    plane, pipe = textured_plane, enable_geometry_guidance(make_pipeline().to(torch.bfloat16))
    guidance = GeometryGuidance([plane.right] * 2, [plane.K] * 2, [plane.E] * 2, inner_steps=1)
    out = pipe([plane.left] * 2, guidance=guidance, num_inference_steps=1, output_type="pt")
    assert pipe.unet.dtype == torch.bfloat16 and out.prediction.shape[0] == 2
    made = [out.prediction, out.scale, out.shift, out.global_scale]
    made += [values for report in out.history for values in (report.loss, report.s_hat, report.g_s)]
    assert {values.dtype for values in made} == {torch.float32}
