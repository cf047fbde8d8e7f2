"""``report.json``: every number of a guided call as one JSON document, and the line that sums it up."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin.cli.inputs import Inputs
from geodiff_plugin.cli.options import DepthOptions
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.runtime.confidence import expected_error
from geodiff_plugin.runtime.machine import versions
from geodiff_plugin.types import MetricDepthOutput

REPORT = "report.json"


def read_report(folder: Path) -> dict[str, Any]:
    """The report of a result; empty where there is none, or none that can be read."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}


def single_map(value: Any) -> np.ndarray:
    """The ``(H, W)`` map of the one image of a call."""
    return np.asarray(value)[0, ..., 0]


def depth_summary(depth_m: np.ndarray, visible: np.ndarray | None) -> dict[str, Any]:
    """Near, far, median of ``(H, W)`` metres over valid pixels; shares and counts over all.

    ``visible`` is ``None`` without a right view.
    """
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
    """``(4, 4)`` poses of the further views of one image, in the left camera's frame and the output's unit.

    Where they were refined these are the refined ones, which the depth fits.
    """
    if output.poses and output.poses[0].status == "refined":
        return output.poses[0].E
    return tuple(_rescaled(rig.E, output) for rig in guidance.rigs)


def _rescaled(E: np.ndarray, output: MetricDepthOutput) -> np.ndarray:
    """A pose of the guidance in the unit of the output."""
    return E * np.array([1.0, 1.0, 1.0, output.rescaled])


def result_entries(output: MetricDepthOutput, guidance: GeometryGuidance) -> dict[str, Any]:
    """What a report says of the result of a guided call on one image, whoever asked for it."""
    depth_m, visible, error = single_map(output.prediction), None, math.nan
    if output.visible is not None:
        visible = single_map(output.visible).astype(bool)
        error = float(single_map(output.photometric_error)[visible].mean()) if visible.any() else math.nan
    verdict, spread, estimated = asdict(output.verdict), output.uncertainty, guidance.estimated
    if estimated is not None:
        found = ("inliers", "parallax_deg", "residual_px", "depth_spread")
        scale = {"scale_from": output.scale_from, "scale_spread": output.scale_spread}
        pose = {name: getattr(estimated, name) for name in found} | scale | {"assumed": estimated.notes}
    names = ("K", "scale", "shift", "global_scale", "own_scale", "prior_error", "unit", "assumed")
    return {
        "depth": depth_summary(depth_m, visible),
        "verdict": verdict | {"signs": verdict.pop("indicators")},
        "photometric_error_mean": error,
        "expected_error_median_m": np.median(
            expected_error(depth_m, guidance.inputs[0].K_left, used_poses(output, guidance))
        ),
        "uncertainty_median_m": None if spread is None else np.median(single_map(spread)),
        **{name: getattr(output, name) for name in names},
        "history": [vars(step) for step in output.history],
        "estimated_pose": None if estimated is None else pose,
        "pose": vars(output.poses[0]) if output.poses else None,
        "guidance": guidance.as_run().to_dict(),
        "versions": versions(),
    }


def build_report(
    inputs: Inputs, output: MetricDepthOutput, pipe: Any, options: DepthOptions, warnings: list[str]
) -> dict[str, Any]:
    """The report without seconds and files, which are known when everything else is written."""
    rig, rigs = inputs.rig, inputs.guidance.rigs
    report = result_entries(output, inputs.guidance) | {
        "warnings": warnings,
        "undistorted": inputs.undistorted,
        "inputs": {
            "left_size": rig.size_left,
            "right_size": rig.size_right,
            "calibration": rig.source,
            "K_left": rig.K_left,
            "K_right": rig.K_right,
            "E": _rescaled(rig.E, output),
            "baseline_m": output.rescaled * float(np.linalg.norm(rig.E[:3, 3])),
            "further_views": [{"K": each.K_right, "E": _rescaled(each.E, output)} for each in rigs[1:]],
        },
        "prior": {
            "name": options.prior,
            "pipeline": type(pipe).__name__,
            "scheduler": type(pipe.scheduler).__name__,
            "device": str(pipe._execution_device),
            "dtype": options.dtype,
        },
        "arguments": options.as_json(),
    }
    return plain(report)


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
        reason = verdict["reasons"][0] if verdict["reasons"] else "neither matches nor known depths test it."
        return f"{verdict['status'].upper()}: {reason} (Unconfirmed: {metres}; {end})"
    signs, error, own = verdict["signs"], report.get("expected_error_median_m"), report["own_scale"]
    trusted = ["trusted"]
    trusted += [] if signs["confidence"] is None else [f"confidence {signs['confidence']:.2f}"]
    trusted += [] if error is None else [f"expected error {_length(error, report['unit'])}"]
    trusted += [] if signs["matched"] is None else [f"{100 * signs['matched']:.0f} % matched"]
    trusted += [f"{signs['points']} known depths"] if signs["points"] else []
    scale = [] if own is None else [f"prior's own metres x {own[0][0]:.2f}"]
    return "; ".join([metres, ", ".join(trusted), *scale, end])
