"""The field of view that K gives the left image."""

import math

import pytest
import torch

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.trust import measure_result
from geodiff_plugin.trust.field_of_view import FieldOfView, ViewAngle
from geodiff_plugin.trust.search_range import Ends
from tests.unit.trust.made_stages import made_result
from tests.unit.trust.sheets import codes, good, judged
from tests.views import view_of


def test_it_is_that_of_the_width_and_the_focal_length_along_rows():
    K = torch.tensor([[900.0, 0, 800.0], [0, 700.0, 150.0], [0, 0, 1]])
    native = PosedViews(view_of(torch.zeros(3, 300, 1664), K), ())
    found = measure_result(made_result(native=native))[FieldOfView]
    assert found.degrees == pytest.approx(math.degrees(2 * math.atan(832 / 900)))


@pytest.mark.parametrize(
    ("degrees", "usual"), [(14.9, False), (15.0, True), (21.0, True), (120.0, True), (120.1, False)]
)
def test_an_unusual_one_is_a_remark(degrees, usual):
    assert codes(good(ViewAngle(degrees), calibrated=True)) == ([] if usual else ["camera.field-of-view"])


@pytest.mark.parametrize(("degrees", "usual"), [(14.9, False), (15.0, True), (120.0, True), (120.1, False)])
def test_an_unusual_one_is_trusted_only_from_a_file_or_with_a_depth_range(degrees, usual):
    reason = ["camera.unconfirmed-field-of-view"]
    assert codes(good(ViewAngle(degrees))) == ([] if usual else reason)
    assert codes(good(ViewAngle(degrees), range_given=True)) == ([] if usual else ["camera.field-of-view"])
    outside = codes(good(ViewAngle(degrees), Ends(0.3), range_given=True))
    assert set(outside) == {"depth.range", *([] if usual else reason)}


def test_the_finding_states_the_degrees():
    finding = judged(good(ViewAngle(12.6)), "camera.unconfirmed-field-of-view")
    assert (
        "a field of view of 13 degrees" in finding and "millimetres * image width / sensor width" in finding
    )
    finding = judged(good(ViewAngle(12.6), calibrated=True), "camera.field-of-view")
    assert "a field of view of 13 degrees" in finding
