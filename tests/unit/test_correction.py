"""The edge-aware fit to matches: it stops at edges, and what it is fitted to; its numbers are those of
``tests/parity/test_numpy_references.py``."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin.algorithm.correction import correction_target, off_edges, refine_depth
from geodiff_plugin.matching import Matches

SIZE = (40, 60)
WEAK, STRONG = (torch.full((1, 1, 1, 1), error) for error in (0.3, 0.02))


def _target(depth_m: torch.Tensor, confidence: torch.Tensor) -> Matches:
    return Matches(1.0 / depth_m, confidence, torch.full((len(depth_m),), 1e-3))


def _grey(value: float = 0.5) -> torch.Tensor:
    return torch.full((1, 3, *SIZE), value)


def test_a_correction_spreads_over_its_surface_and_stops_at_an_edge():
    left, truth = _grey(0.2), torch.full((1, 1, *SIZE), 2.0)
    left[..., 30:] = 0.9  # another surface, of which nothing is known
    confidence = torch.zeros_like(truth)
    confidence[..., :, 5:10] = 1.0
    error = torch.full((1, 1, 1, 1), 0.1)
    depth_m, support, _ = refine_depth(1.2 * truth, _target(truth, confidence), left, error)
    own, other = depth_m[..., 10:14], depth_m[..., 31:]
    assert (own / 2.0 - 1.0).abs().max() < 0.09
    assert (other / 2.4 - 1.0).abs().max() < 0.09  # half of what the surface beside it moved by
    assert support[..., 10:14].min() > 0.3
    assert support[..., 31:].max() < 0.1


def test_samples_of_a_batch_do_not_mix_and_any_resolution_comes_back():
    truth = torch.full((2, 1, *SIZE), 3.0)
    confidence = torch.stack([torch.ones(1, *SIZE), torch.zeros(1, *SIZE)])
    depth_m, support, _ = refine_depth(
        torch.full((2, 1, 90, 130), 3.3),
        _target(truth, confidence),
        _grey().expand(2, -1, -1, -1),
        WEAK.expand(2, 1, 1, 1),
    )
    assert depth_m.shape == (2, 1, 90, 130)
    assert depth_m[0].mean() == pytest.approx(3.0, rel=0.01)
    assert depth_m[1].mean() == pytest.approx(3.3, rel=1e-5)


def test_beside_an_edge_of_a_good_map_a_match_counts_for_less():
    depth = torch.full((1, 1, *SIZE), 2.0)
    depth[..., 30:] = 4.0
    target = _target(depth, torch.ones_like(depth))
    doubted = off_edges(target, depth, STRONG).confidence
    assert doubted[..., 29:31].max() < 0.2
    assert doubted[..., :29].min() == doubted[..., 31:].min() == 1.0
    # A map that is wrong by a third does not know where edges are.
    assert off_edges(target, depth, WEAK).confidence.min() > 0.9
    # Nor is a slope an edge.
    slope = torch.linspace(2.0, 4.0, SIZE[1]).expand(1, 1, *SIZE)
    assert off_edges(target, slope, STRONG).confidence.min() > 0.95


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
