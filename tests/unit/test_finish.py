"""The last stage: blurred edges become steep, and matches, colours and a good map decide where they are."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm import finish
from geodiff_plugin.algorithm.finish import sharpen_edges, vote_depth
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.rows import match_rows
from geodiff_plugin.types import CameraView

NEAR, FAR = 2.0, 6.0


def box(height: int = 48, width: int = 64) -> Tensor:
    """A box at 2 m before a wall at 6 m."""
    depth = torch.full((1, 1, height, width), FAR)
    depth[..., height // 4 : 3 * height // 4, width // 4 : 3 * width // 4] = NEAR
    return depth


def blurred(depth_m: Tensor, rounds: int = 1) -> Tensor:
    """Inverse depth under a 3 by 3 box filter, as autoencoders blur what they store."""
    inverse = 1.0 / depth_m
    for _ in range(rounds):
        inverse = F.avg_pool2d(F.pad(inverse, (1,) * 4, mode="replicate"), 3, 1)
    return 1.0 / inverse


def between(depth_m: Tensor) -> float:
    """Share of the pixels that are on neither surface."""
    return float((((depth_m / NEAR - 1).abs() > 0.03) & ((depth_m / FAR - 1).abs() > 0.03)).float().mean())


@pytest.mark.parametrize("contrast", [0.0, 0.5])
@pytest.mark.parametrize("spacing", [1, 3])
def test_blurred_edges_become_steep(contrast, spacing):
    truth = F.interpolate(box(), scale_factor=spacing, mode="nearest")
    soft = 1.0 / F.interpolate(1.0 / blurred(box()), scale_factor=spacing, mode="bilinear")
    picture = (0.2 + contrast * (truth < 4.0)).float().expand(-1, 3, -1, -1)
    sharp = sharpen_edges(soft, picture, spacing)
    assert between(soft) > 0.05 and between(sharp) < 0.25 * between(soft)
    error, before = ((each / truth - 1.0).abs().mean() for each in (sharp, soft))
    assert error < 0.4 * before


@pytest.mark.parametrize("spacing", [1, 4])
def test_planes_thin_posts_and_steep_edges_stay_bit_for_bit(spacing):
    v = torch.arange(96.0).view(1, 1, -1, 1).expand(-1, -1, -1, 80)
    ground = 1.6 * 100.0 / (v + 4.0)  # a camera 1.6 m above it; it changes by a fifth a row at the horizon
    post = torch.full((1, 1, 40, 60), FAR)
    post[..., 28 : 28 + spacing] = NEAR
    for depth_m in (ground, post, F.interpolate(box(), scale_factor=2, mode="nearest")):
        assert torch.equal(sharpen_edges(depth_m, torch.rand(1, 3, *depth_m.shape[-2:]), spacing), depth_m)


def test_sharpening_gives_depths_that_are_there_whatever_the_strips(monkeypatch):
    generator = torch.Generator().manual_seed(1)
    soft = torch.cat([blurred(box(), rounds) for rounds in (1, 2)])
    soft = soft * (1.0 + 0.01 * torch.rand(soft.shape, generator=generator))
    left = torch.rand(2, 3, 48, 64, generator=generator)
    whole = sharpen_edges(soft, left, 2)
    assert not torch.equal(whole, soft) and torch.isin(whole, soft).all()
    monkeypatch.setattr("geodiff_plugin.formats.depth.STRIP_PIXELS", 5 * 64)
    monkeypatch.setattr(finish, "CHUNK", 7)
    assert torch.equal(sharpen_edges(soft, left, 2), whole)


#: Cameras of ``scene``: a shift of 9 px at 2 m, of 3 px at 6 m.
K = torch.tensor([[90.0, 0.0, 47.5], [0.0, 90.0, 35.5], [0.0, 0.0, 1.0]])
BASELINE_M = 0.2


def scene(side: int = 1, doffs: float = 0.0) -> tuple[Tensor, Tensor, CameraView]:
    """Depth ``(1, 1, 72, 96)``, left image and a view to its right (``side`` 1) or left of a textured box."""
    truth = box(72, 96)
    generator = torch.Generator().manual_seed(5)
    wall, front = (0.1 * torch.rand(1, 3, 72, 160, generator=generator) + low for low in (0.1, 0.6))

    def seen(shift_near: int, shift_far: int) -> Tensor:
        columns = torch.arange(96) + 32
        inside = torch.roll(truth, -shift_near, -1) < 4.0
        return torch.where(inside, front[..., columns + shift_near], wall[..., columns + shift_far])

    T = torch.eye(4)
    T[0, 3] = -side * BASELINE_M
    K_right = K.clone()
    K_right[0, 2] -= doffs
    moved = [round(side * shift + doffs) for shift in (9, 3)]
    return truth, seen(0, 0), CameraView(seen(*moved)[0], K_right, T)


def voted(
    map_m: Tensor, left: Tensor, views: list[CameraView], matched_m: Tensor, confidence: float
) -> Tensor:
    target = Matches(1.0 / matched_m, torch.full_like(matched_m, confidence), torch.full((1,), 2e-3))
    return vote_depth(map_m, left, K, views, target, torch.full((1, 1, 1, 1), 0.4))


@pytest.mark.parametrize(("side", "doffs"), [(1, 0.0), (-1, 0.0), (1, 4.0), (-1, 4.0)])
def test_rows_are_matched_whatever_side_and_principal_point_the_view_has(side, doffs):
    truth, left, view = scene(side, doffs)
    found, matched, filled = match_rows(left[0], view, K, 9.0)
    seen, gaps = matched > 0, filled > 0
    right = (found - 18.0 / truth[0, 0]).abs()[seen] < 0.5
    assert seen.float().mean() > 0.6 and right.float().mean() > 0.9
    assert gaps.any() and not (gaps & seen).any()


def test_a_weak_map_takes_its_edges_from_the_views_and_their_colours(monkeypatch):
    truth, left, view = scene()
    moved = torch.roll(truth, (3, -4), (2, 3))

    def wrong(depth_m: Tensor) -> float:
        """Share of the pixels that both views see that are off by more than 10 %."""
        return float(((depth_m / truth - 1.0).abs() > 0.1)[..., 12:-12].float().mean())

    assert wrong(moved) > 0.05
    assert wrong(voted(moved, left, [view], truth, 0.0)) < 0.4 * wrong(moved)
    assert wrong(voted(moved, left, [view], truth, 0.95)) < 0.12 * wrong(moved)
    turned = view._replace(T_right_from_left=view.T_right_from_left.roll(1, 0))
    for views in ([], [turned], [view._replace(image_01=view.image_01[..., 1:])]):  # none is rectified
        assert voted(moved, left, views, truth, 0.95) is moved
    monkeypatch.setattr(finish, "STRIP", 700)
    monkeypatch.setattr(finish, "MOST_PIXELS", 36 * 48)
    large = voted(truth, left, [view], truth, 0.95)  # which takes its edges from its colours
    assert ((large < 3.5) != (truth < 3.5))[..., 12:-12].float().mean() < 0.02
