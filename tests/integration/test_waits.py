"""Nothing between the first denoising step and the last waits for the device."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.pretended_device import Reached, There, Waits, pretended

#: Read-backs, copies from the device and constants copied to it, from the first step to the last. A copy
#: either way waits for all that the device was told before.
ALLOWED = 0
KNOBS = {
    "default": {},
    "updates": {"inner_steps": 1},
    "full": {"gradient": "full", "inner_steps": 1},
}
STEPS = 2


def waits_of(pipe, pair, monkeypatch, points=None, **call):
    knobs = call.pop("knobs", {})
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, points=points, **knobs)
    with pretended(enable_geometry_guidance(pipe), guidance, monkeypatch) as waits, pytest.raises(Reached):
        pipe(pair.left, guidance=guidance, num_inference_steps=STEPS, **call)
    return waits


@pytest.mark.parametrize(
    "name", ["updates", *(pytest.param(n, marks=pytest.mark.slow) for n in ("default", "full"))]
)
def test_no_step_waits(make_pipeline, textured_plane, monkeypatch, name):
    waits = waits_of(make_pipeline(), textured_plane, monkeypatch, knobs=KNOBS[name])
    assert sum(waits.found.values()) == ALLOWED, waits.found


def test_what_waits_is_found(monkeypatch):
    """A read-back, a mask and a copy, as a step may come to hold them."""
    monkeypatch.setattr(Waits, "_line", staticmethod(lambda: "step"))
    with Waits() as waits:
        x = There(torch.rand(4, 4))
        waits.counts = True
        float(x.mean())
        x[x > 0.5]
        x.cpu()
    assert waits.of_kind("read back") == {"step": 2}
    assert waits.of_kind("to here") == {"step": 1}
