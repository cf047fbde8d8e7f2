"""torch's default device and dtype are the user's: nothing that is computed reads either."""

from contextlib import contextmanager

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.pose.refine import refine_views
from geodiff_plugin.types import CameraView
from tests.conftest import guided_call, plane_pair
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


def unchanged(compute, defaults=DEFAULTS):
    expected = compute()
    for value in defaults:
        with default(value):
            assert np.array_equal(compute(), expected), value


@pytest.mark.parametrize(
    ("key", "kind"),
    [("marigold", k) for k in ("turned", "points", "paper")]
    + [(k, "") for k in ("lotus", "geowizard", "ppd")],
)
def test_a_guided_call_does_not_depend_on_them(key, kind):
    """Where there are points, with a warm start from the result of a first call."""
    pair, pipe = plane_pair(rotation_y=0.05 if kind == "turned" else 0.0), TINY[key]()
    points = np.zeros_like(pair.depth_m)
    points[::7, ::5] = pair.depth_m[::7, ::5]
    knobs = {"points": {"points": points}, "paper": PAPER}.get(kind, {})

    def compute():
        told = {}
        if kind == "points":
            told["previous"] = guided_call(pipe, pair, knobs, output_latent=True)
        return guided_call(pipe, pair, knobs | told).prediction

    unchanged(compute, DEFAULTS if kind else DEFAULTS[-1:])


@pytest.fixture(scope="module")
def rendered():
    """Left image, right image, K, and E of a pair whose cameras do not look the same way."""
    pair = render_pair(3, size=(180, 240), posed=True)
    images = (view.image_01.float() for view in (pair.left, pair.right))
    return *images, pair.K_left, pair.E.numpy()


def test_an_estimated_pose_does_not_depend_on_them(rendered):
    pytest.importorskip("poselib")
    left, right, K, _ = rendered
    told = {"baseline_m": 0.3, "K": K.numpy()}
    unchanged(lambda: GeometryGuidance.from_photographs(left, right, **told).rigs[0].E, DEFAULTS[:2])


def test_a_refined_pose_does_not_depend_on_them(rendered):
    left, right, K, E = rendered
    E = E.copy()
    E[:3, :3] = E[:3, :3] @ Rotation.from_euler("xyz", (0.8, -0.9, 0.5), degrees=True).as_matrix()

    def compute():
        T = torch.from_numpy(np.linalg.inv(E)).to(torch.float32)
        found, report = refine_views(left, [CameraView(right, K.float(), T)], K.float())
        assert report.status == "refined"
        return found[0].T_right_from_left.numpy()

    unchanged(compute, DEFAULTS[:2])
