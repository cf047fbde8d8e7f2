"""Builds the report of a pair, ``report.json``, and its summary line."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.findings import Severity, as_records
from geodiff_plugin.jobs.records import PairRun
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.result.readings import beyond_limit, measured
from geodiff_plugin.runtime.machine import versions
from geodiff_plugin.trust import (
    UNTESTED,
    KnownPoints,
    MatchedFraction,
    summary_words,
)
from geodiff_plugin.types import DepthFrame


def valid_depth(folder: Path) -> np.ndarray:
    """Read the depth map of a result, ``(H, W)`` metres; 0 marks invalid pixels (confidence 0)."""
    depth_m: np.ndarray = np.load(folder / "depth.npy", allow_pickle=False)
    confidence = folder / "confidence.npy"
    return depth_m * (np.load(confidence, allow_pickle=False) > 0) if confidence.is_file() else depth_m


def known_sigma(folder: Path, name: str = "sigma.npy") -> np.ndarray | None:
    """Read the standard deviation of a result's depth, ``(H, W)`` metres; ``None`` if it has none."""
    path = folder / name
    return np.load(path, allow_pickle=False) if path.is_file() else None


def report_text(report: dict[str, Any]) -> str:
    """Format a report for its file."""
    return json.dumps(report, indent=2, allow_nan=False)


def single_map(value: Any) -> np.ndarray:
    """Return the ``(H, W)`` map of a call with one image."""
    return np.asarray(value)[0, ..., 0]


def output_summary(output: MetricDepthOutput) -> dict[str, Any]:
    """Return the ``depth_summary`` of an output with one image."""
    visible = None if output.visible is None else single_map(output.visible)
    depth_m, valid = single_map(output.prediction), single_map(output.valid)
    return depth_summary(depth_m, visible, valid, measurable_limit(output))


def measurable_limit(output: MetricDepthOutput) -> float | None:
    """Return the farthest measurable depth of an output with one image, ``None`` if unknown."""
    return None if output.measurable_m is None else float(output.measurable_m[0])


def measured_depth(output: MetricDepthOutput) -> np.ndarray:
    """Return the depth of an output with one image, ``(H, W)``; 0 where it is invalid or too far."""
    return measured(single_map(output.prediction), single_map(output.valid), measurable_limit(output))


def depth_summary(
    depth_m: np.ndarray,
    visible: np.ndarray | None,
    valid: np.ndarray | None = None,
    measurable_m: float | None = None,
) -> dict[str, Any]:
    """Return near, far and median of ``(H, W)`` metres over valid pixels; count and fraction over all.

    Depth beyond ``measurable_m``, as of the sky, was not measured and is not a maximum. If there is any,
    ``beyond_m`` is that limit, ``beyond_fraction`` its fraction of all pixels, and ``max_m`` is the farthest
    depth before it.
    """
    has_depth = np.isfinite(depth_m) & (depth_m > 0)
    valid = has_depth if valid is None else has_depth & valid
    beyond = beyond_limit(depth_m, measurable_m)
    kept, near = (depth_m[mask] if mask.any() else np.array([math.nan]) for mask in (valid, valid & ~beyond))
    return {
        "min_m": float(kept.min()),
        "median_m": float(np.median(kept)),
        "mean_m": float(kept.mean()),
        "max_m": float(near.max()),
        "beyond_m": measurable_m if beyond.any() else None,
        "beyond_fraction": float(beyond.mean()),
        "width": depth_m.shape[1],
        "height": depth_m.shape[0],
        "invalid_pixels": int((~valid).sum()),
        "visible_fraction": 0.0 if visible is None else float(visible.mean()),
    }


def smoothed_entries(report: dict[str, Any], frame: DepthFrame, has_holes: bool) -> dict[str, Any]:
    """Return the entries of a frame's report that describe its maps after temporal smoothing.

    ``temporal_smoothing.alone`` keeps the entries of the frame's own result, also if smoothing is repeated.
    Maps with removed depths have no mean confidence, because the confidence of those is removed as well.
    """
    names = ("depth", "sigma_median_m")
    alone = report.get("temporal_smoothing", {}).get("alone") or {name: report[name] for name in names}
    known = frame.depth > 0
    confidence_mean = None if has_holes or not known.any() else float(frame.confidence[known].mean())
    depth = depth_summary(frame.depth, None, frame.confidence > 0, frame.measurable)
    entries = {
        "depth": depth | {"visible_fraction": alone["depth"]["visible_fraction"]},
        "sigma_median_m": median_sigma(frame.sigma),
        "temporal_smoothing": {
            "confidence_mean": confidence_mean,
            "alone": alone,
        },
    }
    return plain(entries)


def median_sigma(sigma_m: np.ndarray | None) -> float | None:
    """Return the median of the known standard deviations ``(H, W)``; ``None`` if there are none."""
    known = np.zeros(0) if sigma_m is None else sigma_m[np.isfinite(sigma_m)]
    return float(np.median(known)) if known.size else None


def plain(value: Any) -> Any:
    """Convert tensors and arrays to lists, and non-finite numbers to ``None``, for JSON."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, torch.Tensor):
        return plain(value.detach().cpu().tolist())
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def used_poses(output: MetricDepthOutput, guidance: GeometryGuidance) -> tuple[np.ndarray, ...]:
    """Return the ``(4, 4)`` poses of the further views in the output's unit; refined poses if available."""
    if output.poses and output.poses[0].status == "refined":
        return output.poses[0].E
    return tuple(_rescaled(rig.E, output) for rig in guidance.rigs)


def _rescaled(E: np.ndarray, output: MetricDepthOutput) -> np.ndarray:
    """Convert a pose of the guidance to the unit of the output."""
    rescaled = np.array(E)
    rescaled[:3, 3] *= output.rescaled
    return rescaled


def verdict_report(output: MetricDepthOutput) -> dict[str, Any]:
    """Return the verdict as in reports, with the facts of its checks by name."""
    verdict = output.verdict
    facts = plain(verdict.facts.as_record())
    return {
        "status": verdict.status,
        "reasons": list(verdict.reasons),
        "remarks": list(verdict.remarks),
        "facts": facts,
    }


def severities(report: dict[str, Any]) -> set[str]:
    """Return the severities of the findings of a report."""
    return {finding["severity"] for finding in report.get("findings", ())}


def build_report(run: PairRun) -> dict[str, Any]:
    """Build the report of a pair, without seconds and files, which are added last."""
    output = run.output
    guidance = run.inputs.guidance
    error = math.nan
    if output.visible is not None:
        visible = single_map(output.visible).astype(bool)
        error = float(single_map(output.photometric_error)[visible].mean()) if visible.any() else math.nan
    spread = output.uncertainty
    names = ("K", "scale", "shift", "global_scale", "prior_scale", "prior_error", "unit")
    report = {
        "depth": output_summary(output),
        "measurable_m": measurable_limit(output),
        "verdict": verdict_report(output),
        "photometric_error_mean": error,
        "sigma_median_m": median_sigma(None if output.sigma is None else single_map(output.sigma)),
        "uncertainty_median_m": None if spread is None else np.median(single_map(spread)),
        **{name: getattr(output, name) for name in names},
        "history": [vars(step) for step in output.history],
        "estimated_pose": _estimated_pose(output, guidance),
        "pose": vars(output.poses[0]) if output.poses else None,
        "guidance": guidance.as_run().to_dict(),
        "versions": versions(),
        "findings": as_records(output.findings, run.log.findings),
        "undistorted": run.inputs.undistorted,
        "inputs": _cameras(run),
        "prior": run.prior,
        "arguments": run.options.as_json(),
    }
    return plain(report if run.origin is None else report | {"pair": vars(run.origin)})


def _estimated_pose(output: MetricDepthOutput, guidance: GeometryGuidance) -> dict[str, Any] | None:
    estimated = guidance.estimated
    if estimated is None:
        return None
    measures = ("inliers", "parallax_deg", "residual_px", "depth_spread")
    scale = {"scale_from": output.scale_from, "scale_rel_std": output.scale_rel_std}
    return {name: getattr(estimated, name) for name in measures} | scale


def _cameras(run: PairRun) -> dict[str, Any]:
    """Return the cameras that were used, with lengths in the output's unit."""
    rig = run.inputs.rig
    output = run.output
    further = run.inputs.guidance.rigs[1:]
    return {
        "left_size": rig.size_left,
        "right_size": rig.size_right,
        "calibration": rig.source,
        "K_left": rig.K_left,
        "K_right": rig.K_right,
        "E": _rescaled(rig.E, output),
        "baseline_m": output.rescaled * float(np.linalg.norm(rig.E[:3, 3])),
        "further_views": [{"K": each.K_right, "E": _rescaled(each.E, output)} for each in further],
    }


def _length(value: float, unit: str | None) -> str:
    """Format with two decimals, or two significant digits if smaller."""
    number = f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"
    return number if unit is None else f"{number} {unit}"


def limit_words(measurable_m: float, unit: str | None) -> str:
    """Format the farthest measurable depth with two significant digits."""
    return f"{float(f'{measurable_m:.2g}'):g}" + ("" if unit is None else f" {unit}")


def depth_range_words(depth: Mapping[str, Any], unit: str | None) -> str:
    """Format the range of a ``depth_summary``, such as ``3.24 m to beyond 71 m``."""
    near = _length(depth["min_m"], unit)
    beyond_m = depth.get("beyond_m")
    if beyond_m is None:
        return f"{near} to {_length(depth['max_m'], unit)}"
    far = f"beyond {limit_words(beyond_m, unit)}"
    nothing_measured = depth["max_m"] is None or math.isnan(depth["max_m"])
    return far if nothing_measured else f"{near} to {far}"


def summary_line(report: dict[str, Any], where: str) -> str:
    """Summarise a report in one line: near, far, median, evidence; first the verdict if not trusted."""
    depth, verdict = report["depth"], report["verdict"]
    end = f"{sum(report['seconds'].values()):.1f} s -> {where}"
    if depth["median_m"] is None:
        return f"no valid depth; {end}"
    metres = (
        f"{depth_range_words(depth, report['unit'])}, median {_length(depth['median_m'], report['unit'])}"
    )
    if report["unit"] is None:
        lengths = "baselines" if report.get("estimated_pose") else "the calibration's lengths"
        metres += f", in {lengths} (no unit)"
    if verdict["status"] != "trusted":
        reason = verdict["reasons"][0] if verdict["reasons"] else f"{UNTESTED}."
        return f"{verdict['status'].upper()}: {reason} (Unreliable: {metres}; {end})"
    facts, prior_scale = verdict["facts"], report["prior_scale"]
    found, points = facts.get(MatchedFraction.name(), {}), facts.get(KnownPoints.name(), {})
    sigma = report.get("sigma_median_m")
    trusted = [summary_words(verdict["status"], Severity.ASSUMPTION.value in severities(report))]
    trusted += [] if found.get("confidence") is None else [f"confidence {found['confidence']:.2f}"]
    trusted += [] if sigma is None else [f"median sigma {_length(sigma, report['unit'])}"]
    trusted += [] if found.get("matched") is None else [f"{100 * found['matched']:.0f} % matched"]
    trusted += [f"{points['count']} known depths"] if points.get("count") else []
    scale = [] if prior_scale is None else [f"prior's metric scale x {prior_scale[0][0]:.2f}"]
    return "; ".join([metres, ", ".join(trusted), *scale, end])
