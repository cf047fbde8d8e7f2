"""The left image and the arguments of a guided call are checked before anything runs."""

import warnings

import numpy as np
import pytest
import torch
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from PIL import Image

from geodiff_plugin import GeometryGuidance, InputError
from geodiff_plugin.evidence.inputs import left_images

pytestmark = pytest.mark.end_to_end

LEFT = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
FLOATS = LEFT.astype(np.float32) / 255
WITH_NAN = np.where(np.arange(64)[None, :, None] == 4, np.float32(np.nan), FLOATS)
ALPHA = np.dstack([LEFT, np.full(LEFT.shape[:2], 7, np.uint8)])
PALETTE = Image.fromarray(LEFT).convert("P")
TOLD = ["image has an alpha channel: fully transparent pixels (alpha 0) are treated as invalid."]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"image": "left.png"},
            "image must be a PIL image, a numpy array or a torch tensor; got the string 'left.png'",
        ),
        ({"image": (LEFT, LEFT)}, "image must be a PIL image.*got tuple"),
        ({"image": FLOATS.transpose(2, 0, 1)}, r"image must be .*transpose\(1, 2, 0\)"),
        ({"image": LEFT.astype(np.int64)}, "image must be uint8, uint16 or floats.*got dtype int64"),
        ({"image": LEFT > 90}, r"got dtype bool. Convert it with astype\('uint8'\) \* 255"),
        ({"image": LEFT.astype(np.float32)}, r"image must be floats in \[0, 1\].*Divide by 255"),
        ({"image": WITH_NAN}, "image must be finite; got NaN or infinity. Mask or fill"),
        ({"image": LEFT[:31]}, "image must be at least 32 pixels per side"),
        ({"image": []}, "image must be an image or a list of images"),
        ({"image": [FLOATS, WITH_NAN]}, r"image\[1\] must be finite"),
        ({"image": [LEFT, LEFT[:40]]}, r"image\[1\] must be 64x48 pixels, like image\[0\]; got 64x40"),
        ({"output_type": "pil"}, "output_type must be one of np, pt; got 'pil'"),
        ({"generator": [torch.Generator()] * 2}, "a list of 1, one per image.*got a list of 2"),
        ({"generator": 7}, "generator must be None, a torch.Generator or a list of them; got int"),
        ({"ensemble_size": 0}, "ensemble_size must be between 1"),
        ({"batch_size": None}, "batch_size must be an integer; got NoneType"),
        ({"num_inference_steps": "4"}, "num_inference_steps must be an integer; got the string '4'"),
        ({"processing_resolution": -8}, "processing_resolution must be between 0"),
        ({"resample_method_input": "lanczos"}, "resample_method_input must be one of .* got 'lanczos'"),
        ({"resample_method_output": "cubic"}, "resample_method_output must be one of .* got 'cubic'"),
        ({"callback_on_step_end": 3}, "callback_on_step_end must be a function; got int"),
        ({"latents": torch.full((1, 4, 8, 8), torch.nan)}, "latents must be finite; got NaN or infinity"),
    ],
)
def test_bad_arguments_are_named_before_anything_runs(pipe, textured_plane, monkeypatch, arguments, message):
    pair = textured_plane
    monkeypatch.setattr(GeometryGuidance, "prepare", lambda *_: pytest.fail("something ran"))
    with pytest.raises(InputError, match=message):
        pipe(**({"image": LEFT, "guidance": GeometryGuidance(pair.right, pair.K, pair.E)} | arguments))


@pytest.mark.parametrize(
    ("image", "like", "said"),
    [
        (ALPHA, LEFT, TOLD),
        (Image.fromarray(ALPHA), LEFT, TOLD),
        ([ALPHA], [LEFT], ["image[0]" + TOLD[0].removeprefix("image")]),
        (FLOATS * 1.0005, np.clip(FLOATS * 1.0005, 0, 1), []),
        (LEFT[:, ::-1] / 255.0, np.ascontiguousarray(LEFT[:, ::-1]), []),
        (PALETTE, np.asarray(PALETTE.convert("RGB")), []),
    ],
)
def test_what_the_stock_call_does_not_read_is_read_as_the_right_image_is(image, like, said):
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        found = left_images(image)
    assert [str(w.message) for w in heard if str(w.message).startswith("image")] == said
    np.testing.assert_array_equal(found, left_images(like))


@pytest.mark.parametrize(
    "image",
    [
        LEFT,
        FLOATS,
        LEFT.astype(np.uint16) * 257,
        Image.fromarray(LEFT),
        Image.fromarray(LEFT[..., 0].astype(np.uint16) * 257),
        torch.from_numpy(FLOATS).permute(2, 0, 1),
        np.stack([LEFT, LEFT]),
        [LEFT, LEFT],
    ],
)
def test_what_the_stock_call_reads_is_read_as_it_reads_it(image):
    stock = MarigoldImageProcessor(vae_scale_factor=1, do_normalize=False)
    np.testing.assert_array_equal(left_images(image), stock.preprocess(image, 0)[0])


@pytest.mark.parametrize("image", [ALPHA, LEFT > 90])
def test_without_guidance_the_errors_are_the_stock_ones(make_pipeline, pipe, image):
    with pytest.raises(ValueError) as stock:
        make_pipeline()(image)
    with pytest.raises(ValueError) as enabled:
        pipe(image)
    assert str(enabled.value) == str(stock.value) and not isinstance(enabled.value, InputError)
