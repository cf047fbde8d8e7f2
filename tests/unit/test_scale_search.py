"""The search for metres: on made-up pairs with a known answer, and (slow) on real ones."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin import matching as m
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.points import fit_to_points, refine_to_matches, reliable_matches
from geodiff_plugin.scale.space import MetricMap
from geodiff_plugin.scale.volume_search import search_scale
from tests.benchmarks.matching import textured_pair

SPACES = {
    "depth": lambda z: z,
    "disparity": lambda z: 1 / z,
    "log": torch.log,
    "log1p": torch.log1p,
    "sqrt_disparity": lambda z: z**-0.5,
}
NEAR_IS_ONE = ("disparity", "sqrt_disparity")
SIZE = (96, 144)


def relative(depth: torch.Tensor, space: str, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    """The map a perfect prior would give: affine in its space, two quantiles at 0 and 1."""
    value = SPACES[space](depth)
    ends = torch.quantile(value.flatten()[:: max(1, value.numel() // 100_000)], torch.tensor([low, high]))
    return ((value - ends[0]) / (ends[1] - ends[0])).clamp(0, 1)[None]


def metres(x: torch.Tensor, near: float, far: float, space: str) -> torch.Tensor:
    """Depth of a relative map between two ends, written independently of the package."""
    to = SPACES[space]
    at_zero, at_one = (far, near) if space in NEAR_IS_ONE else (near, far)
    value = to(torch.tensor(at_zero)) + (to(torch.tensor(at_one)) - to(torch.tensor(at_zero))) * x
    back = {
        "depth": lambda v: v,
        "disparity": lambda v: 1 / v,
        "log": torch.exp,
        "log1p": torch.expm1,
        "sqrt_disparity": lambda v: v**-2,
    }
    return back[space](value)


@pytest.fixture(scope="module")
def scene():
    left, right, K, depth = textured_pair(SIZE)
    return m.build_cost_volume(left, [right], K), depth


@pytest.mark.parametrize("space", SPACES)
def test_true_relative_map_gives_the_true_metres(scene, space):
    volume, depth = scene
    x = relative(depth, space)
    found = search_scale(volume, x, space)
    estimate = metres(x[0], float(found.near_m), float(found.far_m), space)
    assert ((estimate - depth).abs() / depth).mean() < 0.03
    assert float(found.near_m) == pytest.approx(float(depth.min()), rel=0.05)
    assert found.near_m.shape == found.far_m.shape == found.cost.shape == found.on_edge.shape == (1,)
    assert 0 <= found.cost < 0.15


@pytest.mark.parametrize("space", ["depth", "disparity"])
def test_current_state_stays_unless_something_better_shows_up(scene, space):
    volume, depth = scene
    x = relative(depth, space)
    found = search_scale(volume, x, space)
    ends = (found.near_m, found.far_m)
    again = search_scale(volume, x, space, current=ends)
    assert torch.equal(again.near_m, found.near_m) and torch.equal(again.far_m, found.far_m)
    wrong = search_scale(volume, x, space, current=tuple(3.0 * end for end in ends))
    assert float(wrong.near_m) == pytest.approx(float(found.near_m), rel=1e-4)


@pytest.mark.parametrize("space", SPACES)
def test_refinement_finds_the_truth_among_outliers(scene, space):
    volume, depth = scene
    x = relative(depth, space, 0.02, 0.98)
    generator = torch.Generator().manual_seed(0)
    target = 1 / depth
    wrong = torch.rand(depth.shape, generator=generator) < 0.1
    span = volume.inverse_depth[-1]
    target = torch.where(wrong, span * torch.rand(depth.shape, generator=generator), target)
    matches = m.Matches(target, torch.ones_like(depth), volume.plane_step / 4)
    ends = torch.quantile(depth.flatten(), torch.tensor([0.02, 0.98]))
    start = (ends[:1] * 1.08, ends[1:] * 0.9)
    before = metres(x[0], float(start[0]), float(start[1]), space)
    near, far = refine_to_matches(x, matches, *start, space)
    after = metres(x[0], float(near), float(far), space)
    error_before, error_after = (float(((d - depth).abs() / depth).mean()) for d in (before, after))
    assert error_after < 0.5 * error_before and error_after < 0.06


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_far_matches_does_not_pull_the_far_end_nearer(scene, seed):
    """Half of a street lies within two planes of infinity, where matches err by one."""
    volume, _ = scene
    step = torch.tensor(0.004)
    generator = torch.Generator().manual_seed(seed)
    inverse = step * torch.cat([torch.linspace(0.5, 2.0, 48 * 144), torch.linspace(2.0, 60.0, 48 * 144)])
    noisy = (inverse + step * torch.randn(inverse.shape, generator=generator)).clamp_min(0.0).view(1, *SIZE)
    matches = m.Matches(noisy, torch.full_like(noisy, 0.96), step)
    depth = (1.0 / inverse).view(1, *SIZE)
    true = (depth.amin()[None], depth.amax()[None])
    near, far = refine_to_matches(
        relative(depth, "disparity"), matches, true[0] * 1.05, true[1] * 0.8, "disparity"
    )
    assert float(near) == pytest.approx(float(true[0]), rel=0.02)
    assert float(far) == pytest.approx(float(true[1]), rel=0.1)


STREET = (40, 60)


def matches_of(depth_m: torch.Tensor, confidence: float = 0.9) -> Matches:
    inverse = 1.0 / depth_m
    return Matches(inverse, torch.full_like(inverse, confidence), torch.tensor(2e-3))


@pytest.fixture
def street():
    """Metres of a road, and a relative map of it that errs by 15 %."""
    x = torch.linspace(0.0, 1.0, STREET[0]).view(1, -1, 1).expand(1, *STREET)
    depth_m = 1.0 / (1 / 80 + (1 / 6 - 1 / 80) * x)
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    return depth_m, (x * torch.exp(0.15 * noise)).clamp(0, 1)[None]


def test_a_wrong_basin_is_left_and_a_right_one_kept(street):
    depth_m, x = street
    reliable = reliable_matches(matches_of(depth_m))
    metric = MetricMap("disparity")
    wrong = (torch.tensor([42.0]), torch.tensor([84.0]))
    near, far = fit_to_points(x, reliable, metric, wrong)
    assert near.item() == pytest.approx(6.0, rel=0.3) and far.item() > 40.0
    kept = fit_to_points(x, reliable, metric, (torch.tensor([6.0]), torch.tensor([80.0])))
    assert [v.item() for v in kept] == pytest.approx([6.0, 80.0])
