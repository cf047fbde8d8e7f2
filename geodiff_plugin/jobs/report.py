"""The report of a pair, ``report.json``, and the line that sums it up."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.formats.out import REPORT
from geodiff_plugin.jobs.records import PairRun
from geodiff_plugin.messages import Message, as_records
from geodiff_plugin.result.misfit import expected_error, misfit_of
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.result.standing import standing_words
from geodiff_plugin.runtime.machine import versions
from geodiff_plugin.types import UNTESTED


def read_report(folder: Path) -> dict[str, Any]:
    """The report of a result; empty where there is none, or none that can be read."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}


def report_text(report: dict[str, Any]) -> str:
    """A report as its file has it."""
    return json.dumps(report, indent=2, allow_nan=False)


def single_map(value: Any) -> np.ndarray:
    """The ``(H, W)`` map of the one image of a call."""
    return np.asarray(value)[0, ..., 0]


def depth_summary(depth_m: np.ndarray, visible: np.ndarray | None) -> dict[str, Any]:
    """Near, far, median of ``(H, W)`` metres over valid pixels; shares and counts over all."""
    valid = np.isfinite(depth_m) & (depth_m > 0)
    kept = depth_m[valid] if valid.any() else np.array([math.nan])
    return {
        "min_m": float(kept.min()),
        "median_m": float(np.median(kept)),
        "mean_m": float(kept.mean()),
        "max_m": float(kept.max()),
        "width": depth_m.shape[1],
        "height": depth_m.shape[0],
        "invalid_pixels": int((~valid).sum()),
        "visible_fraction": 0.0 if visible is None else float(visible.mean()),
    }


def plain(value: Any) -> Any:
    """Tensors and arrays as lists, numbers that JSON has no name for as ``None``."""
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
    """``(4, 4)`` poses of the further views in the output's unit; the refined ones, which the depth fits."""
    if output.poses and output.poses[0].status == "refined":
        return output.poses[0].E
    return tuple(_rescaled(rig.E, output) for rig in guidance.rigs)


def _rescaled(E: np.ndarray, output: MetricDepthOutput) -> np.ndarray:
    """A pose of the guidance in the unit of the output."""
    rescaled = np.array(E)
    rescaled[:3, 3] *= output.rescaled
    return rescaled


def verdict_report(output: MetricDepthOutput) -> dict[str, Any]:
    """The verdict as reports have it; for one release its indicators also have their former names."""
    verdict: dict[str, Any] = plain(asdict(output.verdict))
    former = {"order" if name == "rank_correlation" else name: x for name, x in verdict["indicators"].items()}
    return verdict | {"signs": former}


def messages_of(output: MetricDepthOutput, *more: Iterable[Message]) -> list[dict[str, Any]]:
    """Every message on a result of one image, with its code, as reports have them."""
    verdict = output.verdict
    return as_records(verdict.reasons, verdict.remarks, output.warnings, output.assumed, *more)


def build_report(run: PairRun) -> dict[str, Any]:
    """The report of a pair without seconds and files, which are known when everything else is written."""
    output, guidance = run.output, run.inputs.guidance
    depth_m, visible, error = single_map(output.prediction), None, math.nan
    if output.visible is not None:
        visible = single_map(output.visible).astype(bool)
        error = float(single_map(output.photometric_error)[visible].mean()) if visible.any() else math.nan
    spread = output.uncertainty
    names = ("K", "scale", "shift", "global_scale", "prior_scale", "prior_error", "unit", "assumed")
    cameras = guidance.inputs[0].K_left, used_poses(output, guidance)
    found = output.verdict.indicators
    misfit = misfit_of(found, depth_m.shape)
    expected_m = expected_error(depth_m, *cameras, np.nan_to_num(found.scale_spread), misfit)
    report = {
        "depth": depth_summary(depth_m * single_map(output.valid), visible),
        "verdict": verdict_report(output),
        "photometric_error_mean": error,
        "expected_error_median_m": np.median(expected_m),
        "uncertainty_median_m": None if spread is None else np.median(single_map(spread)),
        **{name: getattr(output, name) for name in names},
        "history": [vars(step) for step in output.history],
        "estimated_pose": _estimated_pose(output, guidance),
        "pose": vars(output.poses[0]) if output.poses else None,
        "guidance": guidance.as_run().to_dict(),
        "versions": versions(),
        "warnings": run.log.warnings,
        "messages": messages_of(output, run.log.warnings, run.inputs.notes),
        "undistorted": run.inputs.undistorted,
        "inputs": _cameras(run),
        "prior": run.prior,
        "arguments": run.options.as_json(),
    }
    return plain(report)


def _estimated_pose(output: MetricDepthOutput, guidance: GeometryGuidance) -> dict[str, Any] | None:
    estimated = guidance.estimated
    if estimated is None:
        return None
    measures = ("inliers", "parallax_deg", "residual_px", "depth_spread")
    scale = {"scale_from": output.scale_from, "scale_spread": output.scale_spread}
    return {name: getattr(estimated, name) for name in measures} | scale | {"assumed": estimated.notes}


def _cameras(run: PairRun) -> dict[str, Any]:
    """The cameras as they were understood, lengths in the output's unit."""
    rig, output, further = run.inputs.rig, run.output, run.inputs.guidance.rigs[1:]
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
    """Two decimals, or two digits of what is too small for them."""
    number = f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"
    return number if unit is None else f"{number} {unit}"


def summary_line(report: dict[str, Any], where: str) -> str:
    """One line for people: near, far, median and what they rest on; where not trusted, the verdict first."""
    depth, verdict = report["depth"], report["verdict"]
    end = f"{sum(report['seconds'].values()):.1f} s -> {where}"
    if depth["median_m"] is None:
        return f"no valid depth; {end}"
    near, far, median = (_length(depth[name], report["unit"]) for name in ("min_m", "max_m", "median_m"))
    metres = f"{near} to {far}, median {median}"
    if report["unit"] is None:
        of = "baselines" if report.get("estimated_pose") else "the calibration's lengths"
        metres += f", in {of} (no unit)"
    if verdict["status"] != "trusted":
        reason = verdict["reasons"][0] if verdict["reasons"] else f"{UNTESTED}."
        return f"{verdict['status'].upper()}: {reason} (Unconfirmed: {metres}; {end})"
    found, prior_scale = verdict["indicators"], report["prior_scale"]
    error = report.get("expected_error_median_m")
    trusted = [standing_words(verdict["status"], bool(report.get("assumed")))]
    trusted += [] if found["confidence"] is None else [f"confidence {found['confidence']:.2f}"]
    trusted += [] if error is None else [f"expected error {_length(error, report['unit'])}"]
    trusted += [] if found["matched"] is None else [f"{100 * found['matched']:.0f} % matched"]
    trusted += [f"{found['points']} known depths"] if found["points"] else []
    scale = [] if prior_scale is None else [f"prior's own metres x {prior_scale[0][0]:.2f}"]
    return "; ".join([metres, ", ".join(trusted), *scale, end])
