"""Upright lines: which are found, what is matched along them, and from when on they show a shear."""

import math

import cv2
import numpy as np
import pytest

from geodiff_plugin.matching import uprights
from geodiff_plugin.matching.uprights import certain_shear, upright_lines

HEIGHT, WIDTH = 120, 200
V = np.arange(HEIGHT)[:, None]


def test_only_long_lines_that_hardly_lean_are_upright():
    grey = np.full((HEIGHT, WIDTH), 200, np.uint8)
    ends = {  # upright: longer than 6 % of the height, leaning by less than a fifth
        (30, 10, 30, 110): True,
        (70, 10, 85, 100): True,
        (120, 10, 150, 100): False,
        (160, 50, 160, 55): False,
        (20, 115, 190, 115): False,
    }
    for x0, v0, x1, v1 in ends:
        cv2.line(grey, (x0, v0), (x1, v1), 0, 5)
    found = upright_lines(cv2.GaussianBlur(grey, (0, 0), 0.8))
    assert found.shape[1] == 4 and len(found) >= 4  # both sides of each
    for x0, v0, x1, v1 in found:
        middle = ((x0 + x1) / 2, (v0 + v1) / 2)
        near = [
            upright
            for (a, b, c, d), upright in ends.items()
            if abs((c - a) * (middle[1] - b) - (d - b) * (middle[0] - a)) < 6 * math.hypot(c - a, d - b)
            and min(b, d) - 4 <= middle[1] <= max(b, d) + 4
        ]
        assert near == [True]
        assert abs(v1 - v0) > 0.06 * HEIGHT and abs(x1 - x0) < 0.2 * abs(v1 - v0)
    assert upright_lines(np.full((50, 60), 9, np.uint8)).shape == (0, 4)


def test_the_median_of_each_row_counts_its_known_values():
    rng = np.random.default_rng(0)
    values, known = rng.normal(size=(30, 9)), rng.random((30, 9)) < 0.5
    known[:, 4] = True
    expected = [np.median(row[mask]) for row, mask in zip(values, known, strict=True)]
    np.testing.assert_allclose(uprights._median(values, known), expected)


def test_straight_courses_are_fitted_to_the_known_values_of_each_row_in_spite_of_outliers():
    """Against reweighted least squares, one row after the other."""
    rng = np.random.default_rng(1)
    at = rng.uniform(0, 90, (5, 40))
    values = 3 + np.linspace(-0.2, 0.3, 5)[:, None] * at + rng.normal(0, 0.1, at.shape)
    values[:, ::7] += 9
    known = rng.random(at.shape) < 0.8
    values[~known] = np.nan
    found = uprights._fit_lines(at, values, known)
    for n in range(5):
        x, y, mask = at[n][known[n]], values[n][known[n]], known[n]
        x = x - x.mean()
        weight = np.ones(len(x))
        for _ in range(8):
            slope, middle = np.polyfit(x, y, 1, w=np.sqrt(weight))
            off = y - middle - slope * x
            scale = 1.4826 * np.median(np.abs(off))
            weight = 1 / (1 + (off / (2 * scale)) ** 2)
        assert found.slope[n] == pytest.approx(slope, rel=1e-6)
        assert found.middle[n] == pytest.approx(middle, rel=1e-6)
        assert found.scale[n] == pytest.approx(scale, rel=1e-6)
        np.testing.assert_allclose(found.off[n][mask], off, atol=1e-6)
        assert abs(found.slope[n] - np.linspace(-0.2, 0.3, 5)[n]) < 5e-3


def test_the_shift_along_a_line_is_that_of_its_nearer_side_where_it_is_matched():
    rng = np.random.default_rng(2)
    shift = rng.uniform(1, 30, (HEIGHT, WIDTH)).astype(np.float32)
    matched = (rng.random(shift.shape) < 0.3).astype(np.float32)
    lines = np.array([[50.2, 20.0, 61.7, 99.0], [1.0, 110.3, 0.4, 70.9], [120.0, 5.0, 121.0, 9.0]])
    found = uprights._along(lines, shift, matched)
    for n, (x0, v0, x1, v1) in enumerate(lines):
        count = max(8, int(abs(v1 - v0)))
        known = 0
        for k in range(count):
            t = 0.05 + 0.9 * k / (count - 1)  # not at the ends, where other lines meet it
            row, column = round(v0 + (v1 - v0) * t), round(x0 + (x1 - x0) * t)
            columns = np.clip(np.arange(column - 2, column + 3), 0, WIDTH - 1)
            values = shift[row, columns][matched[row, columns] > 0]
            assert found.row[n, k] == row and found.known[n, k] == (len(values) > 0)
            if len(values):
                assert found.shift[n, k] == values.max()
                known += 1
        assert not found.known[n, count:].any()
        assert found.share[n] == pytest.approx(known / count)
    assert found.known.shape[1] == 79


def lines_of(count: int = 9, k: float = 0.0, spread: float = 70.0, length: float = 80.0) -> np.ndarray:
    """Lines with slopes ``k (x - 95)``, spread evenly around column 100 at half height."""
    x = 100 + spread * np.linspace(-1, 1, count)
    lean = k * (x - 95) * length / 2
    return np.stack([x - lean, np.full(count, 60 - length / 2), x + lean, np.full(count, 60 + length / 2)], 1)


def sheared(k: float = 0.0, shear: float = 0.0, scatter: float = 0.0) -> np.ndarray:
    """Shift of a plane at 20 px along whose lines it grows by ``k d``, and by a shear."""
    noise = np.random.default_rng(3).normal(0, scatter, (HEIGHT, WIDTH)) if scatter else 0.0
    return (20 * (1 + k * (V - 60)) + shear * (V - 60) + noise) * np.ones((1, WIDTH))


EVERYWHERE = np.ones((HEIGHT, WIDTH))


@pytest.mark.parametrize("shear", [-0.07, 0.05])
@pytest.mark.parametrize("k", [0.0, 0.002, -0.002])
def test_a_shear_is_measured_as_far_as_the_lines_that_meet_leave_no_doubt(k, shear):
    """Exact lines: of the error only the one of ``k`` remains, for slopes that are exact to 0.01 px a row."""
    lines = lines_of(k=k)
    error = 0.01 / (3 * np.std((lines[:, 0] + lines[:, 2]) / 2)) * 20
    pitched = math.copysign(max(abs(shear) - 4 * error, 0), shear)
    flat = shear + 20 * k
    expected = min((flat, pitched), key=abs) if flat * pitched > 0 else 0.0
    found = certain_shear(lines, sheared(k, shear), EVERYWHERE)
    assert found == pytest.approx(expected, abs=1e-3)
    if k == 0:
        assert abs(found) < abs(shear) - 0.004


def test_a_pitch_alone_is_no_shear():
    for k in (-0.004, 0.003):
        assert certain_shear(lines_of(k=k), sheared(k), EVERYWHERE) == 0.0


def in_columns(good: int, bad: float) -> np.ndarray:
    """The map around the first ``good`` of nine lines, and another around the others."""
    return np.where(np.arange(WIDTH) < 30 + 17.5 * good - 8, 1.0, bad) * EVERYWHERE


@pytest.mark.parametrize(
    ("lines", "shift", "matched", "enough"),
    [
        pytest.param(lines_of(6), sheared(), EVERYWHERE, True, id="six lines"),
        pytest.param(lines_of(5), sheared(), EVERYWHERE, False, id="five lines"),
        pytest.param(lines_of(), sheared(), in_columns(6, 0.0), True, id="six are matched"),
        pytest.param(lines_of(), sheared(), in_columns(5, 0.0), False, id="five are matched"),
        pytest.param(
            lines_of(), sheared(), (V % 25 < 13) * EVERYWHERE, True, id="half of their pixels are matched"
        ),
        pytest.param(lines_of(), sheared(), (V % 25 < 11) * EVERYWHERE, False, id="less than half of them"),
        pytest.param(
            lines_of(length=9.9),
            sheared(),
            (V != 60) * EVERYWHERE,
            True,
            id="eight pixels of nine are matched",
        ),
        pytest.param(
            lines_of(length=9.9), sheared(), ((V != 60) & (V != 62)) * EVERYWHERE, False, id="seven of nine"
        ),
        pytest.param(lines_of(spread=32), sheared(), EVERYWHERE, True, id="spread by a tenth of the width"),
        pytest.param(lines_of(spread=30), sheared(), EVERYWHERE, False, id="less spread"),
    ],
)
def test_few_short_and_narrow_sets_of_lines_show_nothing(lines, shift, matched, enough):
    assert math.isnan(certain_shear(lines, shift, matched)) is not enough


def test_lines_along_which_shifts_scatter_do_not_count():
    """On three or four of nine lines they scatter by 1.4 px; of the larger of five neighbours by less."""
    columns = np.arange(WIDTH)
    for noisy, enough in ((3, True), (4, False)):
        first = 30 + 17.5 * (9 - noisy) - 8
        jump = np.where((V % 5 < 3) & (columns > first), 2.5, 0.0)
        found = certain_shear(lines_of(), sheared() + jump, EVERYWHERE)
        assert math.isnan(found) is not enough
    small = np.where((V % 5 < 3) & (columns > 0), 1.1, 0.0)
    assert not math.isnan(certain_shear(lines_of(), sheared() + small, EVERYWHERE))


def test_lines_that_do_not_meet_in_the_common_vanishing_point_do_not_count():
    lines = lines_of(12)
    leaning = lines.copy()
    leaning[::4, 2] += 0.05 * 80  # three of twelve lean by more than three times the exactness of .01
    shift = sheared(shear=0.06)
    own = np.where(np.abs(np.arange(WIDTH)[:, None] - lines[::4, 0]).min(1) < 8, 0.3, 0.0)
    straight = certain_shear(lines, shift, EVERYWHERE)
    assert straight > 0.03
    assert certain_shear(leaning, shift + own * (V - 60), EVERYWHERE) == pytest.approx(straight, abs=0.006)
    leaning = lines.copy()
    leaning[::2, 2] += 0.15 * 80  # half of them lean: there is no common vanishing point
    assert math.isnan(certain_shear(leaning, shift, EVERYWHERE))
    leaning = lines_of(7)
    leaning[[2, 5], 2] += 0.05 * 80  # five of seven remain
    assert math.isnan(certain_shear(leaning, shift, EVERYWHERE))
    assert not math.isnan(certain_shear(lines_of(7), shift, EVERYWHERE))


def test_the_median_of_scattered_values_is_certain_beyond_four_standard_errors():
    """Of normal values: a median's error is 1.253 times a mean's, their middle half 1.349 deviations."""
    values = np.random.default_rng(5).normal(1.0, 0.3, 41)
    quartiles = np.quantile(values, (0.25, 0.75))
    error = 1.253 * (quartiles[1] - quartiles[0]) / 1.349 / np.sqrt(41)
    for sign in (1, -1):
        expected = sign * (np.median(values) - 4 * error)
        assert uprights._certain_median(sign * values) == pytest.approx(expected, rel=1e-9)
        expected = sign * (np.median(values) - 4 * np.hypot(error, 0.1))
        assert uprights._certain_median(sign * values, 0.1) == pytest.approx(expected, rel=1e-9)
    assert uprights._certain_median(values, 0.5) == 0.0
