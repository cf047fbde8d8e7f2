"""DepthMaster: one pass of a U-Net from the image latent to the depth latent (arXiv 2501.02576)."""

from __future__ import annotations

import functools
from typing import Any

import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from torch import Tensor, nn
from transformers import CLIPTextModel, CLIPTokenizer

from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import Condition, DepthDiffusionPipeline, Generators

#: The fixed timestep input of the network.
TIMESTEP = 1


class FourierBlock(nn.Module):
    """Enhances features in Fourier magnitude, Fourier angle and space; named like the published weights."""

    def __init__(self, channels: int, groups: int = 8) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(groups, channels)
        self.conv_f1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv_f2 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv_f4 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv_f3 = nn.Conv2d(channels, channels, 1)
        self.conv_s1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv_s2 = nn.Conv2d(channels, channels, 3, padding=1)
        self.fuse = nn.Conv2d(2 * channels, channels, 1)
        self.act = nn.SiLU()

    def forward(self, features: Tensor) -> Tensor:
        """Transform ``(B, C, h, w)`` to the same shape and dtype."""
        features = self.norm(features)
        start = self.act(self.conv_f1(features))
        # Half-precision FFTs support only sizes that are powers of two.
        spectrum = torch.fft.rfft2(start.float(), norm="ortho")  # (B, C, h, w // 2 + 1)
        magnitude = self.act(self.conv_f2(spectrum.abs().to(start.dtype)))
        angle = self.act(self.conv_f4(spectrum.angle().to(start.dtype))).float()
        enhanced = torch.complex(magnitude * torch.cos(angle), magnitude * torch.sin(angle))
        enhanced = torch.fft.irfft2(enhanced, s=start.shape[-2:], norm="ortho").to(start.dtype)
        in_frequency = self.conv_f3(enhanced + start)
        in_space = self.conv_s2(self.act(self.conv_s1(features))) + features
        return self.fuse(torch.cat([in_space, in_frequency], dim=1))


class FourierUNet(UNet2DConditionModel):
    """``UNet2DConditionModel`` whose middle block is followed by a ``FourierBlock`` named ``fftblock``."""

    # The wrapper keeps the signature, from which diffusers reads the allowed config entries.
    @functools.wraps(UNet2DConditionModel.__init__)  # type: ignore[misc]
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.fftblock = FourierBlock(self.config.block_out_channels[-1])
        self.mid_block.register_forward_hook(self._after_middle)

    def _after_middle(self, middle: nn.Module, inputs: tuple[Any, ...], output: Tensor) -> Tensor:
        return self.fftblock(output)


class DepthMasterPipeline(DepthDiffusionPipeline):
    """One step from the image latent alone to the clean latent of the square root of disparity."""

    max_steps = 1
    deterministic = True
    sees_latents = False
    model_cpu_offload_seq = "text_encoder->unet->vae"

    def __init__(
        self,
        unet: FourierUNet,
        vae: AutoencoderKL,
        text_encoder: CLIPTextModel,
        tokenizer: CLIPTokenizer,
        prediction_type: str = "sqrt_disparity",
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 768,
    ) -> None:
        super().__init__()
        # Not a component: the authors' folders have no scheduler, and converted ones match them.
        self.scheduler = DirectScheduler(TIMESTEP)
        defaults = prediction_type, default_denoising_steps, default_processing_resolution
        modules = {"unet": unet, "vae": vae, "text_encoder": text_encoder, "tokenizer": tokenizer}
        self.register_prior(modules, *defaults)

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Recognise 4 input channels, no class embedding, a text encoder, and no scheduler component."""
        unet = layout.config("unet")
        return (
            unet.get("in_channels") == 4
            and not unet.get("class_embed_type")
            and "text_encoder" in layout.index
            and "scheduler" not in layout.index
        )

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators
    ) -> Condition:
        """Return the mode of the image latent's posterior, and the empty prompt."""
        latent = self.image_latents(image, ensemble_size, batch_size)  # (N * E, 4, h, w)
        return {"image_latent": latent, "prompt": self.prompt_embedding(latent)}

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """Predict the clean depth latent; ``latents`` are ignored."""
        return self.run_unet(condition["image_latent"], timestep, condition)
