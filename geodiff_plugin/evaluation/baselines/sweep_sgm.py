"""Our plane sweep with semi-global aggregation, left-right check and fill: stereo for any pose, no prior.

Data flow: ``StereoSample`` of any pose -> cost volume -> matches -> filled -> metres.
Paper: none; shows what of the guided result the matches alone explain.
"""

from __future__ import annotations

from typing import Any

import torch

from geodiff_plugin.evaluation.baselines._fill import fill_background
from geodiff_plugin.evaluation.baselines._sweep import native_depth, sweep
from geodiff_plugin.evaluation.baselines.base import Method, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.matching import find_matches

__all__ = ["SWEEP_SGM"]


def _run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    volume = sweep(sample, settings.device, settings.views)
    matches = find_matches(volume.left_01, volume.rights, volume.K, volume=volume)
    # A match at infinity is none: the sky would spread over every hole beside it.
    matched = (matches.confidence[0] > 0) & (matches.inverse_depth[0] > 0.5 * volume.plane_step)
    with_holes = torch.where(matched, matches.inverse_depth[0], torch.nan).cpu().numpy()
    filled = torch.from_numpy(fill_background(with_holes))
    depth_m = native_depth(filled, volume, sample.left.shape[:2], "bilinear")
    notes = {"density": float(matched.float().mean())}
    return Prediction(depth_m=depth_m, space="disparity", notes=notes)


def _configuration(settings: Settings) -> dict[str, Any]:
    choices = {"cost": "census", "aggregation": "semi-global", "fill": "background"}
    return choices | {"views": settings.views, "device": settings.device}


SWEEP_SGM = Method(
    name="sweep-sgm",
    title="sweep + SGM",
    summary="our own plane sweep, aggregated, left-right checked and filled, any pose",
    run=_run,
    configuration=_configuration,
    uses_prior=False,
)
