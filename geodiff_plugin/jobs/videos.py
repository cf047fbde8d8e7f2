"""Finds the frames of two videos that show the same moment; imports no torch."""

from __future__ import annotations

from pathlib import Path

from geodiff_plugin._internal.checks import bad_value, raise_input_error
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import (
    Offset,
    VideoFacts,
    estimate_offset,
    frame_interval,
    pair_frames,
    video_facts,
    watch,
)


def pair_videos(
    left: Path, right: Path, offset_s: float | None
) -> tuple[list[tuple[int, int]], tuple[Finding, ...]]:
    """Return the numbers of simultaneous frames of two videos, and a finding if their offset is estimated.

    ``offset_s`` is the time by which the right video started after the left one; ``None`` if unknown.
    """
    if offset_s is not None:
        facts = video_facts(left, "LEFT"), video_facts(right, "RIGHT")
        return _simultaneous(*facts, offset_s), ()
    videos = watch(left, "LEFT"), watch(right, "RIGHT")
    first, second = (video.facts for video in videos)
    estimated = estimate_offset(*videos)
    interval_s = max(frame_interval(first.times), frame_interval(second.times))
    together = estimated is None or abs(estimated.seconds) < interval_s / 2
    if together and first.frames == second.frames:
        return _simultaneous(first, second, 0.0), ()
    counts = f"LEFT has {first.frames} frames and RIGHT {second.frames}"
    if estimated is None:
        hint = "Pass --offset SECONDS, or trim both videos to the same time span."
        raise_input_error(f"{counts}, and their brightness does not show which are simultaneous. {hint}")
    start_s = 0.0 if together else estimated.seconds
    pairs = _simultaneous(first, second, start_s)
    return pairs, (_offset_finding(start_s, estimated, f"{counts}, of which {len(pairs)} are paired."),)


def _offset_finding(start_s: float, estimated: Offset, counts: str) -> Finding:
    """Return the finding on an estimated offset; ``counts`` is a sentence on the paired frames."""
    when = f"{abs(start_s):.3f} s {'after' if start_s > 0 else 'before'}" if start_s else "together with"
    sentence = (
        f"RIGHT is assumed to start {when} LEFT: the brightness of both then changes alike (correlation "
        f"{estimated.correlation:.2f}, {estimated.without:.2f} without an offset). {counts} Pass --offset "
        "SECONDS if this is wrong."
    )
    return Finding("pairs.offset", sentence)


def _simultaneous(left: VideoFacts, right: VideoFacts, offset_s: float) -> list[tuple[int, int]]:
    pairs = pair_frames(left, right, offset_s)
    if not pairs:
        got = f"{offset_s:g}, with videos of {left.times[-1]:.2f} s and {right.times[-1]:.2f} s"
        bad_value("--offset", "an offset at which both videos show the same moments", got)
    return pairs
