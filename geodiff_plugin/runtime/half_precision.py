"""Half precision on a CPU: images are resized in float32, because PyTorch lacks kernels for half.

Data flow: the pipeline's image processor, in half precision on a CPU -> the same, resizing in float32.
Paper: none.
"""

from __future__ import annotations

from typing import Any

import torch

from geodiff_plugin.runtime.hiding import hide_method

__all__ = ["ImagesInFloat32"]


class ImagesInFloat32:
    """Hides ``preprocess`` of an image processor by one that casts after it has resized; on a CPU only.

    It may be left and entered again in the middle of a call, as callbacks are.
    """

    def __init__(self, processor: Any, device: torch.device) -> None:
        self._processor, self._on_cpu = processor, device.type == "cpu"

    def __enter__(self) -> ImagesInFloat32:
        if not self._on_cpu:
            return self
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
        if self._on_cpu:
            self._restore()
