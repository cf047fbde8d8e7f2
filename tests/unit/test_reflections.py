"""Matches behind the prior's surface, over a region and by more than chance, lose their say."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin.matching import Matches, reject_reflections

SIZE = (60, 80)
REGION = (slice(20, 40), slice(30, 60))


def scene(factor: float, scatter: float = 0.02, region=REGION) -> tuple[Matches, torch.Tensor]:
    """A slanted wall, the prior's noisy view of it, and its matches, ``factor`` times as far in a region."""
    generator = torch.Generator().manual_seed(0)
    wall = torch.linspace(2.0, 4.0, SIZE[1]).expand(1, 1, *SIZE)
    matched = wall.clone()
    matched[..., region[0], region[1]] *= factor
    prior = wall * torch.exp(scatter * torch.randn(wall.shape, generator=generator))
    return Matches(1.0 / matched, torch.ones_like(wall), torch.tensor([1e-3])), prior


def inside(kept: torch.Tensor) -> torch.Tensor:
    return kept[..., REGION[0], REGION[1]]


def test_a_reflection_is_not_believed_and_all_else_is():
    kept = reject_reflections(*scene(2.0))
    assert kept.shape == (1, 1, *SIZE)
    assert inside(kept)[..., 5:-5, 5:-5].max() == 0.0
    outside = torch.ones(SIZE, dtype=torch.bool)
    outside[REGION] = False
    assert kept[0, 0][outside].min() == 1.0


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.0, 1.1])
def test_what_is_near_or_before_the_prior_is_believed(factor):
    assert reject_reflections(*scene(factor)).min() == 1.0


def test_a_prior_that_errs_as_much_everywhere_contradicts_nothing():
    kept = reject_reflections(*scene(2.0, scatter=0.4))
    assert inside(kept).mean() > 0.95


def test_a_gap_between_things_is_no_region():
    kept = reject_reflections(*scene(2.0, region=(slice(0, 60), slice(40, 42))))
    assert kept.min() == 1.0


def test_scale_does_not_matter_and_samples_do_not_mix():
    target, prior = scene(2.0)
    other, _ = scene(1.0)
    both = Matches(
        torch.cat([target.inverse_depth / 7.0, other.inverse_depth]),
        torch.cat([target.confidence, other.confidence]),
        torch.tensor([1e-3, 1e-3]),
    )
    kept = reject_reflections(both, torch.cat([7.0 * prior, prior]))
    assert torch.allclose(kept[:1], reject_reflections(target, prior), atol=1e-5)
    assert kept[1].min() == 1.0


def test_without_a_match_there_is_nothing_to_reject():
    target, prior = scene(2.0)
    empty = Matches(target.inverse_depth, torch.zeros_like(target.confidence), target.plane_step)
    assert reject_reflections(empty, prior).min() == 1.0
