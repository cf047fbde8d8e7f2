"""Baselines and scenes in another unit: what is measured of them, and what a stated range confirms."""

import numpy as np
import pytest
import torch

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import Call, measure_result
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.trust.length_units import Lengths, LengthUnits
from geodiff_plugin.trust.search_range import Ends
from tests.unit.trust.made_stages import FULL, GRID, made_result, matches_of, right_view
from tests.unit.trust.sheets import codes, good, judged
from tests.views import view_of

K = torch.tensor([[900.0, 0, 30.0], [0, 700.0, 18.0], [0, 0, 1]])
PARALLEL = (1.0, 0, 0, -0.3), (0, 1, 0, 0), (0, 0, 1, 0)
METRES = Call()
TURNED = (0.8, 0, 0.6, 0.2), (0, 1, 0, -0.3), (-0.6, 0, 0.8, 0.6)


def lengths_of(*rows, count: int = 40, call: Call = METRES) -> Lengths | None:
    """Of matches 4 m away, and of two right views of which the second is another one."""
    views = (right_view(K, *rows), right_view(2 * K, *TURNED)) if rows else ()
    confidence = np.zeros(GRID)
    confidence.flat[:count] = 1.0
    native = PosedViews(view_of(torch.zeros(3, *FULL), K), views)
    stage = made_result(matches_of(np.full(GRID, 0.25), confidence), native=native, call=call)
    return measure_result(stage)[LengthUnits]


def test_the_baseline_is_the_length_of_the_first_pose_in_space():
    assert lengths_of(*PARALLEL) == Lengths(True, pytest.approx(0.3), 4.0)
    assert lengths_of(*TURNED) == Lengths(False, pytest.approx(0.7), 4.0)


def test_unknown_lengths_are_none():
    assert lengths_of(*PARALLEL, count=39) == Lengths(True, pytest.approx(0.3), None)
    assert lengths_of(*PARALLEL, call=Call(has_unit=False)) == Lengths(True, None, None)
    assert lengths_of() is None
    assert codes(good(Lengths(True, None, None))) == []


@pytest.mark.parametrize(
    ("lengths", "code"),
    [
        # A rectified rig in centimetres in front of a scene of half a metre or more.
        (Lengths(True, 7.5, 51.0), "pose.unit"),
        (Lengths(True, 7.5, 49.0), None),
        # Of other poses, a drone's are that long.
        (Lengths(False, 7.5, 199.0), None),
        (Lengths(False, 7.5, 201.0), "pose.unit"),
        (Lengths(True, 4.9, 400.0), None),
        (Lengths(True, 5.1, 400.0), "pose.unit"),
        (Lengths(False, 10.0, 1999.0), "pose.unit"),
        (Lengths(False, 10.0, 2001.0), None),
        (Lengths(False, 20.1, 400.0), None),  # ``baseline.long`` is reported of it
        (Lengths(False, 10.0, None), None),
        (Lengths(False, 0.00099, 5.0), "baseline.short"),
        (Lengths(False, 0.00101, 5.0), None),
        (Lengths(False, 0.0, 5.0), None),
    ],
)
def test_lengths_that_are_implausible_in_metres_are_reasons(lengths, code):
    assert codes(good(lengths)) == ([] if code is None else [code])


@pytest.mark.parametrize(
    ("records", "range_given", "expected"),
    [
        ([], True, []),
        ([Ends(0.19)], True, []),
        ([Ends(0.21)], True, ["pose.unit", "depth.range"]),
        ([Points(50, 0, 0.5, 1.0, 0.0)], False, ["pose.unit"]),  # they may be in the same unit
    ],
)
def test_a_stated_range_confirms_the_unit_and_points_do_not(records, range_given, expected):
    facts = good(Lengths(False, 10.0, 400.0), *records, range_given=range_given)
    assert codes(facts) == expected


def test_a_stated_range_confirms_a_long_baseline_and_no_other_doubt():
    long = Finding("baseline.long", "E has a baseline of 25 m.")
    other = Finding("camera.principal-point", "K is for another image.")
    lengths = Lengths(False, 25.0, 50.0)
    doubted = good(lengths, findings=(long, other))
    assert set(codes(doubted)) == {long.code, other.code}
    assert codes(good(lengths, findings=(long, other), range_given=True)) == [other.code]
    outside = good(lengths, Ends(0.3), findings=(long, other), range_given=True)
    assert set(codes(outside)) == {long.code, other.code, "depth.range"}


def test_a_stated_range_confirms_a_short_baseline():
    lengths = Lengths(False, 0.00048, 0.0066)
    assert codes(good(lengths)) == ["baseline.short"]
    assert codes(good(lengths, range_given=True)) == []
    assert set(codes(good(lengths, Ends(0.3), range_given=True))) == {"baseline.short", "depth.range"}


def test_findings_state_the_lengths():
    assert "The baseline is 0.345 mm" in judged(good(Lengths(False, 0.000345, 5.0)), "baseline.short")
    finding = judged(good(Lengths(False, 12.34, 456.7)), "pose.unit")
    assert "With a baseline of 12.34 m the median matched depth is 457 m" in finding
    assert (
        "a baseline in centimetres by 100, one in millimetres by 1000" in finding
        and "depth_range, --near, --far" in finding
    )
