"""Depth models of ``transformers`` as one-step priors, with preprocessing that does not need torchvision."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from transformers import AutoModelForDepthEstimation, PreTrainedModel
from transformers.models.auto.modeling_auto import MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES

from geodiff_plugin._internal.checks import bad_value, check_choice
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.loading import Layout, build_pipeline, load_component
from geodiff_plugin.priors.pipeline import Condition, DirectMapPipeline, Generators

MODES = {2: "bilinear", 3: "bicubic"}  # PIL's resampling codes
#: Models whose library resizes without antialiasing.
ALIASED = ("ZoeDepth", "DepthPro")
#: Models whose library pads after normalizing.
PADDED_LAST = ("DPT", "PromptDepthAnything")
#: Models whose library resizes the map to the image bilinearly; others do so bicubically.
BILINEAR = ("DepthPro", "Tipsv2Dpt")
HALF = (0.5, 0.5, 0.5)
#: Defaults of entries missing from a processor's file.
COMMON: dict[str, Any] = {
    "resample": 2,
    "do_resize": True,
    "do_normalize": True,
    "do_pad": False,
    "image_mean": HALF,
    "image_std": HALF,
    "keep_aspect_ratio": False,
    "ensure_multiple_of": 1,
}
#: Processors with other defaults.
DEFAULTS: dict[str, dict[str, Any]] = {
    "DPT": {"size": 384, "resample": 3},
    "ZoeDepth": {
        "size": {"height": 384, "width": 512},
        "do_pad": True,
        "keep_aspect_ratio": True,
        "ensure_multiple_of": 1 / 32,
    },
    "GLPN": {"size": None, "do_normalize": False, "size_divisor": 32},
    "DepthPro": {"size": 1536},
    "PromptDepthAnything": {"size": 384, "resample": 3},
    "Tipsv2Dpt": {"size": {"height": 448, "width": 448}, "do_normalize": False},
}


class _Grid(NamedTuple):
    """Geometry of an image's preprocessing, in the order of the steps."""

    reflected: tuple[int, int]  # rows and columns of reflection padding on each side
    size: tuple[int, int]  # (h, w) after resizing
    zeros: list[int]  # pixels of zero padding on the left, right, top and bottom


class Preparation:
    """Resizing, padding and normalization of one checkpoint, from its preprocessor file."""

    def __init__(self, config: dict[str, Any]) -> None:
        file = "of preprocessor_config.json"
        name = str(config.get("image_processor_type") or config.get("feature_extractor_type"))
        self.kind = name.removesuffix("Fast").removesuffix("Pil")
        self.kind = self.kind.removesuffix("ImageProcessor").removesuffix("FeatureExtractor")
        if self.kind not in DEFAULTS:
            expected = f"one of {', '.join(f'{k}ImageProcessor' for k in DEFAULTS)}"
            bad_value(f"image_processor_type {file}", expected, name)
        given = {k: v for k, v in config.items() if v is not None}
        self.options = COMMON | DEFAULTS[self.kind] | given
        if self.options["resample"] not in MODES:
            bad_value(f"resample {file}", "2 (bilinear) or 3 (bicubic)", self.options["resample"])
        size = self.options["size"]
        if size is not None and not isinstance(size, int) and not {"height", "width"} <= set(size):
            bad_value(f"size {file}", "a number, or a height and a width", size)

    def _grid(self, height: int, width: int) -> _Grid:
        options = self.options
        rows = 0
        columns = 0
        if self.kind == "ZoeDepth" and options["do_pad"]:
            rows, columns = int((height / 2) ** 0.5 * 3), int((width / 2) ** 0.5 * 3)
        h, w = self._resized(height + 2 * rows, width + 2 * columns)
        zeros = [0, 0, 0, 0]
        divisor = options.get("size_divisor")
        if self.kind in PADDED_LAST and options["do_pad"] and divisor:
            missing = -w % divisor, -h % divisor
            zeros = [part for n in missing for part in (n // 2, n - n // 2)]
        return _Grid((rows, columns), (h, w), zeros)

    def _resized(self, height: int, width: int) -> tuple[int, int]:
        if not self.options["do_resize"]:
            return height, width
        if self.kind == "GLPN":
            divisor = self.options["size_divisor"]
            return height // divisor * divisor, width // divisor * divisor
        size = self.options["size"]
        target_h, target_w = (size["height"], size["width"]) if isinstance(size, dict) else (size, size)
        scale_h, scale_w = target_h / height, target_w / width
        if self.options["keep_aspect_ratio"]:  # use the side that changes least
            scale_h = scale_w = scale_w if abs(1 - scale_w) < abs(1 - scale_h) else scale_h
        multiple = self.options["ensure_multiple_of"]
        h, w = (int(round(side / multiple) * multiple) for side in (scale_h * height, scale_w * width))
        return h, w

    def __call__(self, image_01: Tensor) -> Tensor:
        """Preprocess images ``(B, 3, H, W)`` in [0, 1] to the network's input ``(B, 3, h, w)`` float32.

        Agrees within about one grey level with the library's, which rounds to bytes twice.
        """
        (rows, columns), size, zeros = self._grid(*image_01.shape[-2:])
        x = F.pad(image_01, (columns, columns, rows, rows), mode="reflect") if rows or columns else image_01
        if min(size) < 1:
            bad_value("image", "at least as large as a patch of the network", f"{x.shape[-1]}x{x.shape[-2]}")
        if size != tuple(x.shape[-2:]):
            mode = MODES[self.options["resample"]]
            corners = self.kind == "ZoeDepth"
            antialias = self.kind not in ALIASED
            x = F.interpolate(x, size, mode=mode, align_corners=corners, antialias=antialias)
            x = x.clamp(0.0, 1.0) if antialias else x  # the library resizes bytes, which cannot overshoot
        if self.options["do_normalize"]:
            mean, std = (x.new_tensor(self.options[k]).view(1, -1, 1, 1) for k in ("image_mean", "image_std"))
            x = (x - mean) / std
        return F.pad(x, zeros)

    def remove_padding(self, values: Tensor, height: int, width: int) -> Tensor:
        """Remove padding around ``(height, width)`` from the network's map ``(B, 1, h, w)``."""
        (rows, columns), (h, w), (left, right, top, bottom) = self._grid(height, width)
        if rows or columns:  # in image pixels
            h, w, left, right, top, bottom = height, width, columns, columns, rows, rows
        if left + right + top + bottom == 0:
            return values
        return _bicubic(values, (h + top + bottom, w + left + right))[:, :, top : top + h, left : left + w]


def _bicubic(values: Tensor, size: tuple[int, int]) -> Tensor:
    return F.interpolate(values, size, mode="bicubic", align_corners=False)


#: Class names of all models that ``AutoModelForDepthEstimation`` loads, and the name in TIPSv2's files.
DEPTH_ARCHITECTURES = frozenset(MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES.values()) | {
    "Tipsv2DptForDensePrediction"
}
#: Model whose map is canopy height seen from the air, not depth.
NO_DEPTH = "CHMv2ForDepthEstimation"
#: The class that takes a depth prompt and then predicts metres.
PROMPTED = "PromptDepthAnythingForDepthEstimation"
SPACES = ("depth", "disparity")
#: Weights that DPT's published files lack and no forward pass reads: the first fusion has nothing to add.
UNREAD = "fusion_stage.layers.0.residual_layer1."
#: DepthPro's upper limit of inverse metres.
NEAREST = 1e4
#: DepthPro's lower limit of inverse metres.
MIN_DISPARITY = 1e-4
#: Quantile that is mapped to 1, so that a few outliers do not compress the rest.
TOP_QUANTILE = 0.98
#: Minimum depth of a network's range, metres, since its nearest depth may be 0.
NEAREST_M = 1e-3
#: Minimum difference between nearest and farthest depth of a prompt, metres, since they may be equal.
MIN_SPAN_M = 1e-6
PREPARATION_FILES = ("preprocessor_config.json", "processor_config.json")


def output_of(model: PreTrainedModel) -> tuple[str, bool]:
    """Return the space that a model's class predicts (depth or disparity), and whether in (inverse) metres.

    DPT predicts metres with the projection that only DINOv2's depth heads have, DepthPro only with the head
    for its field of view, Prompt Depth Anything only with a prompt.
    """
    name = type(model).__name__.removesuffix("ForDepthEstimation")
    config = model.config
    if name in ("DepthAnything", "DPT"):
        metres = config.depth_estimation_type == "metric" if name != "DPT" else config.add_projection
        return ("depth", True) if metres else ("disparity", False)
    if name in ("ZoeDepth", "GLPN", "Tipsv2Dpt", "PromptDepthAnything"):
        return "depth", name != "PromptDepthAnything"
    if name == "DepthPro":
        return "disparity", bool(config.use_fov_model)
    hint = "Pass the space of its output: space='depth' or space='disparity' (--space)."
    bad_value("the prior", "a depth model with a known output space", type(model).__name__, hint)


def range_of(values: Tensor) -> tuple[Tensor, Tensor]:
    """Return minimum and 98 % quantile of maps ``(B, 1, H, W)``, ``(B,)`` each."""
    rows = values.flatten(1)
    # torch.quantile does not support as many values as a large map has.
    high = torch.quantile(rows[:, :: max(1, rows.shape[1] // 1_000_000)], TOP_QUANTILE, dim=1)
    return rows.amin(dim=1), high


def unit_range(values: Tensor) -> Tensor:
    """Scale maps ``(B, 1, H, W)`` from their minimum at 0 to their 98 % quantile at 1; a flat map is 0."""
    low, high = range_of(values)
    span = (high - low).clamp_min(torch.finfo(values.dtype).tiny)
    return (values - low.view(-1, 1, 1, 1)) / span.view(-1, 1, 1, 1)


class TransformersDepthPipeline(DirectMapPipeline):
    """All models that ``AutoModelForDepthEstimation`` loads, except for the one of canopy height.

    ``processing_resolution`` is the longer side of the map, which guidance updates pixel by pixel, 0 for the
    image's own size. ``preparation``, the contents of ``preprocessor_config.json``, defines the network's
    input size. ``metric``: whether maps are in metres (inverse metres in disparity space) without a prompt.
    """

    model_cpu_offload_seq = "model"

    def __init__(
        self,
        model: PreTrainedModel,
        scheduler: DirectScheduler,
        preparation: dict[str, Any] | None = None,
        prediction_type: str | None = None,
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 768,
    ) -> None:
        super().__init__()
        if type(model).__name__ == NO_DEPTH:
            bad_value("prior", "a depth model", f"{NO_DEPTH}, which predicts canopy height")
        self.takes_prompt = type(model).__name__ == PROMPTED
        self.prepare = Preparation(preparation or {})
        try:
            space, metric = output_of(model)
        except ValueError:
            if prediction_type is None:
                raise
            space, metric = prediction_type, False
        # A saved space equal to the known one of the model's class adds nothing: the pipeline stays metric.
        self.metric = metric and prediction_type in (None, space)
        space = check_choice(prediction_type or space, "space", SPACES)
        defaults = space, default_denoising_steps, default_processing_resolution
        modules = {"model": model, "scheduler": scheduler}
        self.register_prior(modules, *defaults, image_processor=1, preparation=preparation)

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Recognise an architecture of ``AutoModelForDepthEstimation``, alone or as component ``model``."""
        configs = layout.config(""), layout.config("model")
        return any(DEPTH_ARCHITECTURES & set(config.get("architectures") or ()) for config in configs)

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> TransformersDepthPipeline:
        """Load the model and its preprocessing, from this package's folder or as published on the hub."""
        if layout.index:
            return build_pipeline(cls, layout, dtype, prediction_type=space)
        config = next(filter(None, map(layout.read_json, PREPARATION_FILES)), None)
        if config is None:
            hint = "Download the whole folder again: this file defines how images are preprocessed."
            bad_value(str(layout.folder), f"a folder with {PREPARATION_FILES[0]}", "none", hint)
        model = load_component(layout, "", AutoModelForDepthEstimation, dtype, unread=UNREAD)
        preparation = config.get("image_processor", config)  # may be nested in a processor's file
        return cls(model.requires_grad_(False), DirectScheduler(0), preparation, space)

    def prepare_condition(
        self,
        image: Tensor,
        ensemble_size: int,
        batch_size: int,
        generator: Generators,
        prompt_depth: Tensor | None = None,
    ) -> Condition:
        """Predict the relative map of every image, ``(N * E, 1, H, W)`` float32.

        ``prompt_depth (N, 1, h, w)``, metres everywhere, is for Prompt Depth Anything.
        """
        if prompt_depth is not None:
            prompt_depth = torch.as_tensor(prompt_depth)
            if prompt_depth.ndim != 4 or len(prompt_depth) != len(image):
                bad_value("prompt_depth", f"({len(image)}, 1, h, w) metres", tuple(prompt_depth.shape))
        size = (image.shape[-2], image.shape[-1])
        parts = image.split(batch_size)
        prompts = [None] * len(parts) if prompt_depth is None else prompt_depth.split(batch_size)
        maps = [
            self.predict(part.float() / 2 + 0.5, size, prompt)
            for part, prompt in zip(parts, prompts, strict=True)
        ]
        self.metric_range = None
        if self.metric or prompt_depth is not None:
            ends = torch.cat([torch.stack([self.metres(v) for v in range_of(part)], 1) for part in maps])
            self.metric_range = ends.clamp_min(NEAREST_M).repeat_interleave(ensemble_size, dim=0)
        return {"image_latent": unit_range(torch.cat(maps)).repeat_interleave(ensemble_size, dim=0)}

    def metres(self, values: Tensor) -> Tensor:
        """Convert values of a metric map to metres, > 0, any shape."""
        return (
            values if self.config.prediction_type == "depth" else 1.0 / values.clamp(MIN_DISPARITY, NEAREST)
        )

    @torch.no_grad()
    def predict(self, image_01: Tensor, size: tuple[int, int], prompt_m: Tensor | None = None) -> Tensor:
        """Run the model on images in [0, 1]; returns its own unit, unclipped, ``(B, 1, h, w)`` float32.

        Resampled to ``size`` like the library's ``post_process_depth_estimation``, without padding. With
        ``prompt_m (B, 1, h', w')``, metres everywhere, for models that take a prompt, the result is in
        metres.
        """
        prompt_arguments: dict[str, Tensor] = {}
        low, span = image_01.new_zeros(1), image_01.new_ones(1)
        if prompt_m is not None:
            if not self.takes_prompt:
                bad_value(
                    "prompt_depth", "omitted with this model", "one passed", f"Only {PROMPTED} takes one."
                )
            # Normalized to [0, 1], as the model itself does, but before half precision rounds the metres.
            prompt = prompt_m.to(image_01.device).float()
            low, high = prompt.amin((1, 2, 3), keepdim=True), prompt.amax((1, 2, 3), keepdim=True)
            span = (high - low).clamp_min(MIN_SPAN_M)
            prompt = (prompt - low) / span
            # The model divides by the span.
            prompt[:, :, :1, :1] = torch.where(high > low, prompt[:, :, :1, :1], 1.0)
            prompt_arguments["prompt_depth"] = prompt.to(self.model.dtype)
        output = self.model(
            pixel_values=self.prepare(image_01.float()).to(self.model.dtype), **prompt_arguments
        )
        values = output.predicted_depth.float()[:, None] * span + low  # (B, 1, h', w')
        fov = getattr(output, "field_of_view", None)
        if fov is not None:  # canonical inverse depth -> inverse metres: times width over focal length
            values = values * 2.0 * torch.tan(0.5 * torch.deg2rad(fov.float())).view(-1, 1, 1, 1)
        values = self.prepare.remove_padding(values, *image_01.shape[-2:])
        if tuple(values.shape[-2:]) == tuple(size):
            return values
        if self.prepare.kind in BILINEAR:
            return F.interpolate(values, size, mode="bilinear", align_corners=False)
        return _bicubic(values, size)
