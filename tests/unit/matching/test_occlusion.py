"""The order of near and far at occlusions, against a loop over the rows of a scene in which not all agree."""

import math

import cv2
import numpy as np
import pytest

from geodiff_plugin.matching.gaps import find_gaps
from geodiff_plugin.matching.occlusion import occlusion_order

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
