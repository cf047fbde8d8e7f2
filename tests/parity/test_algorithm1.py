"""The ``paper`` preset of a live pipeline is Algorithm 1, step by step."""

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.parity.algorithm1_oracle import algorithm_1
from tests.tiny import plane_pair

STEPS = 4
#: Above the paper's 1e-2, so that a few steps move latents, scale and shift well beyond rounding.
RATE, RATE_AFFINE = 0.06, 2.0


def _tensor(image) -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1).float() / 255


@pytest.mark.parametrize("turned", [0.0, 0.06])
def test_scale_shift_and_latents_of_every_step(make_pipeline, turned):
    pair = plane_pair(rotation_y=turned)
    pipe = enable_geometry_guidance(make_pipeline())
    z = torch.randn(1, 4, 24, 32, generator=torch.Generator().manual_seed(3))
    steps = []

    def watch(pipe, i, t, values):
        steps.append((float(values["scale"]), float(values["shift"]), values["latents"][0].clone()))

    out = pipe(
        Image.fromarray(pair.left),
        guidance=GeometryGuidance.paper(pair.right, pair.K, pair.E, lr_latents=RATE, lr_affine=RATE_AFFINE),
        num_inference_steps=STEPS,
        latents=z,
        callback_on_step_end=watch,
    )
    left, right = _tensor(pair.left), _tensor(pair.right)
    with torch.no_grad():
        encoded = pipe.vae.encode(2 * left[None] - 1).latent_dist.mode()[0] * pipe.vae.config.scaling_factor
        token = pipe.tokenizer("", return_tensors="pt").input_ids
        text = pipe.text_encoder(token)[0]
    K, T = (torch.from_numpy(m).float() for m in (pair.K, np.linalg.inv(pair.E)))
    expected = algorithm_1(pipe, encoded, text, z[0], STEPS, left, right, K, T, RATE, RATE_AFFINE)
    assert float(out.global_scale) == expected[-1][2]
    # Float32's rounding, multiplied by RATE: up to 1e-6 and, on latents of up to 5.5, 3e-5 were seen.
    for (scale, shift, latents), (its_scale, its_shift, _, its_latents) in zip(steps, expected, strict=True):
        assert scale == pytest.approx(its_scale, abs=5e-6) and shift == pytest.approx(its_shift, abs=5e-6)
        torch.testing.assert_close(latents, its_latents, atol=1e-4, rtol=0)
    # The guidance has moved something: without it this would hold of any sign.
    alone = algorithm_1(pipe, encoded, text, z[0], STEPS, left, right, K, T, 0.0, 0.0)
    assert (alone[-1][3] - expected[-1][3]).abs().max() > 0.05 and abs(alone[-1][0] - expected[-1][0]) > 0.01
