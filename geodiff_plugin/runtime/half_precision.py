"""Half precision: images are read and resized in float32, and cast afterwards.

Data flow: the pipeline's image processor -> the same, whatever its precision reading and resizing in float32.
Paper: none.
"""

from __future__ import annotations

from typing import Any

import torch

from geodiff_plugin.runtime.hiding import hide_method

__all__ = ["ImagesInFloat32"]


class ImagesInFloat32:
    """Hides ``preprocess`` of an image processor by one that casts last.

    PyTorch has no kernels for half precision on a CPU, and float16 has no number for the white of a 16-bit
    image. It may be left and entered again in the middle of a call, as callbacks are.
    """

    def __init__(self, processor: Any) -> None:
        self._processor = processor

    def __enter__(self) -> ImagesInFloat32:
        own = self._processor.preprocess

        def preprocess(
            image: Any,
            processing_resolution: int | None = None,
            resample_method_input: str = "bilinear",
            device: torch.device | None = None,
            dtype: torch.dtype = torch.float32,
        ) -> Any:
            images, *rest = own(image, processing_resolution, resample_method_input, device, torch.float32)
            return images.to(dtype), *rest

        self._restore = hide_method(self._processor, "preprocess", preprocess)
        return self

    def __exit__(self, *exc: object) -> None:
        self._restore()
