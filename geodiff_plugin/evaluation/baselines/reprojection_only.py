"""The paper's ablation without diffusion: gradient descent of the prior's depth on the photometric error.

Data flow: ``StereoSample`` -> prior's relative map -> 50 updates of its pixels, scale and shift -> metres.
Paper: S5.3.1, Figure 6 (fig:ab1).
"""

from __future__ import annotations

from typing import Any

import torch.nn.functional as F
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from PIL import Image
from torch import Tensor

from geodiff_plugin.config import PAPER
from geodiff_plugin.evaluation.baselines._constant import Start, constant_method
from geodiff_plugin.evaluation.baselines._guidance import call_arguments
from geodiff_plugin.evaluation.baselines.base import Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.guidance.guidance import GeometryGuidance

__all__ = ["REPROJECTION_ONLY"]

ITERATIONS = 50


def _preset(right: Any, K: Any, E: Any, **changes: Any) -> GeometryGuidance:
    """Photometric error and pull only, started by the default's search, so that pixels are the change.

    The paper names a rate of 1e-2 and no optimiser. A plain step of that size moves no pixel, because the
    gradient of a mean over all pixels is tiny in each; Adam's do.
    """
    preset = {"weights": PAPER.weights, "inner_steps": ITERATIONS, "step_latents": 0.01}
    preset |= {"correct": False, "refine": False}
    return GeometryGuidance(right, K, E, **(preset | changes))


def _as_it_is(pixels: Tensor) -> Tensor:
    return pixels


def _start(pipe: Any, sample: StereoSample, settings: Settings) -> Start:
    stock = pipe(
        Image.fromarray(sample.left),
        match_input_resolution=False,
        output_type="pt",
        **call_arguments(settings),
    )
    relative = stock.prediction.float()  # (1, 1, h, w), in [0, 1]

    def answer(image: Tensor) -> Tensor:
        size = image.shape[-2:]
        if relative.shape[-2:] == size:
            return relative
        return F.interpolate(relative, size, mode="bilinear", align_corners=False)

    return Start(answer, _as_it_is, _as_it_is, MarigoldImageProcessor(vae_scale_factor=1))


REPROJECTION_ONLY = constant_method(
    "reprojection-only",
    "reprojection only",
    "no diffusion: the prior's map, its pixels moved by 50 updates of the photometric error",
    _preset,
    _start,
    rounds=1,
)
