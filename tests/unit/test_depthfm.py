"""DepthFM: its grid, its time, its noise and its ending."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from geodiff_plugin.algorithm.denoising import z0_from
from geodiff_plugin.priors.depthfm import SIDE, cosine_alpha_bar
from geodiff_plugin.priors.pipelines.sides import SidesOf
from geodiff_plugin.runtime.noise_levels import noise_level
from tests.contracts.tiny_depthfm import make_depthfm


@pytest.fixture(scope="module")
def pipe():
    return make_depthfm()


@pytest.fixture(scope="module")
def image():
    return torch.rand(1, 3, 48, 100, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("size", "resolution", "grid"),
    [
        ((375, 1242), 768, (256, 768)),  # 231 is nearer to 256
        ((375, 1242), 0, (384, 1216)),
        ((96, 160), 0, (128, 128)),  # 1.5 and 2.5 round to the even number, as in Python
        ((20, 300), 256, (64, 256)),  # never less than one
    ],
)
def test_sides_are_multiples_of_64(size, resolution, grid):
    out, padding, native = SidesOf(SIDE).preprocess(torch.rand(1, 3, *size), resolution)
    assert tuple(out.shape[-2:]) == grid and padding == (0, 0) and tuple(native) == size
    assert -1 <= out.min() < -0.5 and 0.5 < out.max() <= 1


def test_an_image_that_fits_is_not_touched():
    image = torch.rand(1, 3, 64, 128)
    torch.testing.assert_close(SidesOf(SIDE).preprocess(image, 128)[0], image * 2 - 1, rtol=0, atol=0)


def test_time_runs_from_0_to_1_and_the_sign_is_the_schedulers(pipe):
    """``z0 = z_t + (1 - t) v`` of theirs is what guidance computes from ``denoise`` and the noise level."""
    told, velocities = [], []

    def spy(module, arguments, output):
        told.append(float(arguments[1]))
        velocities.append(output[0])

    hook = pipe.unet.register_forward_hook(spy)
    z = torch.randn(1, 4, 8, 8)
    condition = {"image_latent": torch.randn(1, 4, 8, 8), "prompt": pipe.prompt.embedding}
    pipe.set_timesteps(4, z.device)
    for k, t in enumerate(pipe.scheduler.timesteps):
        level = noise_level(pipe.scheduler, t)
        with torch.no_grad():
            output = pipe.denoise(z, t, condition)
        torch.testing.assert_close(z0_from(output, z, level), z + (1 - k / 4) * velocities[-1])
        moved = pipe.scheduler.step(output, t, z).prev_sample
        torch.testing.assert_close(moved, z + velocities[-1] / 4)
        z = moved
    hook.remove()
    assert told == [0.0, 0.25, 0.5, 0.75]


def test_noise_keeps_the_variance():
    """The cosine schedule: all signal at 0, half of the variance half way, little at the end."""
    assert cosine_alpha_bar(0.0) == pytest.approx(1.0) and cosine_alpha_bar(0.999) < 1e-5
    assert cosine_alpha_bar(0.5) == pytest.approx(0.5, abs=1e-4)
    assert cosine_alpha_bar(0.4) == pytest.approx(math.cos(math.pi * 0.4 / 2) ** 2, abs=1e-4)


def test_the_start_is_drawn_from_the_generator(pipe, image):
    def run(seed):
        return pipe(image, generator=torch.Generator().manual_seed(seed)).prediction

    a, b, c = run(0), run(0), run(1)
    assert np.array_equal(a, b) and not np.array_equal(a, c)
    assert a.shape == (1, 48, 100, 1) and a.min() >= 0 and a.max() <= 1
    assert not pipe.deterministic
    still = make_depthfm(noising_step=0)
    assert still.deterministic
    with pytest.raises(ValueError, match="noising_step"):
        make_depthfm(noising_step=1000)


def test_members_of_a_batch_are_their_own(pipe, image):
    """Two images with two members each are what each image is alone."""
    latents = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    square = image[:, :, :, :48]
    other = square.flip(-1)
    options = {"ensemble_size": 2, "num_inference_steps": 1, "output_type": "pt"}
    both = pipe(torch.cat([square, other]), latents=latents, batch_size=3, **options).prediction
    alone = [pipe(x, latents=latents[i : i + 2], **options).prediction for x, i in ((square, 0), (other, 2))]
    torch.testing.assert_close(both, torch.cat(alone), atol=1e-4, rtol=1e-4)


def test_how_members_are_put_together_is_fixed(pipe, image):
    with pytest.raises(ValueError, match="ensembling_kwargs"):
        pipe(image, ensemble_size=2, num_inference_steps=1, ensembling_kwargs={"reduction": "mean"})
