"""Depth without our guidance: stereo matching, models of transformers, and maps in files (paper S5.1)."""

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

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines.guided import guided_configuration, guided_map
from geodiff_plugin.evaluation.baselines.method import (
    Method,
    NotApplicable,
    Prediction,
    PriorCache,
    Settings,
    folder_fingerprint,
)
from geodiff_plugin.evaluation.datasets.sample import StereoSample, disparity_to_depth, read_depth_m
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.formats import as_image_01, read_depth_png
from geodiff_plugin.formats.depth import read_map
from geodiff_plugin.matching import CostVolume, build_cost_volume, match_volume
from geodiff_plugin.matching.gaps import fill_background
from geodiff_plugin.matching.rows import PARAMETERS, make_matcher, pad_columns
from geodiff_plugin.types import CameraView, PosedViews


def sweep(sample: StereoSample, device: str, views: int = 2) -> CostVolume:
    """Planes from infinity to the default nearest one, swept through the left of at most ``views`` views."""

    def moved(x: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(x, dtype=torch.float32, device=device)

    given = ((sample.right, sample.K_right, sample.E), *sample.extra_views)[: views - 1]
    rights = (
        CameraView(as_image_01(image, "right").to(device), moved(K), moved(np.linalg.inv(E)))
        for image, K, E in given
    )
    left_01 = as_image_01(sample.left, "left").to(device)
    return build_cost_volume(PosedViews(left_01, tuple(rights), moved(sample.K_left)))


#: Largest shift that is tried, as a share of the image width.
MAX_SHIFT = 0.25
#: Matches with a smaller shift than this, in pixels, are taken for mistakes, which cost most, and filled.
MIN_SHIFT_PX = 1.0
#: Smoothness of the filter, as OpenCV's example sets it.
WLS_LAMBDA = 8000.0
#: Its sensitivity to edges of the image, likewise.
WLS_SIGMA = 1.5


def sgbm_shift(sample: StereoSample, wls: bool = False) -> np.ndarray:
    """``(H, W)`` float32 pixels: ``f b / z``, disparity plus doffs; NaN where the match was rejected."""
    # Depth at infinity has the disparity cx_left - cx_right, which is 0 but for Middlebury's doffs.
    lowest = int(np.floor(sample.K_left[0, 2] - sample.K_right[0, 2]))
    count = 16 * int(np.ceil(MAX_SHIFT * sample.left.shape[1] / 16))
    matcher, pad = make_matcher(lowest, count, 3), max(0, lowest + count)
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


def _run_sgbm(wls: bool, sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    if not sample.rectified:
        raise NotApplicable("not rectified")
    if sample.left.shape != sample.right.shape:
        raise NotApplicable("views of different sizes")
    if wls and not hasattr(cv2, "ximgproc"):
        raise NotApplicable("cv2.ximgproc, of opencv-contrib-python, is not installed")
    with_holes = sgbm_shift(sample, wls)
    depth_m = sample.K_left[0, 0] * sample.E[0, 3] / fill_background(with_holes)
    return Prediction(depth_m, space="disparity", notes={"density": float(np.isfinite(with_holes).mean())})


def _run_sweep(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    volume = sweep(sample, settings.device, settings.views)
    matches, farthest = match_volume(volume), 0.5 * float(volume.plane_step)
    # A match at infinity is none: the sky would spread over every hole beside it.
    matched = (matches.confidence[0] > 0) & (matches.inverse_depth[0] > farthest)
    with_holes = torch.where(matched, matches.inverse_depth[0], torch.nan).cpu().numpy()
    filled = torch.from_numpy(fill_background(with_holes))[None, None]
    full = F.interpolate(filled, sample.left.shape[:2], mode="bilinear", align_corners=False)[0, 0]
    depth_m = 1.0 / np.maximum(full.numpy().astype(np.float64), farthest)
    return Prediction(depth_m, space="disparity", notes={"density": float(matched.float().mean())})


_SHIFTS: dict[str, Any] = {"max_shift": MAX_SHIFT, "min_shift_px": MIN_SHIFT_PX, "mode": "3way"}
_SHIFTS |= {"fill": "background"} | PARAMETERS
_CHOICES = {"cost": "census", "aggregation": "semi-global", "fill": "background"}
_SGBM = "OpenCV StereoSGBM (3-way) with background fill; rectified pairs only"
_WLS = "the same smoothed by OpenCV's WLS filter; needs opencv-contrib-python"
_SWEEP = "our own plane sweep, aggregated, left-right checked and filled, any pose"
STEREO_METHODS = (
    Method("sgbm", "SGBM + fill", _SGBM, partial(_run_sgbm, False), lambda _: _SHIFTS, uses_prior=False),
    Method("sgbm-wls", "SGBM + WLS", _WLS, partial(_run_sgbm, True), lambda _: _SHIFTS, uses_prior=False),
    Method(
        *("sweep-sgm", "sweep + SGM", _SWEEP, _run_sweep),
        lambda settings: _CHOICES | {"views": settings.views, "device": settings.device},
        uses_prior=False,
    ),
)


def hf_method(name: str) -> Method:
    """A depth checkpoint of transformers, hub id or folder; relative ones are scored aligned only."""
    if not name:
        bad_value("methods", "hf:MODEL with a hub id or a folder", "'hf:'")

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
    return Method(f"hf:{name}", title, f"{title} by transformers", run, configuration, uses_prior=False)


#: What the maps of a folder are; ``depth`` unless the method says otherwise.
KINDS = {
    "depth": "metres",
    "disparity": "pixels of the left view, rectified pairs",
    "relative-depth": "depth up to scale and shift",
    "relative-disparity": "inverse depth up to scale and shift",
}


def _read(path: Path, kind: str) -> np.ndarray:
    """``(H, W)`` float64; NaN where it is not known: 0 in metric maps and PNG files, not finite anywhere."""
    png = path.suffix == ".png"
    if kind == "depth":
        values = read_depth_m(path, "map")
    else:
        values = read_depth_png(path, 256.0, "map")[0] if png else read_map(path, "map")
    signed = kind.startswith("relative") and not png
    known = np.isfinite(values) & (signed | (values > 0))
    return np.where(known, values.astype(np.float64), np.nan)


def _prediction(values: np.ndarray, sample: StereoSample, kind: str) -> Prediction:
    """A map at the image's size; bilinear, so that a hole grows by the pixels that it mixes into."""
    size, resized = tuple(sample.left.shape[:2]), values
    if values.shape != size:
        given = torch.from_numpy(values)[None, None]
        resized = F.interpolate(given, size, mode="bilinear", align_corners=False)[0, 0].numpy()
    if kind.startswith("relative"):
        return Prediction(None, relative=resized, space=kind.removeprefix("relative-"))
    if kind == "depth":
        return Prediction(resized)
    if not sample.rectified:
        raise NotApplicable("not rectified")
    disparity_px = resized * (size[1] / values.shape[1])  # pixels of the map -> pixels of the image
    depth_m = disparity_to_depth(disparity_px, sample.K_left, sample.K_right, sample.E)
    return Prediction(np.where(depth_m > 0, depth_m, np.nan), space="disparity")


def files_method(text: str, guided: bool = False) -> Method:
    """Maps that were made elsewhere, in a folder: DIR or KIND:DIR; ``guided``: as a prior."""
    kind, colon, named = text.partition(":")
    if not (colon and kind in KINDS):
        kind, named = "depth", text
    folder, space = Path(named), kind.removeprefix("relative-")
    if not named or not os.path.isdir(folder):
        cure = f"KIND is one of {', '.join(KINDS)}."
        bad_value("methods", "files:DIR or files:KIND:DIR with an existing folder", repr(text), cure)

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        paths = [folder / f"{sample.dataset}_{sample.name}{suffix}" for suffix in (".npy", ".pfm", ".png")]
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            raise NotApplicable("no map in the folder")
        values = _read(path, kind)
        if guided:
            return guided_map(values, space, sample, settings, priors, GeometryGuidance)
        return _prediction(values, sample, kind)

    def configuration(settings: Settings) -> dict[str, Any]:
        maps = {"kind": kind, "files": folder_fingerprint(folder)}
        return maps | (guided_configuration(GeometryGuidance, settings) if guided else {})

    name, title = folder.resolve().name, f"maps of {folder.resolve().name} ({KINDS[kind]})"
    if guided:
        return Method(f"prior-map:{text}", f"guided {name}", f"{title}, guided", run, configuration, False)
    return Method(f"files:{text}", name, title, run, configuration, uses_prior=False)
