"""Stages of the scale by their kernels, in Triton's interpreter, against the same stages without them."""

import pytest
import torch

from geodiff_plugin.matching import Matches
from geodiff_plugin.scale import constants, points, sampling, volume_search
from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.space import MetricMap, smooth_floor
from tests.unit.runtime.triton_interpreter import interpreted
from tests.unit.scale.test_volume_search import Volume, scene

KERNELS = "geodiff_plugin.scale.kernels"


def drawn(*shape: int, seed: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    ("space", "positive"), [("depth", "square"), ("disparity", "softplus"), ("log1p", "softplus")]
)
def test_metric_maps_and_back_are_the_same_by_kernels(space, positive):
    x, metric = 1.3 * drawn(2, 1, 4, 5, seed=1) - 0.15, MetricMap(space, positive)
    state = metric.from_range(torch.tensor([1.3, 0.7]), torch.tensor([8.0, 30.0]))

    def stages() -> list[torch.Tensor]:
        depth_m = metric(x, state)
        return [depth_m, metric.relative(depth_m, state), smooth_floor(x)]

    expected = stages()
    with interpreted(f"{KERNELS}.space") as kernels:
        called = []
        for name in ("metric_depth", "relative", "smooth_floor"):
            run = getattr(kernels, name)
            setattr(kernels, name, lambda *given, name=name, run=run: called.append(name) or run(*given))
        found = stages()
        assert called == ["metric_depth", "relative", "smooth_floor"]
        # A kernel has no gradient, no other type, and no number that maps have in common.
        called.clear()
        with torch.enable_grad():
            wanted = x.clone().requires_grad_()
            assert torch.autograd.grad(metric(wanted, state).sum(), wanted)[0].abs().sum() > 0
            numbers = [state.s_hat.clone().requires_grad_(), state.t_hat, state.g_s]
            metric(x, AffineState(*numbers, state.units)).sum().backward()
            assert (numbers[0].grad != 0).all()
        assert smooth_floor(x.double()).dtype == torch.float64
        first = state.of(slice(0, 1))
        torch.testing.assert_close(metric(x, first)[:1], expected[0][:1])
        torch.testing.assert_close(metric.relative(expected[0], first)[:1], expected[1][:1])
        assert set(called) <= {"smooth_floor"}  # of maps without gradient
    for by_kernel, reference in zip(found, expected, strict=True):
        torch.testing.assert_close(by_kernel, reference, rtol=1e-5, atol=1e-5)


def test_a_fit_to_matches_is_the_same_by_the_kernel(monkeypatch):
    for module in (points, constants):
        monkeypatch.setattr(module, "FIT_ITERATIONS", 2)
    x, space = drawn(2, 1, 5, 6, seed=2), "sqrt_disparity"
    depth = MetricMap(space).from_range(torch.tensor([1.5]), torch.tensor([9.0]))
    target = 1.0 / MetricMap(space)(x[:1], depth)[0]
    matches = Matches(target, drawn(1, 5, 6, seed=3), torch.tensor(0.01))
    ends = torch.tensor([1.7, 1.2]), torch.tensor([8.0, 12.0])
    expected = points.refine_to_matches(x, matches, *ends, space)
    with interpreted(f"{KERNELS}.points"):
        found = points.refine_to_matches(x, matches, *ends, space)
    torch.testing.assert_close(found, expected, rtol=2e-3, atol=0.0)
    assert expected[0][0] != expected[0][1]


@pytest.mark.parametrize(("space", "positive"), [("depth", "softplus"), ("disparity", "square")])
def test_a_basin_is_the_same_by_the_kernel(space, positive, monkeypatch):
    for module in (points, constants):
        monkeypatch.setattr(module, "BASIN_CANDIDATES", 4)
    x, metric = drawn(2, 1, 5, 6, seed=4), MetricMap(space, positive)
    depth = metric(x[:1], metric.from_range(torch.tensor([1.5]), torch.tensor([9.0])))
    known = Matches(1.0 / depth[0], (drawn(1, 5, 6, seed=5) < 0.7).float(), torch.tensor(0.004))
    current = (torch.tensor([1.5, 7.0]), torch.tensor([9.0, 8.0])) if space == "depth" else None
    expected = points.fit_to_points(x, known, metric, current)
    with interpreted(f"{KERNELS}.search"):
        found = points.fit_to_points(x, known, metric, current)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0.0)


def test_a_search_in_a_volume_is_the_same_by_the_kernel(monkeypatch):
    monkeypatch.setattr(sampling, "GROUPS", 9)
    for module in (volume_search, constants):
        monkeypatch.setattr(module, "COARSE_GRID", 4)
        monkeypatch.setattr(module, "FINE_GRIDS", (2,))
    x, depth = scene("disparity")
    volume = Volume(depth)
    volume.levels = torch.from_numpy(volume.cost * 224).to(torch.uint8)
    volume.in_view = torch.from_numpy(volume.seen)
    monkeypatch.setattr(
        volume,
        "at_pixels",
        lambda at: (volume.levels.flatten(1)[:, at].float() / 224, volume.in_view.flatten(1)[:, at]),
        raising=False,
    )
    maps = torch.from_numpy(x).float()[None, None].repeat(2, 1, 1, 1)
    maps[1] = 0.2 + 0.6 * maps[1]
    in_use = torch.tensor([1.8, 1.0]), torch.tensor([11.0, 30.0])
    current = volume_search.DepthRange(*in_use)
    expected = volume_search.search_scale(volume, maps, "disparity", current=current)
    with interpreted(f"{KERNELS}.search"):
        found = volume_search.search_scale(volume, maps, "disparity", current=current)
    torch.testing.assert_close(found[:2], expected[:2], rtol=1e-4, atol=0.0)
    assert expected.near_m[0] != expected.near_m[1]
