"""torch's default device and dtype are the user's: nothing that is computed reads either."""

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

DEFAULTS = ("meta", torch.float64, torch.bfloat16)
WEIGHTS = {"photometric": 1.0, "prior_pull": 0.01, "anchor": 0.1}
PAPER = {"search": "one-number", "inner_steps": 2, "weights": WEIGHTS, "z_test": True}


@contextmanager
def default(value):
    """Of a device that holds nothing, whatever is made there by mistake is an error."""
    (torch.set_default_device if value == "meta" else torch.set_default_dtype)(value)
    try:
        yield
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)


def call(pipe, pair, **knobs):
    """A guided call; where there are points, with a warm start from the result of a first one."""
    pointed = "points" in knobs

    def run(output_latent=False, **more):
        guidance = GeometryGuidance(pair.right, pair.K, pair.E, **knobs | more)
        seed = torch.Generator("cpu").manual_seed(0)
        return pipe(pair.left, guidance=guidance, generator=seed, output_latent=output_latent)

    first = run(output_latent=pointed)
    return run(previous=first).prediction if pointed else first.prediction


@pytest.mark.parametrize(
    ("key", "kind"),
    [("marigold", k) for k in ("turned", "points", "paper")]
    + [(k, "") for k in ("lotus", "geowizard", "ppd")],
)
def test_a_guided_call_does_not_depend_on_them(key, kind):
    pair = plane_pair(rotation_y=0.05 if kind == "turned" else 0.0)
    points = np.zeros_like(pair.depth_m)
    points[::7, ::5] = pair.depth_m[::7, ::5]
    knobs = {"points": {"points": points}, "paper": PAPER}.get(kind, {})
    pipe = enable_geometry_guidance(TINY[key]())
    expected = call(pipe, pair, **knobs)
    for value in DEFAULTS if kind else DEFAULTS[-1:]:
        with default(value):
            assert np.array_equal(call(pipe, pair, **knobs), expected), value


def estimated(pair):
    pytest.importorskip("poselib")
    left, right = (view.image_01.float() for view in (pair.left, pair.right))
    guidance = GeometryGuidance.from_photographs(left, right, baseline_m=0.3, K=pair.K_left.numpy())
    return guidance.rigs[0].E


def refined(pair):
    left, right, K = pair.left.image_01.float(), pair.right.image_01.float(), pair.K_left.float()
    E = pair.E.numpy().copy()
    E[:3, :3] = E[:3, :3] @ Rotation.from_euler("xyz", (0.8, -0.9, 0.5), degrees=True).as_matrix()
    T = torch.from_numpy(np.linalg.inv(E)).to(torch.float32)
    found, report = pose_views(left, [CameraView(right, pair.K_right.float(), T)], K)
    assert report.status == "refined"
    return found[0].T_right_from_left.numpy()


@pytest.mark.parametrize("pose_of", [estimated, refined])
def test_no_pose_depends_on_them(pose_of):
    pair = render_pair(3, size=(180, 240), posed=True)
    expected = pose_of(pair)
    for value in DEFAULTS[:2]:
        with default(value):
            assert np.array_equal(pose_of(pair), expected), value
