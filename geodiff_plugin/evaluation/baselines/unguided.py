"""Depth without guidance: stereo matching, models of transformers, and maps from files (paper S5.1)."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.cameras import Camera, PosedViews, View
from geodiff_plugin.evaluation.baselines.guided import (
    call_arguments,
    guidance_of,
    guided_configuration,
    guided_map,
    guided_prediction,
)
from geodiff_plugin.evaluation.baselines.method import (
    Method,
    NotApplicable,
    Prediction,
    PriorCache,
    Settings,
    folder_fingerprint,
)
from geodiff_plugin.evaluation.datasets.sample import StereoSample, disparity_to_depth, like, read_depth_m
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.formats import as_image_01, read_depth_png, read_map
from geodiff_plugin.matching import CostVolume, build_cost_volume, match_volume
from geodiff_plugin.matching.gaps import fill_background
from geodiff_plugin.matching.rows import PARAMETERS, make_matcher, pad_columns


def sweep(sample: StereoSample, device: str, views: int = 2) -> CostVolume:
    """Sweep planes from infinity to the default nearest depth through the left of at most ``views`` views."""
    given = (sample.right, sample.K_right, sample.E), *sample.extra_views
    left, *rights = (
        View.single(as_image_01(image, "image").to(device), Camera(K), np.linalg.inv(E))
        for image, K, E in ((sample.left, sample.K_left, np.eye(4)), *given[: views - 1])
    )
    return build_cost_volume(PosedViews(left, tuple(rights)))


#: Maximum tested shift, as a fraction of the image width.
MAX_SHIFT = 0.25
#: Matches with a smaller shift in pixels are treated as outliers, which would cost most, and filled.
MIN_SHIFT_PX = 1.0
#: Smoothness of the filter, as in OpenCV's example.
WLS_LAMBDA = 8000.0
#: Sensitivity of the filter to image edges, as in OpenCV's example.
WLS_SIGMA = 1.5


def sgbm_shift(sample: StereoSample, wls: bool = False, mode: int = cv2.STEREO_SGBM_MODE_HH) -> np.ndarray:
    """Return ``f b / z`` in pixels, ``(H, W)`` float32 (disparity plus doffs); NaN if rejected."""
    # Depth at infinity has the disparity cx_left - cx_right, which is nonzero only for Middlebury's doffs.
    lowest = int(np.floor(sample.K_left[0, 2] - sample.K_right[0, 2]))
    count = 16 * int(np.ceil(MAX_SHIFT * sample.left.shape[1] / 16))
    matcher = make_matcher(lowest, count, 3, mode)
    pad = max(0, lowest + count)
    left, right = pad_columns(sample.left, pad), pad_columns(sample.right, pad)
    raw = matcher.compute(left, right)
    if wls:
        ximgproc: Any = cv2.ximgproc  # type: ignore[attr-defined]
        smoother = ximgproc.createDisparityWLSFilter(matcher)
        smoother.setLambda(WLS_LAMBDA)
        smoother.setSigmaColor(WLS_SIGMA)
        raw_right = ximgproc.createRightMatcher(matcher).compute(right, left)
        raw = smoother.filter(raw, left, disparity_map_right=raw_right)
    raw = raw[:, pad:]
    shift = raw.astype(np.float32) / 16.0 + np.float32(sample.K_right[0, 2] - sample.K_left[0, 2])
    shift[(raw <= 16 * (lowest - 1)) | (shift < MIN_SHIFT_PX)] = np.nan
    return shift


def _run_sgbm(
    sample: StereoSample,
    settings: Settings,
    priors: PriorCache,
    wls: bool = False,
    mode: int = cv2.STEREO_SGBM_MODE_HH,
) -> Prediction:
    if not sample.rectified:
        raise NotApplicable("not rectified")
    if sample.left.shape != sample.right.shape:
        raise NotApplicable("views of different sizes")
    if wls and not hasattr(cv2, "ximgproc"):
        raise NotApplicable("cv2.ximgproc, of opencv-contrib-python, is not installed")
    with_holes = sgbm_shift(sample, wls, mode)
    depth_m = sample.K_left[0, 0] * sample.E[0, 3] / fill_background(with_holes)
    return Prediction(depth_m, space="disparity", notes={"density": float(np.isfinite(with_holes).mean())})


def _run_sweep(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    volume = sweep(sample, settings.device, settings.views)
    matches = match_volume(volume)
    farthest = 0.5 * float(volume.plane_step)
    # Matches at infinity are rejected, because the sky would spread into adjacent holes.
    matched = (matches.confidence[0] > 0) & (matches.inverse_depth[0] > farthest)
    with_holes = torch.where(matched, matches.inverse_depth[0], torch.nan).cpu().numpy()
    filled = torch.from_numpy(fill_background(with_holes))[None, None]
    full = F.interpolate(filled, sample.left.shape[:2], mode="bilinear", align_corners=False)[0, 0]
    depth_m = 1.0 / np.maximum(full.numpy().astype(np.float64), farthest)
    return Prediction(depth_m, space="disparity", notes={"density": float(matched.float().mean())})


_SHIFTS: dict[str, Any] = {"max_shift": MAX_SHIFT, "min_shift_px": MIN_SHIFT_PX, "mode": "8way"}
_SHIFTS |= {"fill": "background"} | PARAMETERS
_CHOICES = {"cost": "census", "aggregation": "semi-global", "fill": "background"}
_SGBM = "OpenCV StereoSGBM (8-way) with background fill; rectified pairs only"
_THREE_WAY = "sgbm in the faster three-way mode, which guided calls run on rectified pairs"
_WLS = "sgbm smoothed by OpenCV's WLS filter; needs opencv-contrib-python"
_SWEEP = "this package's plane sweep, aggregated, left-right checked and filled, any pose"
STEREO_METHODS = (
    Method("sgbm", "SGBM + fill", _SGBM, _run_sgbm, lambda _: _SHIFTS, uses_prior=False),
    Method(
        *("sgbm-wls", "SGBM + WLS", _WLS, partial(_run_sgbm, wls=True)),
        lambda _: _SHIFTS,
        uses_prior=False,
    ),
    Method(
        *("sgbm-3way", "SGBM (3-way) + fill", _THREE_WAY),
        partial(_run_sgbm, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY),
        lambda _: _SHIFTS | {"mode": "3way"},
        uses_prior=False,
    ),
    Method(
        *("sweep-sgm", "sweep + SGM", _SWEEP, _run_sweep),
        lambda settings: _CHOICES | {"views": settings.views, "device": settings.device},
        uses_prior=False,
    ),
)


def hf_method(name: str) -> Method:
    """Return the method of a depth checkpoint of transformers; relative ones are scored aligned only."""
    if not name:
        bad_value("methods", "hf:MODEL with a Hugging Face model ID or a folder", "'hf:'")

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        left_01 = as_image_01(sample.left, "left")[None].to(settings.device)
        model = priors.get(replace(settings, prior=f"transformers:{name}", space=None))
        values = model.predict(left_01, sample.left.shape[:2])[0, 0]
        depth_m = model.metres(values).cpu().numpy() if model.metric else None
        return Prediction(depth_m, relative=values.cpu().numpy(), space=model.config.prediction_type)

    def configuration(settings: Settings) -> dict[str, Any]:
        files = folder_fingerprint(Path(name))
        return {"device": settings.device, "dtype": settings.dtype, "files": files}

    title = Path(name).name
    return Method(f"hf:{name}", title, f"{title} via transformers", run, configuration, uses_prior=False)


#: Kinds of maps in a folder; ``depth`` by default.
KINDS = {
    "depth": "metres",
    "disparity": "pixels of the left view, rectified pairs",
    "relative-depth": "depth up to scale and shift",
    "relative-disparity": "inverse depth up to scale and shift",
}


def _read(path: Path, kind: str) -> np.ndarray:
    """Read ``(H, W)`` float64; NaN where unknown: 0 in metric maps and PNG files, or not finite."""
    png = path.suffix == ".png"
    if kind == "depth":
        values = read_depth_m(path, "map")
    else:
        values = read_depth_png(path, 256.0, "map")[0] if png else read_map(path, "map")
    signed = kind.startswith("relative") and not png
    known = np.isfinite(values) & (signed | (values > 0))
    return np.where(known, values.astype(np.float64), np.nan)


def _prediction(values: np.ndarray, sample: StereoSample, kind: str) -> Prediction:
    """Resize a map to the image bilinearly, which enlarges holes by the pixels they are mixed into."""
    size = tuple(sample.left.shape[:2])
    resized = values
    if values.shape != size:
        given = torch.from_numpy(values)[None, None]
        resized = F.interpolate(given, size, mode="bilinear", align_corners=False)[0, 0].numpy()
    if kind.startswith("relative"):
        return Prediction(None, relative=resized, space=kind.removeprefix("relative-"))
    if kind == "depth":
        return Prediction(resized)
    if not sample.rectified:
        raise NotApplicable("not rectified")
    disparity_px = resized * (size[1] / values.shape[1])  # pixels of the map to pixels of the image
    depth_m = disparity_to_depth(disparity_px, sample.K_left, sample.K_right, sample.E)
    return Prediction(np.where(depth_m > 0, depth_m, np.nan), space="disparity")


#: Use of maps in a folder by method family: scored, as the prior of a guided call, or as its known depths.
MAP_USES = ("files", "prior-map", "points-map")
#: Folder, in the folder of the maps, of confidence in [0, 1] by the same names, for ``files``, where it is
#: scored, and ``points-map``.
CONFIDENCE_FOLDER = "confidence"


def _map_in(folder: Path, sample: StereoSample) -> Path:
    """Return the file of a sample's map; ``NotApplicable`` without one."""
    paths = [folder / f"{sample.dataset}_{sample.name}{suffix}" for suffix in (".npy", ".pfm", ".png")]
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        raise NotApplicable("no map in the folder")
    return path


def _confidence(path: Path, sample: StereoSample, known: np.ndarray) -> np.ndarray | None:
    """Read the confidence of a map at the image's size, 0 where it is not ``known``; ``None`` without one."""
    confidence_path = path.parent / CONFIDENCE_FOLDER / path.with_suffix(".npy").name
    if not confidence_path.is_file():
        return None
    values = like(sample.left, confidence_path, read_map(confidence_path, "confidence"))
    return np.where(known, values, 0).astype(np.float32)


def _run_points(
    path: Path, kind: str, sample: StereoSample, settings: Settings, priors: PriorCache
) -> Prediction:
    """Guide the prior with both views and a map as known depths, with confidence if there is a file of it."""
    depth_m = _prediction(_read(path, kind), sample, kind).depth_m
    assert depth_m is not None  # only metric kinds are accepted
    known = np.isfinite(depth_m) & (depth_m > 0)
    confidence = _confidence(path, sample, known)
    points = {"points": np.where(known, depth_m, 0).astype(np.float32), "points_confidence": confidence}
    guidance = guidance_of(sample, settings, priors, GeometryGuidance, **points)
    return guided_prediction(priors.get(settings), sample, guidance, call_arguments(settings))


def files_method(text: str, use: str = "files") -> Method:
    """Return the method of maps in a folder, DIR or KIND:DIR, for one of ``MAP_USES``."""
    kind, colon, named = text.partition(":")
    if not (colon and kind in KINDS):
        kind, named = "depth", text
    folder = Path(named)
    space = kind.removeprefix("relative-")
    if not named or not os.path.isdir(folder):
        hint = f"KIND is one of {', '.join(KINDS)}."
        bad_value("methods", f"{use}:DIR or {use}:KIND:DIR with an existing folder", repr(text), hint)
    if use == "points-map" and kind != space:
        bad_value("methods", "points-map with maps of kind depth or disparity", repr(text))

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        path = _map_in(folder, sample)
        if use == "points-map":
            return _run_points(path, kind, sample, settings, priors)
        values = _read(path, kind)
        if use == "prior-map":
            return guided_map(values, space, sample, settings, priors, GeometryGuidance)
        found = _prediction(values, sample, kind)
        if found.depth_m is None:
            return found
        return replace(found, confidence=_confidence(path, sample, np.isfinite(found.depth_m)))

    def configuration(settings: Settings) -> dict[str, Any]:
        maps = {"kind": kind, "files": folder_fingerprint(folder)}
        return maps | ({} if use == "files" else guided_configuration(GeometryGuidance, settings))

    name = folder.resolve().name
    about = f"maps of {folder.resolve().name} ({KINDS[kind]})"
    title, summary = {
        "files": (name, about),
        "prior-map": (f"guided {name}", f"{about}, guided"),
        "points-map": (
            f"guided, points of {name}",
            f"the prior guided with both views and {about} as known depths",
        ),
    }[use]
    return Method(f"{use}:{text}", title, summary, run, configuration, uses_prior=use == "points-map")
