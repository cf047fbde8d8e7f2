"""torch's default device and dtype are the user's, and not read; calls of priors in float16 and float64."""

from contextlib import contextmanager

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.runtime.hooks import images_in_float32
from tests.contracts.tiny_priors import TINY, make_e2e_ft
from tests.scenes import render_pair
from tests.tiny import checked_views, guided_call, plane_pair
from tests.views import posed_of

pytestmark = pytest.mark.end_to_end

DEFAULTS = ("meta", torch.float64, torch.bfloat16)
WEIGHTS = {"photometric": 1.0, "affine_reg": 0.01, "anchor": 0.1}
PAPER = {"search": "one-number", "guidance_steps": 2, "weights": WEIGHTS, "occlusion_mask": True}


@contextmanager
def default(value):
    """Of a device that holds nothing, anything allocated there is an error."""
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
    pair, pipe = plane_pair(rotation_y=0.05 if kind == "turned" else 0.0), TINY[key]()
    points = np.zeros_like(pair.depth_m)
    points[::7, ::5] = pair.depth_m[::7, ::5]
    parameters = {"points": {"points": points}, "paper": PAPER}.get(kind, {})

    def compute():
        return guided_call(pipe, pair, {"min_steps": 2} | parameters).prediction

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
    reported = {"baseline_m": 0.3, "K": K.numpy()}
    unchanged(lambda: GeometryGuidance.from_unposed_images(left, right, **reported).rigs[0].E, DEFAULTS[:2])


def test_a_refined_pose_does_not_depend_on_them(rendered):
    left, right, K, E = rendered
    E = E.copy()
    E[:3, :3] = E[:3, :3] @ Rotation.from_euler("xyz", (0.8, -0.9, 0.5), degrees=True).as_matrix()

    def compute():
        found, report, _, _ = checked_views(posed_of(left, K, (right, K, np.linalg.inv(E))))
        assert report.status == "refined"
        return found[0].T_right_from_left

    unchanged(compute, DEFAULTS[:2])


@pytest.mark.parametrize(("count", "gradient"), [(1, "full"), (20, "denoised")])
def test_a_handful_of_known_points_is_enough(pipe, textured_plane, count, gradient):
    """The loss is a mean over so few pixels that each one's share is thousands of times an image's."""
    pair, points = textured_plane, np.zeros((48, 64), np.float32)
    at = np.random.default_rng(0).choice(48 * 64, count, replace=False)
    points.flat[at] = pair.depth_m.flat[at]
    parameters = {"gradient": gradient, "guidance_steps": 3, "fit_matches": False, "min_steps": 2}
    guidance = GeometryGuidance.from_points(points, pair.K, **parameters)
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


def test_an_overflow_of_the_decoder_names_step_tensor_and_hint(pipe, textured_plane):
    pipe.to(torch.float16).vae.decoder.conv_out.weight.data.fill_(6e4)
    with pytest.raises(ValueError, match=r"decoded map of denoising step 3 .* float16.*bfloat16"):
        guided_call(pipe, textured_plane, {"guidance_steps": 1})


def test_a_prior_in_float64_gives_the_same_depth(textured_plane):
    pipe = make_e2e_ft()  # it draws nothing
    expected, found = (
        guided_call(pipe.to(dtype), textured_plane, {"guidance_steps": 1}).prediction
        for dtype in (torch.float32, torch.float64)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4)
