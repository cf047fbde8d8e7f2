"""Members in metres become one map."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.runtime.output import ensemble_metric, median


@pytest.mark.parametrize(
    ("members", "middle", "deviation"),
    [
        ([2.0], 2.0, 0.0),
        ([1.0, 3.0], 2.0, 1.0),
        ([1.0, 2.0, 9.0], 2.0, 1.0),
        ([1.0, 2.0, 3.0, 4.0], 2.5, 1.0),
    ],
)
def test_median_of_even_and_odd_numbers(members, middle, deviation):
    depth_m = torch.tensor(members)[:, None, None, None].expand(-1, 1, 2, 3)
    found, spread = ensemble_metric(depth_m)
    assert found.shape == spread.shape == (1, 1, 2, 3)
    assert (found == middle).all() and (spread == deviation).all()
    assert torch.equal(median(depth_m, 0), found[0])
    torch.testing.assert_close(ensemble_metric(depth_m, lower=True)[0][0], depth_m.median(0).values)


def test_mean_and_an_unknown_reduction():
    depth_m = torch.tensor([1.0, 2.0, 6.0])[:, None, None, None]
    found, spread = ensemble_metric(depth_m, "mean")
    assert found.item() == 3.0 and spread.item() == pytest.approx(14**0.5 / 3**0.5)
    with pytest.raises(ValueError, match="reduction"):
        ensemble_metric(depth_m, "mode")


def test_uncertainty_is_of_the_refined_map(make_pipeline, textured_plane):
    """Each member alone, refined as it is: the spread of those around the ensemble's result."""
    pipe = enable_geometry_guidance(make_pipeline())
    pair, left = textured_plane, Image.fromarray(textured_plane.left)
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, inner_steps=1)
    latents = torch.randn(3, 4, 24, 32, generator=torch.Generator().manual_seed(0))
    call = {"guidance": guidance, "num_inference_steps": 1}
    alone = [pipe(left, latents=one[None], **call).prediction for one in latents]
    out = pipe(left, latents=latents, ensemble_size=3, output_uncertainty=True, **call)
    expected = np.median(np.abs(np.stack(alone) - out.prediction), axis=0)
    np.testing.assert_allclose(out.uncertainty, expected, rtol=1e-3, atol=1e-4)
    assert out.uncertainty.shape == out.prediction.shape and out.support.shape == out.prediction.shape
