"""The search for metres, on made-up pairs with a known answer."""

import math

import pytest
import torch

from geodiff_plugin import matching as m
from geodiff_plugin.scale.points import refine_to_matches
from geodiff_plugin.scale.volume_search import search_scale
from geodiff_plugin.types import PosedViews
from tests.benchmarks.matching import textured_pair

#: Of every space: from depth, and back.
SPACES = {
    "depth": (lambda z: z, lambda v: v),
    "disparity": (lambda z: 1 / z, lambda v: 1 / v),
    "log": (torch.log, torch.exp),
    "log1p": (torch.log1p, torch.expm1),
    "sqrt_disparity": (lambda z: z**-0.5, lambda v: v**-2),
}
SIZE = (96, 144)


def relative(depth: torch.Tensor, space: str, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    """The map a perfect prior would give: affine in its space, two quantiles at 0 and 1."""
    value = SPACES[space][0](depth)
    ends = torch.quantile(value.flatten(), torch.tensor([low, high]))
    return ((value - ends[0]) / (ends[1] - ends[0])).clamp(0, 1)[None]


def error_of(
    x: torch.Tensor, near: torch.Tensor, far: torch.Tensor, space: str, depth: torch.Tensor
) -> float:
    """Mean relative error of a map between two ends, written independently of the package."""
    forward, back = SPACES[space]
    at_zero, at_one = (far, near) if "disparity" in space else (near, far)
    value = forward(at_zero) + (forward(at_one) - forward(at_zero)) * x[0]
    return float((back(value) / depth - 1.0).abs().mean())


@pytest.fixture(scope="module")
def scene():
    left, right, K, depth = textured_pair(SIZE)
    return m.build_cost_volume(PosedViews(left, (right,), K)), depth


@pytest.mark.parametrize("space", SPACES)
def test_true_relative_map_gives_the_true_metres(scene, space):
    volume, depth = scene
    x = relative(depth, space)
    near, far, _ = search_scale(volume, x, space)
    assert error_of(x, near, far, space, depth) < 0.03
    assert float(near) == pytest.approx(float(depth.min()), rel=0.05)


@pytest.mark.parametrize(
    ("low", "high", "on_edge"),
    [(0.5, 2.0, False), (1.3, 2.0, True), (0.5, 0.7, True), (None, None, False)],
)
def test_a_search_that_ends_on_either_edge_of_a_given_range_says_so(scene, low, high, on_edge):
    """``low`` is in shares of the nearest depth, ``high`` of the farthest."""
    volume, depth = scene
    bounds = None if low is None else (low * float(depth.min()), high * float(depth.max()))
    found = search_scale(volume, relative(depth, "depth"), "depth", depth_range=bounds)
    assert found.on_edge.tolist() == [on_edge], found


@pytest.mark.parametrize("space", SPACES)
def test_refinement_finds_the_truth_among_outliers(scene, space):
    volume, depth = scene
    x = relative(depth, space, 0.02, 0.98)
    generator = torch.Generator().manual_seed(0)
    wrong = torch.rand(depth.shape, generator=generator) < 0.1
    outlier = volume.inverse_depth[-1] * torch.rand(depth.shape, generator=generator)
    target = torch.where(wrong, outlier, 1 / depth)
    matches = m.Matches(target, torch.ones_like(depth), volume.plane_step / 4)
    ends = torch.quantile(depth.flatten(), torch.tensor([0.02, 0.98]))
    start = (ends[:1] * 1.08, ends[1:] * 0.9)
    refined = refine_to_matches(x, matches, *start, space)
    before, after = (error_of(x, *ends, space, depth) for ends in (start, refined))
    assert after < 0.5 * before and after < 0.06


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_far_matches_does_not_pull_the_far_end_nearer(seed):
    """Half of a street lies within two planes of infinity, where matches err by one."""
    step, generator = torch.tensor(0.004), torch.Generator().manual_seed(seed)
    inverse = step * torch.cat([torch.linspace(0.5, 2.0, 48 * 144), torch.linspace(2.0, 60.0, 48 * 144)])
    noisy = (inverse + step * torch.randn(inverse.shape, generator=generator)).clamp_min(0.0).view(1, *SIZE)
    matches = m.Matches(noisy, torch.full_like(noisy, 0.96), step)
    depth = (1.0 / inverse).view(1, *SIZE)
    nearest, farthest = depth.amin()[None], depth.amax()[None]
    x = relative(depth, "disparity")
    near, far = refine_to_matches(x, matches, nearest * 1.05, farthest * 0.8, "disparity")
    assert float(near) == pytest.approx(float(nearest), rel=0.02)
    assert float(far) == pytest.approx(float(farthest), rel=0.1)


@pytest.mark.parametrize(
    ("start", "reached"),
    [
        ((1.0 * math.exp(1.35), 10.0), (1.0, 10.0)),
        ((1.0 * math.exp(1.5), 10.0), (math.exp(0.1), None)),  # near moves by a log factor of 1.4 at most
        ((0.5 * math.exp(-0.65), 10.0), (1.0, 10.0)),
        ((1.0, 10.0 * math.exp(0.65)), (1.0, 10.0)),
        ((1.0, 10.0 * math.exp(0.9)), (None, 10.0 * math.exp(0.2))),  # far by one of .7
        ((1.0, 10.0 * math.exp(-0.65)), (1.0, 10.0)),
        ((1.0, 10.0 * math.exp(-0.9)), (None, 10.0 * math.exp(-0.2))),
    ],
)
def test_a_fit_moves_near_and_far_as_far_as_its_basin_reaches(start, reached):
    """Exact matches of a map from 1 to 10 m."""
    x = torch.linspace(0.0, 1.0, SIZE[0] * SIZE[1]).view(1, 1, *SIZE)
    depth = 1.0 + 9.0 * x[0]
    matches = m.Matches(1.0 / depth, torch.full_like(depth, 0.99), torch.tensor(0.001))
    found = refine_to_matches(x, matches, *(torch.tensor([end]) for end in start), "depth")
    for end, expected in zip(found, reached, strict=True):
        assert expected is None or float(end) == pytest.approx(expected, rel=0.01)
