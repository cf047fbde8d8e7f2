"""torch's default device and dtype are the user's: a guided call reads neither."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.guidance.evidence import pose_views
from geodiff_plugin.types import CameraView
from tests.conftest import plane_pair
from tests.contracts.tiny_priors import TINY
from tests.scenes import render_pair

#: Of device and dtype.
DEFAULTS = ("meta", torch.float64, torch.bfloat16)
PAPER = {
    "search": "one-number",
    "inner_steps": 2,
    "weights": {"photometric": 1.0, "prior_pull": 0.01, "anchor": 0.1},
    "z_test": True,
}


@contextmanager
def _default(value):
    """Of a device that holds nothing, whatever is made there by mistake is an error."""
    of_device = value == "meta"
    (torch.set_default_device if of_device else torch.set_default_dtype)(value)
    try:
        yield
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)


def _depth_m(pipe, pair, **knobs):
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, **knobs)
    seed = torch.Generator("cpu").manual_seed(0)
    return pipe(pair.left, guidance=guidance, generator=seed).prediction


def _points(pair):
    points = np.zeros_like(pair.depth_m)
    points[::7, ::5] = pair.depth_m[::7, ::5]
    return points


@pytest.mark.parametrize("kind", ["turned", "points", "paper"])
def test_a_guided_call_does_not_depend_on_them(kind):
    """Nor does a warm start from its result, with points beside a rectified view."""
    pair = plane_pair(rotation_y=0.05 if kind == "turned" else 0.0)
    knobs = {"points": {"points": _points(pair)}, "paper": PAPER}.get(kind, {})
    pipe = enable_geometry_guidance(TINY["marigold"]())
    if kind == "points":
        guidance = GeometryGuidance(pair.right, pair.K, pair.E)
        seed = torch.Generator("cpu").manual_seed(0)
        knobs["previous"] = pipe(pair.left, guidance=guidance, generator=seed, output_latent=True)
    expected = _depth_m(pipe, pair, **knobs)
    for default in DEFAULTS:
        with _default(default):
            assert np.array_equal(_depth_m(pipe, pair, **knobs), expected), default


def test_no_estimate_of_a_pose_does():
    pytest.importorskip("poselib")
    pair = render_pair(3, size=(180, 240), posed=True)
    left, right = (view.image_01.float() for view in (pair.left, pair.right))
    known = {"baseline_m": 0.3, "K": pair.K_left.numpy()}
    expected = GeometryGuidance.from_photographs(left, right, **known)
    for default in DEFAULTS[:2]:
        with _default(default):
            found = GeometryGuidance.from_photographs(left, right, **known)
        assert np.array_equal(found.rigs[0].E, expected.rigs[0].E), default


@pytest.mark.parametrize("key", ["lotus", "geowizard", "ppd"])
def test_no_prior_does(key, textured_plane):
    pipe = enable_geometry_guidance(TINY[key]())
    expected = _depth_m(pipe, textured_plane)
    with _default(torch.bfloat16):
        assert np.array_equal(_depth_m(pipe, textured_plane), expected)


def test_no_refinement_of_a_pose_does():
    pair = render_pair(3, size=(180, 240), posed=True)
    left, right, K = pair.left.image_01.float(), pair.right.image_01.float(), pair.K_left.float()
    E = pair.E.numpy().copy()
    E[:3, :3] = E[:3, :3] @ Rotation.from_euler("xyz", (0.8, -0.9, 0.5), degrees=True).as_matrix()
    rights = [CameraView(right, pair.K_right.float(), torch.from_numpy(np.linalg.inv(E)).float())]
    expected, report = pose_views(left, rights, K)
    assert report.status == "refined"
    for default in DEFAULTS[:2]:
        with _default(default):
            found, _ = pose_views(left, rights, K)
        assert torch.equal(found[0].T_right_from_left, expected[0].T_right_from_left), default
