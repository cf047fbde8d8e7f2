"""Nothing between the first denoising step and the last waits for the device."""

from __future__ import annotations

import pytest

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.algorithm.state import Trajectory
from tests.pretended_device import Reached, pretended

#: Read-backs, copies from the device and constants copied to it, from the first step to the last. A copy
#: either way waits for all that the device was told before.
ALLOWED = 0
KNOBS = {
    "default": {},
    "updates": {"inner_steps": 2},
    "full": {"gradient": "full", "inner_steps": 1},
}
STEPS = 3


def waits_of(pipe, pair, monkeypatch, points=None, **call):
    knobs = {"loss_resolution": 64} | call.pop("knobs", {})
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, points=points, **knobs)
    with pretended(enable_geometry_guidance(pipe), guidance, monkeypatch) as waits, pytest.raises(Reached):
        pipe(pair.left, guidance=guidance, num_inference_steps=STEPS, **call)
    return waits


@pytest.mark.parametrize("name", KNOBS)
def test_no_step_waits(make_pipeline, textured_plane, monkeypatch, name):
    waits = waits_of(make_pipeline(), textured_plane, monkeypatch, knobs=KNOBS[name])
    assert sum(waits.found.values()) == ALLOWED, waits.found


def test_what_waits_is_found(make_pipeline, textured_plane, monkeypatch):
    """A read-back, a mask and a list that a step may come to hold."""
    corrected = Trajectory.corrected

    def careless(self, x):
        float(x.mean())
        x[x > 0.5]
        x.cpu()
        return corrected(self, x)

    monkeypatch.setattr(Trajectory, "corrected", careless)
    waits = waits_of(make_pipeline(), textured_plane, monkeypatch, knobs={"corrections": 2})
    assert list(waits.of_kind("read back").values()) == [2]
    assert list(waits.of_kind("to here").values()) == [1]
