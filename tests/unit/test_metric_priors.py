"""Priors that are metric by themselves: the search starts from their metres, and the run says how far off."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.contracts.tiny_transformers import make_transformers
from tests.scenes import render_pair

FAST = {"inner_steps": 1, "min_steps": 1}


def knowing(kind, depth_m, factor=1.0):
    """A model that answers with the truth, in its own unit, times a factor; to a prompt, with the prompt."""
    pipe, answer = make_transformers(kind), torch.from_numpy(depth_m)[None] * factor

    def forward(pixel_values, prompt_depth=None):
        values, fov = answer, {}
        if kind == "depth_pro":
            values, fov = 1 / answer, {"field_of_view": torch.tensor([2 * np.degrees(np.arctan(0.5))])}
        elif prompt_depth is not None:
            values = torch.nn.functional.interpolate(prompt_depth, answer.shape[1:], mode="bilinear")[:, 0]
        return type("Output", (), {"predicted_depth": values, **fov})()

    pipe.model.forward = forward
    return enable_geometry_guidance(pipe)


def guided(pipe, pair, **knobs):
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, **FAST | knobs)
    return pipe(Image.fromarray(pair.left), guidance=guidance, processing_resolution=64)


@pytest.mark.parametrize("kind", ["zoedepth", "glpn", "tipsv2", "depth_pro"])
def test_a_run_says_how_far_the_priors_metres_were_off(kind, textured_plane):
    out = guided(knowing(kind, textured_plane.depth_m, factor=0.5), textured_plane)
    assert out.prior_scale.shape == (1, 1) and float(out.prior_scale) == pytest.approx(2.0, rel=0.02)
    assert any("2 times the prior's own metres" in sentence for sentence in out.warnings)
    assert np.median(out.prediction[0, ..., 0] / textured_plane.depth_m) == pytest.approx(1.0, rel=0.01)


def test_prompt_depth_anything_is_given_what_is_known_unless_it_is_given_depths(textured_plane):
    pipe = knowing("prompt_depth_anything", textured_plane.depth_m)
    out = guided(pipe, textured_plane)
    assert float(out.prior_scale) == pytest.approx(1.0, abs=0.01)  # its map is in metres with a prompt
    call = {"image": Image.fromarray(textured_plane.left), "processing_resolution": 64}
    pipe(**call)
    assert pipe.metric_range is None  # without guidance it is a relative prior
    own = torch.linspace(7.0, 9.0, 24).view(1, 1, 4, 6)
    pipe(**call, prompt_depth=own)
    assert pipe.metric_range[0].tolist() == pytest.approx([7.0, 9.0], abs=0.1)
    with pytest.raises(ValueError, match="prompt_depth"):
        make_transformers("zoedepth")(**call, prompt_depth=own)


def test_without_a_length_the_metres_are_those_of_a_metric_prior():
    """An estimated pose has no unit; the prior knows the depth in metres, so everything is in metres."""
    pytest.importorskip("poselib")
    pair = render_pair(0, posed=True)  # 8 degrees of parallax, so that the estimated pose is accurate
    depth_m, E = pair.left.depth_m[0].numpy(), pair.E.numpy()
    left, right = (
        np.rint(v.image_01.permute(1, 2, 0).numpy() * 255).astype(np.uint8) for v in (pair.left, pair.right)
    )
    runs = {}
    for kind in ("zoedepth", "depth_anything"):
        guidance = GeometryGuidance.from_photographs(left, right, K=pair.K_left.numpy(), **FAST)
        call = {"guidance": guidance, "processing_resolution": 64}
        runs[kind] = knowing(kind, depth_m)(Image.fromarray(left), **call)
    metric, relative = runs["zoedepth"], runs["depth_anything"]
    baseline = float(np.linalg.norm(E[:3, 3]))
    assert metric.unit == "m" and metric.scale_from == "prior" and 0 < metric.scale_spread < 0.1
    assert metric.rescaled == pytest.approx(baseline, rel=0.03)
    assert np.median(metric.prediction[0, ..., 0] / depth_m) == pytest.approx(1.0, rel=0.025)
    assert np.linalg.norm(metric.poses[0].E[0][:3, 3]) == pytest.approx(metric.rescaled, rel=1e-5)
    assert float(metric.prior_scale) == pytest.approx(1.0, rel=1e-5)
    assert any("metres are the prior's own" in sentence for sentence in metric.warnings)
    assert not any("no unit" in sentence for sentence in metric.warnings)
    assert relative.unit is None and relative.scale_from == "none" and relative.rescaled == 1.0
    assert any("no unit" in sentence for sentence in relative.warnings)


def test_given_poses_without_a_unit_get_the_metres_of_a_metric_prior(textured_plane):
    scaled = textured_plane.E.copy()
    scaled[:3, 3] *= 0.001 / np.linalg.norm(scaled[:3, 3])  # as a model of COLMAP might have it
    pair = replace(textured_plane, E=scaled)
    metric, relative = (
        guided(knowing(kind, pair.depth_m), pair, unit=None) for kind in ("zoedepth", "depth_anything")
    )
    assert metric.unit == "m" and metric.scale_from == "prior"
    assert np.median(metric.prediction[0, ..., 0] / pair.depth_m) == pytest.approx(1.0, rel=0.03)
    assert sum("metres are the prior's own" in sentence for sentence in metric.warnings) == 1
    assert relative.unit is None and not any(" mm" in sentence for sentence in relative.warnings)
