"""At occlusions a picture changes where the nearer surface begins."""

import cv2
import numpy as np
import pytest

from geodiff_plugin.matching import occlusion
from geodiff_plugin.matching.gaps import find_gaps
from geodiff_plugin.matching.occlusion import FEWEST, REACH_PX

HEIGHT, WIDTH, RISE = 80, 200, 12
#: Columns of a box that stands before a wall.
BOX = slice(90, 140)


def box_before_a_wall(rows: int = HEIGHT) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The left picture, the shift and where both pictures show the same, for a box in the first ``rows``."""
    rng = np.random.default_rng(0)
    grey = rng.integers(90, 110, (HEIGHT, WIDTH)).astype(np.uint8)
    shift = np.full((HEIGHT, WIDTH), 5.0, np.float32)
    matched = np.ones((HEIGHT, WIDTH), bool)
    grey[:rows, BOX], shift[:rows, BOX] = rng.integers(190, 210, (rows, 50)), 5.0 + RISE
    matched[:rows, BOX.start - RISE : BOX.start] = False  # of the wall, hidden from the camera to the right
    return grey, shift, matched


def occlusion_order(grey: np.ndarray, shift: np.ndarray, matched: np.ndarray) -> float:
    return occlusion.occlusion_order(grey, shift, find_gaps(matched))


def test_near_hides_far_and_a_mirrored_pair_shows_the_opposite():
    grey, shift, matched = box_before_a_wall()
    assert occlusion_order(grey, shift, matched) == 1.0
    # Mirrored, the hidden pixels lie at the other side of the box, whose shift is now the smaller one.
    mirrored = [np.ascontiguousarray(part[:, ::-1]) for part in (grey, 22.0 - shift, matched)]
    assert occlusion_order(*mirrored) == -1.0


@pytest.mark.parametrize(("rows", "known"), [(FEWEST, True), (FEWEST - 1, False)])
def test_few_occlusions_say_nothing(rows, known):
    assert np.isnan(occlusion_order(*box_before_a_wall(rows))) is not known


def test_gaps_that_are_no_occlusions_say_nothing():
    grey, shift, matched = box_before_a_wall()
    unlit = np.full_like(grey, 100)
    small = np.where(shift > 5.0, 10.0, 5.0).astype(np.float32)  # the gap is twice as wide as the rise
    at_edge = np.roll(matched, -(BOX.start - RISE - REACH_PX + 1), axis=1)
    for case in ((unlit, shift, matched), (grey, small, matched), (grey, shift, at_edge)):
        assert np.isnan(occlusion_order(*case))
    assert np.isnan(occlusion_order(grey, shift, np.ones_like(matched)))
    assert np.isnan(occlusion_order(grey, shift, np.zeros_like(matched)))


def test_an_edge_that_the_matcher_moved_by_a_little_is_still_found():
    grey, shift, matched = box_before_a_wall()
    moved = cv2.warpAffine(grey, np.float32([[1, 0, 2], [0, 1, 0]]), grey.shape[::-1], borderValue=100)
    assert occlusion_order(moved, shift, matched) == 1.0
