"""Marigold v1-0, v1-1 and LCM, and every fine-tune that keeps ``MarigoldDepthPipeline``.

Paper: S3.1, S5.1 (built upon Marigold).
"""

from __future__ import annotations

import torch
from diffusers import MarigoldDepthPipeline
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.pipelines.base import encode_map
from geodiff_plugin.scale.space import SPACES

__all__ = ["MarigoldPrior"]


class MarigoldPrior:
    """Adapter of ``MarigoldDepthPipeline``.

    Args:
        pipe: the live pipeline.

    Raises:
        ValueError: its ``prediction_type`` is no key of ``SPACES``.
    """

    max_steps: int | None = None
    deterministic = False
    takes_prompt = False
    latents = slice(None)
    licence = dict.fromkeys(
        (
            "prs-eth/marigold-depth-v1-1",
            "prs-eth/marigold-depth-v1-0",
            "prs-eth/marigold-v1-0",
            "prs-eth/marigold-depth-lcm-v1-0",
            "prs-eth/marigold-lcm-v1-0",
        ),
        "openrail++ (RAIL++-M)",
    )

    def __init__(self, pipe: MarigoldDepthPipeline) -> None:
        self._pipe = pipe
        self.space = pipe.config.get("prediction_type") or "depth"
        if self.space not in SPACES:
            bad_value("the pipeline's prediction_type", f"one of {sorted(SPACES)}", repr(self.space))
        # After the image latent.
        self.network_input: slice | None = slice(pipe.vae.config.latent_channels, None)

    @staticmethod
    def matches(pipe: object) -> bool:
        """Any instance of ``MarigoldDepthPipeline``."""
        return isinstance(pipe, MarigoldDepthPipeline)

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
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> MarigoldDepthPipeline:
        """The stock pipeline; folders of v1-0 do not say what they predict, which is depth."""
        space = space or layout.index.get("prediction_type") or "depth"
        return build_pipeline(MarigoldDepthPipeline, layout, dtype, prediction_type=space)

    def network(self) -> tuple[torch.nn.Module, str]:
        """The U-Net's forward; its input is ``cat[image latent, depth latent]``."""
        return self._pipe.unet, "forward"

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

    def encode(self, x: Tensor) -> Tensor:
        """By the pipeline's VAE."""
        return encode_map(self._pipe.vae, x)

    def metric_range(self, samples: slice) -> None:
        """None: its depth is relative."""
        return None

    def known(self, samples: slice) -> None:
        """None: it says something everywhere."""
        return None
