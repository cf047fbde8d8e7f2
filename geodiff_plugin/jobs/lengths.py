"""Lengths in a capture: the known one, which sets its scale, and those that ``--measure`` asks for."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._certain import MAX_SCALE_SPREAD
from geodiff_plugin._checks import bad_value, check_positive
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.capture.results import read_agreed
from geodiff_plugin.formats.lenses import undistorted_pixels
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.messages import Message
from geodiff_plugin.result.readings import Reading, distance_m, metres, read_pixel

#: How the options are typed.
KNOWN_LENGTH = "NAME:X1,Y1,X2,Y2,METRES"
DISTANCE = "NAME,NAME,METRES"
MEASURE = "NAME:X1,Y1,X2,Y2"

#: Depth and confidence of a frame by its name, ``(H, W)`` each.
MapsOf = Callable[[str], tuple[np.ndarray, np.ndarray | None]]


@dataclass(frozen=True, eq=False)
class Span:
    """Two pixels of a frame, in its image as taken and in that without lens distortion, ``(2, 2)`` each."""

    frame: str
    taken: np.ndarray
    ends: np.ndarray


@dataclass(frozen=True)
class KnownScale:
    """Metres per unit of the poses, its relative standard deviation, and why it is not to be trusted."""

    factor: float
    spread: float = 0.0
    doubt: Message | None = None


def check_lengths(capture: Capture, options: CaptureOptions) -> None:
    """``InputError`` where the options name a length that the capture cannot have."""
    if options.distance is not None:
        _distance(capture, options.distance)
    if options.known_length is not None:
        _known_length(capture, options.known_length)
    chosen = capture.choose(options.frames)
    for span in spans_to_measure(capture, options):
        if span.frame not in chosen:
            bad_value("--measure", "of frames that get depth (--frames)", repr(span.frame))


def spans_to_measure(capture: Capture, options: CaptureOptions) -> list[Span]:
    """What ``--measure`` names."""
    return [
        _span(capture, "--measure", typed, *_numbers("--measure", typed, MEASURE, 4))
        for typed in options.measure
    ]


def _numbers(option: str, typed: str, form: str, count: int) -> tuple[str, list[float]]:
    """The frame's name before the colon, and the numbers behind it."""
    name, _, rest = typed.rpartition(":")
    try:
        numbers = [float(word) for word in rest.split(",")]
    except ValueError:
        numbers = []
    if not name or len(numbers) != count:
        bad_value(option, form, repr(typed))
    return name, numbers


def _span(capture: Capture, option: str, typed: str, name: str, numbers: Sequence[float]) -> Span:
    frame, taken = capture.frame(name), np.array(numbers).reshape(2, 2)
    (width, height), last = frame.size, np.array(frame.size) - 1
    if not ((taken >= 0) & (taken <= last)).all():
        bad_value(option, f"pixels of {width}x{height}", repr(typed))
    if (taken[0] == taken[1]).all():
        bad_value(option, "of two different pixels", repr(typed))
    assert frame.K is not None  # of a capture that was read
    ends = taken if frame.lens is None else undistorted_pixels(taken, frame.K, frame.lens)
    if not ((ends >= 0) & (ends <= last)).all():  # false where a pixel has no ray
        expected = "pixels that the image without lens distortion has"
        bad_value(option, expected, repr(typed), "Choose ends nearer to the middle.")
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
    """The scale that the options give a capture whose poses are solved; ``None`` where they give none.

    That of ``--known-length`` is the length over the distance of its two pixels by the depth of their frame.
    """
    if options.distance is not None:
        names, length = _distance(capture, options.distance)
        numbers = [capture.names.index(name) for name in names]
        apart = float(np.linalg.norm(np.diff(capture.solve().E[numbers, :3, 3], axis=0)))
        if not apart > 0:
            bad_value("--distance", "of two frames with different positions", repr(options.distance))
        return KnownScale(length / apart)
    if options.known_length is None:
        return None if options.metres_per_unit is None else KnownScale(options.metres_per_unit)
    span, length = _known_length(capture, options.known_length)
    measured, spread = distance_m(*_readings(capture, span, maps_of))
    if not measured > 0:
        bad_value("--known-length", "between two different places", repr(options.known_length))
    relative = math.inf if spread is None else spread / measured
    doubt = _doubt(span.frame, relative) if relative > MAX_SCALE_SPREAD else None
    return KnownScale(length / measured, relative if math.isfinite(relative) else 1.0, doubt)


def _doubt(frame: str, relative: float) -> Message:
    """Why a known length sets no scale to trust."""
    known = f"to {100 * relative:.0f} % only" if math.isfinite(relative) else "by nothing but the prior"
    cure = "Choose ends on surfaces with texture that other frames see, or give --distance."
    said = f"The known length in {frame} is measured {known}, so the scale is uncertain"
    return Message("capture.length", f"{said}. {cure}")


def _readings(capture: Capture, span: Span, maps_of: MapsOf) -> list[Reading]:
    depth, confidence = maps_of(span.frame)
    K = capture.solve().K[capture.names.index(span.frame)]
    return [read_pixel(depth, K, (round(x), round(y)), confidence) for x, y in span.ends.tolist()]


def measure(
    capture: Capture, spans: Sequence[Span], out: Path, doubted: Collection[str], scale_spread: float
) -> list[dict[str, Any]]:
    """Distances between pixels by the finished depth of their frames, as records of ``capture.json``.

    ``scale_spread`` is the relative standard deviation of the capture's scale, ``doubted`` are frames without
    trust; a standard deviation (``spread``) holds both the depth's and the scale's.
    """

    def maps_of(name: str) -> tuple[np.ndarray, np.ndarray]:
        return read_agreed(out / name)

    records = []
    for span in spans:
        length, spread = distance_m(*_readings(capture, span, maps_of))
        spread = None if spread is None else math.hypot(spread, length * scale_spread)
        record = {"frame": span.frame, "pixels": span.taken.tolist(), "length": length, "spread": spread}
        records.append(record | {"unit": capture.unit, "trusted": span.frame not in doubted})
    return records


def measured_words(record: dict[str, Any]) -> str:
    """A measured length for people."""
    ends = " to ".join(f"({x:g}, {y:g})" for x, y in record["pixels"])
    words = metres(record["length"], record["spread"], record["unit"])
    return f"{record['frame']} {ends}: {words}{'' if record['trusted'] else ' (not trusted)'}"
