"""Pixels that are not valid: nothing in them reaches a result, and they get no depth."""

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, InputError
from geodiff_plugin.cameras import eroded
from tests.tiny import guided_call, plane_pair
from tests.unit.evidence.test_valid import as_jpeg

pytestmark = pytest.mark.end_to_end

SIZE = (96, 144)
V, U = np.mgrid[: SIZE[0], : SIZE[1]]
CIRCLE = (U - 70) ** 2 + (V - 48) ** 2 < 45**2
SHAPES = {
    "circle": CIRCLE,
    "letterbox": (V >= 14) & (V < 80),
    "wedge": 6 + 14 * V / SIZE[0] < U,
    "two parts": (U < 60) | (U > 80),
    "holes": np.random.default_rng(0).random((6, 9)).repeat(16, 0).repeat(16, 1) > 0.25,
}
CALL = {"num_inference_steps": 2, "processing_resolution": 0}


def contents(shape) -> dict[str, np.ndarray]:
    """What may stand in invalid pixels, ``(H, W, 3)`` uint8."""
    return {
        "noise": np.random.default_rng(1).integers(0, 256, shape, np.uint8),
        "black": np.zeros(shape, np.uint8),
        "white": np.full(shape, 255, np.uint8),
        "another scene": plane_pair(shape[:2], seed=5, focal=130.0).left,
    }


def pair_of(rotated: bool):
    """A pair of a tilted plane, rectified or with a rotated right camera."""
    return plane_pair(SIZE, focal=130.0, rotation_y=0.05 if rotated else 0.0)


def masked(pair, valid, content, right_valid=None):
    """The two images with other content where they are not valid."""
    right_valid = valid if right_valid is None else right_valid
    return [
        np.where(m[..., None], image, content) for image, m in ((pair.left, valid), (pair.right, right_valid))
    ]


def call(make_oracle, pair, left, right, parameters=(), **options):
    """A guided call with a prior that knows the plane."""
    inverse = 1.0 / pair.depth_m
    relative = (inverse - inverse.min()) / np.ptp(inverse)
    pipe = make_oracle(relative.astype(np.float32), "disparity")
    guidance = GeometryGuidance(right, pair.K, pair.E, **dict(parameters), **options)
    return guided_call(pipe, type(pair)(left, right, pair.K, pair.E, pair.depth_m), guidance, **CALL)


@pytest.mark.parametrize(
    ("shape", "rotated"), [*((shape, False) for shape in SHAPES), ("circle", True), ("holes", True)]
)
def test_content_outside_of_the_mask_does_not_change_results_inside(make_oracle, shape, rotated):
    pair, valid = pair_of(rotated), SHAPES[shape]
    results = []
    for content in contents(pair.left.shape).values():
        left, right = masked(pair, valid, content)
        results.append(call(make_oracle, pair, left, right, mask=valid, right_mask=valid))
    first = results[0]
    assert (first.valid[0, ..., 0] <= valid).all() and first.valid[0, ..., 0][valid].mean() > 0.95
    assert (first.prediction[0, ..., 0][~valid] == 0).all() and (
        first.confidence[0, ..., 0][~valid] == 0
    ).all()
    error = np.abs(first.prediction[0, ..., 0] / pair.depth_m - 1)
    assert np.median(error[valid]) < 0.02 and error[first.confidence[0, ..., 0] > 0.5].mean() < 0.04
    for other in results[1:]:
        np.testing.assert_allclose(other.prediction, first.prediction, rtol=1e-3)
        np.testing.assert_allclose(other.confidence, first.confidence, atol=1e-3)
        assert other.verdict.status == first.verdict.status


def test_updates_compare_valid_pixels_only(make_oracle):
    """Algorithm 1 itself, whose loss warps the right image."""
    pair, results = pair_of(False), []
    parameters = {"guidance_steps": 2, "fit_matches": False}
    for content in contents(pair.left.shape).values():
        left, right = masked(pair, CIRCLE, content, SHAPES["wedge"])
        masks = {"mask": CIRCLE, "right_mask": SHAPES["wedge"]}
        results.append(call(make_oracle, pair, left, right, parameters, **masks).prediction)
    for other in results[1:]:
        np.testing.assert_allclose(other, results[0], rtol=1e-3)


def test_a_mask_of_valid_pixels_changes_nothing(make_oracle):
    pair = pair_of(False)
    plain = call(make_oracle, pair, pair.left, pair.right)
    full = call(
        make_oracle, pair, pair.left, pair.right, mask=np.ones(SIZE, bool), right_mask=np.ones(SIZE, bool)
    )
    for name in ("prediction", "confidence", "support", "photometric_error"):
        assert np.array_equal(getattr(plain, name), getattr(full, name)), name


def test_a_mask_an_alpha_channel_and_a_black_border_agree(make_oracle):
    """The border is found without a mask; then only the blended pixels at its edge have no depth."""
    pair = pair_of(False)
    left, right = masked(pair, CIRCLE, np.zeros_like(pair.left))
    given = call(make_oracle, pair, left, right, mask=CIRCLE, right_mask=Image.fromarray(CIRCLE))
    with pytest.warns(UserWarning, match="transparent pixels .alpha 0. are treated as invalid"):
        alpha = [np.dstack([image, 255 * CIRCLE.astype(np.uint8)]) for image in (left, right)]
        by_alpha = call(make_oracle, pair, *alpha)
    assert np.array_equal(by_alpha.prediction, given.prediction)
    found = call(make_oracle, pair, left, right)
    assert (found.valid & ~given.valid).mean() < 0.002
    rim = torch.from_numpy(given.valid[0, ..., 0]) & ~eroded(torch.from_numpy(given.valid[0, ..., 0]), 2)
    assert (found.valid | rim.numpy()[None, ..., None])[given.valid].mean() > 0.99
    error = np.abs(found.prediction[0, ..., 0] / pair.depth_m - 1)[found.valid[0, ..., 0]]
    assert error.mean() < 0.04


def test_the_wedge_of_one_compressed_view_gets_no_depth(make_oracle):
    pair, wedge = pair_of(False), SHAPES["wedge"]
    left = (as_jpeg(pair.left * wedge[..., None].astype(np.uint8), 85) * 255).byte().permute(1, 2, 0).numpy()
    found = call(make_oracle, pair, left, pair.right)
    assert found.valid[0, ..., 0][~wedge].mean() < 0.15 and found.valid[0, ..., 0][wedge].mean() > 0.97


def test_fill_gives_a_guess_of_low_confidence(make_oracle):
    pair = pair_of(False)
    left, right = masked(pair, CIRCLE, np.zeros_like(pair.left))
    plain, filled = (
        call(make_oracle, pair, left, right, mask=CIRCLE, right_mask=CIRCLE, fill=f) for f in (False, True)
    )
    inside = CIRCLE[None, ..., None]
    assert np.array_equal(plain.prediction[inside], filled.prediction[inside])
    assert (filled.prediction > 0).all() and (filled.confidence[~inside] <= 0.05).all()
    assert filled.valid[~inside].mean() > 0.9


def test_invalid_pixels_stay_out_of_another_camera(make_oracle):
    pair = pair_of(False)
    output = call(
        make_oracle, pair, *masked(pair, CIRCLE, np.zeros_like(pair.left)), mask=CIRCLE, right_mask=CIRCLE
    )
    depth, sigma = (maps[0, ..., 0] for maps in output.reproject(pair.K, np.eye(4), SIZE[::-1]))
    assert (depth[~CIRCLE] == 0).all() and (depth > 0).any()
    np.testing.assert_array_equal(np.isfinite(sigma), depth > 0)


@pytest.mark.parametrize(
    ("masks", "said"),
    [
        ({"right_mask": np.ones((4, 4))}, "right_mask must be 144x96 pixels, like its image"),
        ({"right_mask": (CIRCLE, CIRCLE)}, "right_mask must be one mask, or a tuple of 1"),
        ({"mask": CIRCLE[1:]}, "mask must be 144x96 pixels, like its image"),
    ],
)
def test_a_mask_of_another_image_is_an_error(make_oracle, masks, said):
    pair = pair_of(False)
    with pytest.raises(InputError, match=said):
        call(make_oracle, pair, pair.left, pair.right, **masks)


def test_an_ensemble_a_batch_and_tensors_have_their_masks(make_oracle):
    pair = pair_of(False)
    inverse = 1.0 / pair.depth_m
    relative = ((inverse - inverse.min()) / np.ptp(inverse)).astype(np.float32)
    left, right = masked(pair, CIRCLE, np.zeros_like(pair.left))
    guidance = GeometryGuidance(
        [right, pair.right], pair.K, pair.E, mask=[torch.from_numpy(CIRCLE), None], right_mask=[CIRCLE, None]
    )
    lefts = type(pair)([left, pair.left], None, pair.K, pair.E, pair.depth_m)
    more = {"ensemble_size": 2, "output_uncertainty": True, "output_type": "pt"}
    output = guided_call(make_oracle(relative, "disparity"), lefts, guidance, **CALL, **more)
    assert (output.prediction[0, 0][torch.from_numpy(~CIRCLE)] == 0).all() and (
        output.prediction[1] > 0
    ).all()
    assert output.valid.shape == output.prediction.shape
