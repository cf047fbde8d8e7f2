"""The default preset without the U-Net: the same corrections of a latent that starts as a ramp.

Data flow: ``StereoSample`` -> latent of a ramp -> the default's corrections of it and scale -> metres.
Paper: none; what is left of the default once the diffusion is taken out.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from geodiff_plugin.evaluation.baselines._constant import Start, constant_method
from geodiff_plugin.evaluation.baselines.base import Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import find_adapter
from geodiff_plugin.scale.space import SPACES

__all__ = ["NO_DIFFUSION"]


def _start(pipe: Any, sample: StereoSample, settings: Settings) -> Start:
    """The latent of a ground plane: near at the bottom, far at the top."""
    adapter = find_adapter(pipe)(pipe)
    near, far = (0.0, 1.0) if SPACES[adapter.space].grows_with_depth else (1.0, 0.0)

    def answer(image: Tensor) -> Tensor:
        rows = torch.linspace(far, near, image.shape[-2], device=image.device)
        return adapter.encode(rows.view(1, 1, -1, 1).expand(len(image), 1, -1, image.shape[-1]))

    return Start(answer, adapter.decode, adapter.encode, pipe.image_processor)


NO_DIFFUSION = constant_method(
    "no-diffusion",
    "no diffusion",
    "the default preset without the U-Net: its search, corrections and refinement on the latent of a ramp",
    partial(GeometryGuidance, reject_reflections=False),  # a ramp contradicts nothing
    _start,
)
