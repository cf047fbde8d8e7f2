"""Guided calls of a prior in float16, and in float64."""

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.runtime.hooks import images_in_float32
from tests.conftest import guided_call
from tests.contracts.tiny_priors import make_e2e_ft


@pytest.mark.parametrize(("count", "gradient"), [(1, "full"), (20, "denoised")])
def test_a_handful_of_known_points_is_enough(pipe, textured_plane, count, gradient):
    """The loss is a mean over so few pixels that each one's share is thousands of times an image's."""
    pair, points = textured_plane, np.zeros((48, 64), np.float32)
    at = np.random.default_rng(0).choice(48 * 64, count, replace=False)
    points.flat[at] = pair.depth_m.flat[at]
    knobs = {"gradient": gradient, "inner_steps": 3, "correct": False}
    guidance = GeometryGuidance.from_points(points, pair.K, **knobs)
    full, half = (guided_call(pipe.to(d), pair, guidance).prediction for d in (torch.float32, torch.float16))
    assert np.isfinite(half).all()
    assert np.median(np.abs(half / full - 1)) < 0.1


def test_white_of_16_bits_is_no_overflow(pipe, textured_plane):
    """float16 ends at 65504; what the processor is given is cast once it is in [0, 1]."""
    image = textured_plane.left.astype(np.uint16) * 257
    image[0, 0] = 65535
    with images_in_float32(pipe.image_processor):
        images, *_ = pipe.image_processor.preprocess(image, 0, "bilinear", torch.device("cpu"), torch.float16)
    assert images.dtype == torch.float16 and images.max() == 1.0
    assert "preprocess" not in vars(pipe.image_processor)


def test_an_overflow_of_the_decoder_names_step_tensor_and_cure(pipe, textured_plane):
    pipe.to(torch.float16).vae.decoder.conv_out.weight.data.fill_(6e4)
    with pytest.raises(ValueError, match=r"decoded map of denoising step 3 .* float16.*bfloat16"):
        guided_call(pipe, textured_plane, {"inner_steps": 1})


def test_a_prior_in_float64_gives_the_same_depth(textured_plane):
    pipe = make_e2e_ft()  # it draws nothing
    expected, found = (
        guided_call(pipe.to(dtype), textured_plane, {"inner_steps": 1}).prediction
        for dtype in (torch.float32, torch.float64)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4)
