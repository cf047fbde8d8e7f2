"""The search for the scale: its stages in every case, and ranges that are known beforehand."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin.algorithm import depth_range
from geodiff_plugin.algorithm.depth_range import fit_depth_range, search_one_number, span_of_points
from geodiff_plugin.algorithm.terms import Objective
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.space import DepthRange, MetricMap, smooth_floor
from tests.views import posed_of


def drawn(*shape: int, seed: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def known(depth_m: torch.Tensor, seed: int) -> Matches:
    """A fifth of a map ``(h, w)`` as known points of one image."""
    given = (drawn(1, *depth_m.shape, seed=seed) > 0.8).float()
    return Matches(given / depth_m, given, 0.01 * (1 / depth_m).median())


def evidence_of(points: Matches | None) -> Evidence:
    nothing = posed_of(torch.zeros(3, 4, 4), np.eye(3))
    return Evidence(nothing, nothing, None, None, points)


def test_the_span_of_points_is_that_of_every_sample():
    maps = [drawn(6, 9, seed=k, low=1.0 + k, high=5.0 + 3 * k) for k in range(3)]
    points = [known(depth_m, k) for k, depth_m in enumerate(maps)]
    found = span_of_points([evidence_of(each) for each in points])
    depths = [m[p.confidence[0] > 0] for m, p in zip(maps, points, strict=True)]
    np.testing.assert_allclose(found.near_m, [float(d.min()) for d in depths], rtol=1e-6)
    np.testing.assert_allclose(found.far_m, [float(d.max()) for d in depths], rtol=1e-6)
    assert found.on_edge.tolist() == [False] * 3 and found.on_edge.dtype == torch.bool


@pytest.mark.parametrize("limits", [None, (2.5, 6.0)])
def test_points_alone_give_every_members_own_range(limits):
    """Two members whose maps begin and end elsewhere; a given range bounds both ends."""
    depth_m = drawn(17, 23, seed=1, low=2.0, high=9.0)
    points = known(depth_m, 2)
    inverse, ends = 1.0 / depth_m, [(1.8, 11.0), (1.2, 30.0)]
    maps = torch.stack([(inverse - 1 / far) / (1 / near - 1 / far) for near, far in ends])[:, None]
    config = DEFAULT.changed(depth_range=limits)
    found = fit_depth_range(maps, evidence_of(points), MetricMap("disparity"), config)
    expected = np.array(ends).T
    if limits is not None:
        expected = expected.clip(*limits)
    np.testing.assert_allclose(torch.stack(found[:2]), expected, rtol=0.02)
    assert found.on_edge.tolist() == [False, False]


class Stages:
    """Notes the stages of the search in order, and gives each result another number."""

    def __init__(self, monkeypatch) -> None:
        self.calls: list[tuple] = []
        for name in ("search_scale", "fit_to_points", "refine_to_matches"):
            monkeypatch.setattr(depth_range, name, self.stage(name))

    def stage(self, name):
        def run(*arguments, **options):
            self.calls.append((name, *arguments, *options.items()))
            near = torch.full((2,), float(len(self.calls)))
            ends = near, near + 0.5
            return (*ends, torch.tensor([True, False])) if name == "search_scale" else ends

        return run


X = drawn(2, 1, 5, 6, seed=3)
VALID = drawn(1, 1, 5, 6, seed=4) > 0.5
GIVEN = DepthRange(torch.tensor([7.0, 8.0]), torch.tensor([70.0, 80.0]), torch.tensor([False, True]))


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("current", [None, GIVEN, GIVEN._replace(on_edge=None)])
def test_a_sweep_is_searched_first_and_again_only_without_reliable_matches(monkeypatch, reliable, current):
    """Then reliable matches choose the basin, and the ends are fitted to matches and to points."""
    stages, metric = Stages(monkeypatch), MetricMap("disparity")
    evidence = SimpleNamespace(
        volume="volume", matches="matches", points="points", reliable="reliable" if reliable else None
    )
    found = fit_depth_range(X, evidence, metric, DEFAULT, current, VALID)
    calls, floored = stages.calls, smooth_floor(X)
    searched = not (reliable and current is not None and current.on_edge is not None)
    if searched:
        name, volume, x, space, *options = calls.pop(0)
        assert (name, volume, space) == ("search_scale", "volume", "disparity") and torch.equal(x, floored)
        assert dict(options) == {"depth_range": None, "current": current, "valid": VALID}
        assert found.on_edge.tolist() == [True, False]
    else:
        assert found.on_edge is GIVEN.on_edge
    ends = (1.0, 1.5) if searched else (7.0, 70.0)
    asked = ["matches", "reliable"] * reliable + ["matches", "points"]
    assert len(calls) == len(asked)
    for number, (call, target) in enumerate(zip(calls, asked, strict=True), 1 + searched):
        name, x, at, *rest = call
        basin = target == "reliable"
        assert (name, at) == ("fit_to_points" if basin else "refine_to_matches", target)
        assert torch.equal(x, X if basin else floored)
        near, far = rest[1] if basin else rest[:2]
        assert (near[0], far[0]) == ends and rest[-1 if not basin else 0] in ("disparity", metric)
        ends = (float(number), number + 0.5)
    assert (found.near_m[1], found.far_m[1]) == ends


def test_without_a_sweep_points_are_searched_from_the_current_ends(monkeypatch):
    stages, metric = Stages(monkeypatch), MetricMap("log")
    evidence = SimpleNamespace(volume=None, matches=None, points="points", reliable=None)
    fit_depth_range(X, evidence, metric, DEFAULT)
    fit_depth_range(X, evidence, metric, DEFAULT, GIVEN, VALID)
    first, _, second, _ = stages.calls
    assert first == ("fit_to_points", X, "points", metric, None)
    assert second == ("fit_to_points", X, "points", metric, GIVEN[:2])
    assert [call[0] for call in stages.calls] == ["fit_to_points", "refine_to_matches"] * 2


def test_one_number_is_the_depth_of_a_wall_in_front_of_each_camera():
    """Flat walls at 3 m and 7 m, of two samples; the paper's scale and shift are softplus(0) of a map."""
    generator = torch.Generator().manual_seed(0)
    texture = torch.rand(2, 3, 12, 40, generator=generator)
    texture = torch.nn.functional.interpolate(texture, (24, 160), mode="bicubic").clamp(0, 1)
    K = [[60.0, 0, 24], [0, 60.0, 12], [0, 0, 1]]
    views = []
    for b, (shift, baseline) in enumerate(((10, 0.5), (9, 1.05))):
        T = np.eye(4)
        T[0, 3] = -baseline
        views.append(posed_of(texture[b, ..., 40:88], K, (texture[b, ..., 40 + shift : 88 + shift], K, T)))
    config = DEFAULT.changed(g_s_range=(1.0, 12.0), g_s_candidates=12, weights={"photometric": 1.0})
    objective = Objective(views, MetricMap("depth"), config)
    x = torch.full((2, 1, 24, 48), 1.0 / np.log(2.0) - 1.0)  # log(2) (x + 1) = 1
    affine, on_edge = search_one_number(x.requires_grad_(), objective)
    assert affine.g_s.tolist() == [3.0, 7.0] and on_edge.tolist() == [False, False]
    assert not affine.g_s.requires_grad
    for limits, edges in (((3.0, 14.0), [True, False]), ((1.0, 7.0), [False, True])):
        count = round(limits[1] - limits[0]) + 1
        objective.config = config.changed(g_s_range=limits, g_s_candidates=count)
        assert search_one_number(x, objective)[1].tolist() == edges
