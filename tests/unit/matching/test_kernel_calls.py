"""Stages hand their kernels what these need: with stand-ins made of references, all results are the same."""

import inspect
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin import _kernels, matching
from geodiff_plugin._kernels import without_kernels
from geodiff_plugin.matching import aggregation, consistency, matches, rows, sweep
from geodiff_plugin.matching import winner as winners
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.types import PosedViews
from tests.unit.matching import references as ref

SIZE = (17, 26)
K = ref.matrix(30.0, 27.0, 12.0, 9.0)
CAMERAS = [
    (SIZE, ref.right_from_left((0.0, 0.0, 0.0), (0.2, 0.0, 0.0))),
    ((21, 23), ref.right_from_left((3.0, -4.0, 6.0), (-0.15, 0.05, 0.08))),
]


def jump_penalties(grey, axes):
    with without_kernels():
        return aggregation.jump_penalties(grey, axes)


def aggregate(levels, penalties, step, axes):
    assert tuple(axes) == ((1, 0), (0, 1))
    return torch.from_numpy(ref.walked(levels.numpy(), penalties.numpy(), step)).int()


def winner(total, levels, in_view):
    return winners.winner(total.short(), levels, in_view)


def winner_positions(total):
    return winners.winner_positions(total.short())


def looked_up(levels, rows, columns):
    return consistency._looked_up(levels, rows, columns, aggregation.Buffers())


def swept(left, view):
    return sweep._plane_by_plane(left, [view])


def weighed(volume, found, means, others):
    contrast, sharpness = means
    unit = 1 / (4 * 224)
    margin, cost = ((found.runner_up - found.best) * unit).clamp(0, 0.5), (found.best * unit).clamp(0, 0.8)
    confidence = torch.zeros(volume.size)
    for view, other in zip(volume.aligned, others, strict=True):
        apart = consistency._disagreement(view, other, found.position)
        odds = 5.8 + 0.8 * (margin + 0.03).log() - 5.9 * cost - 0.62 * apart.clamp_max(1.5)
        probability = odds.sigmoid() * (contrast / 0.03).clamp_max(1)
        confidence = torch.maximum(confidence, torch.where(apart <= 1.5, probability, 0.0))
    deviation = ((1 - confidence) / 0.04).sqrt() * (0.1 / sharpness.clamp_min(0.001)).clamp_min(1)
    inverse_depth = volume.inverse_depth[0] + found.position * volume.plane_step
    return torch.stack([confidence, deviation, inverse_depth])


def reject_reflections(matches, depth_m, radius):
    assert radius == round(0.08 * max(depth_m.shape[-2:]))
    with without_kernels():
        return matching.reject_reflections(matches, depth_m)


def known_share(deviation, confidence):
    with without_kernels():
        return consistency.known_share(Matches(confidence, confidence, torch.tensor(0.1), deviation))


def with_hidden(matches, deviation, strips):
    with without_kernels():
        found = rows.with_hidden(replace(matches, deviation=deviation), strips)
    return found.inverse_depth, found.confidence, found.deviation


STAND_INS = {
    "kernels": (jump_penalties, aggregate, winner, winner_positions, looked_up, swept, weighed),
    "reflection_kernels": (reject_reflections,),
    "window_kernels": (known_share, with_hidden),
}


@pytest.fixture
def called(monkeypatch) -> list[str]:
    """Kernels run on the CPU, and are stand-ins whose names are noted."""
    names = []

    def noted(function):
        def call(*given):
            names.append(function.__name__)
            return function(*given)

        return call

    monkeypatch.setattr(_kernels, "has_triton", lambda: True)
    monkeypatch.setattr(_kernels, "interpreting", lambda: True)
    for module, functions in STAND_INS.items():
        stand_in = SimpleNamespace(**{function.__name__: noted(function) for function in functions})
        monkeypatch.setattr(matching, module, stand_in, raising=False)
    return names


def test_stand_ins_have_the_parameters_of_the_kernels():
    pytest.importorskip("triton", reason="Triton is for Linux")
    for module, functions in STAND_INS.items():
        kernels = pytest.importorskip(f"geodiff_plugin.matching.{module}")
        for function in functions:
            expected = inspect.signature(getattr(kernels, function.__name__)).parameters
            assert list(inspect.signature(function).parameters) == list(expected)


@pytest.mark.parametrize("which", [(0,), (1,), (0, 1)])
def test_a_sweep_and_its_matches_are_the_same_by_kernels(called, which):
    rng = np.random.default_rng(0)
    views = tuple(ref.view_of(rng.random(CAMERAS[v][0]), K, CAMERAS[v][1]) for v in which)
    left, planes = torch.from_numpy(rng.random((1, *SIZE))).float(), torch.linspace(0.1, 1.0, 12)
    posed = PosedViews(left, views, torch.from_numpy(K).float())
    found = sweep.sweep_planes(posed, planes)
    by_kernels = consistency.match_volume(found)
    assert set(called) == {function.__name__ for function in STAND_INS["kernels"]}
    with without_kernels():
        volume = sweep.sweep_planes(posed, planes)
        expected = consistency.match_volume(volume)
    assert torch.equal(found.levels, volume.levels) and torch.equal(found.in_view, volume.in_view)
    for name in ("inverse_depth", "confidence", "deviation", "plane_step"):
        ours, theirs = getattr(by_kernels, name), getattr(expected, name)
        assert ours.shape == theirs.shape
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)
    assert (expected.confidence > 0).any()


@pytest.mark.parametrize("deviates", [True, False])
def test_reflections_and_windows_are_the_same_by_kernels(called, monkeypatch, deviates):
    rng = np.random.default_rng(1)
    maps = torch.from_numpy(rng.random((5, 1, 1, 25, 38))).float()
    inverse, confidence, deviation, inside, strip = maps
    given = Matches(inverse, confidence, torch.tensor([0.01]), 1 + deviation if deviates else None)
    strips = rows.HiddenStrips(inside > 0.5, strip)
    depth_m = 1 / inverse.roll(3, -1)

    def results() -> list[torch.Tensor | None]:
        hidden = rows.with_hidden(given, strips)
        maps = [hidden.inverse_depth, hidden.confidence, hidden.deviation]
        return [matches.reject_reflections(given, depth_m), consistency.known_share(given), *maps]

    found = results()
    assert set(called) == {"reject_reflections", *(("with_hidden", "known_share") if deviates else ())}
    with without_kernels():
        expected = results()
    for ours, theirs in zip(found, expected, strict=True):
        assert (ours is None) == (theirs is None) and (ours is None or torch.equal(ours, theirs))
    del called[:]
    monkeypatch.setattr(matches, "MOST_SORTED", 25 * 38)  # as many as that are left to the reference
    matches.reject_reflections(given, depth_m)
    assert not called
