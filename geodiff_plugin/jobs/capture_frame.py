"""Processes one frame of a capture: its depth, files and report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin import __version__
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.capture.results import ALONE, FinishedFrame, save_alone
from geodiff_plugin.findings import as_records
from geodiff_plugin.formats import (
    MAP_SUFFIXES,
    REPORT,
    OutFolder,
    find_map,
    read_map,
    read_report,
    write_text,
)
from geodiff_plugin.jobs.journal import Item, Record
from geodiff_plugin.jobs.memory import fitting_memory
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.jobs.prior import prior_of_capture
from geodiff_plugin.jobs.report import measurable_limit, plain, single_map, verdict_report
from geodiff_plugin.jobs.writing import thresholds, write_maps, write_previews
from geodiff_plugin.result.output import MetricDepthOutput

#: Additional hint if memory is insufficient.
FEWER_PROCESSES = ", or pass a lower --processes"


def depth_of_frame(
    capture: Capture, pipe: Any, name: str, options: CaptureOptions, points: str = "none"
) -> MetricDepthOutput:
    """Estimate the depth of one frame with the options."""
    call: dict[str, Any] = {} if options.steps is None else {"num_inference_steps": options.steps}
    if options.prior_map is not None:
        path = find_map(options.prior_map, name) or options.prior_map / f"{name}{MAP_SUFFIXES[0]}"
        call["depth_map"] = read_map(path, f"--prior-map of {name}")
    with torch.no_grad():
        return capture.depth(pipe, name, options.neighbours, seed=options.seed, points=points, **call)


def maps_of_frame(
    capture: Capture, options: CaptureOptions, name: str
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Return depth, confidence and sigma of one frame, estimated separately."""
    return _maps_of(depth_of_frame(capture, prior_of_capture(options), name, options))


def _maps_of(output: MetricDepthOutput) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    confidence, sigma = (
        None if each is None else single_map(each) for each in (output.confidence, output.sigma)
    )
    return single_map(output.prediction), confidence, sigma


def make_frame(capture: Capture, options: CaptureOptions, loaded: Callable[[], Any], item: Item) -> Record:
    """Write the files of one frame, and return its report.

    Args:
        capture: a capture with solved poses.
        options: options of the command.
        loaded: returns the prior.
        item: item of the frame, with the digest of its settings and inputs.

    Raises:
        InputError: too little memory, or unreadable inputs.
    """
    pipe = loaded()
    size = capture.frame(item.key).size
    with fitting_memory("A frame", size, FEWER_PROCESSES):
        return _write_frame(capture, options, pipe, item)


def _write_frame(capture: Capture, options: CaptureOptions, pipe: Any, item: Item) -> Record:
    """Write the files and the report of one frame.

    ``--holes`` does not apply to the maps that are saved for the agreement check, which raises confidence.
    """
    name = item.key
    started = time.perf_counter()
    output = depth_of_frame(capture, pipe, name, options, options.points)
    limits = thresholds(options)
    shown = output.with_holes(*limits) if options.holes else output
    report = _report(capture, options, item, shown)

    def fill(folder: Path) -> None:
        report["files"] = write_maps(folder, shown, capture.image(name), *limits)
        save_alone(folder, *_maps_of(output))
        report["files"]["names"] = [*sorted(path.name for path in folder.iterdir()), REPORT]
        report["seconds"] = round(time.perf_counter() - started, 2)
        write_text(folder / REPORT, json.dumps(report, indent=2) + "\n")

    with OutFolder(options.out / name, overwrite=True) as out:
        out.write(fill)
    return report


def _report(capture: Capture, options: CaptureOptions, item: Item, output: MetricDepthOutput) -> Record:
    """Return the report of one frame without files and seconds."""
    solved = capture.solve()
    number = capture.names.index(item.key)
    return {
        "version": __version__,
        "frame": item.key,
        "made_from": item.inputs,
        "neighbours": capture.neighbours(item.key, options.neighbours),
        "unit": output.unit,
        "K": np.asarray(output.K)[0].tolist(),
        "T_world_from_camera": solved.E[number].tolist(),
        "connected": bool(solved.connected[number]),
        "scale_rel_std": plain(round(solved.scale_rel_std, 4)),
        "depth": _percentiles(single_map(output.prediction)),
        "measurable_m": plain(measurable_limit(output)),
        "poses": [pose.status for pose in output.poses],
        "verdict": verdict_report(output),
        "findings": as_records(output.findings),
    }


def _percentiles(depth: np.ndarray) -> dict[str, float]:
    """Return the percentiles of a report of the known depths; 0 if there are none."""
    known = depth[depth > 0] if (depth > 0).any() else np.zeros(1)
    low, middle, high = (float(v) for v in np.percentile(known, (2, 50, 98)))
    return {"p02": low, "median": middle, "p98": high}


def write_agreed_frame(capture: Capture, name: str, folder: Path) -> Record:
    """Write cloud, previews and report of a frame again after the agreement check, with its holes.

    Returns the entries of the report that changed.
    """
    report = read_report(folder)
    frame = FinishedFrame.of(folder, report)
    maps = frame.read()
    counts = write_previews(frame, maps, capture.image(name))
    changed = {"depth": _percentiles(maps.depth), "files": report["files"] | counts}
    write_text(folder / REPORT, json.dumps(report | changed, indent=2) + "\n")
    return changed


def is_made(item: Item, folder: Path) -> bool:
    """Whether a folder holds the result of this item."""
    whole = all((folder / f"{file}.npy").is_file() for file in ALONE)
    return whole and read_report(folder).get("made_from") == item.inputs
