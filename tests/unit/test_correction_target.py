"""What an estimate is fitted to: matches less reflections and less those beside its edges, and points."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin.algorithm.correction import correction_target, refine_depth
from geodiff_plugin.matching import Matches

FINE, COARSE = (24, 32), (12, 16)
ERROR, GREY = torch.full((1, 1, 1, 1), 0.05), torch.full((1, 3, *COARSE), 0.5)
KEPT = torch.ones(1, 1, *COARSE)


def matches_at(depth_m: float, size: tuple[int, int] = COARSE, confidence: float = 1.0) -> Matches:
    inverse = torch.full((1, 1, *size), 1.0 / depth_m)
    return Matches(inverse, torch.full_like(inverse, confidence), torch.tensor([0.01]))


def one_point(depth_m: float) -> Matches:
    points = matches_at(depth_m, confidence=0.0)
    points.confidence[0, 0, 6, 8] = 1.0
    return points


def depth(metres: float) -> torch.Tensor:
    return torch.full((1, 1, *COARSE), metres)


def test_matches_of_images_stack_unless_one_has_none():
    image = Matches(torch.ones(1, 2, 3), torch.ones(1, 2, 3), torch.tensor(0.01))
    stacked = Matches.stack([image, image])
    assert stacked.confidence.shape == (2, 1, 2, 3) and stacked.size == (2, 3)
    assert stacked.plane_step.shape == (2,) and Matches.stack([image, None]) is None


def test_shares_of_one_grid_hold_on_another():
    kept = torch.zeros(1, 1, *COARSE)
    kept[..., :8] = 1.0
    fine = correction_target(matches_at(2.0, FINE), None, kept, None, depth(2.0))
    assert (fine.confidence[..., :14] == 1).all() and (fine.confidence[..., 18:] == 0).all()


def test_no_match_counts_before_the_first_estimate():
    assert correction_target(matches_at(2.0), None, None, None, depth(2.0)) is None
    assert correction_target(None, None, None, ERROR, depth(2.0)) is None
    alone = correction_target(matches_at(2.0), one_point(2.2), None, ERROR, depth(2.0))
    assert int((alone.confidence > 0).sum()) == 1


def test_points_count_in_full_beside_an_edge():
    edge = depth(2.0)
    edge[..., 8:] = 6.0
    beside, away = (
        correction_target(matches_at(2.0), one_point(2.2), KEPT, ERROR, m).confidence[0, 0]
        for m in (edge, depth(2.1))
    )
    assert beside[6, 8] == away[6, 8] and beside[5, 8] < 0.3 * away[5, 8]


def test_an_estimate_is_fitted_to_matches_and_points():
    target = correction_target(matches_at(2.0), one_point(2.2), KEPT, ERROR, depth(2.1))
    assert float(target.inverse_depth[0, 0, 6, 8]) == pytest.approx(1 / 2.2)
    depth_m, support, _ = refine_depth(depth(2.1), target, GREY, ERROR)
    assert float(depth_m.median()) == pytest.approx(2.0, rel=0.1) and (support > 0.8).all()
