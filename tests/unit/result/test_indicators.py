"""Every indicator of a run against NumPy on the same maps, or against the report that it comes from."""

import math
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin import _strips as strips
from geodiff_plugin._threads import BackgroundTask
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.rows import RowChecks
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.mistakes import INVERSE
from geodiff_plugin.result import indicators
from geodiff_plugin.result.indicators import (
    indicators_of,
    measure_indicators,
    pixels_of_matches,
    pose_of,
    read_numbers,
    warnings_of,
)
from geodiff_plugin.types import CameraView, Indicators, PosedViews, PoseReport, Tear

GRID, FULL = (29, 43), (37, 61)


def as_map(x: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(x, np.float32))[None]


def matches_of(inverse: np.ndarray, confidence: np.ndarray, step: float) -> Matches:
    return Matches(as_map(inverse), as_map(confidence), torch.tensor(step))


def nearest(x: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    at = [((np.arange(new) + 0.5) * old / new).astype(int) for new, old in zip(size, x.shape, strict=True)]
    return x[np.ix_(*at)]


def lower_median(values: np.ndarray) -> float:
    return float(np.quantile(values, 0.5, method="lower"))


def measured(evidence: Evidence, depth_m: np.ndarray, range_given: bool) -> dict[str, float]:
    return read_numbers(
        measure_indicators(evidence, torch.from_numpy(depth_m)[None, None].float(), range_given)
    )


def scene(seed: int = 0):
    """Matches, some at infinity, behind it or beside the last planes, and a depth of another size."""
    rng, step = np.random.default_rng(seed), 0.01
    planes = np.linspace(0.1, 0.7, 61)
    inverse = rng.uniform(0.1, 0.7, GRID)
    inverse[rng.random(GRID) < 0.05] = 0.004  # nearer to infinity than a plane
    inverse[rng.random(GRID) < 0.05] = -0.02
    inverse[rng.random(GRID) < 0.05] = 0.0
    inverse[rng.random(GRID) < 0.06] = 0.1 + 0.007  # beside the first plane
    inverse[rng.random(GRID) < 0.06] = 0.7 - 0.007
    inverse[rng.random(GRID) < 0.06] = 0.1 + 0.008
    inverse[rng.random(GRID) < 0.06] = 0.7 - 0.008
    confidence = rng.random(GRID)
    confidence[rng.random(GRID) < 0.05] = 0.5
    depth = rng.uniform(1.2, 9.0, FULL)
    native = PosedViews(torch.rand(3, *FULL), (), torch.eye(3))
    return rng, planes, inverse, confidence, step, depth, native


@pytest.mark.parametrize("range_given", [True, False])
@pytest.mark.parametrize("most_sorted", [1 << 22, 400])
def test_numbers_of_matches_and_depth(monkeypatch, range_given, most_sorted):
    monkeypatch.setattr(indicators, "MOST_SORTED", most_sorted)
    _, planes, inverse, confidence, step, depth, native = scene()
    volume = SimpleNamespace(inverse_depth=torch.from_numpy(planes).float())
    found = measured(
        Evidence(native, native, volume, matches_of(inverse, confidence, step)), depth, range_given
    )
    sure = confidence > 0.5
    in_front = sure & (inverse > 0)
    every = max(1, inverse.size // most_sorted)
    flat = np.where(in_front, inverse, np.nan).ravel()[::every]
    sample = flat[np.isfinite(flat)]
    low, high = np.quantile(sample, (0.05, 0.95))
    near = sure & (inverse > step)
    apart = np.abs(np.log(nearest(depth, GRID) * inverse, where=near, out=np.full(GRID, np.nan)))
    at_end = (np.abs(inverse - 0.1) < 0.0075) | (np.abs(inverse - 0.7) < 0.0075)
    expected = {
        "matched": sure.mean(),
        "in_front": in_front.sum(),
        "spread": math.log(high / low),
        "planes_apart": (high - low) / step,
        "scene_m": 1 / lower_median(sample),
        "off_matches": lower_median(apart[near]),
        "off_where": near.sum(),
    }
    if range_given:
        expected["at_end"] = (at_end & in_front).sum() / in_front.sum()
    assert found == pytest.approx(expected, rel=1e-4)


def test_the_ends_of_a_range_that_was_searched_but_not_given_say_nothing():
    _, planes, inverse, confidence, step, depth, native = scene()
    matches = matches_of(inverse, confidence, step)
    volume = SimpleNamespace(inverse_depth=torch.from_numpy(planes).float())
    for given, of_search in ((True, None), (False, volume)):
        assert "at_end" not in measured(Evidence(native, native, of_search, matches), depth, given)
    first, last = (
        measured(
            Evidence(native, native, volume, matches_of(np.full(GRID, value), np.ones(GRID), step)),
            depth,
            True,
        )["at_end"]
        for value in (0.1, 0.7)
    )
    assert first == last == 1.0


def test_points_are_compared_with_the_matches_around_them():
    """Sparse points, matches with gaps wider than a window, and points beyond the first plane."""
    rng, _, _, _, step, depth, native = scene(1)
    inverse, confidence = rng.uniform(0.1, 0.7, GRID), rng.random(GRID) * (rng.random(GRID) < 0.5)
    confidence[:12, :20] = 0.2
    confidence[rng.random(GRID) < 0.1] = 0.5
    inverse[20:, 30:] = 0.004
    known = rng.random(GRID) < 0.06
    of_points = np.where(known, inverse * np.exp(rng.normal(-0.05, 0.2, GRID)), 0.0)
    points = matches_of(of_points, known * rng.uniform(0.1, 1.0, GRID), 0.002)
    found = measured(
        Evidence(native, native, None, matches_of(inverse, confidence, step), points), depth, False
    )
    ratios = []
    for row, column in np.argwhere(known):
        window = np.s_[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4]
        sure = confidence[window] > 0.5
        if sure.any() and inverse[window][sure].mean() > step:
            ratios.append(inverse[window][sure].mean() / of_points[row, column])
    ratios = np.array(ratios)
    assert 12 < len(ratios) < known.sum()
    assert found["points_ratio"] == pytest.approx(lower_median(ratios), rel=1e-4)
    assert found["points_off"] == pytest.approx((np.abs(np.log(ratios)) > math.log(1.2)).mean())
    assert found["points_compared"] == len(ratios) and found["points"] == known.sum()
    parts = [
        known[
            GRID[0] * i // 8 : -(-GRID[0] * (i + 1) // 8), GRID[1] * j // 8 : -(-GRID[1] * (j + 1) // 8)
        ].any()
        for i in range(8)
        for j in range(8)
    ]
    assert found["cover"] == pytest.approx(np.mean(parts)) and 0 < np.mean(parts) < 1


def test_without_a_confident_match_nothing_is_compared():
    _, planes, inverse, _, step, depth, native = scene()
    points = matches_of(inverse, np.ones(GRID), step)
    volume = SimpleNamespace(inverse_depth=torch.from_numpy(planes).float())
    unsure = matches_of(inverse, np.full(GRID, 0.5), step)
    found = measured(Evidence(native, native, volume, unsure, points), depth, True)
    zero = ("matched", "in_front", "off_where", "at_end", "points_compared", "points_off")
    assert [found[name] for name in zero] == [0.0] * 6 and math.isnan(found["scene_m"])


def test_points_without_matches_are_counted_and_without_either_nothing_is_measured():
    native = PosedViews(torch.rand(3, *FULL), (), torch.eye(3))
    points = matches_of(np.full(GRID, 0.5), np.eye(*GRID), 0.01)
    found = measured(Evidence(native, native, None, None, points), np.ones(FULL), True)
    assert found.keys() == {"points", "cover"} and found["points"] == 29
    assert measured(Evidence(native, native, None, None), np.ones(FULL), True) == {} == read_numbers({})


@pytest.mark.parametrize("strip", [1 << 20, 5 * FULL[1]])
def test_the_view_that_is_most_alike_counts_if_it_has_the_size_of_the_left_image(monkeypatch, strip):
    monkeypatch.setattr(strips, "STRIP_PIXELS", strip)
    rng = np.random.default_rng(2)
    left = rng.uniform(0.2, 0.7, (3, *FULL)).astype(np.float32)
    apart = [left.copy() for _ in range(3)]
    apart[0][1, 30, 50] += 0.2
    apart[1][2, 3, 4] -= 0.1
    apart[2][0, 36, 60] += 0.05
    images = [*map(torch.from_numpy, apart), torch.from_numpy(left[:, :-1])]
    views = tuple(CameraView(image, torch.eye(3), torch.eye(4)) for image in images)

    def of_views(*indices: int) -> dict[str, float]:
        native = PosedViews(torch.from_numpy(left), tuple(views[i] for i in indices), torch.eye(3))
        return measured(Evidence(native, native, None, None), np.ones(FULL), False)

    for indices, least in (((0,), 0.2), ((0, 1), 0.1), ((1, 2, 0), 0.05), ((3, 0), 0.2)):
        found = of_views(*indices)
        assert found["difference"] == pytest.approx(least, abs=1e-6)
        assert found["contrast"] == pytest.approx(np.ptp(left), abs=1e-6)
    assert of_views(3) == {}


def pose_report(**changes) -> PoseReport:
    """Every field differs, so that none can take another's place."""
    report = PoseReport(
        "refined",
        (),
        (),
        residual_px_given=(5.1, 9.2, math.nan),
        residual_px=(math.nan, 0.31, 0.72),
        straightened_px=(0.41, 1.52, 0.2),
        scale_spread=0.023,
        depth_spread=0.034,
        behind_infinity=0.045,
        behind_px=3.1,
        distortion=-0.056,
        distortion_alone=-0.017,
        tear=Tear(1, 40, -6),
        bars=0.067,
        exchangeable=0.078,
        moved=0.089,
        warnings=(INVERSE, Message("camera.scaled", "K is scaled."), Message("pose.refined", "Refined.")),
    )
    return replace(report, **changes)


NUMBERS = {
    "matched": 0.61,
    "in_front": 40.0,
    "spread": 0.63,
    "planes_apart": 9.0,
    "scene_m": 6.4,
    "at_end": 0.065,
    "off_matches": 0.066,
    "off_where": 40.0,
    "points": 12.0,
    "cover": 0.67,
    "points_ratio": 1.068,
    "points_off": 0.069,
    "points_compared": 12.0,
    "difference": 0.5,
    "contrast": 0.9,
    "visible": 0.77,
}
SIZE = (300, 1664)  # a grid of 832 columns: two pixels in one of it
K = torch.tensor([[900.0, 0, 800.0], [0, 700.0, 150.0], [0, 0, 1]])


def evidence_of(T=((1.0, 0, 0, -0.3), (0, 1, 0, 0), (0, 0, 1, 0)), **parts) -> Evidence:
    """An image with two right views, of which the second is another one."""
    pose = torch.eye(4)
    pose[:3] = torch.tensor(T)
    left = torch.zeros(3, *SIZE)
    views = CameraView(left, K, pose), CameraView(left, 2 * K, 5 * pose)
    native = PosedViews(left, views, K)
    return Evidence(native, native, None, None, **parts)


def rows_of(shear: float, occlusion: float):
    return BackgroundTask.known(SimpleNamespace(checks=BackgroundTask.known(RowChecks(shear, occlusion))))


def test_every_indicator_comes_from_its_own_number():
    noticed = (Message("pose.inverse", "The matching says so too."),)
    evidence = evidence_of(
        report=BackgroundTask.known(pose_report()), rows=rows_of(0.0011, -0.22), noticed=noticed
    )
    doubts = (Message("baseline.long", "25 m."),)
    further = {"confidence": 0.81, "rank_correlation": -0.32, "prior_ratio": 1.83, "on_edge": True}
    further |= {"doubts": doubts, "centre_assumed": True, "range_given": True}
    found = indicators_of(evidence, NUMBERS, **further)
    expected = Indicators(
        **further,
        matched=0.61,
        spread=0.63,
        points_ratio=1.068,
        points_off=0.069,
        points=12,
        cover=0.67,
        at_end=0.065,
        baseline_m=pytest.approx(0.3),
        scene_m=6.4,
        rectified=True,
        view_deg=pytest.approx(math.degrees(2 * math.atan(832 / 900))),
        epipolar_px=0.72,
        given_px=9.2,
        scale_spread=0.023,
        depth_spread=0.034,
        straightened_px=1.52,
        behind_infinity=0.045,
        behind_px=pytest.approx(6.2),
        distortion=-0.056,
        distortion_alone=-0.017,
        tear=Tear(1, 40, -6),
        exchangeable=0.078,
        occlusion=-0.22,
        moved=0.089,
        bars=0.067,
        shear=pytest.approx(0.0011 * 300 / 1664),
        off_matches=0.066,
        mistakes=(Message("camera.scaled", "K is scaled."),),
        inverse_fits=True,
    )
    for field in fields(Indicators):
        assert getattr(found, field.name) == getattr(expected, field.name), field.name


@pytest.mark.parametrize(
    ("short", "unknown"),
    [
        ({"in_front": 39.0}, {"spread", "at_end", "scene_m"}),
        ({"off_where": 39.0}, {"off_matches"}),
        ({"points_compared": 11.0}, {"points_ratio", "points_off"}),
    ],
)
def test_of_too_few_matches_or_points_nothing_is_told(short, unknown):
    whole, found = (indicators_of(evidence_of(), numbers) for numbers in (NUMBERS, NUMBERS | short))
    unlike = {
        f.name for f in fields(Indicators) if repr(getattr(whole, f.name)) != repr(getattr(found, f.name))
    }
    assert unlike == unknown
    for name in unknown:
        default = getattr(Indicators(), name)
        assert repr(getattr(found, name)) == repr(default)


@pytest.mark.parametrize(
    ("spread", "planes_apart", "flat"),
    [(0.19, 1.9, True), (0.2, 1.9, False), (0.19, 2.0, False), (0.3, 5.0, False), (0.19, 9.0, False)],
)
def test_a_scene_is_flat_if_its_depths_lie_together_and_within_two_planes(spread, planes_apart, flat):
    numbers = NUMBERS | {"spread": spread, "planes_apart": planes_apart}
    assert indicators_of(evidence_of(), numbers).flat is flat


def test_lengths_without_a_unit_mean_nothing():
    evidence = evidence_of(report=BackgroundTask.known(pose_report()))
    found = indicators_of(evidence, NUMBERS, False)
    assert found.baseline_m == 0.0 and math.isnan(found.scene_m) and math.isnan(found.scale_spread)
    assert found.rectified and found.spread == 0.63 and found.depth_spread == 0.034
    points_alone = replace(evidence_of(), native=PosedViews(torch.zeros(3, *SIZE), (), K))
    found = indicators_of(points_alone, NUMBERS)
    assert found.baseline_m == 0.0 and math.isnan(found.scene_m) and not found.rectified
    assert math.isnan(found.scale_spread) and found.points == 12


def test_the_baseline_is_the_length_of_the_first_pose_in_space():
    turned = ((0.8, 0, 0.6, 0.2), (0, 1, 0, -0.3), (-0.6, 0, 0.8, 0.6))
    found = indicators_of(evidence_of(turned), {})
    assert found.baseline_m == pytest.approx(0.7) and not found.rectified


def test_what_a_report_does_not_know_stays_unknown():
    report = pose_report(
        status="not checked",
        residual_px=(math.nan,),
        residual_px_given=(),
        straightened_px=(),
        scale_spread=None,
        behind_px=math.nan,
        warnings=(),
    )
    evidence = evidence_of(report=BackgroundTask.known(report), rows=rows_of(math.nan, 0.4))
    found = indicators_of(evidence, {})
    unknown = (
        found.epipolar_px,
        found.given_px,
        found.scale_spread,
        found.behind_px,
        found.shear,
        found.matched,
    )
    assert all(map(math.isnan, unknown)) and found.straightened_px == 0.0 and found.occlusion == 0.4
    assert found.pose_unchecked and found.mistakes == () and not found.inverse_fits and not found.same
    assert found.points == 0 and not found.flat
    checked = evidence_of(report=BackgroundTask.known(pose_report()))
    assert not indicators_of(checked, {}).pose_unchecked
    assert math.isnan(indicators_of(evidence_of(), {}).occlusion)


@pytest.mark.parametrize(
    ("difference", "contrast", "same"),
    [
        (0.0058, 0.9, True),
        (0.0059, 0.9, False),
        (0.0019, 0.04, True),
        (0.0021, 0.04, False),
        (0.0, 0.0, False),
    ],
)
def test_images_are_the_same_up_to_rounding_and_a_twentieth_of_their_contrast(difference, contrast, same):
    numbers = {"difference": difference, "contrast": contrast}
    assert indicators_of(evidence_of(), numbers).same is same


def test_messages_of_poses_and_of_matching_come_once_each_in_order():
    report, other = pose_report(), Message("points.outside", "3 points outside.")
    both = evidence_of(report=BackgroundTask.known(report), noticed=(other, INVERSE))
    assert pose_of(both) is report and warnings_of(both) == (*report.warnings, other)
    assert pose_of(evidence_of()) is None and warnings_of(evidence_of(noticed=(other,))) == (other,)
    assert indicators_of(evidence_of(noticed=(INVERSE,)), {}).inverse_fits
    assert not indicators_of(evidence_of(noticed=(other,)), {}).inverse_fits


@pytest.mark.parametrize(
    ("size", "pixels"), [((100, 832), 1.0), ((1248, 900), 1.5), ((900, 1248), 1.5), ((60, 80), 1.0)]
)
def test_poses_are_checked_on_832_pixels_of_the_longer_side(size, pixels):
    assert pixels_of_matches(size) == pytest.approx(pixels)
