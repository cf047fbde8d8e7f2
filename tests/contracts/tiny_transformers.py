"""Tiny random depth models of ``transformers``, for the contract tests and as folders to try."""

from __future__ import annotations

from typing import Any

import torch
from transformers import (
    BeitConfig,
    DepthAnythingConfig,
    DepthAnythingForDepthEstimation,
    DepthProConfig,
    DepthProForDepthEstimation,
    Dinov2Config,
    DPTConfig,
    DPTForDepthEstimation,
    GLPNConfig,
    GLPNForDepthEstimation,
    PreTrainedModel,
    PromptDepthAnythingConfig,
    PromptDepthAnythingForDepthEstimation,
    Tipsv2DptConfig,
    Tipsv2DptForDepthEstimation,
    Tipsv2VisionConfig,
    ZoeDepthConfig,
    ZoeDepthForDepthEstimation,
)

from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.transformers_depth import TransformersDepthPipeline

IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
STAGES = {"out_features": [f"stage{i}" for i in range(1, 5)], "reshape_hidden_states": False}
VIT = {"hidden_size": 16, "num_hidden_layers": 4, "num_attention_heads": 2}
NECK = {"neck_hidden_sizes": [8] * 4, "fusion_hidden_size": 8}


def depth_anything(kind: str = "relative") -> tuple[PreTrainedModel, dict[str, Any]]:
    """Depth Anything, ``"relative"`` or ``"metric"``, and its preparation."""
    backbone = Dinov2Config(**VIT, **STAGES, mlp_ratio=2, patch_size=14, image_size=56)
    options = {"reassemble_hidden_size": 16, "head_hidden_size": 8, "patch_size": 14, "max_depth": 20}
    config = DepthAnythingConfig(backbone_config=backbone, depth_estimation_type=kind, **options, **NECK)
    size = {"size": {"height": 56, "width": 56}, "keep_aspect_ratio": True, "ensure_multiple_of": 14}
    preparation = {"image_processor_type": "DPTImageProcessor", "resample": 3, **size, **IMAGENET}
    return DepthAnythingForDepthEstimation(config), preparation


def dpt() -> tuple[PreTrainedModel, dict[str, Any]]:
    """DPT, in the file of the time when processors were called feature extractors."""
    options = {
        "intermediate_size": 32,
        "image_size": 32,
        "patch_size": 8,
        "backbone_out_indices": [0, 1, 2, 3],
    }
    preparation = {"feature_extractor_type": "DPTFeatureExtractor", "size": 32, "resample": 3}
    return DPTForDepthEstimation(DPTConfig(**VIT, **options, **NECK)), preparation


def glpn() -> tuple[PreTrainedModel, dict[str, Any]]:
    """GLPN, which takes images of any size and does not normalise."""
    options = {"depths": [1] * 4, "hidden_sizes": [8, 8, 16, 16], "num_attention_heads": [1, 1, 2, 2]}
    preparation = {"image_processor_type": "GLPNImageProcessor", "size_divisor": 32, "resample": 2}
    return GLPNForDepthEstimation(GLPNConfig(**options, decoder_hidden_size=8, max_depth=10)), preparation


def zoedepth() -> tuple[PreTrainedModel, dict[str, Any]]:
    """ZoeDepth, whose images get a reflected border."""
    options = {
        "intermediate_size": 32,
        "image_size": 64,
        "patch_size": 16,
        "use_relative_position_bias": True,
    }
    bins = {"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0}
    config = ZoeDepthConfig(
        backbone_config=BeitConfig(**VIT, **STAGES, **options),
        backbone_hidden_size=16,
        bottleneck_features=8,
        num_relative_features=8,
        bin_embedding_dim=8,
        num_attractors=[4, 2, 2, 1],
        bin_configurations=[bins],
        **NECK,
    )
    size = {"size": {"height": 64, "width": 96}, "keep_aspect_ratio": True, "ensure_multiple_of": 32}
    preparation = {"image_processor_type": "ZoeDepthImageProcessor", "do_pad": True, "resample": 2, **size}
    return ZoeDepthForDepthEstimation(config), preparation


def depth_pro() -> tuple[PreTrainedModel, dict[str, Any]]:
    """DepthPro with its field of view."""
    vit = {"model_type": "dinov2", "image_size": 16, "patch_size": 4, **VIT, "mlp_ratio": 2}
    config = DepthProConfig(
        patch_size=16,
        fusion_hidden_size=8,
        intermediate_hook_ids=[1, 0],
        intermediate_feature_dims=[8, 8],
        scaled_images_ratios=[0.5, 1.0],
        scaled_images_overlap_ratios=[0.0, 0.2],
        scaled_images_feature_dims=[8, 8],
        image_model_config=vit,
        patch_model_config=vit,
        fov_model_config=vit,
        use_fov_model=True,
        num_fov_head_layers=0,
    )
    size = {"height": 64, "width": 64}
    preparation = {"image_processor_type": "DepthProImageProcessorFast", "size": size, "resample": 2}
    return DepthProForDepthEstimation(config), preparation


def prompt_depth_anything() -> tuple[PreTrainedModel, dict[str, Any]]:
    """Prompt Depth Anything, which takes depths to start from."""
    backbone = Dinov2Config(**VIT, **STAGES, mlp_ratio=2, patch_size=14, image_size=56)
    options = {"reassemble_hidden_size": 16, "head_hidden_size": 8, "patch_size": 14}
    config = PromptDepthAnythingConfig(
        backbone_config=backbone, depth_estimation_type="metric", **options, **NECK
    )
    size = {"size": {"height": 56, "width": 56}, "keep_aspect_ratio": True, "ensure_multiple_of": 14}
    preparation = {
        "image_processor_type": "PromptDepthAnythingImageProcessor",
        "resample": 3,
        **size,
        **IMAGENET,
    }
    return PromptDepthAnythingForDepthEstimation(config), preparation


def tipsv2() -> tuple[PreTrainedModel, dict[str, Any]]:
    """TIPSv2's depth head, metres in bins."""
    backbone = Tipsv2VisionConfig(
        **VIT,
        mlp_ratio=2,
        patch_size=14,
        image_size=56,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
    )
    config = Tipsv2DptConfig(backbone_config=backbone, num_depth_bins=16, **NECK)
    preparation = {"image_processor_type": "Tipsv2DptImageProcessor", "size": {"height": 56, "width": 56}}
    return Tipsv2DptForDepthEstimation(config), preparation


MODELS = {
    f.__name__: f for f in (depth_anything, dpt, glpn, zoedepth, depth_pro, prompt_depth_anything, tipsv2)
}


def spread(model: PreTrainedModel) -> PreTrainedModel:
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


def make_transformers(kind: str = "depth_anything", seed: int = 0) -> TransformersDepthPipeline:
    """A model of ``MODELS`` with random weights of a seed, its map at 64 px."""
    torch.manual_seed(seed)
    model, preparation = MODELS[kind]()
    pipe = TransformersDepthPipeline(
        spread(model), DirectScheduler(timestep=0), preparation, default_processing_resolution=64
    )
    pipe.set_progress_bar_config(disable=True)
    return pipe
