"""Depth models of ``transformers`` on tensors, with their image preparation and without torchvision."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from transformers import AutoConfig, AutoModelForDepthEstimation, BaseImageProcessor, PreTrainedModel
from transformers.models.auto.modeling_auto import MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.priors.loading import check_finite, check_weights, reading

__all__ = ["DEPTH_ARCHITECTURES", "DepthMap", "HFDepthModel", "Preparation", "output_of"]

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
        metres, relative without the head for its field of view; Prompt Depth Anything relative depth, until
        it is given a prompt.

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
        return "disparity", bool(config.use_fov_model)  # without its field of view the scale is open
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


def check_is_depth(name: str) -> None:
    """Refuse a class of ``transformers`` by its name, with the reason.

    Raises:
        ValueError: its map is no depth.
    """
    if name in NO_DEPTH:
        bad_value("the prior", "a model of depth", name, f"It is refused because {NO_DEPTH[name]}.")


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
        check_is_depth(name)
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
            architectures = AutoConfig.from_pretrained(
                str(name), trust_remote_code=False, **files
            ).architectures
        for architecture in architectures or ():
            check_is_depth(architecture)
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
