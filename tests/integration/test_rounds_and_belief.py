"""What rounds of one step are anchored to, and what of the matches the result believes."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.algorithm import correction
from geodiff_plugin.algorithm.gradients import RULES
from geodiff_plugin.algorithm.terms import TERMS, Term
from geodiff_plugin.config import GuidanceConfig, UpdatePlan
from tests.conftest import render_plane
from tests.contracts.tiny_priors import make_e2e_ft

STEP = 0.02


@dataclass
class Constant:
    """The same step whatever the gradient says, so that a test knows where an update ends."""

    rate: float

    def step(self, gradient, reference=None):
        return torch.full_like(gradient, STEP)


def test_later_rounds_are_anchored_to_the_network_and_all_corrections(textured_plane, monkeypatch):
    """Each correction moves the anchor as far as the latent; an update moves the latent alone."""
    seen = []

    def spy(estimate):
        if estimate.z0.requires_grad:
            seen.append((estimate.z0.detach().clone(), estimate.anchor.clone()))
        return (estimate.z0 - estimate.anchor).square().flatten(1).mean(1)

    monkeypatch.setitem(TERMS, "spy", Term(spy))
    monkeypatch.setitem(RULES, "constant", Constant)
    monkeypatch.setattr(GuidanceConfig, "plan_updates", lambda *_args, **_kw: UpdatePlan(1, 0.0, 0.03))
    pair, pipe = textured_plane, enable_geometry_guidance(make_e2e_ft())
    guidance = GeometryGuidance(
        *(pair.right, pair.K, pair.E),
        rule="constant",
        inner_steps=1,
        min_steps=3,
        weights={"matches": 1.0, "spy": 1.0},
    )
    pipe(Image.fromarray(pair.left), guidance=guidance)
    assert len(seen) == 3
    torch.testing.assert_close(seen[0][0], seen[0][1])  # the first round starts from the anchor
    for (z, anchor), (next_z, next_anchor) in zip(seen, seen[1:], strict=False):
        moved = next_z - (z + STEP)
        assert moved.abs().max() > 1e-3
        torch.testing.assert_close(next_anchor - anchor, moved, atol=1e-5, rtol=0)


@pytest.mark.parametrize("rejects", [True, False])
def test_the_result_believes_no_match_behind_the_prior(make_oracle, monkeypatch, rejects):
    """A prior that sees a near surface in the far part of a plane, as it sees a mirror."""
    K = np.array([[90.0, 0, 47.5], [0, 90.0, 35.5], [0, 0, 1]])
    E, normal = np.eye(4), np.array([0.5, -0.7, 1.0])
    E[0, 3] = 0.15
    left, truth_m = render_plane(K, np.eye(4), (72, 96), normal, 2.0, 0)
    right, _ = render_plane(K, E, (72, 96), normal, 2.0, 0)
    seen_m, block = truth_m.copy(), np.zeros(truth_m.shape, bool)
    block[40:66, 20:46] = True
    seen_m[block] = 1.1 * truth_m.min()
    pipe = enable_geometry_guidance(make_oracle((seen_m - seen_m.min()) / (seen_m.max() - seen_m.min())))
    # Nothing else that doubts a match: it is the rejection that is looked at.
    monkeypatch.setattr(correction, "STIFFEST", 0.7)
    monkeypatch.setattr(correction, "MOST_INERTIA", 0.003)
    knobs = {"inner_steps": 0, "correct": False, "reject_reflections": rejects, "outlier_width": 1e3}
    guidance = GeometryGuidance(right, K, E, **knobs)
    out = pipe(Image.fromarray(left), guidance=guidance, num_inference_steps=1)
    inner = np.zeros_like(block)
    inner[45:61, 25:41] = True
    support, depth_m = out.support[0, ..., 0], out.prediction[0, ..., 0]
    followed = float((np.abs(depth_m / truth_m - 1) < 0.1)[inner].mean())
    if rejects:
        assert np.median(support[inner]) < 0.5 and followed < 0.2
    else:
        assert np.median(support[inner]) > 0.8 and followed > 0.8
