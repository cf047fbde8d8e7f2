"""Stereo without a prior: OpenCV's semi-global matching, and our plane sweep for any pose."""

from __future__ import annotations

from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from geodiff_plugin.evaluation.baselines.base import Method, NotApplicable, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.matching import CostVolume, build_cost_volume, match_volume
from geodiff_plugin.matching.rows import PARAMETERS, fill_background, make_matcher, pad_columns
from geodiff_plugin.types import CameraView


def sweep(sample: StereoSample, device: str, views: int = 2) -> CostVolume:
    """Sweep planes from infinity to the default nearest one through the left view of a sample of any pose.

    Args:
        sample: any pose.
        device: where the work is done.
        views: the most views to compare, the left one counted.
    """

    def moved(x: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(x, dtype=torch.float32, device=device)

    given = ((sample.right, sample.K_right, sample.E), *sample.extra_views)[: views - 1]
    rights = [
        CameraView(as_image_01(image, "right").to(device), moved(K), moved(np.linalg.inv(E)))
        for image, K, E in given
    ]
    return build_cost_volume(as_image_01(sample.left, "left").to(device), rights, moved(sample.K_left))


def native_depth(
    inverse_depth: torch.Tensor, volume: CostVolume, size: tuple[int, int], mode: str
) -> np.ndarray:
    """``(H, W)`` float64, metres at the left image's resolution, NaN in holes.

    Args:
        inverse_depth: ``(h, w)`` 1/m on the volume's grid, NaN in holes.
        volume: its planes; nothing is farther than half a step from infinity.
        size: ``(H, W)`` of the left image.
        mode: ``"nearest-exact"`` keeps holes as they are; ``"bilinear"`` for maps without.
    """
    farthest = 0.5 * float(volume.plane_step)
    options = {} if mode == "nearest-exact" else {"align_corners": False}
    full = F.interpolate(inverse_depth[None, None], size, mode=mode, **options)[0, 0]
    return 1.0 / np.maximum(full.cpu().numpy().astype(np.float64), farthest)


#: Largest shift that is tried, as a share of the image width.
MAX_SHIFT = 0.25
#: Matches with a smaller shift than this, in pixels, are taken for mistakes and filled: one such match in the
#: sky's neighbourhood costs more AbsRel than a hundred good ones gain.
MIN_SHIFT_PX = 1.0
#: As OpenCV's own example sets the filter.
WLS_LAMBDA, WLS_SIGMA = 8000.0, 1.5


def sgbm_shift(sample: StereoSample, wls: bool = False) -> np.ndarray:
    """Shift of a rectified pair, ``f b / z``, with holes.

    Args:
        sample: a rectified sample.
        wls: smooth it, with that of the right view, by OpenCV's weighted least squares: no holes are left.

    Returns:
        ``(H, W)`` float32, pixels, disparity plus Middlebury's doffs; NaN where the match was rejected.
    """
    # Depth at infinity has the disparity cx_left - cx_right, which is 0 but for Middlebury's doffs.
    lowest = int(np.floor(sample.K_left[0, 2] - sample.K_right[0, 2]))
    count = 16 * int(np.ceil(MAX_SHIFT * sample.left.shape[1] / 16))
    matcher, pad = make_matcher(lowest, count, 3), max(0, lowest + count)
    left, right = (pad_columns(image, pad) for image in (sample.left, sample.right))
    raw = matcher.compute(left, right)
    if wls:
        ximgproc: Any = cv2.ximgproc  # type: ignore[attr-defined]
        smoother = ximgproc.createDisparityWLSFilter(matcher)
        smoother.setLambda(WLS_LAMBDA)
        smoother.setSigmaColor(WLS_SIGMA)
        opposite = ximgproc.createRightMatcher(matcher).compute(right, left)
        raw = smoother.filter(raw, left, disparity_map_right=opposite)
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
    notes = {"density": float(np.isfinite(with_holes).mean())}
    return Prediction(depth_m=depth_m, space="disparity", notes=notes)


def _run_plane_sweep(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    volume = sweep(sample, settings.device, settings.views)
    # A plane on which the right camera does not see the pixel cannot win.
    cost = torch.where(volume.in_view, volume.cost, torch.inf)
    best, index = cost.min(dim=0)
    inverse_depth = torch.where(torch.isfinite(best), volume.inverse_depth[index], torch.nan)
    depth_m = native_depth(inverse_depth, volume, sample.left.shape[:2], "nearest-exact")
    return Prediction(depth_m=depth_m, space="disparity")


def _run_sweep_sgm(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    volume = sweep(sample, settings.device, settings.views)
    matches = match_volume(volume)
    # A match at infinity is none: the sky would spread over every hole beside it.
    matched = (matches.confidence[0] > 0) & (matches.inverse_depth[0] > 0.5 * volume.plane_step)
    with_holes = torch.where(matched, matches.inverse_depth[0], torch.nan).cpu().numpy()
    filled = torch.from_numpy(fill_background(with_holes))
    depth_m = native_depth(filled, volume, sample.left.shape[:2], "bilinear")
    notes = {"density": float(matched.float().mean())}
    return Prediction(depth_m=depth_m, space="disparity", notes=notes)


def _sgbm_configuration(wls: bool, settings: Settings) -> dict[str, Any]:
    smoother = {"wls": [WLS_LAMBDA, WLS_SIGMA]} if wls else {}
    shifts = {"max_shift": MAX_SHIFT, "min_shift_px": MIN_SHIFT_PX}
    return shifts | {"mode": "3way", "fill": "background"} | PARAMETERS | smoother


def _sweep_method(name: str, title: str, summary: str, run: Any, choices: dict[str, str]) -> Method:
    def configuration(settings: Settings) -> dict[str, Any]:
        return {"cost": "census", "views": settings.views, "device": settings.device} | choices

    return Method(name, title, summary, run, configuration, uses_prior=False)


def _sgbm_method(name: str, title: str, summary: str, wls: bool) -> Method:
    return Method(name, title, summary, partial(_run_sgbm, wls), partial(_sgbm_configuration, wls), False)


STEREO_METHODS = (
    _sgbm_method(
        "sgbm",
        "SGBM + fill",
        "OpenCV StereoSGBM (3-way) with background fill; rectified pairs only",
        wls=False,
    ),
    _sgbm_method(
        "sgbm-wls",
        "SGBM + WLS",
        "OpenCV StereoSGBM smoothed by its WLS filter (opencv-contrib); rectified pairs only",
        wls=True,
    ),
    _sweep_method(
        "plane-sweep",
        "plane sweep",
        "winner take all over our own plane sweep, any pose",
        _run_plane_sweep,
        {"winner": "take all"},
    ),
    _sweep_method(
        "sweep-sgm",
        "sweep + SGM",
        "our own plane sweep, aggregated, left-right checked and filled, any pose",
        _run_sweep_sgm,
        {"aggregation": "semi-global", "fill": "background"},
    ),
)
