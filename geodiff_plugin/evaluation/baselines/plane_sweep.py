"""Winner-takes-all depth of our plane sweep, without aggregation.

Data flow: ``StereoSample`` of any pose -> cost volume -> best plane -> metres.
Paper: none; the floor under every method that uses the volume.
"""

from __future__ import annotations

from typing import Any

import torch

from geodiff_plugin.evaluation.baselines._sweep import native_depth, sweep
from geodiff_plugin.evaluation.baselines.base import Method, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample

__all__ = ["PLANE_SWEEP"]


def _run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    volume = sweep(sample, settings.device, settings.views)
    # A plane on which the right camera does not see the pixel cannot win.
    cost = torch.where(volume.in_view, volume.cost, torch.inf)
    best, index = cost.min(dim=0)
    inverse_depth = torch.where(torch.isfinite(best), volume.inverse_depth[index], torch.nan)
    depth_m = native_depth(inverse_depth, volume, sample.left.shape[:2], "nearest-exact")
    return Prediction(depth_m=depth_m, space="disparity")


def _configuration(settings: Settings) -> dict[str, Any]:
    choices = {"cost": "census", "winner": "take all"}
    return choices | {"views": settings.views, "device": settings.device}


PLANE_SWEEP = Method(
    name="plane-sweep",
    title="plane sweep",
    summary="winner take all over our own plane sweep, any pose",
    run=_run,
    configuration=_configuration,
    uses_prior=False,
)
