"""Kernels that judge matches, against their references: reflections, windows around them, their numbers."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.matching import Matches, known_fraction, reflections, reject_reflections
from geodiff_plugin.matching.matches import HalfOcclusions
from geodiff_plugin.matching.rows import with_occluded
from geodiff_plugin.result.confidence import _features_on_grid
from geodiff_plugin.result.planar import _known_maps
from geodiff_plugin.trust.match_statistics import _of_grid
from tests.kernels.drawn import drawn

SIZES = st.tuples(st.integers(1, 40), st.integers(1, 40))


@pytest.fixture(scope="module", autouse=True)
def small_tiles(device):
    """Tiles of so few rows and columns that a small grid has several down and across."""
    from geodiff_plugin.matching.kernels import windows
    from geodiff_plugin.result.kernels import confidence, planar

    with pytest.MonkeyPatch.context() as patch:
        for module in (windows, planar, confidence):
            patch.setattr(module, "TILE", (16, 32))
        yield


def random_matches(seed: int, batch: int, size: tuple[int, int], device: torch.device) -> Matches:
    """Matches ``(B, 1, h, w)`` of depths around 3 m, a patch of which lies far behind; some at infinity."""
    generator = torch.Generator().manual_seed(seed)

    def rand() -> torch.Tensor:
        return torch.rand(batch, 1, *size, generator=generator)

    inverse = (0.25 + 0.1 * rand()) * (rand() > 0.1)
    inverse[..., : size[0] // 2, : size[1] // 3] *= 0.3
    confidence = torch.where(rand() > 0.3, rand(), 0.0)
    return Matches(*(part.to(device) for part in (inverse, confidence, torch.full((batch,), 0.01))))


@drawn(6)
@given(seed=st.integers(0, 999), batch=st.integers(1, 2), size=SIZES, factor=st.sampled_from([0.0, 0.6, 1.0]))
@example(seed=0, batch=2, size=(31, 37), factor=1.0)
@example(seed=1, batch=2, size=(5, 3), factor=0.0)  # no match counts
def test_what_remains_of_reflections(device, seed, batch, size, factor):
    found = random_matches(seed, batch, size, device)
    found = Matches(found.inverse_depth, factor * found.confidence, found.plane_step)
    depth_m = 2.8 + 0.4 * torch.rand(batch, 1, *size, generator=torch.Generator().manual_seed(seed))
    fraction = reject_reflections(found, depth_m.to(device))
    with without_kernels():
        expected = reject_reflections(found, depth_m.to(device))
    torch.testing.assert_close(fraction, expected, rtol=1e-5, atol=1e-5)


def test_a_reflection_is_rejected_by_the_kernel_as_well(device):
    size = 30, 45
    inverse = torch.full((2, 1, *size), 0.3, device=device)
    inverse[1, :, 10:22, 12:27] = 0.1
    of_both = Matches(inverse, torch.full_like(inverse, 0.9), torch.full((2,), 0.01, device=device))
    fraction = reject_reflections(of_both, torch.full_like(inverse, 1.0 / 0.3))
    assert (fraction[0] == 1.0).all() and fraction[1, 0, 15, 20] == 0.0 and fraction[1, 0, 0, 0] == 1.0


@drawn(8)
@given(seed=st.integers(0, 999), size=SIZES, least=st.sampled_from([0.0, 0.5, 0.97, 1.0]))
@example(seed=0, size=(31, 37), least=0.5)
@example(seed=1, size=(4, 5), least=1.0)  # no match
@example(seed=2, size=(1, 1), least=0.0)
@example(seed=14, size=(1, 1), least=0.0)  # matches at infinity, none in front
@example(seed=1, size=(2, 2), least=0.0)
def test_numbers_of_matches(device, seed, size, least):
    found = random_matches(seed, 1, size, device)
    confidence = torch.where(found.confidence >= least, found.confidence, 0.0)
    of_image = Matches(found.inverse_depth[0], confidence[0], found.plane_step[0])
    depth_m = 2.8 + 0.4 * torch.rand(1, *size, generator=torch.Generator().manual_seed(seed))
    numbers = _of_grid(of_image, depth_m.to(device))
    with without_kernels():
        expected = _of_grid(of_image, depth_m.to(device))
    assert numbers.keys() == expected.keys()
    for name, value in expected.items():
        exactly = name in ("matched", "in_front", "compared")
        assert float(numbers[name]) == pytest.approx(
            float(value), rel=0.0 if exactly else 1e-5, abs=0.0 if exactly else 1e-6, nan_ok=True
        ), name


def test_more_values_than_are_sorted_are_left_to_the_reference(device, monkeypatch):
    found, depth_m = random_matches(0, 1, (9, 8), device), torch.full((1, 1, 9, 8), 3.0, device=device)
    monkeypatch.setattr(reflections, "MAX_SORTED", 72)
    monkeypatch.setattr("geodiff_plugin.trust.match_statistics.MAX_SORTED", 36)
    of_image = Matches(found.inverse_depth[0], found.confidence[0], found.plane_step[0])
    both = []
    for off in (False, True):
        with without_kernels(off):
            numbers = _of_grid(of_image, depth_m[0])
            both.append((reject_reflections(found, depth_m), *(float(each) for each in numbers.values())))
    assert torch.equal(both[0][0], both[1][0])
    assert all(math.isclose(one, other) for one, other in zip(both[0][1:], both[1][1:], strict=True))


def with_deviation(found: Matches, seed: int) -> Matches:
    """Matches that deviate by half a plane to four; some are known points."""
    size, generator = found.confidence.shape, torch.Generator().manual_seed(seed)
    deviation = 0.3 + 4.0 * torch.rand(size, generator=generator).to(found.confidence)
    points = 20.0 * (torch.rand(size, generator=generator) > 0.95).to(found.confidence)
    return replace(found, deviation=deviation, confidence=torch.maximum(found.confidence, points))


def assert_same(call) -> None:
    """Every map of kernel and reference within 1e-5 of the largest value."""
    found = call()
    with without_kernels():
        expected = call()
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape == theirs.shape and ours.dtype == theirs.dtype
        assert (ours - theirs).abs().max() <= 1e-5 * theirs.abs().max()


@drawn(2)
@given(seed=st.integers(0, 999), size=SIZES)
@example(seed=0, size=(31, 37))
def test_what_matches_know_around_them(device, seed, size):
    found = with_deviation(random_matches(seed, 2, size, device), seed)
    assert_same(lambda: [known_fraction(found)])


@drawn(2)
@given(seed=st.integers(0, 999), size=SIZES)
@example(seed=0, size=(31, 37))
def test_strips_that_the_right_view_cannot_see(device, seed, size):
    found = with_deviation(random_matches(seed, 1, size, device), seed)
    generator = torch.Generator().manual_seed(seed + 1)
    rows = [torch.rand(1, 1, *size, generator=generator).to(device) for _ in range(2)]
    strips = HalfOcclusions(rows[0] > 0.4, rows[1])

    def filled() -> list[torch.Tensor]:
        kept = with_occluded(found, strips)
        assert kept.deviation is not None
        return [kept.inverse_depth, kept.confidence, kept.deviation]

    assert_same(filled)


@drawn(2)
@given(seed=st.integers(0, 999), size=SIZES)
@example(seed=0, size=(31, 37))
def test_grounds_of_a_depth_and_what_is_known_of_its_shape(device, seed, size):
    found = with_deviation(random_matches(seed, 1, size, device), seed)
    generator = torch.Generator().manual_seed(seed)
    log_depth = (2.8 + 0.4 * torch.rand(1, 1, *size, generator=generator)).log().to(device)
    denoised = log_depth + 0.1 * torch.rand(1, 1, *size, generator=generator).to(device)
    good = torch.full((1, 1, 1, 1), 1.5, device=device)
    assert_same(lambda: _features_on_grid(log_depth, denoised, found).unbind(1))
    assert_same(lambda: _known_maps(found, log_depth, log_depth.mean(), good))
