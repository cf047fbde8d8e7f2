"""The left image of a guided call is checked as the right one is, before anything runs."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from PIL import Image

from geodiff_plugin import GeometryGuidance, InputError, enable_geometry_guidance
from geodiff_plugin.runtime.checks import check_left_images

FAST = {"inner_steps": 0, "min_steps": 1, "correct": False, "crisp": False}
LEFT = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
FLOATS = LEFT.astype(np.float32) / 255
ALPHA = np.dstack([LEFT, np.full(LEFT.shape[:2], 7, np.uint8)])


def with_nan():
    x = FLOATS.copy()
    x[3, 4, 1] = np.nan
    return x


@pytest.fixture
def call(make_pipeline, textured_plane):
    pipe = enable_geometry_guidance(make_pipeline())
    pair = textured_plane

    def run(image, *, rights=1, **kwargs):
        guidance = GeometryGuidance([pair.right] * rights, pair.K, pair.E, **FAST)
        call = {"generator": torch.Generator().manual_seed(0), "num_inference_steps": 1}
        return pipe(image, guidance=guidance, **(call | kwargs))

    return run


@pytest.mark.parametrize(
    ("image", "message"),
    [
        ("left.png", "image must be a PIL image, a numpy array or a torch tensor; got str"),
        (None, "image must be a PIL image"),
        ((LEFT, LEFT), "image must be a PIL image.*got tuple"),
        (FLOATS.transpose(2, 0, 1), r"image must be .*transpose\(1, 2, 0\)"),
        (torch.from_numpy(FLOATS), r"image must be .*permute\(2, 0, 1\)"),
        (LEFT.astype(np.int64), "image must be uint8, uint16 or floats.*got dtype int64"),
        (LEFT > 90, r"got dtype bool. Convert it with astype\('uint8'\) \* 255"),
        (FLOATS * 2 - 1, r"image must be floats in \[0, 1\].*\(x \+ 1\) / 2"),
        (LEFT.astype(np.float32), r"image must be floats in \[0, 1\].*Divide by 255"),
        (with_nan(), "image must be finite; got NaN or infinity in it. Mask or fill"),
        (LEFT[:31], "image must be at least 32 pixels a side"),
        ([], "image must be an image or a list of images"),
        ([FLOATS, with_nan()], r"image\[1\] must be finite"),
        (np.stack([FLOATS, with_nan()]), r"image\[1\] must be finite"),
        ([LEFT, LEFT[:40]], r"image\[1\] must be of 64x48 pixels, as image\[0\]; got 64x40"),
    ],
)
def test_a_bad_left_image_is_named_before_anything_runs(call, monkeypatch, image, message):
    monkeypatch.setattr(GeometryGuidance, "prepare", lambda *_: pytest.fail("something ran"))
    with pytest.raises(InputError, match=message):
        call(image)


@pytest.mark.parametrize(
    ("image", "like", "said"),
    [
        (ALPHA, LEFT, ["image has an alpha channel; it is dropped."]),
        (Image.fromarray(ALPHA), LEFT, ["image has an alpha channel; it is dropped."]),
        (torch.from_numpy(ALPHA).permute(2, 0, 1), LEFT, ["image has an alpha channel; it is dropped."]),
        (FLOATS * 1.0005, np.clip(FLOATS * 1.0005, 0, 1), []),
        (LEFT[:, ::-1] / 255.0, np.ascontiguousarray(LEFT[:, ::-1]), []),
        (
            Image.fromarray(LEFT).convert("CMYK"),
            np.asarray(Image.fromarray(LEFT).convert("CMYK").convert("RGB")),
            [],
        ),
        (
            Image.fromarray(LEFT).convert("P"),
            np.asarray(Image.fromarray(LEFT).convert("P").convert("RGB")),
            [],
        ),
    ],
)
def test_what_the_stock_call_does_not_read_is_read_as_the_right_image_is(image, like, said):
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        found, _ = check_left_images(image)
    mine = [str(w.message) for w in heard if str(w.message).startswith("image")]
    assert mine == said
    np.testing.assert_allclose(_read(found), _read(check_left_images(like)[0]), atol=1e-6)


def _read(image) -> np.ndarray:
    """What the stock call makes of an image, in [0, 1]."""
    images, *_ = MarigoldImageProcessor().preprocess(image, 0)
    return (images.numpy() + 1) / 2


def test_a_batch_with_alpha_or_of_two_kinds_becomes_tensors(call):
    with pytest.warns(UserWarning, match=r"^image\[0\] has an alpha channel"):
        out = call([ALPHA, Image.fromarray(LEFT)], rights=2, generator=[torch.manual_seed(0)] * 2)
    single = call(LEFT, generator=torch.Generator().manual_seed(0))
    np.testing.assert_allclose(out.prediction[:1], single.prediction, rtol=1e-3)


@pytest.mark.parametrize(
    "image",
    [
        LEFT,
        LEFT[..., 0],
        FLOATS,
        FLOATS.astype(np.float16),
        LEFT.astype(np.uint16) * 257,
        Image.fromarray(LEFT),
        Image.fromarray(LEFT[..., 0]),
        Image.fromarray(LEFT[..., 0].astype(np.uint16) * 257),
        torch.from_numpy(FLOATS).permute(2, 0, 1),
        torch.from_numpy(LEFT).permute(2, 0, 1),
        torch.from_numpy(FLOATS[..., 0]),
        np.stack([LEFT, LEFT]),
        torch.from_numpy(np.stack([LEFT, LEFT])).permute(0, 3, 1, 2),
        [LEFT, LEFT],
    ],
)
def test_what_the_stock_call_reads_goes_on_untouched(image):
    before = image.copy() if isinstance(image, np.ndarray) else image
    found, count = check_left_images(image)
    assert found is image and count == (2 if isinstance(image, list) or np.ndim(image) == 4 else 1)
    if isinstance(image, np.ndarray):
        np.testing.assert_array_equal(image, before)


def test_12_bits_in_16_are_told_once_of_either_image(make_pipeline, textured_plane):
    pair, pipe = textured_plane, enable_geometry_guidance(make_pipeline())
    left, right = (x.astype(np.uint16) * 16 for x in (pair.left, pair.right))
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        pipe(left, guidance=GeometryGuidance(right, pair.K, pair.E, **FAST))
    dark = [str(w.message).split(" is a 16-bit")[0] for w in heard if "nearly black" in str(w.message)]
    assert dark == ["right", "image"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"output_type": "pil"}, "output_type must be one of np, pt; got 'pil'"),
        ({"generator": [torch.Generator()] * 2}, "a list of 1: one for every image.*got a list of 2"),
        ({"generator": [torch.Generator()] * 2, "ensemble_size": 3}, "a list of 3.*got a list of 2"),
        ({"generator": []}, "got a list of 0"),
        ({"generator": 7}, "generator must be None, a torch.Generator or a list of them; got int"),
        ({"ensemble_size": 0}, "ensemble_size must be between 1"),
        ({"batch_size": 0}, "batch_size must be between 1"),
        ({"batch_size": None}, "batch_size must be an integer; got NoneType"),
        ({"num_inference_steps": "4"}, "num_inference_steps must be an integer; got str"),
        ({"num_inference_steps": 4.0}, "num_inference_steps must be an integer; got float"),
        ({"processing_resolution": "768"}, "processing_resolution must be an integer; got str"),
        ({"processing_resolution": -8}, "processing_resolution must be between 0"),
        (
            {"resample_method_input": "lanczos"},
            "resample_method_input must be one of .* got 'lanczos'",
        ),
        ({"resample_method_input": None}, "resample_method_input must be one of area, .*; got None"),
        ({"resample_method_output": "cubic"}, "resample_method_output must be one of .* got 'cubic'"),
        ({"callback_on_step_end": 3}, "callback_on_step_end must be a function; got int"),
        ({"latents": torch.full((1, 4, 8, 8), torch.nan)}, "latents must be finite; got NaN or infinity"),
    ],
)
def test_other_arguments_are_checked_first_too(call, monkeypatch, arguments, message):
    monkeypatch.setattr(GeometryGuidance, "prepare", lambda *_: pytest.fail("something ran"))
    with pytest.raises(InputError, match=message):
        call(LEFT, **arguments)


def test_one_generator_for_every_member(call):
    assert call(LEFT, generator=[torch.Generator() for _ in range(3)], ensemble_size=3).scale.shape == (1, 3)


def test_latents_go_with_any_form_of_the_image(call):
    noise = torch.randn(1, 4, 24, 32, generator=torch.Generator().manual_seed(0))
    forms = (Image.fromarray(LEFT), FLOATS, [LEFT])
    first, *others = (call(image, latents=noise, generator=None).prediction for image in forms)
    for prediction in others:
        np.testing.assert_array_equal(prediction, first)


def test_without_guidance_the_errors_are_the_stock_ones(make_pipeline):
    for image in (ALPHA, FLOATS * 2 - 1, LEFT > 90):
        with pytest.raises(ValueError) as stock:
            make_pipeline()(image)
        with pytest.raises(ValueError) as enabled:
            enable_geometry_guidance(make_pipeline())(image)
        assert str(enabled.value) == str(stock.value) and not isinstance(enabled.value, InputError)
