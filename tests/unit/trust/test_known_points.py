"""Known points: how they compare with matches, whether they are enough, and the units that they may be in."""

import math
from dataclasses import replace

import numpy as np
import pytest

from geodiff_plugin.trust import KnownPoints, judge, measure_result
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.trust.matched_fraction import Matched
from geodiff_plugin.trust.prior_correlation import Correlation
from tests.unit.trust.made_stages import GRID, STEP, made_result, matches_of
from tests.unit.trust.sheets import codes, good, judged, sheet

LOG = math.log
#: Points that agree with the matches.
AGREE = Points(99, 0, 0.5, 1.0, 0.0)


def lower_median(values: np.ndarray) -> float:
    return float(np.quantile(values, 0.5, method="lower"))


def cover(known: np.ndarray) -> float:
    """Fraction of 8x8 parts of the map that contain a point."""
    height, width = known.shape
    parts = [
        known[height * i // 8 : -(-height * (i + 1) // 8), width * j // 8 : -(-width * (j + 1) // 8)].any()
        for i in range(8)
        for j in range(8)
    ]
    return float(np.mean(parts))


def test_points_are_compared_with_the_matches_around_them():
    """Sparse points, matches with gaps wider than a window, and matches beyond the first plane."""
    rng = np.random.default_rng(1)
    inverse, confidence = rng.uniform(0.1, 0.7, GRID), rng.random(GRID) * (rng.random(GRID) < 0.5)
    confidence[:12, :20] = 0.2
    confidence[rng.random(GRID) < 0.1] = 0.5
    inverse[20:, 30:] = 0.004
    known = rng.random(GRID) < 0.06
    of_points = np.where(known, inverse * np.exp(rng.normal(-0.05, 0.2, GRID)), 0.0)
    points = matches_of(of_points, known * rng.uniform(0.1, 1.0, GRID), 0.002)
    stage = made_result(matches_of(inverse, confidence), points, points_outside=7)
    ratios = []
    for row, column in np.argwhere(known):
        window = np.s_[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4]
        confident = confidence[window] > 0.5
        if confident.any() and inverse[window][confident].mean() > STEP:
            ratios.append(inverse[window][confident].mean() / of_points[row, column])
    ratios = np.array(ratios)
    assert 12 < len(ratios) < known.sum() and 0 < cover(known) < 1
    off = (np.abs(np.log(ratios)) > LOG(1.2)).mean()
    found = measure_result(stage)[KnownPoints]
    assert (found.count, found.outside) == (known.sum(), 7)
    expected = (cover(known), lower_median(ratios), off)
    assert (found.cover, found.ratio, found.fraction_off) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("count", "is_known"), [(12, True), (11, False)])
def test_twelve_points_next_to_matches_are_compared(count, is_known):
    inverse, known = np.full(GRID, 0.5), np.zeros(GRID)
    known.flat[:count] = 1.0
    stage = made_result(matches_of(inverse, np.ones(GRID)), matches_of(0.25 * known, known))
    found = measure_result(stage)[KnownPoints]
    assert (found.ratio, found.fraction_off) == ((2.0, 1.0) if is_known else (None, None))
    assert found.count == count


def test_points_alone_are_counted_and_without_any_nothing_is_known():
    known = np.eye(*GRID)
    points = matches_of(np.full(GRID, 0.5), known)
    alone = Points(29, 0, cover(known > 0), None, None)
    assert measure_result(made_result(None, points))[KnownPoints] == alone
    assert measure_result(made_result(matches_of(np.full(GRID, 0.5), np.ones(GRID))))[KnownPoints] is None
    unsure = matches_of(np.full(GRID, 0.5), np.full(GRID, 0.5))
    assert measure_result(made_result(unsure, points))[KnownPoints] == alone


@pytest.mark.parametrize("ratio", [1.0799, 1.08001, 1.1999, 1.2001, 1000.0])
@pytest.mark.parametrize("fraction_off", [0.0, 0.2501, 0.5001])
def test_points_that_differ_are_a_remark_and_points_that_are_wrong_a_reason(ratio, fraction_off):
    wrong = ratio > 1.2 or fraction_off > 0.5
    if wrong:
        expected = ["points.factor" if ratio > 1.2 else "points.contradict"]
    elif ratio > 1.08:
        expected = ["points.differ"]
    else:
        expected = ["points.some-contradict"] if fraction_off > 0.25 else []
    for each in (ratio, 1 / ratio):
        points = Points(99, 0, 0.5, each, fraction_off)
        assert codes(good(points)) == expected
        assert judge(good(points)).trusted is not (wrong and bool(expected))
        assert KnownPoints.agree(sheet(points)) is not wrong


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_one_or_two_points_fix_no_scale(count):
    points = replace(AGREE, count=count, ratio=None, fraction_off=None)
    assert codes(good(points)) == (["points.few"] if count in (1, 2) else [])
    alone = sheet(points, Correlation(0.8), Matched(confidence=0.9))
    assert ("points.too-few" in codes(alone)) is (count in (1, 2))
    assert KnownPoints.fix_scale(sheet(points)) is (count == 3) and not KnownPoints.agree(sheet(points))


@pytest.mark.parametrize(
    ("count", "part", "is_judged"), [(50, 0.25, True), (49, 1.0, False), (448, 0.249, False), (99, 0.5, True)]
)
def test_without_matches_enough_points_all_over_the_image_test_a_depth(count, part, is_judged):
    alone = sheet(Points(count, 0, part, None, None))
    assert KnownPoints.test_the_depth(alone) is is_judged
    assert judge(alone).status == ("trusted" if is_judged else "not judged")
    assert not KnownPoints.test_the_depth(sheet()) and not KnownPoints.fix_scale(sheet())


def test_points_outside_the_image_are_reported():
    points = replace(AGREE, outside=7)
    assert judged(good(points), "points.outside").startswith("7 points outside the left image")
    assert judge(good(points)).trusted


@pytest.mark.parametrize(
    ("points", "code", "words"),
    [
        (replace(AGREE, ratio=3.456), "points.factor", "are 3.46 times the matched depths"),
        (replace(AGREE, ratio=3.456), "points.factor", "check their unit and frame, the baseline and K"),
        (replace(AGREE, ratio=1234.0), "points.factor", "are 1230 times the matched depths"),
        (replace(AGREE, ratio=1.1234), "points.differ", "are 1.12 times the matched depths"),
        (replace(AGREE, fraction_off=0.6789), "points.contradict", "68 % of the known depths"),
        (replace(AGREE, fraction_off=0.3456), "points.some-contradict", "35 % of the known depths"),
        (replace(AGREE, count=2), "points.few", "The image has only 2 known depths; provide at least 3."),
    ],
)
def test_findings_state_the_numbers_of_the_points(points, code, words):
    assert words in judged(good(points), code)


def test_too_few_points_alone_are_reported_with_how_many_are_needed():
    finding = judged(sheet(replace(AGREE, count=2)), "points.too-few")
    assert "undetermined: the image has only 2 known depths; provide at least 3." in finding


#: Units that are confused: factor of the points, and what its sentence calls it.
UNITS = {
    0.256: "KITTI depth (1/256 m) was read as millimetres; set the points' scale to 256",
    3.90625: "set the points' scale to 1000",
    1000.0: "the points are in millimetres; divide them by 1000",
    0.001: "metres were divided by 1000; set the points' scale to 1",
    256.0: "the points are KITTI integers; divide them by 256",
    100.0: "the points are in centimetres; divide them by 100",
    3.28084: "the points are in feet",
    0.3048: "metres were read as feet",
}


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_is_named_for_factors_within_four_per_cent_of_it(unit):
    for factor, named in ((1.0, True), (1.039, True), (1 / 1.039, True), (1.041, False), (1 / 1.041, False)):
        finding = judged(good(replace(AGREE, ratio=unit * factor)), "points.factor")
        assert (UNITS[unit] in finding) is named
        assert ("check their unit and frame, the baseline and K" in finding) is not named


def test_confidence_falls_with_the_factor_of_the_points_and_is_not_changed_without_one():
    assert KnownPoints.confidence_factor(sheet(replace(AGREE, ratio=None))) == 1.0
    middle = math.exp((LOG(1.08) + LOG(1.2)) / 2)
    for ratio, factor in ((1.0, 1.0), (1.0799, 1.0), (middle, 0.625), (1.2, 0.25), (100.0, 0.25)):
        for each in (ratio, 1 / ratio):
            found = KnownPoints.confidence_factor(sheet(replace(AGREE, ratio=each)))
            assert found == pytest.approx(factor)
