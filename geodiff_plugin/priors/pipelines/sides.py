"""Image processors for networks whose input sides must be multiples of a number."""

from __future__ import annotations

from typing import Any

import torch
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from torch import Tensor

__all__ = ["SidesOf"]


class SidesOf(MarigoldImageProcessor):
    """Resizes each side to a multiple of ``side`` pixels, each with a factor of its own, and never pads.

    Args:
        side: what both sides are multiples of, pixels.
        grow: always round up; else to the nearest multiple.
    """

    def __init__(self, side: int, grow: bool = False) -> None:
        super().__init__(vae_scale_factor=side)
        self.side, self.grow = side, grow

    @staticmethod
    def pad_image(image: Tensor, align: int) -> tuple[Tensor, tuple[int, int]]:
        """The image as it is, and no padding."""
        return image, (0, 0)

    def preprocess(
        self,
        image: Any,
        processing_resolution: int | None = None,
        resample_method_input: str = "bilinear",
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> tuple[Tensor, tuple[int, int], tuple[int, int]]:
        """As the stock method, but for the size.

        Returns:
            ``(N, 3, H, W)`` in [-1, 1] with sides of a multiple of ``side``, no padding ``(0, 0)``, and the
            size ``(H, W)`` that the image came with.
        """
        # In float32 until the end: not every device resizes in half precision.
        image, padding, size = super().preprocess(image, 0, resample_method_input, device, torch.float32)
        factor = processing_resolution / max(size) if processing_resolution else 1.0
        grid = tuple(self._multiple(length * factor) for length in size)
        if grid != tuple(size):
            image = self.resize_antialias(image, grid, resample_method_input, is_aa=True)
        return image.to(dtype), padding, size

    def _multiple(self, length: float) -> int:
        parts = -(-round(length) // self.side) if self.grow else round(int(length) / self.side)
        return max(1, parts) * self.side
