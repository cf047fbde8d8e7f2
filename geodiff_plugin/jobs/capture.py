"""Processes a capture: solves the poses once, estimates depth of the chosen frames, and fuses one cloud."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

from geodiff_plugin import __version__
from geodiff_plugin._internal.checks import InputError, bad_value, warn
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.capture.results import write_agreement, write_results
from geodiff_plugin.findings import as_records
from geodiff_plugin.formats import TRANSFORMS, check_new, locked_folder, transforms_of, write_text
from geodiff_plugin.jobs.capture_frame import FEWER_PROCESSES, write_agreed_frame
from geodiff_plugin.jobs.capture_frames import JOURNAL, run_frames
from geodiff_plugin.jobs.capture_poses import POSES_FILE, RunKeys, open_capture, solved_poses
from geodiff_plugin.jobs.journal import BROKEN, Record, Shard
from geodiff_plugin.jobs.lengths import KnownScale, check_valid_ends, measure, spans_to_measure
from geodiff_plugin.jobs.memory import fitting_memory
from geodiff_plugin.jobs.notices import Notify, silent
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.jobs.prior import compile_for
from geodiff_plugin.jobs.provenance import RECORD, SUMMARY, Provenance, check_poses, prepare_frames
from geodiff_plugin.jobs.report import plain
from geodiff_plugin.jobs.writing import thresholds
from geodiff_plugin.runtime.machine import pick_device


def depth_capture(options: CaptureOptions, *, notify: Notify = silent, progress: bool = False) -> Record:
    """Implement ``geodiff capture``: write poses, frames, their agreement and one cloud to ``options.out``.

    Args:
        options: options of the command.
        notify: receives messages for the user.
        progress: whether to count the frames with a progress bar on stderr.

    Returns:
        The content of ``capture.json``; ``failed`` and ``not_trusted`` list frames. For a shard, and with
        ``options.poses_only``, only the entries known so far.

    Raises:
        InputError: no capture, options that do not match it, or no frame with depth.
    """
    started = time.perf_counter()
    capture = open_capture(options)
    names = capture.choose(options.frames)
    ours = any((options.out / name).is_file() for name in (POSES_FILE, JOURNAL, RECORD))
    check_new(options.out, ours or options.overwrite).mkdir(parents=True, exist_ok=True)
    for finding in capture.findings:
        notify(finding)
    largest = max((capture.frame(name).size for name in names), key=math.prod)
    with (
        locked_folder(options.out, shared=not Shard.of(options.shard).whole),
        fitting_memory("A capture", largest, FEWER_PROCESSES),
    ):
        return _depth_of_frames(capture, options, names, Progress(started, notify, progress))


@dataclass(frozen=True)
class Progress:
    """Start time of a run, receiver of its messages, and whether to show a progress bar."""

    started: float
    notify: Notify
    bar: bool

    def seconds(self, *before: float) -> float:
        """Return the seconds since the start, minus the seconds of previous stages."""
        return round(time.perf_counter() - self.started - sum(before), 1)


def _depth_of_frames(
    capture: Capture, options: CaptureOptions, names: Sequence[str], progress: Progress
) -> Record:
    """Run the job in its locked folder."""
    _check_workspace(capture, options)
    made_from = Provenance.of(capture, options)
    check_poses(made_from, options.out, options.overwrite)
    if not options.poses_only:
        prepare_frames(made_from, options.out, names, options.overwrite)
    poses_key = made_from.for_poses().key
    scale = solved_poses(capture, options, poses_key)
    check_valid_ends(capture, options)
    seconds = {"poses": progress.seconds()}
    _report_poses(capture, scale, progress.notify)
    if options.poses_only:
        return {"unit": capture.unit, "poses": _pose_report(capture)} | _outcome([])
    compile_for(options, pick_device(options.device), progress.notify)
    keys = RunKeys(poses_key, made_from.key, scale)
    outcome = _outcome(run_frames(capture, options, names, keys, progress.bar))
    if not Shard.of(options.shard).whole:
        return {"unit": capture.unit} | outcome
    seconds["frames"] = progress.seconds(*seconds.values())
    joined = _join_frames(capture, options, names, outcome)
    seconds["agreement and cloud"] = progress.seconds(*seconds.values())
    report = {
        "version": __version__,
        "made_from": keys.frames_key,
        "path": str(options.path),
        "kind": capture.kind,
        "unit": capture.unit,
        "poses": _pose_report(capture),
        "seconds": seconds,
        **joined,
        "measured": _measured(capture, options, outcome, scale),
        "findings": as_records(capture.findings, capture.solve().findings),
        **outcome,
    }
    write_text(options.out / SUMMARY, json.dumps(report, indent=2) + "\n")
    return report


def _check_workspace(capture: Capture, options: CaptureOptions) -> None:
    """Reject an export that would replace images of the capture itself.

    Raises:
        InputError: The folder of the COLMAP workspace contains an image of the capture.
    """
    workspace = (options.out / "colmap").resolve()
    if "colmap" in options.export and any(
        workspace in frame.image.resolve().parents for frame in capture.frames
    ):
        hint = "Choose a different folder; the export would replace them."
        bad_value("--out", "a folder whose colmap/ has no images of the capture", str(options.out), hint)


def _join_frames(capture: Capture, options: CaptureOptions, names: Sequence[str], outcome: Record) -> Record:
    """Check the agreement of the frames with depth, and write the files that combine them."""
    done = [name for name in names if name not in outcome["failed"]]
    if not done:
        raise InputError(f"All frames failed: {outcome['frames'][0]['error']}")
    limits = thresholds(options)
    agreement = write_agreement(capture, options.out, done, limits if options.holes else None)
    original = transforms_of(options.path, options.images) if capture.kind == TRANSFORMS else None
    doubted = outcome["not_trusted"]
    if options.holes:
        for report in outcome["frames"]:
            if report["key"] in done:
                report |= write_agreed_frame(capture, report["frame"], options.out / report["frame"])
    files = write_results(capture, options.out, done, options.export, doubted, original, limits)
    return {"files": files, "agreement": agreement}


def _report_poses(capture: Capture, scale: KnownScale | None, notify: Notify) -> None:
    """Report the fit of the poses, and warn of problems with the poses or their scale."""
    solved = capture.solve()
    notify(
        f"poses {solved.status}: median distance of matches from epipolar lines {solved.residual_px:.2f} px"
    )
    for finding in (*solved.findings, *([scale.doubt] if scale and scale.doubt else ())):
        (notify if finding.code == "capture.kept" else warn)(finding)


def _measured(
    capture: Capture, options: CaptureOptions, outcome: Record, scale: KnownScale | None
) -> list[Record]:
    """Measure the lengths of ``--measure`` in the frames with depth."""
    spans = [span for span in spans_to_measure(capture, options) if span.frame not in outcome["failed"]]
    spread = capture.solve().scale_rel_std if scale is None else scale.spread
    return measure(capture, spans, options.out, outcome["not_trusted"], spread if spread > 0 else 0.0)


def _outcome(frames: list[Record]) -> Record:
    """Return the reports of frames, and the names of failed and untrusted ones."""
    return {
        "failed": [report["key"] for report in frames if report.get("status") == BROKEN],
        "not_trusted": [f["frame"] for f in frames if "verdict" in f and f["verdict"]["status"] != "trusted"],
        "frames": frames,
    }


def _pose_report(capture: Capture) -> Record:
    """Return the report of the pose solver."""
    solved = capture.solve()
    numbers = {
        "residual_px_given": solved.residual_px_given,
        "residual_px": solved.residual_px,
        "scale_by_positions": solved.scale_trajectory,
        "scale_by_depth": solved.scale_depth,
        "scale_rel_std": solved.scale_rel_std,
    }
    rounded = plain({name: round(value, 4) for name, value in numbers.items()})
    each = zip(capture.names, solved.connected, *solved.moved(), strict=True)
    frames = {
        name: {
            "connected": bool(connected),
            "translation": round(float(shift), 5),
            "rotation_deg": round(float(rotation_deg), 3),
        }
        for name, connected, shift, rotation_deg in each
        if math.isfinite(shift)
    }
    return {"status": solved.status, **rounded, "frames": frames}
