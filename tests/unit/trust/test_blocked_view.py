"""A blank part of one view is found; walls and skies are in both views."""

import cv2
import numpy as np
import pytest

from geodiff_plugin.trust import FactSheet, ImagesStage
from geodiff_plugin.trust.blocked_view import BlankRegions, BlockedView, blank_fraction
from tests.unit.trust.sheets import Case, good, judged
from tests.unit.trust.test_defocus import texture

CASES = [
    Case("MAX_DIFFERENCE", lambda x: good(BlankRegions(0.1, 0.1 + x, 0)), [], ["views.blocked"]),
    Case("MAX_DIFFERENCE", lambda x: good(BlankRegions(0.2 + x, 0.2, 0)), [], ["views.blocked"]),
]
SIZE = (240, 320)
V, U = np.mgrid[: SIZE[0], : SIZE[1]]


def covered(image: np.ndarray, kind: str) -> np.ndarray:
    """An image whose right half is black, noise or a blurred finger, or with a thumb in a corner."""
    right = U > 160
    if kind == "cap":
        return np.where(right, 0, image).astype(np.uint8)
    if kind == "noise":
        dark = np.random.default_rng(0).normal(8, 2, SIZE).clip(0, 255)
        return np.where(right, dark, image).astype(np.uint8)
    finger = (40 + 30 * np.exp(-(((U - 260) / 90) ** 2) - ((V - 120) / 120) ** 2)).astype(np.float32)
    inside = right if kind == "finger" else (U - 320) ** 2 + (V - 240) ** 2 < 180**2
    weight = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), 5)
    return (weight * finger + (1 - weight) * image).astype(np.uint8)


def facts_of(*images: np.ndarray) -> BlankRegions:
    return BlockedView.of_images(ImagesStage(images, [len(image) for image in images]))


def found(fact) -> list:
    return list(BlockedView.findings(FactSheet({BlockedView: fact}), ()))


@pytest.mark.parametrize("kind", ["cap", "noise", "finger", "thumb"])
def test_the_covered_view_is_named(kind):
    left, right = texture(1), texture(2)
    assert not found(facts_of(left, right))
    (of_right,) = found(facts_of(left, covered(right, kind)))
    (of_left,) = found(facts_of(covered(left, kind), right))
    assert "of the right image is blank" in of_right and "of the left image is blank" in of_left


def test_the_view_that_differs_most_counts():
    left, right = texture(1), texture(2)
    (finding,) = found(facts_of(left, right, covered(texture(3), "cap")))
    assert "image of right view 2 is blank" in finding


def test_a_wall_in_both_views_is_not_at_the_lens():
    wall = [np.where(U + shift > 200, 90 + (V // 60), texture(seed)) for seed, shift in ((1, 0), (2, 25))]
    assert not found(facts_of(*(each.astype(np.uint8) for each in wall)))


def test_blank_regions_inside_of_the_image_and_small_ones_do_not_count():
    inside = np.where((abs(U - 160) < 80) & (abs(V - 120) < 60), 50, texture(1)).astype(np.uint8)
    assert blank_fraction(inside) == 0
    corner = np.where((U < 30) & (V < 30), 50, texture(1)).astype(np.uint8)
    assert blank_fraction(corner) == 0


def test_masked_pixels_show_nothing():
    cap, valid = covered(texture(1), "cap"), U <= 160
    assert blank_fraction(cap) == pytest.approx(0.45, abs=0.04)  # but for the window at its edge
    assert blank_fraction(texture(1), valid) == pytest.approx(159 / 320, abs=0.01)
    assert blank_fraction(texture(1), (abs(U - 160) > 80) | (abs(V - 120) > 60)) == 0, "inside of the image"
    masked = ImagesStage([texture(1), texture(2)], [240] * 2, [None, valid])
    (finding,) = found(BlockedView.of_images(masked))
    assert "of the right image is blank or masked" in finding
    assert not found(BlockedView.of_images(masked._replace(valid=[valid, valid])))


@pytest.mark.parametrize("left", [0.0, 0.41])
def test_both_fractions_are_stated_with_their_images(left):
    message = judged(good(BlankRegions(left, 0.41 - left, 0)), "views.blocked")
    blank, other = ("left image", "right image") if left else ("right image", "left image")
    assert message.startswith(f"41 % of the {blank} is blank")
    assert f"only 0 % of the {other}" in message
