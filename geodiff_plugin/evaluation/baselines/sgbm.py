"""OpenCV's semi-global block matching with background fill.

Data flow: rectified ``StereoSample`` -> disparity -> filled -> metres.
Paper: leaves this peer out; fill as KITTI's development kit does it for sparse results.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from geodiff_plugin.evaluation.baselines._fill import fill_background
from geodiff_plugin.evaluation.baselines.base import Method, NotApplicable, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample

__all__ = ["SGBM", "SGBM_WLS", "sgbm_shift"]

#: Largest shift that is tried, as a share of the image width.
MAX_SHIFT = 0.25
#: Matches with a smaller shift than this, in pixels, are taken for mistakes and filled: one such match in the
#: sky's neighbourhood costs more AbsRel than a hundred good ones gain.
MIN_SHIFT_PX = 1.0
#: As OpenCV's own example sets the filter.
WLS_LAMBDA, WLS_SIGMA = 8000.0, 1.5
PARAMETERS = {
    "blockSize": 5,
    "uniquenessRatio": 10,
    "speckleWindowSize": 100,
    "speckleRange": 2,
    "disp12MaxDiff": 1,
}


def sgbm_shift(sample: StereoSample, wls: bool = False) -> np.ndarray:
    """Shift of a rectified pair, ``f b / z``, with holes.

    Args:
        sample: a rectified sample.
        wls: smooth it, with that of the right view, by OpenCV's weighted least squares: no holes are left.

    Returns:
        ``(H, W)`` float32, pixels, disparity plus Middlebury's doffs; NaN where the match was rejected.
    """
    width, block = sample.left.shape[1], PARAMETERS["blockSize"]
    # Depth at infinity has the disparity cx_left - cx_right, which is 0 but for Middlebury's doffs.
    lowest = int(np.floor(sample.K_left[0, 2] - sample.K_right[0, 2]))
    count = 16 * int(np.ceil(MAX_SHIFT * width / 16))
    matcher = cv2.StereoSGBM_create(
        minDisparity=lowest,
        numDisparities=count,
        P1=8 * 3 * block**2,
        P2=32 * 3 * block**2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        **PARAMETERS,
    )
    # OpenCV leaves the first lowest + count columns empty; a padded left edge keeps them.
    pad = max(0, lowest + count)
    left, right = (
        np.pad(image, ((0, 0), (pad, 0), (0, 0)), mode="edge") for image in (sample.left, sample.right)
    )
    left, right = np.ascontiguousarray(left), np.ascontiguousarray(right)
    raw = matcher.compute(left, right)
    if wls:
        smoother = cv2.ximgproc.createDisparityWLSFilter(matcher)
        smoother.setLambda(WLS_LAMBDA)
        smoother.setSigmaColor(WLS_SIGMA)
        opposite = cv2.ximgproc.createRightMatcher(matcher).compute(right, left)
        raw = smoother.filter(raw, left, disparity_map_right=opposite)
    raw = raw[:, pad:]
    shift = raw.astype(np.float32) / 16.0 + np.float32(sample.K_right[0, 2] - sample.K_left[0, 2])
    shift[(raw <= 16 * (lowest - 1)) | (shift < MIN_SHIFT_PX)] = np.nan
    return shift


def _run(wls: bool, sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
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


def _configuration(wls: bool, settings: Settings) -> dict[str, Any]:
    smoother = {"wls": [WLS_LAMBDA, WLS_SIGMA]} if wls else {}
    return {
        "max_shift": MAX_SHIFT,
        "min_shift_px": MIN_SHIFT_PX,
        "mode": "3way",
        "fill": "background",
    } | (PARAMETERS | smoother)


SGBM = Method(
    name="sgbm",
    title="SGBM + fill",
    summary="OpenCV StereoSGBM (3-way) with background fill; rectified pairs only",
    run=partial(_run, False),
    configuration=partial(_configuration, False),
    uses_prior=False,
)
SGBM_WLS = replace(
    SGBM,
    name="sgbm-wls",
    title="SGBM + WLS",
    summary="the same, smoothed by OpenCV's WLS filter (opencv-contrib)",
    run=partial(_run, True),
    configuration=partial(_configuration, True),
)
