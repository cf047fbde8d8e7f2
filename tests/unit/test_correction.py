"""The edge-aware fit to matches: it stops at edges, and what it is fitted to; its numbers are those of
``tests/parity/test_numpy_references.py``."""

import torch

from geodiff_plugin.algorithm.correction import correction_target, off_edges, refine_depth
from geodiff_plugin.matching import Matches

SIZE = (40, 60)
WEAK, STRONG = (torch.full((1, 1, 1, 1), error) for error in (0.3, 0.02))


def matches_at(depth_m: torch.Tensor, confidence: torch.Tensor) -> Matches:
    return Matches(1.0 / depth_m, confidence, torch.full((len(depth_m),), 1e-3))


def grey(value: float = 0.5) -> torch.Tensor:
    return torch.full((1, 3, *SIZE), value)


def test_a_correction_spreads_over_its_surface_and_stops_at_an_edge():
    left, truth = grey(0.2), torch.full((1, 1, *SIZE), 2.0)
    left[..., 30:] = 0.9  # another surface, of which nothing is known
    confidence = torch.zeros_like(truth)
    confidence[..., :, 5:10] = 1.0
    error = torch.full((1, 1, 1, 1), 0.1)
    depth_m, support, _ = refine_depth(1.2 * truth, matches_at(truth, confidence), left, error)
    own, other = depth_m[..., 10:14], depth_m[..., 31:]
    assert (own / 2.0 - 1.0).abs().max() < 0.09
    assert (other / 2.4 - 1.0).abs().max() < 0.09  # half of what the surface beside it moved by
    assert support[..., 10:14].min() > 0.3 and support[..., 31:].max() < 0.1


def test_beside_an_edge_of_a_good_map_a_match_counts_for_less_and_a_point_does_not():
    depth = torch.full((1, 1, *SIZE), 2.0)
    depth[..., 30:] = 4.0
    target, kept = matches_at(depth, torch.ones_like(depth)), torch.ones_like(depth)
    doubted = off_edges(target, depth, STRONG).confidence
    assert doubted[..., 29:31].max() < 0.2
    assert doubted[..., :29].min() == doubted[..., 31:].min() == 1.0
    # A map that is wrong by a third does not know where edges are. Nor is a slope an edge.
    assert off_edges(target, depth, WEAK).confidence.min() > 0.9
    slope = torch.linspace(2.0, 4.0, SIZE[1]).expand(1, 1, *SIZE)
    assert off_edges(target, slope, STRONG).confidence.min() > 0.95
    points = matches_at(depth, torch.zeros_like(depth))
    points.confidence[0, 0, 6, 29] = 1.0
    beside = correction_target(target, points, kept, STRONG, depth).confidence[0, 0]
    assert beside[6, 29] == kept.numel() and beside[5, 29] < 0.3
    # No match counts before the first estimate.
    assert correction_target(target, None, None, None, depth) is None
    assert int((correction_target(target, points, None, WEAK, depth).confidence > 0).sum()) == 1
