"""DepthMaster's U-Net: that of Stable Diffusion 2 with a block after the middle that works on frequencies.

Source: DepthMaster, arXiv 2501.02576, the Fourier Enhancement module.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from diffusers import UNet2DConditionModel
from torch import Tensor, nn

__all__ = ["FourierBlock", "FourierUNet"]


class FourierBlock(nn.Module):
    """Features mended twice, in their Fourier magnitude and angle and in space, and fused.

    Args:
        channels: C.
        groups: of the normalisation.

    The submodules are named as in the published weights.
    """

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
        """``(B, C, h, w)`` to the same shape and dtype."""
        features = self.norm(features)
        start = self.act(self.conv_f1(features))
        # There is no half precision FFT for sizes that are no power of two.
        spectrum = torch.fft.rfft2(start.float(), norm="ortho")  # (B, C, h, w // 2 + 1)
        magnitude = self.act(self.conv_f2(spectrum.abs().to(start.dtype)))
        angle = self.act(self.conv_f4(spectrum.angle().to(start.dtype))).float()
        mended = torch.complex(magnitude * torch.cos(angle), magnitude * torch.sin(angle))
        mended = torch.fft.irfft2(mended, s=start.shape[-2:], norm="ortho").to(start.dtype)
        in_frequency = self.conv_f3(mended + start)
        in_space = self.conv_s2(self.act(self.conv_s1(features))) + features
        return self.fuse(torch.cat([in_space, in_frequency], dim=1))


class FourierUNet(UNet2DConditionModel):
    """``UNet2DConditionModel`` whose middle block is followed by a ``FourierBlock`` named ``fftblock``.

    Everything else, config and weights included, is the stock class's.
    """

    # The wraps keeps the signature, from which diffusers reads what a config may hold.
    @functools.wraps(UNet2DConditionModel.__init__)  # type: ignore[misc]
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.fftblock = FourierBlock(self.config.block_out_channels[-1])
        self.mid_block.register_forward_hook(self._after_middle)

    def _after_middle(self, middle: nn.Module, inputs: tuple[Any, ...], output: Tensor) -> Tensor:
        return self.fftblock(output)
