"""Preprocessing of ``transformers`` depth models, on tensors and without torchvision.

The library's own are not called: those on tensors need torchvision, and two models have no other; those on
Pillow round to bytes after either axis and take the image to the CPU and back, one at a time.

Data flow: ``preprocessor_config.json``, image ``(B, 3, H, W)`` in [0, 1] -> ``pixel_values (B, 3, h, w)``.
Paper: none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._checks import bad_value

__all__ = ["Preparation"]

MODES = {2: "bilinear", 3: "bicubic"}  # of PIL
#: Whose library resizes without antialiasing, or pads after normalising.
ALIASED, PADDED_LAST = ("ZoeDepth", "DepthPro"), ("DPT", "PromptDepthAnything")
HALF = (0.5, 0.5, 0.5)  # mean and standard deviation where the file names none
#: Processor -> what its file leaves out; GLPN and Tipsv2Dpt do not normalise.
DEFAULTS: dict[str, dict[str, Any]] = {
    "DPT": {"size": 384, "resample": 3, "do_normalize": True, "do_pad": False},
    "ZoeDepth": {
        "size": {"height": 384, "width": 512},
        "resample": 2,
        "do_normalize": True,
        "do_pad": True,
        "keep_aspect_ratio": True,
        "ensure_multiple_of": 1 / 32,
    },
    "GLPN": {"size": None, "resample": 2, "do_normalize": False, "do_pad": False, "size_divisor": 32},
    "DepthPro": {"size": 1536, "resample": 2, "do_normalize": True, "do_pad": False},
    "PromptDepthAnything": {"size": 384, "resample": 3, "do_normalize": True, "do_pad": False},
    "Tipsv2Dpt": {
        "size": {"height": 448, "width": 448},
        "resample": 2,
        "do_normalize": False,
        "do_pad": False,
    },
}


def _nearest_multiple(value: float, multiple: float) -> int:
    return int(round(value / multiple) * multiple)


@dataclass(frozen=True)
class Preparation:
    """Resizing, padding and normalisation of one checkpoint.

    Attributes:
        kind: key of ``DEFAULTS``.
        options: ``preprocessor_config.json`` over the processor's defaults.
    """

    kind: str
    options: dict[str, Any]

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> Preparation:
        """Of the contents of ``preprocessor_config.json``.

        Raises:
            ValueError: a processor, a resampling or a size that is not known here.
        """
        name = str(config.get("image_processor_type") or config.get("feature_extractor_type"))
        kind = name.removesuffix("Fast").removesuffix("Pil")
        kind = kind.removesuffix("ImageProcessor").removesuffix("FeatureExtractor")
        if kind not in DEFAULTS:
            known = ", ".join(f"{k}ImageProcessor" for k in DEFAULTS)
            bad_value("image_processor_type of preprocessor_config.json", f"one of {known}", name)
        given = {k: v for k, v in config.items() if v is not None}
        options = {"image_mean": HALF, "image_std": HALF, "do_resize": True, **DEFAULTS[kind], **given}
        if options["resample"] not in MODES:
            bad_value(
                "resample of preprocessor_config.json", "2 (bilinear) or 3 (bicubic)", options["resample"]
            )
        size = options["size"]
        if size is not None and not isinstance(size, int) and not {"height", "width"} <= set(size):
            bad_value("size of preprocessor_config.json", "a number or a height and a width", size)
        return cls(kind, options)

    @property
    def mode(self) -> str:
        """``bilinear`` or ``bicubic``."""
        return MODES[self.options["resample"]]

    def border(self, height: int, width: int) -> tuple[int, int]:
        """Pixels that ZoeDepth reflects above and below, and left and right, before it resizes."""
        if self.kind != "ZoeDepth" or not self.options["do_pad"]:
            return 0, 0
        return int((height / 2) ** 0.5 * 3), int((width / 2) ** 0.5 * 3)

    def resized(self, height: int, width: int) -> tuple[int, int]:
        """Sides ``(h, w)`` of the network's view of an image, without what is padded after resizing."""
        if not self.options["do_resize"]:
            return height, width
        if self.kind == "GLPN":
            divisor = self.options["size_divisor"]
            return height // divisor * divisor, width // divisor * divisor
        size = self.options["size"]
        target_h, target_w = (size["height"], size["width"]) if isinstance(size, dict) else (size, size)
        scale_h, scale_w = target_h / height, target_w / width
        if self.options.get("keep_aspect_ratio", False):  # the side that changes least decides
            scale_h = scale_w = scale_w if abs(1 - scale_w) < abs(1 - scale_h) else scale_h
        multiple = self.options.get("ensure_multiple_of", 1)
        return _nearest_multiple(scale_h * height, multiple), _nearest_multiple(scale_w * width, multiple)

    def padding(self, height: int, width: int) -> tuple[int, int, int, int]:
        """Left, right, top, bottom zeros that DPT adds after normalising, to a multiple of a patch.

        Others than ``PADDED_LAST`` add none.
        """
        divisor = self.options.get("size_divisor")
        if self.kind not in PADDED_LAST or not self.options["do_pad"] or not divisor:
            return 0, 0, 0, 0
        rows, columns = -height % divisor, -width % divisor
        return columns // 2, columns - columns // 2, rows // 2, rows - rows // 2

    def __call__(self, image_01: Tensor) -> Tensor:
        """What the network is given.

        Args:
            image_01: ``(B, 3, H, W)`` float32 in [0, 1].

        Returns:
            ``(B, 3, h, w)`` float32, within about a grey level of the library's, which rounds to bytes twice.

        Raises:
            ValueError: an image smaller than the patch that it is cut into.
        """
        rows, columns = self.border(*image_01.shape[-2:])
        x = F.pad(image_01, (columns, columns, rows, rows), mode="reflect") if rows or columns else image_01
        size = self.resized(*x.shape[-2:])
        if min(size) < 1:
            bad_value("image", "at least as large as a patch of the network", f"{x.shape[-1]}x{x.shape[-2]}")
        if size != tuple(x.shape[-2:]):
            corners, antialias = self.kind == "ZoeDepth", self.kind not in ALIASED
            x = F.interpolate(x, size, mode=self.mode, align_corners=corners, antialias=antialias)
            x = x.clamp(0.0, 1.0) if antialias else x  # the library resizes bytes, which cannot overshoot
        if self.options["do_normalize"]:
            mean, std = (
                torch.as_tensor(self.options[k], dtype=x.dtype, device=x.device).view(1, -1, 1, 1)
                for k in ("image_mean", "image_std")
            )
            x = (x - mean) / std
        return F.pad(x, self.padding(*size))
