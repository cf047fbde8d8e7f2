"""Marigold v1-0, v1-1 and LCM, and every fine-tune that keeps ``MarigoldDepthPipeline``.

Hop: clean latent -> VAE decoder, not clipped -> relative map.
Paper: S3.1, S5.1 (built upon Marigold).
"""

from __future__ import annotations

import torch
from diffusers import MarigoldDepthPipeline
from torch import Tensor

from geodiff_plugin._checks import bad_value

__all__ = ["MarigoldPrior"]

#: The pipeline's own metadata -> our space.
SPACE_OF = {"depth": "depth", "disparity": "disparity", None: "depth"}


class MarigoldPrior:
    """Adapter of ``MarigoldDepthPipeline``.

    Args:
        pipe: the live pipeline.

    Raises:
        ValueError: its ``prediction_type`` is neither depth nor disparity.
    """

    def __init__(self, pipe: MarigoldDepthPipeline) -> None:
        self._pipe = pipe
        prediction_type = pipe.config.get("prediction_type")
        if prediction_type not in SPACE_OF:
            bad_value("the pipeline's prediction_type", "'depth' or 'disparity'", repr(prediction_type))
        self.space = SPACE_OF[prediction_type]

    @staticmethod
    def matches(pipe: object) -> bool:
        """Any instance of ``MarigoldDepthPipeline``."""
        return isinstance(pipe, MarigoldDepthPipeline)

    def denoiser(self) -> torch.nn.Module:
        """The U-Net; its input is ``cat[image latent, depth latent]``."""
        return self._pipe.unet

    def split_input(self, model_input: Tensor) -> tuple[Tensor, Tensor]:
        """Image latent and depth latent, ``(B, C, h, w)`` each."""
        return model_input.chunk(2, dim=1)

    def decode(self, z0: Tensor) -> Tensor:
        """Mean of the decoded channels, mapped from [-1, 1] to [0, 1] and not clipped.

        The pipeline's own ``decode_prediction`` clips, which silences the gradient exactly at near and far.
        """
        vae = self._pipe.vae
        decoded = vae.decode((z0 / vae.config.scaling_factor).to(vae.dtype), return_dict=False)[
            0
        ]  # (B, 3, H, W)
        wide = torch.promote_types(decoded.dtype, torch.float32)  # half precision ends here
        return (decoded.to(wide).mean(dim=1, keepdim=True) + 1.0) / 2.0
