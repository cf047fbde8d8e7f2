"""Our warp against kornia's one-call warp, for equal intrinsics and size."""

import math

import pytest
import torch
from kornia.geometry.depth import warp_frame_depth

from geodiff_plugin import geometry as g


@pytest.mark.parametrize("angle", [0.0, 0.08])
@pytest.mark.parametrize("at", [(0.2, 0.0, 0.0), (-0.1, 0.15, 0.3)])
def test_warp_equals_kornia(angle, at):
    generator = torch.Generator().manual_seed(0)
    right = torch.rand(2, 3, 20, 28, generator=generator, dtype=torch.float64)
    depth = 1.5 + torch.rand(2, 1, 20, 28, generator=generator, dtype=torch.float64)
    K = torch.tensor([[25.0, 0, 13.2], [0, 26.0, 9.7], [0, 0, 1]], dtype=torch.float64).expand(2, 3, 3)
    T = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    T[:, 0, 0] = T[:, 2, 2] = math.cos(angle)
    T[:, 0, 2], T[:, 2, 0] = math.sin(angle), -math.sin(angle)
    T[:, :3, 3] = torch.tensor(at, dtype=torch.float64)
    ours = g.warp_right_to_left(right, depth, K, K, T)
    theirs = warp_frame_depth(right, depth, T, K)
    # kornia blends the last hundredth of a pixel before the edge with zeros, where we repeat the edge
    u, v = ours.uv.unbind(-1)
    inside = (u >= 0) & (u <= 27) & (v >= 0) & (v <= 19)
    visible = (ours.visible & inside[:, None]).expand_as(right)
    assert 0.3 < visible.double().mean() < 1.0
    torch.testing.assert_close(ours.image[visible], theirs[visible])
