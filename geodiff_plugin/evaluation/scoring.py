"""Every metric of one prediction on one sample, as JSON values (paper S5.1: raw and aligned)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch.nn.functional as F

from geodiff_plugin._checks import bad_value
from geodiff_plugin.capture.agreement import DepthFrame, seen_in
from geodiff_plugin.evaluation import metrics
from geodiff_plugin.evaluation.baselines import Prediction
from geodiff_plugin.evaluation.baselines.unguided import sweep
from geodiff_plugin.evaluation.datasets.sample import StereoSample, depth_to_disparity
from geodiff_plugin.matching import match_volume
from geodiff_plugin.runtime.confidence import RIGHT_WITHIN

#: Material classes that Booster's authors call transparent or mirror when they score depth.
TOM_CLASSES = (2, 3)
#: Share of pixels with truth from which on its edges are there to be measured.
DENSE = 0.5
#: Confidence from which on a match of our plane sweep counts as one.
RELIABLE_MATCH = 0.5

Scores = dict[str, float | None]


def out_of_view(sample: StereoSample) -> np.ndarray:
    """``(H, W)`` bool: pixels with truth that the true depth puts behind or beside the right image."""
    left = DepthFrame("left", sample.depth_m, sample.valid, sample.K_left, np.eye(4))
    right = DepthFrame("right", sample.right[..., 0], sample.right[..., 0], sample.K_right, sample.E_scored)
    return sample.valid & ~seen_in(left, right)[3]


@lru_cache(maxsize=1)
def matched(sample: StereoSample) -> np.ndarray | None:
    """``(H, W)`` bool: where our plane sweep has a reliable match, by the true poses; ``None`` for no sweep.

    Made on the CPU, so that no two runs differ.
    """
    try:
        volume = sweep(replace(sample, E=sample.E_scored), "cpu")
    except ValueError:
        return None
    matches = match_volume(volume)
    reliable = (matches.confidence >= RELIABLE_MATCH).float()
    return F.interpolate(reliable[None], sample.depth_m.shape, mode="nearest-exact")[0, 0].numpy() > 0


def regions(sample: StereoSample) -> dict[str, np.ndarray]:
    """Masks by which AbsRel is split, ``(H, W)`` bool, within ``sample.valid``.

    ``matched`` where the two views can be swept; ``occluded`` where the set says what is hidden.
    """
    masks = {"out_of_view": out_of_view(sample)}
    by_match = matched(sample)
    if by_match is not None:
        masks |= {"matched": by_match, "unmatched": ~by_match}
    if sample.occluded is not None:
        hidden = sample.occluded & ~masks["out_of_view"]
        masks |= {"occluded": hidden, "visible": ~hidden & ~masks["out_of_view"]}
    if sample.material is not None:
        tom = np.isin(sample.material, TOM_CLASSES)
        masks |= {"tom": tom, "not_tom": ~tom}
        for value in np.unique(sample.material[sample.valid]):
            masks[f"material_{int(value)}"] = sample.material == value
    return {name: sample.valid & mask for name, mask in masks.items()}


def _plain(scores: Mapping[str, float | None]) -> Scores:
    """Rounded to 7 digits; NaN becomes ``None``, which JSON has a word for."""
    return {k: None if v is None or math.isnan(v) else float(f"{v:.7g}") for k, v in scores.items()}


def _positive(depth_m: np.ndarray | None) -> np.ndarray:
    """The map with NaN where it is not a positive number."""
    assert depth_m is not None  # a prediction has metres where it has no relative map
    return np.where(metrics.answered(depth_m), depth_m, np.nan)


def disparity_scores(sample: StereoSample, depth_m: np.ndarray) -> dict[str, Scores]:
    """``DISPARITY_METRICS`` of a rectified sample, of ``all`` pixels with truth and by region.

    ``visible``: by the set's mask or by dense truth; ``edge`` and ``flat``: near its steps, and not.
    """
    cameras, valid = (sample.K_left, sample.K_right, sample.E_scored), sample.valid
    true_px = depth_to_disparity(np.where(valid, sample.depth_m, 1.0), *cameras)
    pred_px = depth_to_disparity(_positive(depth_m), *cameras)
    masks, hidden = {"all": valid}, sample.occluded
    if hidden is None and valid.mean() > DENSE:
        hidden = metrics.hidden_by_truth(true_px, valid)
    if hidden is not None:
        masks["visible"] = valid & ~hidden & ~out_of_view(sample)
    edge = metrics.near_disparity_steps(true_px, valid)
    masks |= {"edge": edge, "flat": valid & ~edge}
    step_px = float(sample.notes.get("disparity_step_px", 0.0))
    return {
        name: _plain(metrics.evaluate_disparity(pred_px, true_px, mask, step_px))
        for name, mask in masks.items()
        if mask.any()
    }


def _metric_scores(sample: StereoSample, prediction: Prediction, kept: np.ndarray) -> dict[str, Any]:
    """What only a map in metres has: see ``score``."""
    depth_m, truth, valid = prediction.depth_m, sample.depth_m, sample.valid
    names = ("disparity", "ause", "confidence", "ause_confidence", "boundaries")
    record: dict[str, Any] = dict.fromkeys(names)
    if depth_m is None:
        return record
    if sample.rectified:
        by_mask = disparity_scores(sample, depth_m)
        record["disparity"] = by_mask.pop("all") | {"regions": by_mask}
    if prediction.uncertainty is not None:
        record |= _plain({"ause": metrics.ause(depth_m, truth, kept, prediction.uncertainty)})
    if (confidence := prediction.confidence) is not None:
        deciles = metrics.confidence_deciles(depth_m, truth, kept, confidence, RIGHT_WITHIN)
        record["confidence"] = [_plain(decile) for decile in deciles]
        orders = {"ause": -confidence, "random": None}
        areas = {name: metrics.ause(depth_m, truth, kept, order) for name, order in orders.items()}
        record["ause_confidence"] = _plain(areas)
    if valid.mean() > DENSE:
        f1 = {"f1": metrics.boundary_f1(depth_m, truth, valid)}
        record["boundaries"] = _plain(f1 | metrics.boundary_errors(depth_m, truth, valid))
    return record


def in_metres(prediction: Prediction, truth: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """``(H, W)`` metres as they come out; of relative depth, aligned with the truth."""
    if prediction.depth_m is not None:
        return prediction.depth_m
    assert prediction.relative is not None  # a prediction has one of the two
    return metrics.align(prediction.relative, truth, kept, prediction.space)


def score(sample: StereoSample, prediction: Prediction, cap_m: float | None) -> dict[str, Any]:
    """Score one prediction; truth from ``cap_m`` metres on does not count under the cap.

    ``all_pixels``: ``raw`` and ``aligned`` errors over every pixel with truth; ``capped``: the same under the
    cap; ``regions``: AbsRel by region under the cap, aligned for a method without metres; ``None`` where
    something does not apply. ``ValueError`` for a map of the wrong shape or a sample without truth.
    """
    truth, valid = sample.depth_m, sample.valid
    for name in ("depth_m", "relative", "uncertainty", "confidence"):
        values = getattr(prediction, name)
        if values is not None and values.shape != truth.shape:
            bad_value(f"prediction.{name}", f"of the left image's shape {truth.shape}", values.shape)
    sample.check_truth()
    values, depth_m, space = prediction.relative, prediction.depth_m, prediction.space
    if values is None:
        # Metres are aligned in the prior's own space, as its relative map would be.
        values = depth_m if space == "depth" else metrics.to_space(_positive(depth_m), space)

    def both(cap: float | None) -> dict[str, Scores | None]:
        aligned_m = metrics.align(values, truth, metrics.counted(truth, valid, cap), space)
        raw = None if depth_m is None else _plain(metrics.evaluate_depth(depth_m, truth, valid, cap))
        return {"raw": raw, "aligned": _plain(metrics.evaluate_depth(aligned_m, truth, valid, cap))}

    record: dict[str, Any] = {"all_pixels": both(None)}
    record["capped"] = record["all_pixels"] if cap_m is None else both(cap_m)
    kept = metrics.counted(truth, valid, cap_m)
    shown_m, errors = in_metres(prediction, truth, kept), {}
    for name, mask in regions(sample).items():
        if (mask & kept).any():
            errors[name] = metrics.evaluate_depth(shown_m, truth, mask & kept, cap_m)["abs_rel"]
    return record | _metric_scores(sample, prediction, kept) | {"regions": _plain(errors)}
