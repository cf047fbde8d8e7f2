"""Confidence rises with support, falls with photometric error and spread, and stays a probability."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin.runtime.confidence import BY_EVIDENCE, SIGNS, depth_confidence, depth_evidence


def _maps(*values: float) -> torch.Tensor:
    return torch.tensor(values).view(1, 1, 1, -1)


SEEN = torch.ones(1, 1, 1, 3, dtype=torch.bool)


@pytest.mark.parametrize(
    ("support", "error", "spread", "way"),
    [
        ((0.0, 0.95, 1.0), (0.05,) * 3, None, 1),
        ((0.9,) * 3, (0.0, 0.05, 0.5), None, -1),
        ((0.9,) * 3, (0.05,) * 3, (0.0, 0.05, 0.5), -1),
    ],
)
def test_rises_with_support_and_falls_with_error_and_spread(support, error, spread, way):
    spread = None if spread is None else _maps(*spread)
    found = depth_confidence(_maps(*support), _maps(*error), SEEN, spread).flatten()
    assert (way * found.diff() > 0).all() and found.min() > 0 and found.max() < 1
    unseen = depth_confidence(_maps(*support), _maps(*error), ~SEEN, None).flatten()
    assert len(set(support)) > 1 or unseen[0] == unseen[2]


@pytest.mark.parametrize("support", [0.0, 0.3, 0.9, 0.999])
@pytest.mark.parametrize("error", [0.0, 0.05, 1.0])
def test_not_being_in_view_never_raises_it(support, error):
    """Whatever the error says; by the form, with any coefficients of the signs that a refit may give."""
    maps = _maps(*[support] * 3), _maps(*[error] * 3)
    assert bool((depth_confidence(*maps, ~SEEN, None) <= depth_confidence(*maps, SEEN, None)).all())
    seen, unseen = (depth_evidence(*maps, visible, None) for visible in (SEEN, ~SEEN))
    signs = torch.tensor(SIGNS).view(1, -1, 1, 1)
    assert bool((signs * (seen - unseen) >= 0).all()) and bool((seen - unseen)[:, 0].eq(0).all())
    assert all(sign * value >= 0 for sign, value in zip(SIGNS, BY_EVIDENCE, strict=True))


def test_a_good_prior_is_believed_beside_its_matches_and_not_far_from_them():
    support, error = _maps(0.0, 0.01, 0.5, 1.0), _maps(0.05, 0.05, 0.05, 0.05)
    seen = torch.ones_like(support).bool()
    good, poor = (
        depth_confidence(support, error, seen, None, torch.full((1, 1, 1, 1), own)).flatten()
        for own in (0.02, 0.4)
    )
    assert bool((good >= poor).all()) and good[2] > poor[2] + 0.2 and good[3] > poor[3]
    # Its error is measured where matches are: it says nothing of what is far from all of them.
    assert good[0] == poor[0] and good[1] < 0.6
