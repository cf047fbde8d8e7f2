"""What is known beside the prior: one object for both grids, for the step and for the output."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin.algorithm.evidence import Evidence
from geodiff_plugin.algorithm.known import Known
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import Matches

K, FINE, COARSE = torch.eye(3), (24, 32), (12, 16)


def matches_at(depth_m: float, size: tuple[int, int], confidence: float = 1.0) -> Matches:
    inverse = torch.full((1, *size), 1.0 / depth_m)
    return Matches(inverse, torch.full((1, *size), confidence), torch.tensor(0.01), K, size)


def evidence(points: Matches | None = None, sweep_points: Matches | None = None) -> Evidence:
    coarse, fine = matches_at(2.0, COARSE), matches_at(2.0, FINE)
    return Evidence(
        torch.rand(3, *COARSE), torch.rand(3, *COARSE), K, (), None, coarse, fine, points, sweep_points
    )


GREY = torch.full((1, 3, *COARSE), 0.5)


def depth(metres: float, size: tuple[int, int] = COARSE) -> torch.Tensor:
    return torch.full((1, 1, *size), metres)


@pytest.mark.parametrize(("grid", "size"), [("loss", COARSE), ("sweep", FINE)])
def test_each_grid_has_its_own_matches(grid, size):
    known = Known.of([evidence(), evidence()], DEFAULT, grid)
    assert known.matches.confidence.shape == (2, 1, *size) and known.points is None


def test_reflections_are_rejected_once_by_the_first_estimate():
    known = Known.of([evidence()], DEFAULT, "loss")
    assert known.usable_matches is None  # no match is usable before the prior has spoken
    first = known.judged(depth(0.8), GREY)  # all lie far behind it
    assert (first.usable_matches.confidence < 0.1).all()
    assert first.judged(depth(2.0), GREY) is first
    # A lamp post before the sky is no reflection, however much nearer than the estimate it is.
    assert (known.judged(depth(1000.0), GREY).usable_matches.confidence == 1).all()
    off = Known.of([evidence()], DEFAULT.changed(reject_reflections=False), "loss")
    assert (off.judged(depth(0.8), GREY).usable_matches.confidence == 1).all()


def test_what_was_kept_on_one_grid_holds_on_the_other():
    kept = torch.zeros(1, 1, *COARSE)
    kept[..., :8] = 1.0
    fine = Known.of([evidence()], DEFAULT, "sweep", kept).usable_matches
    assert (fine.confidence[..., :14] == 1).all() and (fine.confidence[..., 18:] == 0).all()


def test_points_count_in_full_beside_an_edge():
    edge = depth(2.0)
    edge[..., 8:] = 6.0
    points = matches_at(2.2, COARSE, confidence=0.0)
    points.confidence[0, 6, 8] = 1.0
    known = Known.of([evidence(points)], DEFAULT, "loss").judged(depth(2.1), GREY)
    beside, away = (known.target(m).confidence[0, 0] for m in (edge, depth(2.1)))
    assert beside[6, 8] == away[6, 8] and beside[5, 8] < 0.3 * away[5, 8]


def test_an_estimate_is_refined_to_matches_and_points():
    points = matches_at(2.2, COARSE, confidence=0.0)
    points.confidence[0, 6, 8] = 1.0
    known = Known.of([evidence(points)], DEFAULT, "loss").judged(depth(2.1), GREY)
    target = known.target(depth(2.1))
    assert float(target.inverse_depth[0, 0, 6, 8]) == pytest.approx(1 / 2.2)
    refined = known.refine(depth(2.1), GREY)
    assert float(refined.depth_m.median()) == pytest.approx(2.0, rel=0.1) and (refined.support > 0.8).all()
    nothing = Known(DEFAULT, None, None)
    assert nothing.judged(depth(2.0), GREY) is nothing and nothing.refine(depth(2.0), GREY) is None
