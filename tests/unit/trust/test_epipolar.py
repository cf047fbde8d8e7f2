"""Residuals of the poses as given and as used: what is taken from a report, and what follows from it.

Findings about the refinement itself are tested with the check of the poses (tests/unit/evidence).
"""

import math
from dataclasses import replace

import pytest

from geodiff_plugin.trust import Epipolar, MatchError
from geodiff_plugin.trust.epipolar import Residuals
from geodiff_plugin.trust.length_units import Lengths
from geodiff_plugin.types import PoseReport, RejectedPose
from tests.unit.trust.made_stages import poses_stage
from tests.unit.trust.sheets import codes, good, judged, sheet

NAN = math.nan
RIG, POSED = Lengths(True, 0.12, 5.0), Lengths(False, 0.12, 5.0)
FITS = Residuals("fits", (0.2,), (0.2,), 0.0, 1.0, False, None, None)


def used(px: float | None, **changes) -> Residuals:
    return replace(FITS, used_px=(px,), given_px=(px,), **changes)


def test_every_fact_comes_from_its_own_field_of_the_report():
    """Views with too few matches have no residual."""
    rejected = RejectedPose(1, 9.0, 0.4, 0.2)
    report = PoseReport(
        "refined",
        (),
        (),
        residual_px_given=(5.1, 9.2, NAN),
        residual_px=(NAN, 0.31, 0.72),
        warp_rms_px=(0.41, 1.52, 0.2),
        rig=True,
        features=17,
        rejected=rejected,
    )
    found = Epipolar.of_poses(poses_stage(report, size=(300, 1664)))
    expected = ("refined", (5.1, 9.2, None), (None, 0.31, 0.72), 1.52, 2.0, True, 17, rejected)
    assert found == Residuals(*expected)
    assert (found.worst, found.worst_given_px, found.worst_used_px) == (1, 9.2, 0.72)


def test_what_a_report_does_not_know_stays_unknown():
    report = PoseReport("not checked", (), (), residual_px=(NAN,))
    found = Epipolar.of_poses(poses_stage(report))
    assert found == Residuals("not checked", (), (None,), 0.0, 1.0, False, None, None)
    assert found.worst_given_px is found.worst_used_px is None
    assert codes(good(found)) == ["pose.unchecked"] and Epipolar.match_error(sheet(found)) == MatchError()
    assert Epipolar.of_poses(poses_stage(PoseReport("given", (), ()))) is None


@pytest.mark.parametrize(
    ("px", "code"),
    [
        (None, None),
        (1.99, None),
        (2.01, "pose.residual"),
        (2.4, "pose.residual"),
        (3.99, "pose.residual"),
        (4.01, "pose.epipolar-error"),
        (9.5, "pose.epipolar-error"),
    ],
)
def test_matches_off_their_lines_are_a_remark_and_further_off_a_reason(px, code):
    assert codes(good(used(px))) == ([] if code is None else [code])
    if code is not None:
        assert f"The epipolar error is {px:.1f} px" in judged(good(used(px)), code)


def test_the_worst_view_counts():
    residuals = replace(FITS, used_px=(0.3, None, 5.67), given_px=(0.3, None, 5.67))
    assert "The epipolar error is 5.7 px" in judged(good(residuals), "pose.epipolar-error")


@pytest.mark.parametrize(
    ("px", "weak", "is_good"), [(None, False, False), (0.99, False, True), (1.01, True, False)]
)
def test_an_unknown_residual_speaks_neither_for_nor_against_a_result(px, weak, is_good):
    assert Epipolar.is_weak(sheet(used(px))) is weak and Epipolar.is_good(sheet(used(px))) is is_good
    assert not Epipolar.is_weak(sheet()) and not Epipolar.is_good(sheet())


@pytest.mark.parametrize(("px", "misses"), [(None, None), (3.99, None), (4.01, 4.01)])
def test_given_poses_miss_the_matches_beyond_four_pixels(px, misses):
    assert Epipolar.misses_by_px(sheet(replace(FITS, given_px=(0.3, px)))) == misses
    assert Epipolar.misses_by_px(sheet()) is None


def test_where_few_features_match_the_finding_states_how_many():
    residuals = replace(FITS, status="kept", given_px=(0.8,), used_px=(0.8,), features=17)
    finding = judged(good(residuals), "pose.few-matches")
    assert "Only 17 features match, but 40 are needed" in finding and "epipolar error of 0.8 px" in finding


@pytest.mark.parametrize(
    ("lengths", "px", "warp_px", "expected_px"),
    [
        (RIG, 0.44, 0.0, 0.0),
        (RIG, 0.75, 0.0, 0.6),  # .75^2 = .45^2 + .6^2
        (POSED, 0.25, 0.0, 0.25),  # under other poses all of it counts
        (None, 0.25, 0.0, 0.25),
        (POSED, None, 0.99, 0.0),
        (POSED, None, 1.25, 0.75),
        (RIG, 0.75, 1.25, math.hypot(0.75, 0.6)),
    ],
)
@pytest.mark.parametrize("grid_px", [1.0, 2.0])
def test_the_error_of_matches_is_what_correct_pairs_do_not_show(lengths, px, warp_px, expected_px, grid_px):
    """In pixels of the left image, of which the grid of the matches has fewer."""
    records = [used(px, warp_rms_px=warp_px, grid_px=grid_px)] + ([] if lengths is None else [lengths])
    error = Epipolar.match_error(sheet(*records))
    assert error == pytest.approx(MatchError(px=grid_px * expected_px), abs=1e-9)
