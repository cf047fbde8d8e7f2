"""Lengths in a capture: the known length, which sets its scale, and the lengths of ``--measure``."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._internal.checks import bad_value, check_positive
from geodiff_plugin._internal.statistics import MAX_SCALE_SPREAD
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.capture.results import read_agreed
from geodiff_plugin.findings import Finding
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.result.readings import Reading, distance_m, metres, read_pixel

#: Formats of the options.
KNOWN_LENGTH = "NAME:X1,Y1,X2,Y2,METRES"
DISTANCE = "NAME,NAME,METRES"
MEASURE = "NAME:X1,Y1,X2,Y2"

#: Returns depth, confidence and sigma of a frame by name, ``(H, W)`` each.
MapsOf = Callable[[str], tuple[np.ndarray, np.ndarray | None, np.ndarray | None]]


@dataclass(frozen=True, eq=False)
class Span:
    """Two pixels of a frame, in the original and in the undistorted image, ``(2, 2)`` each."""

    frame: str
    taken: np.ndarray
    ends: np.ndarray


@dataclass(frozen=True)
class KnownScale:
    """Metres per unit of the poses, its relative standard deviation, and reasons not to trust it."""

    factor: float
    spread: float = 0.0
    doubt: Finding | None = None


def check_lengths(capture: Capture, options: CaptureOptions) -> None:
    """Raise ``InputError`` if the options refer to a length outside the capture."""
    if options.distance is not None:
        _distance(capture, options.distance)
    if options.known_length is not None:
        _known_length(capture, options.known_length)
    chosen = capture.choose(options.frames)
    for span in spans_to_measure(capture, options):
        if span.frame not in chosen:
            bad_value("--measure", "in frames selected by --frames", repr(span.frame))


def check_valid_ends(capture: Capture, options: CaptureOptions) -> None:
    """Raise ``InputError`` if ``--measure`` refers to pixels that get no depth; needs solved poses."""
    for typed, span in zip(options.measure, spans_to_measure(capture, options), strict=True):
        valid, (columns, rows) = capture.valid(span.frame), np.rint(span.ends).astype(int).T
        if valid is not None and not valid[rows, columns].all():
            bad_value("--measure", "between valid pixels", f"{typed!r}, of which one is masked")


def spans_to_measure(capture: Capture, options: CaptureOptions) -> list[Span]:
    """Return the spans of ``--measure``."""
    return [
        _span(capture, "--measure", typed, *_numbers("--measure", typed, MEASURE, 4))
        for typed in options.measure
    ]


def _numbers(option: str, typed: str, form: str, count: int) -> tuple[str, list[float]]:
    """Return the frame's name before the colon, and the numbers after it."""
    name, _, rest = typed.rpartition(":")
    try:
        numbers = [float(word) for word in rest.split(",")]
    except ValueError:
        numbers = []
    if not name or len(numbers) != count:
        bad_value(option, form, repr(typed))
    return name, numbers


def _span(capture: Capture, option: str, typed: str, name: str, numbers: Sequence[float]) -> Span:
    frame = capture.frame(name)
    taken = np.array(numbers).reshape(2, 2)
    (width, height), last = frame.size, np.array(frame.size) - 1
    if not ((taken >= 0) & (taken <= last)).all():
        bad_value(option, f"pixels within {width}x{height}", repr(typed))
    if (taken[0] == taken[1]).all():
        bad_value(option, "between two different pixels", repr(typed))
    ends = frame.camera.undistorted_px(taken)
    if not ((ends >= 0) & (ends <= last)).all():  # false if a pixel has no ray
        expected = "between pixels that are also in the undistorted image"
        bad_value(option, expected, repr(typed), "Choose end points closer to the image centre.")
    return Span(frame.name, taken, ends)


def _known_length(capture: Capture, typed: str) -> tuple[Span, float]:
    name, (*ends, length) = _numbers("--known-length", typed, KNOWN_LENGTH, 5)
    check_positive(length, "--known-length", "metres")
    return _span(capture, "--known-length", typed, name, ends), length


def _distance(capture: Capture, typed: str) -> tuple[list[str], float]:
    *names, metres_typed = (word.strip() for word in typed.split(","))
    try:
        length = float(metres_typed)
    except ValueError:
        length = math.nan
    if len(names) != 2 or math.isnan(length):
        bad_value("--distance", DISTANCE, repr(typed))
    check_positive(length, "--distance", "metres")
    return [capture.frame(name).name for name in names], length


def known_scale(capture: Capture, options: CaptureOptions, maps_of: MapsOf) -> KnownScale | None:
    """Return the scale given by the options to a capture with solved poses; ``None`` if they give none.

    ``--known-length`` is divided by the distance between its two pixels according to the depth of their
    frame.
    """
    if options.distance is not None:
        names, length = _distance(capture, options.distance)
        numbers = [capture.names.index(name) for name in names]
        distance = float(np.linalg.norm(np.diff(capture.solve().E[numbers, :3, 3], axis=0)))
        if not distance > 0:
            bad_value("--distance", "between frames with different camera positions", repr(options.distance))
        return KnownScale(length / distance)
    if options.known_length is None:
        return None if options.metres_per_unit is None else KnownScale(options.metres_per_unit)
    span, length = _known_length(capture, options.known_length)
    measured, spread = distance_m(*_readings(capture, span, *maps_of(span.frame)))
    if not measured > 0:
        bad_value("--known-length", "between two different points", repr(options.known_length))
    relative = math.inf if spread is None else spread / measured
    doubt = _scale_warning(span.frame, relative) if relative > MAX_SCALE_SPREAD else None
    return KnownScale(length / measured, relative if math.isfinite(relative) else 1.0, doubt)


def _scale_warning(frame: str, relative: float) -> Finding:
    """Return why a known length gives no reliable scale."""
    known = f"to {100 * relative:.0f} %" if math.isfinite(relative) else "only by the prior"
    hint = "Choose end points on textured surfaces visible in other frames, or pass --distance."
    text = f"The depth at the known length in {frame} is known {known}, so the scale is uncertain"
    return Finding("capture.length", f"{text}. {hint}")


def _readings(capture: Capture, span: Span, depth: np.ndarray, *further: np.ndarray | None) -> list[Reading]:
    K = capture.camera(span.frame).K
    return [read_pixel(depth, K, (round(x), round(y)), *further) for x, y in span.ends.tolist()]


def measure(
    capture: Capture, spans: Sequence[Span], out: Path, doubted: Collection[str], scale_rel_std: float
) -> list[dict[str, Any]]:
    """Measure distances between pixels in the finished depth of their frames, as records of ``capture.json``.

    ``scale_rel_std`` is the relative standard deviation of the capture's scale, ``doubted`` are frames that
    are not trusted. The standard deviation (``spread``) includes the errors of both depth and scale. The
    length is ``None`` if ``--holes`` removed the depth of an end.
    """
    records = []
    for span in spans:
        maps = read_agreed(out / span.frame)
        columns, rows = np.rint(span.ends).astype(int).T
        length = spread = None
        if (maps[0][rows, columns] > 0).all():
            length, spread = distance_m(*_readings(capture, span, *maps))
            spread = None if spread is None else math.hypot(spread, length * scale_rel_std)
        record = {"frame": span.frame, "pixels": span.taken.tolist(), "length": length, "spread": spread}
        records.append(record | {"unit": capture.unit, "trusted": span.frame not in doubted})
    return records


def measured_words(record: dict[str, Any]) -> str:
    """Format a measured length for display."""
    ends = " to ".join(f"({x:g}, {y:g})" for x, y in record["pixels"])
    if record["length"] is None:
        return f"{record['frame']} {ends}: no reliable depth at an end"
    words = metres(record["length"], record["spread"], record["unit"])
    return f"{record['frame']} {ends}: {words}{'' if record['trusted'] else ' (not trusted)'}"
