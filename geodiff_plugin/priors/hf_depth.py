"""Run any depth model of ``transformers``: own preparation, its map, and the space of that map.

Hop: hub id or folder -> ``HFDepthModel``; image ``(B, 3, H, W)`` in [0, 1] -> ``DepthMap``.
Paper: none (a prior without diffusion).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from transformers import AutoModelForDepthEstimation, BaseImageProcessor, PreTrainedModel
from transformers.models.auto.modeling_auto import MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.priors.hf_preparation import Preparation
from geodiff_plugin.priors.loading import check_weights

__all__ = ["DEPTH_ARCHITECTURES", "DepthMap", "HFDepthModel", "output_of"]

#: Class names of every model that ``AutoModelForDepthEstimation`` loads.
DEPTH_ARCHITECTURES = frozenset(MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES.values())
SPACES = ("depth", "disparity")
#: Weights that DPT's published files lack and no forward reads: the first fusion has nothing to add to.
UNUSED = "fusion_stage.layers.0.residual_layer1."
#: DepthPro's own limits on inverse metres.
NEAREST, FARTHEST = 1e4, 1e-4


def output_of(model: PreTrainedModel) -> tuple[str, bool]:
    """What the class of a model predicts: space (``depth`` or ``disparity``) and whether in (inverse) metres.

    Args:
        model: of any class.

    Returns:
        Depth Anything as its ``depth_estimation_type`` says; DPT relative disparity, but metres with the
        projection that only DINOv2's depth heads have; ZoeDepth and GLPN metres; DepthPro inverse metres.

    Raises:
        ValueError: a class of which this is not known.
    """
    name, config = type(model).__name__, model.config
    if name == "DepthAnythingForDepthEstimation":
        return ("depth", True) if config.depth_estimation_type == "metric" else ("disparity", False)
    if name == "DPTForDepthEstimation":
        return ("depth", True) if config.add_projection else ("disparity", False)
    if name in ("ZoeDepthForDepthEstimation", "GLPNForDepthEstimation"):
        return "depth", True
    if name == "DepthProForDepthEstimation":
        return "disparity", True
    cure = "Say what its output is affine in: space='depth' or space='disparity' (--space)."
    bad_value("the prior", "a depth model whose output is known", name, cure)


@dataclass(frozen=True)
class DepthMap:
    """What a depth model says.

    Attributes:
        values: ``(B, 1, h, w)`` float32, not clipped.
        space: what ``values`` is affine in, ``"depth"`` (grows with distance) or ``"disparity"``.
        metric: ``values`` are metres, or inverse metres in disparity space.
    """

    values: Tensor
    space: str
    metric: bool

    def metres(self) -> Tensor:
        """Metric depth, ``(B, 1, h, w)``.

        Raises:
            ValueError: the model is a relative one.
        """
        if not self.metric:
            bad_value("the depth model", "a metric one", "one that predicts relative disparity")
        if self.space == "depth":
            return self.values
        return 1.0 / self.values.clamp(FARTHEST, NEAREST)


class HFDepthModel:
    """A ``transformers`` depth model with its image preparation.

    Args:
        model: any member of ``AutoModelForDepthEstimation``, on its device and in its dtype.
        preparation: of its ``preprocessor_config.json``.
        space: overrides what the class is known to predict; needed for a class that is not known.

    Attributes:
        space: what its map is affine in.
        metric: whether its map is in metres (inverse metres in disparity space).
    """

    def __init__(self, model: PreTrainedModel, preparation: Preparation, space: str | None = None) -> None:
        self.model, self.preparation = model, preparation
        if space is None:
            self.space, self.metric = output_of(model)
        else:
            self.space, self.metric = check_choice(space, "space", SPACES), False

    @classmethod
    def from_pretrained(
        cls,
        name: str | Path,
        *,
        device: str | torch.device | None = None,
        dtype: torch.dtype = torch.float32,
        space: str | None = None,
        **kwargs: Any,
    ) -> HFDepthModel:
        """Load weights (safetensors only) and ``preprocessor_config.json``.

        Args:
            name: hub id, or folder as ``save_pretrained`` wrote it.
            device: where to, CPU for ``None``.
            dtype: of the weights.
            space: see the class.
            **kwargs: ``revision``, ``variant``, ``token``, ``cache_dir``, ``local_files_only``.

        Raises:
            OSError: it does not exist, is neither cached nor can be fetched, or has no safetensors.
            ValueError: weights that are missing; a class whose output, or a processor that, is not known.
        """
        files = {k: v for k, v in kwargs.items() if k != "variant"}
        config, _ = BaseImageProcessor.get_image_processor_dict(str(name), **files)
        model, found = AutoModelForDepthEstimation.from_pretrained(
            str(name), dtype=dtype, use_safetensors=True, output_loading_info=True, **kwargs
        )
        check_weights([key for key in found["missing_keys"] if UNUSED not in key], (), str(name))
        model = model.to(device or "cpu").eval().requires_grad_(False)
        return cls(model, Preparation.from_config(config), space)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Sides of the grid on which the network sees an image of these sides; one scale per axis."""
        rows, columns = self.preparation.border(height, width)
        h, w = self.preparation.resized(height + 2 * rows, width + 2 * columns)
        return round(h * height / (height + 2 * rows)), round(w * width / (width + 2 * columns))

    @torch.no_grad()
    def __call__(self, image_01: Tensor, size: tuple[int, int] | None = None) -> DepthMap:
        """Depth of images.

        Args:
            image_01: ``(B, 3, H, W)`` in [0, 1], on the model's device.
            size: sides ``(h, w)`` of the map; ``None`` for those of ``grid``.

        Returns:
            Map over the whole image and nothing but it (what was padded is gone), resampled as the library's
            ``post_process_depth_estimation`` does.

        Raises:
            ValueError: an image too small for the network.
        """
        height, width = image_01.shape[-2:]
        size = self.grid(height, width) if size is None else size
        output = self.model(pixel_values=self.preparation(image_01.float()).to(self.model.dtype))
        values = output.predicted_depth.float()[:, None]  # (B, 1, h', w')
        fov = getattr(output, "field_of_view", None)
        if fov is not None:  # canonical inverse depth -> inverse metres: times width over focal length
            values = values * 2.0 * torch.tan(0.5 * torch.deg2rad(fov.float())).view(-1, 1, 1, 1)
        values = self._without_padding(values, height, width)
        mode = "bilinear" if self.preparation.kind == "DepthPro" else "bicubic"
        if tuple(values.shape[-2:]) != tuple(size):
            values = F.interpolate(values, size, mode=mode, align_corners=False)
        return DepthMap(values, self.space, self.metric)

    def _without_padding(self, values: Tensor, height: int, width: int) -> Tensor:
        """The map over the image's own ``(height, width)``."""
        rows, columns = self.preparation.border(height, width)
        if rows or columns:
            padded = (height + 2 * rows, width + 2 * columns)
            values = F.interpolate(values, padded, mode="bicubic", align_corners=False)
            return values[:, :, rows : rows + height, columns : columns + width]
        h, w = self.preparation.resized(height, width)
        left, right, top, bottom = self.preparation.padding(h, w)
        if left + right + top + bottom == 0:
            return values
        values = F.interpolate(
            values, (h + top + bottom, w + left + right), mode="bicubic", align_corners=False
        )
        return values[:, :, top : top + h, left : left + w]
