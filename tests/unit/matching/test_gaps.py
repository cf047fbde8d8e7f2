"""Gaps of a map, pixel by pixel: where they are, which are occluded, and what fills them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from geodiff_plugin.matching.gaps import fill_background, find_gaps, occluded_gaps

#: Shifts, NaN where nothing is known.
MAPS = arrays.arrays(
    np.float32,
    st.tuples(st.integers(1, 5), st.integers(1, 12)),
    elements=st.sampled_from([math.nan, math.nan, 1.0, 2.5, 6.0, 9.0]),
)


def neighbours(row: np.ndarray, column: int) -> tuple[int | None, int | None]:
    """Columns of the nearest known pixels to the left and right of one, itself if it is known."""
    known = np.flatnonzero(~np.isnan(row))
    left, right = known[known <= column], known[known >= column]
    return (left.max() if left.size else None), (right.min() if right.size else None)


@settings(max_examples=60, deadline=None)
@given(shift=MAPS)
def test_every_unknown_pixel_is_in_the_gap_between_its_nearest_known_ones(shift):
    gaps = find_gaps(np.isfinite(shift))
    number = gaps.put(np.full(shift.shape, -1), np.arange(len(gaps.row)))
    assert ((number < 0) == ~gaps.unknown).all() and (gaps.unknown == np.isnan(shift)).all()
    for (row, column), gap in np.ndenumerate(number):
        if gap < 0:
            continue
        left, right = neighbours(shift[row], column)
        assert gaps.row[gap] == row
        assert gaps.first[gap] == (0 if left is None else left + 1)
        assert gaps.end[gap] == (shift.shape[1] if right is None else right)
        assert gaps.inner[gap] == (left is not None and right is not None)


@settings(max_examples=60, deadline=None)
@given(shift=MAPS)
def test_gaps_take_the_farther_of_their_ends_and_empty_rows_the_row_above(shift):
    filled = fill_background(shift)
    assert filled.dtype == shift.dtype
    full = [row for row in range(len(shift)) if not np.isnan(shift[row]).all()]
    if not full:
        assert np.isnan(filled).all()
        return
    for row, column in np.ndindex(*shift.shape):
        source = max((other for other in full if other <= row), default=full[0])
        ends = [shift[source, at] for at in neighbours(shift[source], column) if at is not None]
        assert filled[row, column] == min(ends)


def test_a_map_without_gaps_stays_and_given_gaps_count_instead_of_what_is_not_finite():
    shift = np.array([[4.0, 7.0, 2.0], [3.0, 3.0, 5.0]])
    assert (fill_background(shift) == shift).all()
    gaps = find_gaps(np.array([[True, False, True], [False, False, True]]))
    assert fill_background(shift, gaps).tolist() == [[4.0, 2.0, 2.0], [5.0, 5.0, 5.0]]


def hidden_pixels(shift: np.ndarray, known: np.ndarray, infinity_px: float = -20.0) -> np.ndarray:
    """By default a point at infinity is 20 px further to the right in the right view, which sees it all."""
    gaps = find_gaps(known)
    return gaps.put(np.zeros_like(known), occluded_gaps(shift, gaps, infinity_px))


def test_a_gap_is_hidden_where_it_is_no_wider_than_the_step_next_to_it():
    """Gaps of 6 pixels: far before near, near before far, without a step, and with too small a step."""
    ends = [(4.0, 10.0), (10.0, 4.0), (4.0, 4.0), (4.0, 7.0)]
    shift = np.array([[far] * 5 + [0.0] * 6 + [near] * 5 for far, near in ends], np.float32)
    known = shift > 0
    found = hidden_pixels(shift, known)
    assert found[0].tolist() == (~known[0]).tolist()
    assert not found[1:].any()
    assert not hidden_pixels(shift[:, 5:], known[:, 5:]).any()  # the gap has no farther end


@pytest.mark.parametrize(("infinity_px", "hides"), [(-5.0, True), (-4.0, True), (-3.0, False), (0.0, False)])
def test_a_gap_is_not_hidden_where_the_right_view_would_not_see_the_near_surface_either(infinity_px, hides):
    """The right view begins at its column 0, where it sees column ``8 + infinity_px`` of the near surface."""
    shift = np.array([[3.0] * 4 + [0.0] * 6 + [8.0] * 6], np.float32)
    assert hidden_pixels(shift, shift > 0, infinity_px)[0].tolist() == [
        hides and 4 <= column < 10 for column in range(16)
    ]


@pytest.mark.parametrize(("step", "hides"), [(1.9, False), (2.1, True)])
def test_a_step_that_is_chance_hides_nothing(step, hides):
    shift = np.array([[5.0, 0.0, 5.0 + step]], np.float32)
    assert hidden_pixels(shift, shift > 0).tolist() == [[False, hides, False]]


@pytest.mark.parametrize(("width", "hides"), [(1, True), (7, True), (8, True), (9, False), (12, False)])
def test_a_hidden_gap_is_at_most_two_pixels_wider_than_its_step(width, hides):
    shift = np.array([[3.0] * 4 + [0.0] * width + [9.0] * 5], np.float32)
    assert hidden_pixels(shift, shift > 0)[0].tolist() == [hides and not known for known in (shift > 0)[0]]


def test_a_gap_is_all_of_a_map_that_holds_in_each_of_its_pixels():
    gaps = find_gaps(np.array([[True, False, False, True, False], [False, True, True, True, True]]))
    values = np.array([[False, True, True, False, True], [False, True, True, True, True]])
    assert gaps.all_of(values).tolist() == [True, True, False]
    assert gaps.all_of(np.arange(10).reshape(2, 5) != 2).tolist() == [False, True, True]
    assert find_gaps(np.ones((2, 5), bool)).all_of(values).shape == (0,)
