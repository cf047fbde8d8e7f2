"""Evidence where a prior says nothing: matches and points lose their confidence there."""

import numpy as np
import pytest
import torch

from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.matching import Matches
from geodiff_plugin.types import PosedViews

GRID, OF_PRIOR = (12, 18), (8, 9)


def matches_of(seed: int, share: float) -> Matches:
    rng = np.random.default_rng(seed)
    confidence = rng.uniform(0.6, 1.0, GRID) * (rng.random(GRID) < share)
    tensors = [torch.from_numpy(x)[None].float() for x in (rng.uniform(0.1, 1.0, GRID), confidence)]
    return Matches(*tensors, torch.tensor(0.002))


def evidence_of(**parts) -> Evidence:
    native = PosedViews(torch.zeros(3, *GRID), (), torch.eye(3))
    return Evidence(native, native, None, **{"matches": None} | parts)


@pytest.mark.parametrize("has_matches", [True, False])
@pytest.mark.parametrize("has_points", [True, False])
def test_confidence_is_zero_outside_of_the_priors_map(has_matches, has_points):
    """On a coarser grid with other ratios along both axes."""
    valid = np.random.default_rng(2).random(OF_PRIOR) > 0.3
    inside = valid[
        np.ix_(*(((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(GRID, OF_PRIOR, strict=True)))
    ]
    given = {
        "matches": matches_of(0, 0.9) if has_matches else None,
        "points": matches_of(1, 0.2) if has_points else None,
    }
    found = evidence_of(**given).within(torch.from_numpy(valid)[None])
    for name, before in given.items():
        after = getattr(found, name)
        if before is None:
            assert after is None
            continue
        np.testing.assert_array_equal(after.confidence[0], before.confidence[0].numpy() * inside)
        assert (
            torch.equal(after.inverse_depth, before.inverse_depth) and after.plane_step == before.plane_step
        )
    if has_matches:
        likely = (found.matches.confidence > 0.5).float()
        assert torch.equal(found.reliable.confidence, likely) and 50 <= likely.sum() < likely.numel()
    else:
        assert found.reliable is None


def test_points_stay_where_the_prior_is_silent_about_all_of_them():
    points, matches = matches_of(1, 0.2), matches_of(0, 0.9)
    nowhere = torch.zeros(1, *OF_PRIOR, dtype=torch.bool)
    found = evidence_of(points=points, matches=matches).within(nowhere)
    assert found.points is points
    assert not found.matches.confidence.any() and found.reliable is None
    alone = evidence_of(points=points).within(nowhere)
    assert alone.points is points and alone.matches is None
    one = torch.zeros(1, *GRID, dtype=torch.bool)
    row, column = (points.confidence[0] > 0).nonzero()[3]
    one[0, row, column] = True
    kept = evidence_of(points=points).within(one).points
    assert (kept.confidence > 0).sum() == 1 and kept.confidence[0, row, column] == points.confidence[
        0, row, column
    ]
