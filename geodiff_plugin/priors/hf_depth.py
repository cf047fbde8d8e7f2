"""Runs any depth model of ``transformers``: preprocessing, its map, and the space of that map.

Data flow: hub id or folder -> ``HFDepthModel``; image ``(B, 3, H, W)`` in [0, 1] -> ``DepthMap``.
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
from geodiff_plugin.priors.reading import check_finite, reading

__all__ = ["DEPTH_ARCHITECTURES", "DepthMap", "HFDepthModel", "output_of"]

#: Class names of every model that ``AutoModelForDepthEstimation`` loads, and what TIPSv2's files name.
DEPTH_ARCHITECTURES = frozenset(MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES.values()) | {
    "Tipsv2DptForDensePrediction"
}
#: Those whose map is no depth, and what it is.
NO_DEPTH = {"CHMv2ForDepthEstimation": "its map is the height of trees above the ground, seen from the air"}
#: The one that takes depths to start from, and gives metres with them.
PROMPTED = "PromptDepthAnythingForDepthEstimation"
#: Whose library brings the map to the image's size bilinearly; the others' do so bicubically.
BILINEAR = ("DepthPro", "Tipsv2Dpt")
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
        projection that only DINOv2's depth heads have; ZoeDepth, GLPN and TIPSv2 metres; DepthPro inverse
        metres; Prompt Depth Anything relative depth, until it is given a prompt.

    Raises:
        ValueError: a class of which this is not known.
    """
    name, config = type(model).__name__, model.config
    if name == PROMPTED:
        return "depth", False
    if name == "DepthAnythingForDepthEstimation":
        return ("depth", True) if config.depth_estimation_type == "metric" else ("disparity", False)
    if name == "DPTForDepthEstimation":
        return ("depth", True) if config.add_projection else ("disparity", False)
    if name in ("ZoeDepthForDepthEstimation", "GLPNForDepthEstimation", "Tipsv2DptForDepthEstimation"):
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
            bad_value("the depth model", "a metric one", f"one that predicts relative {self.space}")
        return self.metres_of(self.values)

    def metres_of(self, values: Tensor) -> Tensor:
        """Metres, > 0, of values of a metric map's unit, any shape."""
        if self.space == "depth":
            return values
        return 1.0 / values.clamp(FARTHEST, NEAREST)


class HFDepthModel:
    """A ``transformers`` depth model with its image preparation.

    Args:
        model: any member of ``AutoModelForDepthEstimation``, on its device and in its dtype.
        preparation: of its ``preprocessor_config.json``.
        space: overrides what the class is known to predict; needed for a class that is not known.

    Attributes:
        space: what its map is affine in.
        metric: whether its map is in metres (inverse metres in disparity space).
        takes_prompt: whether it can be given depths to start from.

    Raises:
        ValueError: a class whose map is no depth, or of which it is not known.
    """

    def __init__(self, model: PreTrainedModel, preparation: Preparation, space: str | None = None) -> None:
        name = type(model).__name__
        if name in NO_DEPTH:
            bad_value("the prior", "a model of depth", name, f"It is refused because {NO_DEPTH[name]}.")
        self.model, self.preparation = model, preparation
        self.takes_prompt = name == PROMPTED
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
            ValueError: it does not exist, is neither cached nor can be fetched, or has no safetensors;
                weights that are missing; a class whose output, or a processor that, is not known.
        """
        files = {k: v for k, v in kwargs.items() if k != "variant"}
        expected = "a folder, or a hub id that is cached or can be reached, of a depth model with safetensors"
        cure = "Fetch it once with `hf download ID` while online, or check the path."
        with reading("the depth model", expected, repr(str(name)), cure):
            config, _ = BaseImageProcessor.get_image_processor_dict(str(name), **files)
            model, found = AutoModelForDepthEstimation.from_pretrained(
                str(name),
                dtype=dtype,
                use_safetensors=True,
                output_loading_info=True,
                trust_remote_code=False,
                **kwargs,
            )
        check_weights([key for key in found["missing_keys"] if UNUSED not in key], (), str(name))
        check_finite(model, str(name))
        model = model.to(device or "cpu").eval().requires_grad_(False)
        return cls(model, Preparation.from_config(config), space)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Sides of the grid on which the network sees an image of these sides; one scale per axis."""
        rows, columns = self.preparation.border(height, width)
        h, w = self.preparation.resized(height + 2 * rows, width + 2 * columns)
        return round(h * height / (height + 2 * rows)), round(w * width / (width + 2 * columns))

    @torch.no_grad()
    def __call__(
        self, image_01: Tensor, size: tuple[int, int] | None = None, prompt_m: Tensor | None = None
    ) -> DepthMap:
        """Depth of images.

        Args:
            image_01: ``(B, 3, H, W)`` in [0, 1], on the model's device.
            size: sides ``(h, w)`` of the map; ``None`` for those of ``grid``.
            prompt_m: ``(B, 1, h', w')`` metres everywhere, of any size, for a model that takes a prompt; its
                map is in metres then.

        Returns:
            Map over the whole image and nothing but it (what was padded is gone), resampled as the library's
            ``post_process_depth_estimation`` does.

        Raises:
            ValueError: an image too small for the network; a prompt for a model that takes none.
        """
        height, width = image_01.shape[-2:]
        size = self.grid(height, width) if size is None else size
        extra, unit = {}, None
        if prompt_m is not None:
            if not self.takes_prompt:
                bad_value("prompt_depth", "left out with this model", "given", f"Only {PROMPTED} takes one.")
            told = _with_a_span(prompt_m.to(image_01.device))
            if self.model.dtype != torch.float32:  # metres would lose the digits that the model divides by
                low, high = told.amin((1, 2, 3), keepdim=True), told.amax((1, 2, 3), keepdim=True)
                unit, told = (low, high - low), (told - low) / (high - low)
            extra["prompt_depth"] = told.to(self.model.dtype)
        output = self.model(pixel_values=self.preparation(image_01.float()).to(self.model.dtype), **extra)
        values = output.predicted_depth.float()[:, None]  # (B, 1, h', w')
        if unit is not None:  # as the model itself does it
            values = values * unit[1] + unit[0]
        fov = getattr(output, "field_of_view", None)
        if fov is not None:  # canonical inverse depth -> inverse metres: times width over focal length
            values = values * 2.0 * torch.tan(0.5 * torch.deg2rad(fov.float())).view(-1, 1, 1, 1)
        values = self._without_padding(values, height, width)
        mode = "bilinear" if self.preparation.kind in BILINEAR else "bicubic"
        if tuple(values.shape[-2:]) != tuple(size):
            values = F.interpolate(values, size, mode=mode, align_corners=False)
        return DepthMap(values, self.space, self.metric or prompt_m is not None)

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


def _with_a_span(prompt_m: Tensor) -> Tensor:
    """A prompt that is not one number everywhere, as the library makes it: its span is divided by."""
    prompt_m = prompt_m.float().clone()
    corner = prompt_m[:, :, 0, 0]
    # A millionth of a metre is lost beside tens of them.
    above = torch.maximum(corner + 1e-6, torch.nextafter(corner, torch.full_like(corner, torch.inf)))
    is_flat = (prompt_m.amax((1, 2, 3)) == prompt_m.amin((1, 2, 3)))[:, None]
    prompt_m[:, :, 0, 0] = torch.where(is_flat, above, corner)
    return prompt_m
