"""What a corrected step decodes and encodes, and that any other is the prior's own."""

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.integration.test_tiny_decoder import counted


def guided(pipe, pair, steps=5, **knobs):
    call = {name: knobs.pop(name) for name in ("output_latent", "callback_on_step_end") if name in knobs}
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, **knobs)
    generator = torch.Generator().manual_seed(0)
    return enable_geometry_guidance(pipe)(
        pair.left, guidance=guidance, generator=generator, num_inference_steps=steps, **call
    )


@pytest.mark.parametrize("corrections", [1, 3])
def test_a_step_that_is_not_corrected_is_the_priors_own(
    make_pipeline, textured_plane, monkeypatch, corrections
):
    pipe = make_pipeline()
    calls = counted(pipe.vae, monkeypatch)
    found = guided(pipe, textured_plane, corrections=corrections)
    looked = [report.step for report in found.history]
    assert looked == {1: [4], 3: [2, 3, 4]}[corrections]
    # A correction decodes once and encodes twice, the last one not at all; the stock call encodes the image.
    assert calls == {"decode": len(looked), "encode": 1 + 2 * (corrections - 1)}


def test_the_result_does_not_depend_on_whether_the_latent_is_asked_for(make_pipeline, textured_plane):
    plain = guided(make_pipeline(), textured_plane)
    latent = guided(make_pipeline(), textured_plane, output_latent=True)
    np.testing.assert_array_equal(plain.prediction, latent.prediction)
