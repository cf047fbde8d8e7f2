"""Units of length that calibrations state."""

import numpy as np
import pytest

from geodiff_plugin._internal.checks import captured_warnings
from geodiff_plugin.formats import units
from geodiff_plugin.formats.rigs import CameraChoice, RawCamera, make_rig
from tests.unit.formats.calibrated_pair import K_LEFT, K_RIGHT, E


@pytest.mark.parametrize(
    ("length", "baseline", "stated", "unit"),
    [
        (173.0, 0.173, None, 1e3),
        (173.0, 0.177, None, 1e3),
        (173.0, 0.179, None, None),
        (173.0, 0.169, None, 1e3),
        (173.0, 0.167, None, None),
        (17.3, 0.173, None, 1e2),
        (0.173, 0.173, None, None),
        (0.173, 173.0, 1e3, 1.0),
        (17.3, 173.0, 1e3, 1e2),
        (173.0, 173.0, 1e3, 1e3),
        (173.0, 17.3, 1e2, 1e3),
        (5.0, 173.0, 1e3, None),
    ],
)
def test_translation_unit_is_inferred_from_the_baseline(length, baseline, stated, unit):
    assert units._unit_by_baseline(length, baseline, stated) == unit


def _units_per_metre(entries, length):
    named = {units.squeezed(key): value for key, value in entries.items()}
    return units._units_per_metre(named, ("t", "translation"), length)


@pytest.mark.parametrize(
    ("square", "metres", "is_known"),
    [
        ("square_size_mm", 0.021, True),
        ("square_size_mm", 0.019, False),
        ("square_size_mm", 4.9, True),
        ("square_size_mm", 5.1, False),
        ("pattern_spacing_cm", 0.3, True),
        ("tag_size_m", 0.3, True),
        ("marker_length_mm", 0.3, True),
    ],
)
def test_board_unit_applies_only_if_the_baseline_is_plausible(square, metres, is_known):
    unit = units.UNITS[square.rpartition("_")[2]]
    entries = {square: np.array([24.5]), "t": np.zeros(3)}
    assert _units_per_metre(entries, metres * unit) == (unit if is_known else None)
    assert _units_per_metre({"square_size": np.array([24.5])}, metres) is None
    assert _units_per_metre(entries | {"square_size_mm": np.array([1.0, 2.0])}, metres * unit) == (
        unit if is_known and square != "square_size_mm" else None
    )


def test_unit_hints_have_a_fixed_precedence():
    entries = {"unit": "mm", "baseline_cm": np.array([17.3]), "square_size_mm": np.array([24.5])}
    assert _units_per_metre({"t_cm": np.zeros(3)} | entries, 0.173) == 1e2
    assert _units_per_metre(entries, 0.173) == 1e3
    del entries["unit"]
    assert _units_per_metre(entries, 0.173) == 1.0
    assert _units_per_metre(entries, 999.0) == 1e3
    assert _units_per_metre({"unit": "furlong"}, 1.0) is None


@pytest.mark.parametrize(
    ("metres", "given", "warns"),
    [(1.49, None, False), (1.51, None, True), (19.9, None, True), (20.1, None, False), (1.51, 1.5, False)],
)
def test_long_baselines_without_a_unit_raise_a_warning(metres, given, warns):
    cameras = make_rig(RawCamera(K_LEFT), RawCamera(K_RIGHT), E * [[1], [1], [1], [1]])
    cameras.E[:3, 3] *= metres / np.linalg.norm(E[:3, 3])
    with captured_warnings() as reported, pytest.warns() if warns else captured_warnings():
        rig = units.in_stated_unit(cameras, {}, (), CameraChoice(baseline_m=given))
    np.testing.assert_array_equal(rig.E, cameras.E)
    assert [each.code for each in reported] == ["calibration.assumed-metres"] * warns
    assert not warns or f"and {metres:.4g} m is a long baseline for cameras" in reported[0]
    with captured_warnings() as reported:
        units.in_stated_unit(cameras, {"unit": "m"}, (), CameraChoice())
    assert not reported
