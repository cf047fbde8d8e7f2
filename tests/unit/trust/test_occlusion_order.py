"""The order of near and far at occlusions, against a loop over the rows of a scene in which not all agree."""

import math

import cv2
import numpy as np
import pytest

from geodiff_plugin.matching.gaps import find_gaps
from geodiff_plugin.trust import RowsStage
from geodiff_plugin.trust.occlusion_order import MAX_DISTANCE_PX, OcclusionOrder, Order, occlusion_order
from geodiff_plugin.trust.order_ambiguity import Ambiguity
from geodiff_plugin.trust.prior_correlation import Correlation
from tests.unit.trust.sheets import codes, good, sheet

HEIGHT, WIDTH = 220, 140


def votes_of(grey: np.ndarray, shift: np.ndarray, known: np.ndarray) -> dict[int, float]:
    """The vote of each row that has one, by the definition, with its constants written again."""
    blurred = cv2.GaussianBlur(grey, (0, 0), 0.8).astype(float)
    votes = {}
    for row in range(HEIGHT):
        for far in range(3, WIDTH):
            if not known[row, far] or far + 1 >= WIDTH or known[row, far + 1]:
                continue
            near = far + 1 + int(np.argmax(known[row, far + 1 :]))
            if not known[row, near] or near > WIDTH - 5:
                continue
            rise, width = shift[row, near] - shift[row, far], near - far - 1
            if rise < 4 or abs(width - rise) >= max(2.0, 0.35 * rise):
                continue
            steps = np.abs(np.diff(blurred[row]))
            # The seven steps around the one at an end, which is from far to far + 1 or to near.
            difference = steps[near - 4 : near + 3].max() - steps[far - 3 : far + 4].max()
            if abs(difference) > 4:
                votes[row] = np.sign(difference)
    return votes


def mixed(seed: int, rows: int = HEIGHT) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A near surface in front of a far one in every row, with rises and gaps of many widths.

    The image changes at the nearer end in most rows, at the farther one in others, and nowhere in some; some
    occlusions are too near to a border.
    """
    rng = np.random.default_rng(seed)
    grey = np.full((HEIGHT, WIDTH), 100.0) + rng.normal(0, 1, (HEIGHT, WIDTH))
    shift, known = np.full((HEIGHT, WIDTH), 6.0), np.ones((HEIGHT, WIDTH), bool)
    for row in range(0, HEIGHT, 2):
        pair = slice(row, row + 2)  # neighbouring rows alike, so that the blur leaves steps
        start, rise = int(rng.integers(1, 100)), float(rng.uniform(2, 25))
        width = max(1, round(rise + rng.choice([0.0, 0.0, 1.9, -1.9, 2.2, 0.33 * rise, -0.37 * rise])))
        if row % 10 == 0:  # at the borders, where pixels on either side of an end just fit or do not
            start = int(rng.choice([3, 4, WIDTH - 4 - width, WIDTH - 5 - width]))
        near = min(start + width, WIDTH - 1)
        shift[pair, near:] += rise
        known[pair, start:near] = False
        at = rng.choice(
            [near, near, near + 2, near - 3, start - 1, start + 3, -1], p=[0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.1]
        )
        if at >= 0:
            grey[pair, max(at, 0) :] += rng.choice([8, 30, -40])
    known[rows:] = True
    return np.clip(grey, 0, 255).astype(np.uint8), shift.astype(np.float32), known


@pytest.mark.parametrize("seed", range(3))
def test_the_order_is_the_mean_over_clear_occlusions_of_which_end_changes_more(seed):
    grey, shift, known = mixed(seed)
    votes = votes_of(grey, shift, known)
    expected = np.mean(list(votes.values()))
    assert 0.1 < expected < 0.9 and len(votes) > 60
    assert occlusion_order(grey, shift, find_gaps(known)) == pytest.approx(expected, abs=1e-6)
    last = sorted(votes)[59]  # the row of the sixtieth vote, without which there are too few
    expected = np.mean([vote for row, vote in votes.items() if row <= last])
    found = occlusion_order(grey, shift, find_gaps(mixed(seed, last + 1)[2]))
    assert found == pytest.approx(expected, abs=1e-6)
    assert math.isnan(occlusion_order(grey, shift, find_gaps(mixed(seed, last)[2])))


def box_in_front_of_a_wall(rows: int = 80) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The left image, the shift and where it is known, for a box at columns 90 to 140 in the first rows."""
    rng = np.random.default_rng(0)
    grey = rng.integers(90, 110, (80, 200)).astype(np.uint8)
    shift, known = np.full((80, 200), 5.0, np.float32), np.ones((80, 200), bool)
    grey[:rows, 90:140], shift[:rows, 90:140] = rng.integers(190, 210, (rows, 50)), 17.0
    known[:rows, 78:90] = False  # of the wall, occluded in the right view
    return grey, shift, known


def order_of(grey: np.ndarray, shift: np.ndarray, known: np.ndarray) -> Order | None:
    lines = np.zeros((0, 4))
    return OcclusionOrder.of_rows(RowsStage(grey, shift, known, find_gaps(known), lines, (80, 200)))


def test_near_occludes_far_and_a_mirrored_pair_shows_the_opposite():
    grey, shift, known = box_in_front_of_a_wall()
    assert order_of(grey, shift, known) == Order(1.0)
    # Mirrored, the occluded pixels are at the other side of the box, whose shift is now the smaller one.
    mirrored = [np.ascontiguousarray(part[:, ::-1]) for part in (grey, 22.0 - shift, known)]
    assert order_of(*mirrored) == Order(-1.0)


@pytest.mark.parametrize(("rows", "expected"), [(60, Order(1.0)), (59, None)])
def test_sixty_occlusions_are_needed(rows, expected):
    assert order_of(*box_in_front_of_a_wall(rows)) == expected


def test_gaps_that_are_no_occlusions_do_not_count():
    grey, shift, known = box_in_front_of_a_wall()
    unlit = np.full_like(grey, 100)
    small = np.where(shift > 5.0, 10.0, 5.0).astype(np.float32)  # the gap is twice as wide as the rise
    at_edge = np.roll(known, -(78 - MAX_DISTANCE_PX + 1), axis=1)
    for case in ((unlit, shift, known), (grey, small, known), (grey, shift, at_edge)):
        assert order_of(*case) is None
    assert order_of(grey, shift, np.ones_like(known)) is None
    assert order_of(grey, shift, np.zeros_like(known)) is None


def test_an_edge_that_the_matcher_moved_by_a_little_is_still_found():
    grey, shift, known = box_in_front_of_a_wall()
    moved = cv2.warpAffine(grey, np.float32([[1, 0, 2], [0, 1, 0]]), grey.shape[::-1], borderValue=100)
    assert order_of(moved, shift, known) == Order(1.0)


@pytest.mark.parametrize(
    ("order", "ambiguity", "correlation", "is_reason"),
    [
        (-0.36, 0.3, 0.44, True),
        (-0.34, 0.3, 0.44, False),
        (-0.36, 0.29, 0.44, False),  # the matches exclude it
        (-0.36, None, 0.44, False),
        (-0.36, 0.3, 0.45, False),  # the prior confirms the order of the matches
        (-0.36, 0.3, None, True),
        (0.36, 0.3, 0.44, False),
    ],
)
def test_far_that_occludes_near_is_a_reason_if_matches_allow_it_and_the_prior_does_not_deny_it(
    order, ambiguity, correlation, is_reason
):
    known = [Order(order)]
    known += [] if ambiguity is None else [Ambiguity(ambiguity)]
    known += [] if correlation is None else [Correlation(correlation)]
    found = [finding.code for finding in OcclusionOrder.findings(sheet(*known), ())]
    assert found == (["depth.occlusion"] if is_reason else [])
    assert OcclusionOrder.near_occludes_far(sheet(*known)) is (order > 0)


def test_without_occlusions_nothing_is_reported():
    assert not OcclusionOrder.near_occludes_far(good()) and codes(good(Ambiguity(1.0))) == []
