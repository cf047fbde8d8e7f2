"""Analytic gradients of the geometry against finite differences, float64."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.geometry.linalg import relative_transformation
from torch.autograd import gradcheck

from geodiff_plugin import geometry as g

SIZE = (4, 5)
POSES = {
    "shift": (0.0, (0.13, 0.0, 0.0)),
    "turned": (0.12, (0.1, -0.07, 0.05)),
    "half turn about z": (math.pi, (0.05, 0.02, -0.1)),
}


def make(name, axis=(0.1, 1.0, 0.2)):
    angle, at = POSES[name]
    axis = torch.tensor((0.0, 0.0, 1.0) if name.startswith("half") else axis, dtype=torch.float64)
    x, y, z = axis / axis.norm()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    E = torch.eye(4, dtype=torch.float64)
    E[:3, :3] = torch.eye(3).double() + math.sin(angle) * skew + (1 - math.cos(angle)) * (skew @ skew)
    E[:3, 3] = torch.tensor(at, dtype=torch.float64)
    T = relative_transformation(E[None], torch.eye(4, dtype=torch.float64)[None])
    K_left = torch.tensor([[[5.0, 0, 2.0], [0, 5.2, 1.5], [0, 0, 1]]], dtype=torch.float64)
    K_right = torch.tensor([[[6.1, 0, 2.83], [0, 5.9, 2.21], [0, 0, 1]]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(7)
    depth = 1.0 + torch.rand(1, 1, *SIZE, generator=generator, dtype=torch.float64)
    # the 0.3 px of offset keeps samples off integer pixels, where bilinear sampling has a kink
    K_right[:, :2, 2] += 0.3
    return K_left, K_right, T, depth.requires_grad_()


@pytest.mark.parametrize("name", POSES)
def test_unproject_transform_project(name):
    K_left, K_right, T, depth = make(name)
    assert gradcheck(lambda d: g.unproject(d, K_left), (depth,))
    assert gradcheck(lambda K: g.unproject(depth.detach(), K), (K_left.clone().requires_grad_(),))
    points = g.unproject(depth, K_left).detach().requires_grad_()
    assert gradcheck(lambda p, t: g.transform(p, t), (points, T.clone().requires_grad_()))
    assert gradcheck(lambda p, k: g.project(p, k), (points, K_right.clone().requires_grad_()))
    assert gradcheck(lambda d: g.project_rays(d, g.plane_rays(K_left, K_right, T, SIZE)), (depth,))


@pytest.mark.parametrize("name", POSES)
def test_resized_intrinsics(name):
    assert gradcheck(lambda k: g.resize_intrinsics(k, SIZE, (8, 7)), (make(name)[0].requires_grad_(),))


@pytest.mark.parametrize("name", POSES)
def test_warp_is_differentiable_in_depth_and_image(name):
    K_left, K_right, T, depth = make(name)
    generator = torch.Generator().manual_seed(2)
    right = torch.rand(1, 2, 6, 7, generator=generator, dtype=torch.float64, requires_grad=True)
    warped = g.warp_right_to_left(right, depth, K_left, K_right, T)
    near_kink = (warped.uv - warped.uv.round()).abs().min()
    assert near_kink > 1e-4 and warped.visible.any()

    def image(r, d):
        result = g.warp_right_to_left(r, d, K_left, K_right, T)
        return result.image * result.visible

    assert gradcheck(image, (right, depth), eps=1e-7, atol=1e-5)
    (gradient,) = torch.autograd.grad(image(right, depth).sum(), depth)
    assert torch.isfinite(gradient).all() and (gradient[warped.visible] != 0).all()


def test_sample_at():
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(1, 2, 5, 6, generator=generator, dtype=torch.float64, requires_grad=True)
    uv = torch.tensor([[[[0.3, 1.7], [4.3, 3.6]], [[2.3, 0.4], [1.7, 2.3]]]], dtype=torch.float64)
    assert gradcheck(g.sample_at, (image, uv.requires_grad_()))
