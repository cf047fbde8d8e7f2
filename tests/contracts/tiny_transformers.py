"""Tiny random depth models of ``transformers``, each with its preparation of images."""

from typing import Any

import torch
import transformers as t

from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.transformers_depth import TransformersDepthPipeline

IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
STAGES = {"out_features": [f"stage{i}" for i in range(1, 5)], "reshape_hidden_states": False}
VIT = {"hidden_size": 16, "num_hidden_layers": 4, "num_attention_heads": 2}
DINO = VIT | {"mlp_ratio": 2, "patch_size": 14, "image_size": 56}
NECK = {"neck_hidden_sizes": [8] * 4, "fusion_hidden_size": 8}
HEAD = {"reassemble_hidden_size": 16, "head_hidden_size": 8, "patch_size": 14}
PATCHES_OF_14 = {
    "size": {"height": 56, "width": 56},
    "keep_aspect_ratio": True,
    "ensure_multiple_of": 14,
    "resample": 3,
    **IMAGENET,
}
Made = tuple[t.PreTrainedModel, dict[str, Any]]


def depth_anything(kind: str = "relative") -> Made:
    """``"relative"`` or ``"metric"``."""
    backbone = t.Dinov2Config(**DINO, **STAGES)
    reported = {"depth_estimation_type": kind, "max_depth": 20, **HEAD, **NECK}
    model = t.DepthAnythingForDepthEstimation(t.DepthAnythingConfig(backbone_config=backbone, **reported))
    return model, {"image_processor_type": "DPTImageProcessor", **PATCHES_OF_14}


def dpt() -> Made:
    """In the file of the time when processors were called feature extractors."""
    size = {"intermediate_size": 32, "image_size": 32, "patch_size": 8}
    config = t.DPTConfig(**VIT, **size, backbone_out_indices=[0, 1, 2, 3], **NECK)
    preparation = {"feature_extractor_type": "DPTFeatureExtractor", "size": 32, "resample": 3}
    return t.DPTForDepthEstimation(config), preparation


def glpn() -> Made:
    """Takes images of any size and does not normalise."""
    size = {"depths": [1] * 4, "hidden_sizes": [8, 8, 16, 16], "num_attention_heads": [1, 1, 2, 2]}
    config = t.GLPNConfig(**size, decoder_hidden_size=8, max_depth=10)
    preparation = {"image_processor_type": "GLPNImageProcessor", "size_divisor": 32, "resample": 2}
    return t.GLPNForDepthEstimation(config), preparation


def zoedepth() -> Made:
    """Its images get a reflected border."""
    size = {"intermediate_size": 32, "image_size": 64, "patch_size": 16, "use_relative_position_bias": True}
    config = t.ZoeDepthConfig(
        backbone_config=t.BeitConfig(**VIT, **STAGES, **size),
        backbone_hidden_size=16,
        bottleneck_features=8,
        num_relative_features=8,
        bin_embedding_dim=8,
        num_attractors=[4, 2, 2, 1],
        bin_configurations=[{"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0}],
        **NECK,
    )
    grid = {"size": {"height": 64, "width": 96}, "keep_aspect_ratio": True, "ensure_multiple_of": 32}
    preparation = {"image_processor_type": "ZoeDepthImageProcessor", "do_pad": True, "resample": 2, **grid}
    return t.ZoeDepthForDepthEstimation(config), preparation


def depth_pro() -> Made:
    """With its field of view."""
    vit = {"model_type": "dinov2", "image_size": 16, "patch_size": 4, **VIT, "mlp_ratio": 2}
    config = t.DepthProConfig(
        patch_size=16,
        fusion_hidden_size=8,
        intermediate_hook_ids=[1, 0],
        intermediate_feature_dims=[8, 8],
        scaled_images_ratios=[0.5, 1.0],
        scaled_images_overlap_ratios=[0.0, 0.2],
        scaled_images_feature_dims=[8, 8],
        **{f"{part}_model_config": vit for part in ("image", "patch", "fov")},
        use_fov_model=True,
        num_fov_head_layers=0,
    )
    size = {"height": 64, "width": 64}
    preparation = {"image_processor_type": "DepthProImageProcessorFast", "size": size, "resample": 2}
    return t.DepthProForDepthEstimation(config), preparation


def prompt_depth_anything() -> Made:
    """Takes depths to start from."""
    backbone = t.Dinov2Config(**DINO, **STAGES)
    reported = {"depth_estimation_type": "metric", **HEAD, **NECK}
    config = t.PromptDepthAnythingConfig(backbone_config=backbone, **reported)
    preparation = {"image_processor_type": "PromptDepthAnythingImageProcessor", **PATCHES_OF_14}
    return t.PromptDepthAnythingForDepthEstimation(config), preparation


def tipsv2() -> Made:
    """Metres in bins."""
    backbone = t.Tipsv2VisionConfig(**DINO, out_indices=[1, 2, 3, 4], reshape_hidden_states=False)
    config = t.Tipsv2DptConfig(backbone_config=backbone, num_depth_bins=16, **NECK)
    preparation = {"image_processor_type": "Tipsv2DptImageProcessor", "size": {"height": 56, "width": 56}}
    return t.Tipsv2DptForDepthEstimation(config), preparation


MODELS = {
    f.__name__: f for f in (depth_anything, dpt, glpn, zoedepth, depth_pro, prompt_depth_anything, tipsv2)
}


def spread(model: t.PreTrainedModel) -> t.PreTrainedModel:
    """Random weights after which the map varies: as initialised it is flat, or dead behind its last ReLU."""
    last = None
    with torch.no_grad():
        for parameter in model.parameters():
            matrix = parameter.ndim > 1
            drawn = torch.randn_like(parameter) if matrix else torch.rand_like(parameter)
            parameter.copy_(drawn / parameter[0].numel() ** 0.5)
            last = parameter if matrix else last
        last.abs_()
    return model.eval()


def make_transformers(kind: str = "depth_anything") -> TransformersDepthPipeline:
    """A model of ``MODELS`` with random weights, its map at 64 px."""
    torch.manual_seed(0)
    model, preparation = MODELS[kind]()
    parts = spread(model), DirectScheduler(timestep=0), preparation
    pipe = TransformersDepthPipeline(*parts, default_processing_resolution=64)
    pipe.set_progress_bar_config(disable=True)
    return pipe
