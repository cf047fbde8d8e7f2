"""Marigold v1-0, v1-1, LCM, and every fine-tune that keeps ``MarigoldDepthPipeline`` (paper S3.1)."""

from __future__ import annotations

from typing import Any

import torch
from diffusers import MarigoldDepthPipeline
from torch import Tensor

from geodiff_plugin._checks import check_choice
from geodiff_plugin.priors.base import DepthPrior
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import decode_picture, encode_picture, map_of, picture_of
from geodiff_plugin.scale.space import SPACES

#: Under ``prs-eth/``.
PUBLISHED = ("depth-v1-1", "depth-v1-0", "v1-0", "depth-lcm-v1-0", "lcm-v1-0")


class MarigoldPrior(DepthPrior):
    """Adapter of ``MarigoldDepthPipeline``; its ``prediction_type`` must be a key of ``SPACES``."""

    pipeline_class = MarigoldDepthPipeline
    licence = dict.fromkeys([f"prs-eth/marigold-{name}" for name in PUBLISHED], "openrail++ (RAIL++-M)")

    def __init__(self, pipe: Any) -> None:
        super().__init__(pipe)
        self.space = check_choice(self.space or "depth", "the pipeline's prediction_type", SPACES)
        self.network_input = slice(pipe.vae.config.latent_channels, None)  # after the image latent

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """A U-Net on image and depth latent, no class labels, a text encoder for the empty prompt."""
        unet = layout.config("unet")
        latent = layout.config("vae").get("latent_channels", 4)
        return (
            unet.get("in_channels") == 2 * latent
            and unet.get("out_channels") == latent
            and unet.get("class_embed_type") is None
            and "text_encoder" in layout.index
        )

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> Any:
        """The stock pipeline; folders of v1-0 do not say what they predict, which is depth."""
        return super().load(layout, dtype, space or layout.index.get("prediction_type") or "depth")

    def network(self) -> tuple[torch.nn.Module, str]:
        """The U-Net's forward; its input is ``cat[image latent, depth latent]``."""
        return self._pipe.unet, "forward"

    def decode(self, z0: Tensor) -> Tensor:
        """Mean of the channels that the pipeline's VAE decodes, not clipped."""
        return map_of(decode_picture(self._pipe.vae, z0))

    def encode(self, x: Tensor) -> Tensor:
        """By the pipeline's VAE."""
        return encode_picture(self._pipe.vae, picture_of(x))
