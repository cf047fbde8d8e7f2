"""Vertical lines: which are found, what is matched along them, and from when on they show a shear."""

import math

import cv2
import numpy as np
import pytest
import torch

from geodiff_plugin.matching.gaps import find_gaps
from geodiff_plugin.matching.rows import match_rows, row_images
from geodiff_plugin.trust import MatchError, RowsStage, rolling_shutter
from geodiff_plugin.trust.rolling_shutter import RollingShutter, Shear, certain_shear, vertical_lines
from tests.unit.trust.sheets import codes, good, judged, sheet
from tests.views import view_of

HEIGHT, WIDTH = 120, 200
V = np.arange(HEIGHT)[:, None]


def test_only_long_lines_that_hardly_lean_are_vertical():
    grey = np.full((HEIGHT, WIDTH), 200, np.uint8)
    ends = {  # vertical: longer than 6 % of the height, leaning by less than a fifth
        (30, 10, 30, 110): True,
        (70, 10, 85, 100): True,
        (120, 10, 150, 100): False,
        (160, 50, 160, 55): False,
        (20, 115, 190, 115): False,
    }
    for x0, v0, x1, v1 in ends:
        cv2.line(grey, (x0, v0), (x1, v1), 0, 5)
    found = vertical_lines(cv2.GaussianBlur(grey, (0, 0), 0.8))
    assert found.shape[1] == 4 and len(found) >= 4  # both sides of each
    for x0, v0, x1, v1 in found:
        middle = ((x0 + x1) / 2, (v0 + v1) / 2)
        near = [
            is_vertical
            for (a, b, c, d), is_vertical in ends.items()
            if abs((c - a) * (middle[1] - b) - (d - b) * (middle[0] - a)) < 6 * math.hypot(c - a, d - b)
            and min(b, d) - 4 <= middle[1] <= max(b, d) + 4
        ]
        assert near == [True]
        assert abs(v1 - v0) > 0.06 * HEIGHT and abs(x1 - x0) < 0.2 * abs(v1 - v0)
    assert vertical_lines(np.full((50, 60), 9, np.uint8)).shape == (0, 4)


def test_the_median_of_each_row_counts_its_known_values():
    rng = np.random.default_rng(0)
    values, known = rng.normal(size=(30, 9)), rng.random((30, 9)) < 0.5
    known[:, 4] = True
    expected = [np.median(row[mask]) for row, mask in zip(values, known, strict=True)]
    np.testing.assert_allclose(rolling_shutter._median(values, known), expected)


def test_straight_courses_are_fitted_to_the_known_values_of_each_row_in_spite_of_outliers():
    """Against reweighted least squares, one row after the other."""
    rng = np.random.default_rng(1)
    at = rng.uniform(0, 90, (5, 40))
    values = 3 + np.linspace(-0.2, 0.3, 5)[:, None] * at + rng.normal(0, 0.1, at.shape)
    values[:, ::7] += 9
    known = rng.random(at.shape) < 0.8
    values[~known] = np.nan
    found = rolling_shutter._fit_lines(at, values, known)
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
    found = rolling_shutter._along(lines, shift, matched)
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
        assert found.fraction[n] == pytest.approx(known / count)
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
        assert rolling_shutter._certain_median(sign * values) == pytest.approx(expected, rel=1e-9)
        expected = sign * (np.median(values) - 4 * np.hypot(error, 0.1))
        assert rolling_shutter._certain_median(sign * values, 0.1) == pytest.approx(expected, rel=1e-9)
    assert rolling_shutter._certain_median(values, 0.5) == 0.0


POLES_SIZE = (240, 320)
ROWS = np.arange(240)


def poles(k: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Poles that meet in one vanishing point, and the shift of each, 10 to 40 px at half height.

    Of parallel lines in space both the place in the row, from the vanishing point on, and the shift grow by
    ``1 + k (v - v_c)``.
    """
    rng, (height, width) = np.random.default_rng(seed), POLES_SIZE
    grey = np.full(POLES_SIZE, 120, np.uint8)
    shift = np.full(POLES_SIZE, 8.0, np.float32)
    grows = 1 + k * (ROWS - height / 2)
    for x in np.linspace(20, width - 30, 14):
        left, right = (width / 2 + (x + side - width / 2) * grows for side in (0, 9))
        inside = (np.arange(width) >= left[:, None]) & (np.arange(width) <= right[:, None])
        grey[inside] = rng.integers(0, 80)
        shift = np.where(inside, np.float32(rng.uniform(10, 40) * grows[:, None]), shift)
    return cv2.GaussianBlur(grey, (0, 0), 0.7), shift


@pytest.mark.parametrize("k", [-0.002, 0.0, 0.0015])
@pytest.mark.parametrize("shear", [-0.06, 0.03, 0.08])
def test_a_shear_is_measured_in_an_image_and_a_pitch_of_the_cameras_only_hides_it(k, shear):
    grey, shift = poles(k)
    leaning = shift + shear * (ROWS - 120)[:, None]
    found = certain_shear(vertical_lines(grey), leaning, np.ones_like(shift))
    assert found * shear >= 0 and abs(found) <= abs(shear) + 0.002
    if k == 0:
        assert found == pytest.approx(shear, abs=0.012)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("k", [-0.003, -0.001, 0.0, 0.002])
def test_noisy_shifts_of_pitched_cameras_are_no_shear(k, seed):
    grey, shift = poles(k, seed)
    noisy = shift + np.random.default_rng(seed).normal(0, 0.3, shift.shape).astype(np.float32)
    assert abs(certain_shear(vertical_lines(grey), noisy, np.ones_like(shift))) < 0.003


@pytest.mark.parametrize("seed", range(8))
def test_lines_that_lean_each_its_own_way_show_no_shear(seed):
    """Poles in a heap: no common vanishing point in space, though each looks vertical."""
    grey, shift = poles(0.0, seed)
    own = np.random.default_rng(seed).normal(0, 0.08, 16)[np.arange(320) * 16 // 320]
    leaning = shift + own * ROWS[:, None]
    assert abs(certain_shear(vertical_lines(grey), leaning, np.ones_like(shift))) < 0.03


@pytest.mark.parametrize("others", [3, 4])
def test_a_tilted_board_among_few_other_lines_is_no_shear(others):
    """Its lines meet, and shifts grow along them; lines that lean otherwise hide where they meet."""
    k, columns = 0.004, np.arange(320)
    grows = 1 + k * (ROWS - 120)[:, None]
    board = (columns - 160) / grows
    grey = np.where((np.abs(board) < 60) & (board % 12 < 5), 40, 120).astype(np.uint8)
    shift = np.broadcast_to(30 * grows, grey.shape).astype(np.float32).copy()
    for n in range(others):  # poles next to it that lean inwards, where the board's lines lean outwards
        at = (1 - 2 * (n % 2)) * (-130 - 8 * (n // 2) + 0.18 * (ROWS - 120)[:, None]) + 160
        pole = np.abs(columns - at) < 2
        grey[pole], shift[pole] = 10, 12.0
    lines = vertical_lines(cv2.GaussianBlur(grey, (0, 0), 0.7))
    assert not abs(certain_shear(lines, shift, np.ones_like(shift))) > 0.003


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("shear", [0.0, 0.05])
def test_matched_rows_of_a_sheared_image_show_it(side, shear):
    """The right view on either side: what it sees lies further left, or further right."""
    grey = np.clip(poles(0.0)[0] + np.random.default_rng(0).normal(0, 12, POLES_SIZE), 0, 255).astype(
        np.uint8
    )
    v, u = np.mgrid[:240, :320].astype(np.float32)
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    T = torch.eye(4)
    T[0, 3] = -0.1 * side
    right = cv2.remap(grey, u + side * (20 + np.float32(shear) * v), v, cv2.INTER_LINEAR)
    left_01, right_01 = (torch.from_numpy(each / 255.0).float().expand(3, -1, -1) for each in (grey, right))
    images = row_images(view_of(left_01, K), view_of(right_01, K, T))
    greys = images.greys(images.levels)
    stage = RowsStage(*match_rows(images, greys, 60.0), vertical_lines(greys[0]), POLES_SIZE)
    found = RollingShutter.of_rows(stage)
    assert found.width_px == 320 and found.shear == pytest.approx(0.75 * shear, abs=0.0075)


def test_the_shear_is_a_fraction_of_the_width_of_the_image():
    """The rows are matched on a grid of square pixels, smaller than the image."""
    px_per_row = certain_shear(lines_of(), sheared(shear=0.05), EVERYWHERE)

    def stage(count: int) -> RowsStage:
        everywhere = EVERYWHERE > 0
        grey, shift = np.zeros((HEIGHT, WIDTH), np.uint8), sheared(shear=0.05)
        return RowsStage(grey, shift, everywhere, find_gaps(everywhere), lines_of(count), (300, 1664))

    assert px_per_row > 0.04
    assert RollingShutter.of_rows(stage(9)) == Shear(px_per_row * 300 / 1664, 1664)
    assert RollingShutter.of_rows(stage(5)) is None


@pytest.mark.parametrize("shear", [0.0051, -0.0051, 0.0049, -0.0049])
def test_a_shear_to_either_side_is_a_reason(shear):
    assert codes(good(Shear(shear, 640))) == (["views.rolling-shutter"] if abs(shear) > 0.005 else [])
    assert "by 3.5 % of its width" in judged(
        good(Shear(math.copysign(0.03456, shear), 640)), "views.rolling-shutter"
    )


@pytest.mark.parametrize(
    ("shear", "width_px", "expected_px"),
    [
        (0.001, 1248, 0.0),
        (-0.001, 1248, 0.0),
        (0.0011, 1000, 1.1 / math.sqrt(3)),
        (-0.03, 600, 18 / math.sqrt(3)),
    ],
)
def test_the_error_of_a_sheared_image_is_the_root_mean_square_of_its_shift(shear, width_px, expected_px):
    error = RollingShutter.match_error(sheet(Shear(shear, width_px)))
    assert error == pytest.approx(MatchError(px=expected_px))
