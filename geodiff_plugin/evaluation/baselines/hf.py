"""Depth models of ``transformers``: DPT, Depth Anything, ZoeDepth, GLPN, DepthPro.

Data flow: ``StereoSample`` -> depth model on the left image -> metres, or relative disparity to be aligned.
Paper: S5.1 (ZoeDepth, DepthPro and MiDaS among the compared methods).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines._folder import folder_fingerprint
from geodiff_plugin.evaluation.baselines.base import Method, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample

__all__ = ["hf_method"]


def hf_method(name: str) -> Method:
    """A depth checkpoint of transformers, hub id or folder; relative ones are scored aligned only.

    Args:
        name: hub id, or folder as ``save_pretrained`` wrote it.

    Returns:
        The method; the checkpoint is loaded when it is first run.

    Raises:
        ValueError: an empty name. When run: what ``HFDepthModel.from_pretrained`` raises.
    """
    if not name:
        bad_value("methods", "hf:MODEL with a hub id or a folder", "'hf:'")

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        model = priors.depth_model(name, settings)
        left_01 = torch.from_numpy(sample.left).permute(2, 0, 1)[None].to(settings.device) / 255.0
        found = model(left_01, sample.left.shape[:2])
        values = found.values[0, 0].cpu().numpy()
        if not found.metric:
            return Prediction(None, relative=values, space=found.space)
        depth_m = found.metres()[0, 0].cpu().numpy()
        return Prediction(depth_m, relative=values, space=found.space)

    def configuration(settings: Settings) -> dict[str, Any]:
        files = folder_fingerprint(Path(name))
        return {"device": settings.device, "dtype": settings.dtype, "files": files}

    title = Path(name).name
    return Method(f"hf:{name}", title, f"{title} by transformers", run, configuration, uses_prior=False)
