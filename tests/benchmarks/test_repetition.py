"""How results on repeated patterns are scored."""

import numpy as np
import pytest

from tests.benchmarks.repetition import mean_scores, scores_of


def test_scores_count_known_pixels_and_pairs_weigh_the_same():
    truth_m = np.array([[2.0, 2.0, 2.0, 2.0, 0.0]])
    depth_m = np.array([[2.1, 2.1, 4.0, 2.0, 9.0]])
    confidence = np.array([[0.95, 0.5, 0.95, 0.95, 1.0]])
    one = scores_of(depth_m, confidence, truth_m)
    assert (one.within, one.sure, one.sure_and_within) == (0.75, 0.75, 0.5)
    assert one.abs_rel == pytest.approx(1.1 / 4) and one.kept == pytest.approx(2 / 3)
    other = scores_of(truth_m, np.zeros((1, 5)), truth_m)
    assert np.isnan(other.kept)
    both = mean_scores([one, other])
    assert both.kept == pytest.approx(2 / 3) and (both.within, both.sure) == (0.875, 0.375)
