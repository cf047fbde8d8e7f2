"""What rounds of one step are anchored to, and what of the matches the result believes."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin.algorithm import correction
from geodiff_plugin.algorithm.gradients import RULES
from geodiff_plugin.algorithm.terms import TERMS, Term
from geodiff_plugin.config import GuidanceConfig, UpdatePlan
from tests.conftest import guided_call, plane_pair
from tests.contracts.tiny_priors import make_e2e_ft

STEP = 0.02


def constant(rate):
    """The same step whatever the gradient says, so that a test knows where an update ends."""
    return SimpleNamespace(step=lambda gradient, reference=None: torch.full_like(gradient, STEP))


def test_later_rounds_are_anchored_to_the_network_and_all_corrections(textured_plane, monkeypatch):
    """Each correction moves the anchor as far as the latent; an update moves the latent alone."""
    seen = []

    def spy(estimate):
        if estimate.z0.requires_grad:
            seen.append((estimate.z0.detach().clone(), estimate.anchor.clone()))
        return (estimate.z0 - estimate.anchor).square().flatten(1).mean(1)

    monkeypatch.setitem(TERMS, "spy", Term(spy))
    monkeypatch.setitem(RULES, "constant", constant)
    monkeypatch.setattr(GuidanceConfig, "plan_updates", lambda *_args, **_kw: UpdatePlan(1, 0.0, 0.03))
    knobs = {"rule": "constant", "inner_steps": 1, "min_steps": 3, "weights": {"matches": 1.0, "spy": 1.0}}
    guided_call(make_e2e_ft(), textured_plane, knobs)
    assert len(seen) == 3
    torch.testing.assert_close(seen[0][0], seen[0][1])  # the first round starts from the anchor
    for (z, anchor), (next_z, next_anchor) in zip(seen, seen[1:], strict=False):
        moved = next_z - (z + STEP)
        assert moved.abs().max() > 1e-3
        torch.testing.assert_close(next_anchor - anchor, moved, atol=1e-5, rtol=0)


@pytest.mark.parametrize("rejects", [True, False])
def test_the_result_believes_no_match_behind_the_prior(make_oracle, monkeypatch, rejects):
    """A prior that sees a near surface in the far part of a plane, as it sees a mirror."""
    pair = plane_pair((72, 96), 0.15, focal=90.0, normal=(0.5, -0.7, 1.0))
    truth_m, block = pair.depth_m, (slice(40, 66), slice(20, 46))
    seen_m = truth_m.copy()
    seen_m[block] = 1.1 * truth_m.min()
    # Nothing else that doubts a match: it is the rejection that is looked at.
    monkeypatch.setattr(correction, "STIFFEST", 0.7)
    monkeypatch.setattr(correction, "MOST_INERTIA", 0.003)
    knobs = {"inner_steps": 0, "correct": False, "reject_reflections": rejects, "outlier_width": 1e3}
    pipe = make_oracle((seen_m - seen_m.min()) / (seen_m.max() - seen_m.min()))
    out = guided_call(pipe, pair, knobs, num_inference_steps=1)
    inner = slice(45, 61), slice(25, 41)
    support, error = out.support[0, ..., 0][inner], out.prediction[0, ..., 0][inner] / truth_m[inner] - 1
    followed = float((np.abs(error) < 0.1).mean())
    if rejects:
        assert np.median(support) < 0.5 and followed < 0.2
    else:
        assert np.median(support) > 0.8 and followed > 0.8
