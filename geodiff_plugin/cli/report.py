"""``report.json``: every number of a guided call as one JSON document, and the line that sums it up."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from geodiff_plugin.cli.inputs import Inputs
from geodiff_plugin.cli.options import DepthOptions
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.runtime.confidence import expected_error
from geodiff_plugin.runtime.machine import versions
from geodiff_plugin.runtime.verdict import Verdict
from geodiff_plugin.types import MetricDepthOutput

__all__ = ["build_report", "depth_summary", "single_map", "summary_line", "used_poses"]


def single_map(value: Any) -> np.ndarray:
    """The ``(H, W)`` map of the one image of a call."""
    return np.asarray(value)[0, ..., 0]


def depth_summary(depth_m: np.ndarray, visible: np.ndarray) -> dict[str, Any]:
    """Near, far, median in metres over valid pixels; shares and counts over all.

    Args:
        depth_m: ``(H, W)`` metres.
        visible: ``(H, W)`` bool.
    """
    valid = np.isfinite(depth_m) & (depth_m > 0)
    kept = depth_m[valid]
    names = ("min_m", "median_m", "mean_m", "max_m")
    values = (kept.min(), np.median(kept), kept.mean(), kept.max()) if kept.size else (math.nan,) * 4
    return {name: float(value) for name, value in zip(names, values, strict=True)} | {
        "width": depth_m.shape[1],
        "height": depth_m.shape[0],
        "invalid_pixels": int((~valid).sum()),
        "visible_fraction": float(visible.mean()),
    }


def _plain(value: Any) -> Any:
    """Tensors and arrays as lists, numbers that JSON has no name for as ``None``."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, torch.Tensor):
        return _plain(value.detach().cpu().tolist())
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _history(output: MetricDepthOutput) -> list[dict[str, Any]]:
    return [
        {
            "step": entry.step,
            "timestep": float(entry.timestep),
            "loss": entry.loss,
            "terms": entry.terms,
            "s_hat": entry.s_hat,
            "t_hat": entry.t_hat,
            "g_s": entry.g_s,
            "visible_fraction": entry.visible_fraction,
        }
        for entry in output.history
    ]


def _estimated(inputs: Inputs, output: MetricDepthOutput) -> dict[str, Any] | None:
    """What was found out about cameras that nobody measured; ``None`` for given ones."""
    found = inputs.guidance.estimated
    if found is None:
        return None
    return {
        "inliers": found.inliers,
        "parallax_deg": found.parallax_deg,
        "residual_px": found.residual_px,
        "depth_spread": found.depth_spread,
        "scale_from": output.scale_from,
        "scale_spread": output.scale_spread,
        "assumed": found.notes,
    }


def _rescaled_pose(E: np.ndarray, output: MetricDepthOutput) -> np.ndarray:
    """A pose of the guidance in the unit of the output."""
    return E * np.array([1.0, 1.0, 1.0, output.rescaled])


def used_poses(output: MetricDepthOutput, guidance: GeometryGuidance) -> tuple[np.ndarray, ...]:
    """``(4, 4)`` poses of the further views of one image, in the left camera's frame and the output's unit.

    Where they were refined these are the refined ones, which the depth fits.
    """
    if output.poses and output.poses[0].status == "refined":
        return output.poses[0].E
    return tuple(_rescaled_pose(rig.E, output) for rig in guidance.rigs)


def build_report(
    inputs: Inputs,
    output: MetricDepthOutput,
    pipe: Any,
    options: DepthOptions,
    warnings: list[str],
) -> dict[str, Any]:
    """The report without seconds and files, which are known when everything else is written.

    Args:
        inputs: the views and cameras.
        output: of the guided call.
        pipe: the pipeline that made it.
        options: as typed.
        warnings: sentences, those of the output included.
    """
    rig = inputs.rig
    depth_m, error_mean = single_map(output.prediction), math.nan
    visible = np.zeros(depth_m.shape, dtype=bool)
    if output.visible is not None:
        visible = single_map(output.visible)
        error_mean = (
            float(single_map(output.photometric_error)[visible].mean()) if visible.any() else math.nan
        )
    report = {
        "depth": depth_summary(depth_m, visible),
        "verdict": _verdict(output.verdict),
        "assumed": output.assumed,
        "photometric_error_mean": error_mean,
        "expected_error_median_m": np.median(
            expected_error(depth_m, rig.K_left, used_poses(output, inputs.guidance))
        ),
        "uncertainty_median_m": None
        if output.uncertainty is None
        else np.median(single_map(output.uncertainty)),
        "K": output.K,
        "scale": output.scale,
        "shift": output.shift,
        "global_scale": output.global_scale,
        "own_scale": output.own_scale,
        "prior_error": output.prior_error,
        "history": _history(output),
        "warnings": warnings,
        "unit": output.unit,
        "undistorted": inputs.undistorted,
        "estimated_pose": _estimated(inputs, output),
        "pose": None if not output.poses else vars(output.poses[0]),
        "inputs": {
            "left_size": rig.size_left,
            "right_size": rig.size_right,
            "calibration": rig.source,
            "K_left": rig.K_left,
            "K_right": rig.K_right,
            "E": _rescaled_pose(rig.E, output),
            "baseline_m": output.rescaled * float(np.linalg.norm(rig.E[:3, 3])),
            "further_views": [
                {"K": other.K_right, "E": _rescaled_pose(other.E, output)}
                for other in inputs.guidance.rigs[1:]
            ],
        },
        "prior": {
            "name": options.prior,
            "pipeline": type(pipe).__name__,
            "scheduler": type(pipe.scheduler).__name__,
            "device": str(pipe._execution_device),
            "dtype": options.dtype,
        },
        "guidance": inputs.guidance.as_run().to_dict(),
        "arguments": options.as_json(),
        "versions": versions(),
    }
    return _plain(report)


def _verdict(verdict: Verdict) -> dict[str, Any]:
    """JSON values of a verdict; the file has its indicators under ``signs``."""
    values = asdict(verdict)
    return values | {"signs": values.pop("indicators")}


def _quality(signs: dict[str, Any], expected: str | None) -> str:
    """What a trusted depth rests on, in a few words; ``expected`` is the error that the geometry allows."""
    said = [] if signs["confidence"] is None else [f"confidence {signs['confidence']:.2f}"]
    said += [] if expected is None else [f"expected error {expected}"]
    said += [] if signs["matched"] is None else [f"{100 * signs['matched']:.0f} % matched"]
    said += [] if not signs["points"] else [f"{signs['points']} known depths"]
    return ", ".join(["trusted", *said])


def _length(value: float, unit: str | None) -> str:
    """Two decimals, or two digits of what is too small for them."""
    number = f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"
    return number if unit is None else f"{number} {unit}"


def summary_line(report: dict[str, Any], where: str) -> str:
    """One line for people: near, far, median and what they rest on; where not trusted, the verdict first."""
    depth, seconds = report["depth"], sum(report["seconds"].values())
    if depth["median_m"] is None:
        return f"no valid depth; {seconds:.1f} s -> {where}"
    own = report.get("own_scale")
    said = "" if own is None else f"; prior's own metres x {own[0][0]:.2f}"
    unit, lengths = report.get("unit", "m"), ""
    if unit is None:
        of = "the calibration's lengths" if report.get("estimated_pose") is None else "baselines"
        lengths = f", in {of} (no unit)"
    near, far, median = (_length(depth[name], unit) for name in ("min_m", "max_m", "median_m"))
    verdict, metres = report["verdict"], f"{near} to {far}, median {median}{lengths}"
    if verdict["status"] == "trusted":
        error = report.get("expected_error_median_m")
        expected = None if error is None else _length(error, unit)
        return f"{metres}; {_quality(verdict['signs'], expected)}{said}; {seconds:.1f} s -> {where}"
    reason = verdict["reasons"][0] if verdict["reasons"] else "neither matches nor known depths test it."
    return f"{verdict['status'].upper()}: {reason} (Unconfirmed: {metres}; {seconds:.1f} s -> {where})"
