"""Determines the unit of a calibration's lengths from its names and its baseline."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from geodiff_plugin._internal.camera_checks import LONG_BASELINE_M
from geodiff_plugin._internal.checks import warn
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.rigs import CameraChoice, in_units
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
#: Units of length per metre.
UNITS = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1e3),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 1e2),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
}
#: Matches a name with a unit suffix, such as ``baseline_mm`` without underscore; prefers the longest unit.
WITH_UNIT = re.compile(f"(.+?)({'|'.join(sorted(UNITS, key=len, reverse=True))})")
#: Names of the unit of the whole file.
UNIT_NAMES = ("unit", "units", "lengthunit", "lengthunits", "worldunit", "worldunits")
#: Matches the size of a board's squares, whose unit is the translation's.
SQUARE = re.compile("(?:square|pattern|marker|checker|tag|grid)[a-z]*(?:size|length|spacing)")
#: Plausible range of a baseline in metres, in the unit of the board; a translation may count squares.
LIKELY_BASELINE_M = (0.02, 5.0)
#: Maximum baseline in metres if the unit is not stated.
MAX_UNSTATED_M = 1.5
#: Maximum relative difference between a length given twice.
SAME_LENGTH = 0.03


def squeezed(key: str) -> str:
    """Normalise a name: lower case, without ``_``, ``-``, ``.`` and blanks."""
    return re.sub(r"[-_. ]", "", key.lower())


def split_unit(name: str) -> tuple[str, float | None]:
    """Split a normalised name into the name and its unit per metre."""
    match = WITH_UNIT.fullmatch(name)
    return (match[1], UNITS[match[2]]) if match else (name, None)


def in_stated_unit(rig: Rig, entries: Entries, translations: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Convert the rig to metres using the unit stated in ``entries``; otherwise lengths are in metres.

    ``translations`` are the normalised names of the translation. Warns if metres are implausible.
    """
    length = float(np.linalg.norm(rig.E[:3, 3]))
    units = _units_per_metre({squeezed(key): value for key, value in entries.items()}, translations, length)
    if units is None and choice.baseline_m is None and MAX_UNSTATED_M < length <= LONG_BASELINE_M:
        sentence = (
            f"The calibration states no unit, and {length:.4g} m is a long baseline for cameras calibrated "
            f"together. The unit may be centimetres, or squares of the board. Pass the measured camera "
            f"distance (--baseline, baseline_m)."
        )
        warn(Finding("calibration.assumed-metres", sentence))
    return in_units(rig, units or 1.0)


def _units_per_metre(entries: Entries, translations: tuple[str, ...], length: float) -> float | None:
    """Return the translation's units per metre, ``None`` if not stated.

    Uses the translation's name, an entry ``unit``, a baseline in the file, or the name of a board's square
    size; ``length`` is the length of the translation.
    """
    numbers = {}
    for name, value in entries.items():
        base, unit = split_unit(name)
        if base in translations and unit:
            return unit
        if name in UNIT_NAMES and str(value).lower() in UNITS:
            return UNITS[str(value).lower()]
        if isinstance(value, np.ndarray) and value.size == 1:
            numbers[name] = value.item()
    for name, number in numbers.items():
        base, unit = split_unit(name)
        if base.removeprefix("stereo") == "baseline" and (found := _unit_by_baseline(length, number, unit)):
            return found
    for base, unit in map(split_unit, numbers):
        if unit and SQUARE.fullmatch(base):
            return unit if LIKELY_BASELINE_M[0] <= length / unit <= LIKELY_BASELINE_M[1] else None
    return None


def _unit_by_baseline(length: float, baseline: float, stated: float | None) -> float | None:
    """Return the translation's units per metre if it equals the baseline in some unit.

    ``stated`` is the baseline's units per metre, if its name states them. Otherwise the baseline is at most
    in
    metres: equal numbers then prove nothing.
    """
    for unit in (1e3, 1e2, 1.0):
        if abs(length / unit * (stated or 1.0) - baseline) <= SAME_LENGTH * baseline:
            return unit if stated or unit != 1.0 else None
    return None
