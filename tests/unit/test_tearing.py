"""Torn pictures: found where a part is moved along the rows, and not where the scene has rows like that."""

import cv2
import numpy as np
import pytest
import torch

from geodiff_plugin.pose.tearing import find_tear
from geodiff_plugin.result.verdict import judge
from geodiff_plugin.types import CameraView, Indicators, PosedViews, Tear
from tests.scenes import render_pair
from tests.tiny import checked_views

WIDTH, HEIGHT = 320, 240


def scene(seed: int) -> np.ndarray:
    """Texture of details of some pixels, with a little noise, grey levels."""
    rng = np.random.default_rng(seed)
    image = sum(cv2.GaussianBlur(rng.normal(0, 60 * size, (HEIGHT, WIDTH)), (0, 0), size) for size in (2, 6))
    return np.clip(128 + image + rng.normal(0, 1, image.shape), 0, 255).astype(np.uint8)


def torn(image: np.ndarray, row: int, px: int, end: int | None = None) -> np.ndarray:
    image = image.copy()
    image[row:end] = np.roll(image[row:end], px, axis=1)
    return image


@pytest.mark.parametrize("px", [4, -11, 24])
@pytest.mark.parametrize(("row", "end"), [(60, None), (80, 160), (200, None)])
@pytest.mark.parametrize("view", [0, 1, 2])
def test_a_moved_part_of_any_picture_is_found_with_its_row_and_shift(view, row, end, px):
    pictures = [scene(1), scene(2), scene(3)]
    pictures[view] = torn(pictures[view], row, px, end)
    found = find_tear(pictures, [HEIGHT, HEIGHT, HEIGHT])
    assert found in [Tear(view, row, px), Tear(view, end, -px)]
    twice = find_tear(pictures, [2 * HEIGHT] * 3)  # pictures that were halved for it
    assert twice == Tear(view, 2 * found.row, 2 * found.px)


@pytest.mark.parametrize("view", [0, 1])
def test_row_and_shift_are_in_pixels_of_the_torn_picture_whatever_size_the_other_has(view):
    """Looked at in 240 and 150 rows, of pictures of 960 and 300."""
    pictures, heights = [scene(1), scene(2)[:150]], [4 * HEIGHT, 2 * 150]
    pictures[view] = torn(pictures[view], 80, -12)
    factor = (4, 2)[view]
    assert find_tear(pictures, heights) == Tear(view, 80 * factor, -12 * factor)


@pytest.mark.parametrize("seed", range(20))
def test_a_whole_picture_is_not_torn(seed):
    assert find_tear([scene(seed), scene(100 + seed)], [HEIGHT, HEIGHT]) is None


def bricks() -> np.ndarray:
    """Courses of bricks without mortar between them, each shifted by half a brick, and noise."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    image = np.where((u + 10 * (v // 20)) % 20 < 4, 60, 180)
    return (image + np.random.default_rng(0).normal(0, 2, image.shape)).astype(np.uint8)


def test_a_pattern_of_the_scene_is_no_tear():
    course = bricks()
    part = scene(0)
    part[100:] = course[100:]
    for picture in (course, part, course[:45]):
        assert find_tear([picture, picture], [len(picture)] * 2) is None
        assert find_tear([scene(5), course], [HEIGHT, HEIGHT]) is None


def test_bars_cuts_and_blank_pictures_are_no_tears():
    bars, cut = scene(0), scene(1)
    bars[:30], bars[-30:] = 0, 0
    cut[120:] = scene(2)[120:]  # of another picture: no shift brings it back
    blank = np.full((HEIGHT, WIDTH), 90, np.uint8)
    for picture in (bars, cut, blank, blank[:5], torn(blank, 100, 9)):
        assert find_tear([scene(7), picture], [HEIGHT, len(picture)]) is None


def test_a_torn_pair_is_reported_and_not_trusted():
    rig = render_pair(0, size=(240, 320), posed=False)
    left, right, K = rig.left.image_01.float(), rig.right.image_01.float(), rig.K_left.float()
    T = torch.from_numpy(np.linalg.inv(rig.E.numpy())).float()
    moved = right.clone()
    moved[:, 80:160] = moved[:, 80:160].roll(15, -1)
    for image, tear in ((right, None), (moved, [Tear(1, 80, 15), Tear(1, 160, -15)])):
        _, report = checked_views(PosedViews(left, (CameraView(image, rig.K_right.float(), T),), K))
        assert report.tear in (tear or [None])
    verdict = judge(Indicators(tear=Tear(1, 80, -15)))
    assert "right picture is torn: from row 80 on it is moved by 15 px to the left" in verdict.sentence
    assert "picture of right view 2 is torn" in judge(Indicators(tear=Tear(2, 80, -15))).sentence
