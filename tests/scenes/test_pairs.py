"""Stereo pairs: geometry, masks, and photo-consistency under warping."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from geodiff_plugin.cameras import Camera
from geodiff_plugin.geometry import plane_rays, warp_right_to_left
from tests.scenes import CameraEffects, Material, render_mono, render_pair
from tests.scenes.cameras import intrinsics

pytestmark = pytest.mark.end_to_end

SIZE = (72, 96)


def warped(pair):
    """The right image on the left grid, by the exact depth, and where it should agree."""
    depth = pair.left.depth_m.clamp(max=1e4)[None]
    cameras = (Camera(K.numpy()) for K in (pair.K_left, pair.K_right))
    rays = plane_rays(depth, *([camera] for camera in cameras), [np.linalg.inv(pair.E)])
    w = warp_right_to_left(pair.right.image_01[None], depth, rays)
    seen = pair.in_view & ~pair.occluded & pair.left.valid & w.visible[0]
    seen &= pair.left.material == int(Material.DIFFUSE)
    return w.image[0], seen


def interior(pair, seen):
    """Pixels away from outlines, where both images are smooth enough to be resampled."""
    inverse = torch.where(pair.left.valid, 1 / pair.left.depth_m, 0.0)[None]
    spread = torch.nn.functional.max_pool2d(inverse, 3, 1, 1) + torch.nn.functional.max_pool2d(
        -inverse, 3, 1, 1
    )
    return seen & (spread[0] < 0.15 * inverse[0])


@pytest.mark.parametrize(
    "how", [{}, {"rotation_deg": 6.0}, {"posed": True}], ids=["rectified", "rotated", "posed"]
)
@pytest.mark.parametrize("kind", ["room", "street", "tabletop"])
def test_exact_depth_makes_the_views_agree(kind, how):
    pair = render_pair(11, kind, SIZE, exposure=False, **how)
    image, seen = warped(pair)
    seen = interior(pair, seen)
    assert seen.float().mean() > 0.1
    error = (image - pair.left.image_01).abs().mean(0, keepdim=True)[seen].mean()
    assert error < 0.02
    # The images differ a lot without the warp, so the test has teeth.
    unwarped = (pair.right.image_01 - pair.left.image_01).abs().mean(0, keepdim=True)[seen].mean()
    assert error < 0.5 * unwarped


def test_occluded_pixels_disagree_more():
    pair = render_pair(21, "tabletop", SIZE, exposure=False)
    image, seen = warped(pair)
    error = (image - pair.left.image_01).abs().mean(0, keepdim=True)
    hidden = pair.occluded & pair.in_view & pair.left.valid
    assert hidden.sum() > 100
    assert error[hidden].mean() > 4 * error[interior(pair, seen)].mean()


def test_rectified_shift_is_focal_times_baseline_over_depth():
    pair = render_pair(4, "corridor", SIZE)
    assert torch.equal(pair.E[:3, :3], torch.eye(3, dtype=torch.float64))
    assert pair.E[0, 3] > 0
    assert torch.equal(pair.E[1:3, 3], torch.zeros(2, dtype=torch.float64))
    # Depth of a matched pixel is the same in both views.
    shift = pair.K_left[0, 0] * pair.E[0, 3] / pair.left.depth_m
    v, u = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    column = (u - shift[0]).round().long()
    ok = (~pair.occluded & pair.in_view)[0] & (column >= 0) & (column < SIZE[1])
    right = pair.right.depth_m[0][v, column.clamp(0, SIZE[1] - 1)]
    ratio = right / pair.left.depth_m[0]
    assert ((ratio[ok] - 1).abs() < 0.05).float().mean() > 0.95


def test_in_view_is_the_projection():
    pair = render_pair(7, "room", SIZE, posed=True)
    v, u = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    p = torch.linalg.inv(pair.K_left) @ torch.stack([u, v, torch.ones_like(u)]).double().reshape(3, -1)
    p = p * pair.left.depth_m.reshape(1, -1).double()
    q = torch.linalg.inv(pair.E) @ torch.cat([p, torch.ones_like(p[:1])])
    uv = pair.K_right @ q[:3]
    uv = uv[:2] / uv[2]
    inside = (uv[0] > -0.5) & (uv[0] < SIZE[1] - 0.5) & (uv[1] > -0.5) & (uv[1] < SIZE[0] - 0.5) & (q[2] > 0)
    assert torch.equal(inside.reshape(1, *SIZE), pair.in_view)


def test_posed_pairs_have_general_poses():
    poses = [render_pair(seed, "room", (16, 24), posed=True).E for seed in range(3)]
    for E in poses:
        R = E[:3, :3]
        torch.testing.assert_close(R @ R.t(), torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)
        angle = torch.rad2deg(torch.arccos(((R.trace() - 1) / 2).clamp(-1, 1)))
        assert 0.1 < angle < 18
        assert (E[:3, 3] != 0).all()
    turned = render_pair(0, "room", (16, 24), rotation_deg=5.0).E[:3, :3]
    assert torch.rad2deg(torch.arccos((turned.trace() - 1) / 2)) == pytest.approx(5.0, abs=1e-6)


def test_given_pose_and_cameras_are_used():
    E = np.eye(4)
    E[:3, 3] = 0.05, -0.02, 0.03
    K_right = intrinsics((40, 50), 70.0)
    pair = render_pair(3, "room", (48, 64), E=E, K_right=K_right, size_right=(40, 50))
    np.testing.assert_array_equal(pair.E.numpy(), E)
    assert torch.equal(pair.K_right, K_right)
    assert pair.right.image_01.shape == (3, 40, 50)
    assert pair.left.depth_m.shape == pair.occluded.shape == pair.in_view.shape == (1, 48, 64)


def test_baseline_is_as_asked_or_suits_the_kind():
    assert render_pair(0, "street", (16, 24)).E[0, 3] == pytest.approx(0.54)
    assert 0.05 < render_pair(0, "room", (16, 24)).E[0, 3] < 0.21
    assert render_pair(0, "room", (16, 24), baseline_m=0.1).E[0, 3] == pytest.approx(0.1)


def test_exposure_differs_only_on_request():
    same = render_pair(5, "room", (48, 64), exposure=False)
    other = render_pair(5, "room", (48, 64), exposure=True)
    assert torch.equal(same.left.image_01, other.left.image_01)
    assert (same.right.image_01 - other.right.image_01).abs().mean() > 2e-3


def test_effects_on_pairs():
    clean = render_pair(5, "room", (48, 64))
    drawn = render_pair(5, "room", (48, 64), effects=True)
    assert not torch.equal(clean.left.image_01, drawn.left.image_01)
    given = render_pair(5, "room", (48, 64), effects=(CameraEffects(), CameraEffects(saturation=0.0)))
    torch.testing.assert_close(given.left.image_01, clean.left.image_01)
    torch.testing.assert_close(given.right.image_01[0], given.right.image_01[1])
    assert torch.equal(drawn.left.depth_m, clean.left.depth_m)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="baseline_m"):
        render_pair(0, baseline_m=-0.1)
    with pytest.raises(ValueError, match="E must be"):
        render_pair(0, E=np.eye(3))
    with pytest.raises(ValueError, match="kind must be one of room, street"):
        render_pair(0, "moon")
    with pytest.raises(ValueError, match="seed"):
        render_pair(-1)
    with pytest.raises(ValueError, match="seeds"):
        render_mono([])


def test_training_batches_are_seeded_and_shaped():
    images, depth = render_mono([1, 2, 3], (30, 44))
    assert images.shape == (3, 3, 30, 44)
    assert depth.shape == (3, 1, 30, 44)
    assert images.dtype == depth.dtype == torch.float32
    assert images.min() >= 0
    assert images.max() <= 1
    again, same = render_mono([2], (30, 44))
    torch.testing.assert_close(same[0], depth[1], rtol=1e-5, atol=1e-5)
    assert ((again[0] - images[1]).abs() < 0.02).float().mean() > 0.99
    plain, _ = render_mono([1], (30, 44), augment=False)
    assert not torch.equal(plain[0], images[0])
    tall, _ = render_mono([4], (48, 32), kind="street")
    assert tall.shape == (1, 3, 48, 32)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("kind", ["room", "street"])
def test_gpu_and_cpu_agree(kind):
    here, there = (render_pair(2, kind, SIZE, posed=True, device=d) for d in ("cpu", "cuda"))
    close = (here.left.depth_m / there.left.depth_m.cpu() - 1).abs() < 1e-4
    assert (close | ~here.left.valid).float().mean() > 0.999
    assert ((here.left.image_01 - there.left.image_01.cpu()).abs() < 1e-3).float().mean() > 0.995
    assert torch.equal(here.E, there.E)


def test_a_right_image_of_another_size_has_the_left_camera_at_that_size():
    K = torch.tensor([[100.0, 0.0, 31.5], [0.0, 100.0, 23.5], [0.0, 0.0, 1.0]])
    pair = render_pair(0, "room", (48, 64), K_left=K, size_right=(96, 128))
    # Twice as many pixels; the middle of the image stays its middle.
    twice = torch.tensor([[200.0, 0.0, 63.5], [0.0, 200.0, 47.5], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(pair.K_right, twice.double())
