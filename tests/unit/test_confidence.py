"""Confidence rises with support, falls with photometric error and spread, and stays a probability."""

import pytest
import torch

from geodiff_plugin.runtime.confidence import depth_confidence


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
