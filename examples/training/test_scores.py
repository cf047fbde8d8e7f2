"""What the prior is measured by, and what it is measured against."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from examples.training import validate
from examples.training.evaluate import best_constant, best_plane
from tests.benchmarks.bundled_prior import seconds_per_call


def _ramp(seed: int = 0, size: tuple[int, int] = (12, 18)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: size[0], : size[1]]
    return 3.0 + rng.uniform(0.1, 0.5) * x + rng.uniform(0.1, 0.5) * y


@pytest.mark.parametrize("seed", range(3))
def test_plane_fits_a_plane_from_few_pixels(seed):
    depth = _ramp(seed)
    valid = np.random.default_rng(seed).random(depth.shape) < 0.2
    np.testing.assert_allclose(best_plane(depth, valid), depth, rtol=1e-9)


def test_constant_is_the_mean_of_the_known_pixels():
    depth = _ramp()
    valid = np.zeros((12, 18), bool)
    valid[2:5] = True
    assert best_constant(depth, valid)[0, 0] == pytest.approx(depth[2:5].mean())


class _Oracle:
    """Stands for a pipeline and answers with a fixed affine map of the image's red channel."""

    device = torch.device("cpu")
    config = SimpleNamespace(prediction_type="depth")

    def __call__(self, image, num_inference_steps, processing_resolution, generator):
        self.asked = (num_inference_steps, processing_resolution)
        return type("Out", (), {"prediction": (0.2 + 0.5 * image[0, :1].numpy()[..., None])})()


def test_scenes_are_scored_after_alignment_without_sky_and_far_pixels():
    depth = torch.from_numpy(_ramp()).float()[None, None].repeat(2, 1, 1, 1)
    images = (depth / 30.0).repeat(1, 3, 1, 1)
    depth[0, 0, 0, :] = float("inf")
    depth[1, 0, 0, :] = 200.0
    oracle = _Oracle()
    abs_rel, delta1 = validate.score_scenes(oracle, images, depth, steps=3, resolution=64)
    assert abs_rel == pytest.approx(0.0, abs=1e-5) and delta1 == 1.0
    assert oracle.asked == (3, 64)


def test_contact_sheet_has_three_images_per_scene(tmp_path):
    depth = torch.from_numpy(_ramp()).float()[None, None].repeat(4, 1, 1, 1)
    images = depth.repeat(1, 3, 1, 1) / 30.0
    predictions = depth[:, 0].numpy().copy()
    depth[0, 0, 0, :] = float("inf")
    validate.contact_sheet(images, depth, predictions, tmp_path / "sheet.png", "depth", columns=3)
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.size == (3 * 3 * 18, 2 * 12)


def test_seconds_are_positive():
    class Pipeline:
        device = "cpu"

        def __call__(self, image, generator):
            assert image.shape == (1, 3, 4, 5)

    assert seconds_per_call(Pipeline(), (4, 5), repeats=2) > 0
