"""Blur of one view is found, whichever it is; noise-free scale and contrast do not matter."""

import cv2
import numpy as np
import pytest

from geodiff_plugin.trust import FactSheet, ImagesStage
from geodiff_plugin.trust.defocus import Defocus, Sharpness, log_detail_ratio
from tests.unit.trust.sheets import Case, good

CASES = [
    Case("MAX_LOG_RATIO", lambda x: good(Sharpness(0, x)), [], ["views.defocused"]),
    Case("MAX_LOG_RATIO", lambda x: good(Sharpness(0, -x)), [], ["views.defocused"]),
]


def texture(seed: int, size=(240, 320)) -> np.ndarray:
    """Detail of all scales, as natural images have it."""
    rng = np.random.default_rng(seed)
    octaves = [rng.standard_normal((size[0] // k, size[1] // k)) * k for k in (1, 2, 4, 8, 16)]
    image = sum(cv2.resize(octave, size[::-1]) for octave in octaves)
    return np.clip(128 + 30 * image / image.std(), 0, 255).astype(np.uint8)


def blurred(image: np.ndarray, px: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), px)


def facts_of(*images: np.ndarray):
    return Defocus.of_images(ImagesStage(images, [len(image) for image in images]))


def codes(fact) -> list[str]:
    return [finding.code for finding in Defocus.findings(FactSheet({Defocus: fact}), ())]


@pytest.mark.parametrize("px", [3.5, 5.0])
def test_the_blurred_view_is_named(px):
    left, right = texture(1), texture(2)
    assert codes(facts_of(left, right)) == []
    in_right, in_left = facts_of(left, blurred(right, px)), facts_of(blurred(left, px), right)
    assert codes(in_right) == codes(in_left) == ["views.defocused"]
    for fact, blurry in ((in_right, "right"), (in_left, "left")):
        (finding,) = Defocus.findings(FactSheet({Defocus: fact}), ())
        assert finding.startswith(f"The {blurry} image has")
    assert in_right.log_ratio > 0 > in_left.log_ratio


def test_exchanging_the_views_changes_the_sign_and_the_worst_view_counts():
    left, right = texture(3), blurred(texture(4), 1.5)
    assert facts_of(left, right).log_ratio == -facts_of(right, left).log_ratio
    several = facts_of(left, texture(5), right)
    assert several.view == 1 and several.log_ratio == facts_of(left, right).log_ratio
    (finding,) = Defocus.findings(FactSheet({Defocus: facts_of(left, texture(5), blurred(right, 4))}), ())
    assert "image of right view 2" in finding


def test_more_blur_leaves_less_fine_detail_and_contrast_changes_nothing():
    image = texture(6)
    ratios = [log_detail_ratio(blurred(image, px)) for px in (0.5, 1.0, 2.0, 3.0)]
    assert ratios == sorted(ratios, reverse=True)
    softer = (64 + image / 2).astype(np.uint8)
    assert log_detail_ratio(softer) == pytest.approx(log_detail_ratio(image), abs=0.03)
    for flipped in (image[::-1], image[:, ::-1], image.T):
        assert log_detail_ratio(flipped.copy()) == pytest.approx(log_detail_ratio(image), abs=1e-4)


def test_a_blank_image_is_inconclusive():
    blank = np.full((240, 320), 90, np.uint8)
    assert log_detail_ratio(blank) is None and facts_of(texture(7), blank) is None
    assert facts_of(blank, texture(7)) is None and codes(None) == []
    assert facts_of(texture(7), blank, texture(8)).view == 1


def test_smooth_content_of_invalid_pixels_does_not_count():
    """Detail is compared where each view is most textured among its valid pixels."""
    image = blurred(texture(7), 0.8)
    image[:, 200:] = blurred(texture(8), 3.0)[:, 200:]
    valid = np.zeros(image.shape, bool)
    valid[:, :180] = True
    smooth = np.where(valid, image, 128).astype(np.uint8)
    alone = log_detail_ratio(image[:, :180])
    assert log_detail_ratio(smooth, valid) == pytest.approx(alone, abs=0.03)
    stage = ImagesStage([image, smooth], [240, 240], [None, valid])
    expected = log_detail_ratio(image) - log_detail_ratio(smooth, valid)
    assert Defocus.of_images(stage).log_ratio == expected
    for few in (400, 0):
        assert log_detail_ratio(smooth, np.arange(image.size).reshape(image.shape) < few) is None


def test_a_mask_of_all_pixels_changes_nothing():
    image = texture(9)
    assert log_detail_ratio(image, np.ones(image.shape, bool)) == pytest.approx(
        log_detail_ratio(image), abs=1e-6
    )
