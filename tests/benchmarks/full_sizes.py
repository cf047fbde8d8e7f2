"""Architectures of all priors at full size with random weights, to measure their cost.

Data flow: key of ``PRIORS`` -> pipeline of that architecture.
Paper: S5.1 (the prior of the experiments is the first).

Sizes come from the published weights, or for DepthFM, PPD and GeoWizard from the authors' code.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from diffusers import (
    AutoencoderKL,
    AutoencoderKLQwenImage,
    DDIMScheduler,
    FlowMatchEulerDiscreteScheduler,
    MarigoldDepthPipeline,
    QwenImageTransformer2DModel,
    UNet2DConditionModel,
)
from torch._subclasses.fake_tensor import unset_fake_temporarily
from transformers import (
    CLIPTextConfig,
    CLIPTextModel,
    CLIPTokenizer,
    CLIPVisionConfig,
    CLIPVisionModelWithProjection,
    DepthAnythingConfig,
    DepthAnythingForDepthEstimation,
    Dinov2Config,
    Dinov2Model,
)

from geodiff_plugin.priors.components import DirectScheduler, FixedPrompt
from geodiff_plugin.priors.depthfm import DepthFMPipeline
from geodiff_plugin.priors.depthmaster import DepthMasterPipeline, FourierUNet
from geodiff_plugin.priors.geowizard import GeoWizardPipeline
from geodiff_plugin.priors.lotus import LotusPipeline
from geodiff_plugin.priors.marigold import E2EFTPipeline
from geodiff_plugin.priors.marigold_v2 import MarigoldV2Pipeline
from geodiff_plugin.priors.ppd import PixelDiT, PPDPipeline
from geodiff_plugin.priors.transformers_depth import TransformersDepthPipeline

__all__ = ["FULL_SIZES", "SCHEDULER", "UNET", "VAE"]

#: The U-Net of Stable Diffusion 2 with 8 input channels: image latent next to depth latent.
UNET: dict[str, Any] = {
    "sample_size": 96,
    "in_channels": 8,
    "out_channels": 4,
    "block_out_channels": (320, 640, 1280, 1280),
    "down_block_types": ("CrossAttnDownBlock2D",) * 3 + ("DownBlock2D",),
    "up_block_types": ("UpBlock2D",) + ("CrossAttnUpBlock2D",) * 3,
    "layers_per_block": 2,
    "cross_attention_dim": 1024,
    "attention_head_dim": (5, 10, 20, 20),
    "use_linear_projection": True,
}
#: That of Stable Diffusion 1, as GeoWizard v1 has it: with an image embedding and ten numbers as conditions.
GEOWIZARD_UNET = UNET | {
    "cross_attention_dim": 768,
    "attention_head_dim": 8,
    "use_linear_projection": False,
    "class_embed_type": "projection",
    "projection_class_embeddings_input_dim": 10,
}
TASK = {"class_embed_type": "projection", "projection_class_embeddings_input_dim": 4}
VAE: dict[str, Any] = {
    "sample_size": 768,
    "block_out_channels": (128, 256, 512, 512),
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "layers_per_block": 2,
    "latent_channels": 4,
    "scaling_factor": 0.18215,
}
SCHEDULER: dict[str, Any] = {
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "prediction_type": "v_prediction",
    "rescale_betas_zero_snr": True,
    "timestep_spacing": "trailing",
    "set_alpha_to_one": False,
    "steps_offset": 1,
    "clip_sample": False,
}
#: About as many as a sentence and Qwen's template around it.
PROMPT_TOKENS = 128
TEXT = {
    "hidden_size": 1024,
    "intermediate_size": 4096,
    "num_hidden_layers": 23,
    "num_attention_heads": 16,
    "hidden_act": "gelu",
}
VISION = {
    "hidden_size": 1024,
    "intermediate_size": 4096,
    "num_hidden_layers": 24,
    "num_attention_heads": 16,
    "patch_size": 14,
    "projection_dim": 768,
}
DINOV2_LARGE = {
    "hidden_size": 1024,
    "num_hidden_layers": 24,
    "num_attention_heads": 16,
    "image_size": 518,
    "patch_size": 14,
}
DA2_PREPARATION = {
    "image_processor_type": "DPTImageProcessor",
    "size": {"height": 518, "width": 518},
    "keep_aspect_ratio": True,
    "ensure_multiple_of": 14,
    "resample": 3,
    "image_mean": [0.485, 0.456, 0.406],
    "image_std": [0.229, 0.224, 0.225],
}


def _tokenizer() -> CLIPTokenizer:
    """Enough of one for the empty prompt."""
    return CLIPTokenizer(vocab={"<|startoftext|>": 0, "<|endoftext|>": 1}, merges=[], model_max_length=77)


def _text() -> dict[str, Any]:
    return {"text_encoder": CLIPTextModel(CLIPTextConfig(**TEXT)), "tokenizer": _tokenizer()}


def _marigold(cls: type = MarigoldDepthPipeline) -> Any:
    unet, vae = UNet2DConditionModel(**UNET), AutoencoderKL(**VAE)
    scheduler = DDIMScheduler(**SCHEDULER)
    return cls(unet=unet, vae=vae, scheduler=scheduler, prediction_type="depth", **_text())


def _e2e_ft() -> E2EFTPipeline:
    return _marigold(E2EFTPipeline)


def _lotus() -> LotusPipeline:
    unet = UNet2DConditionModel(**UNET | TASK)
    return LotusPipeline(
        unet=unet,
        vae=AutoencoderKL(**VAE),
        scheduler=DirectScheduler(timestep=999),
        prediction_type="disparity",
        **_text(),
    )


def _geowizard() -> GeoWizardPipeline:
    return GeoWizardPipeline(
        unet=UNet2DConditionModel(**GEOWIZARD_UNET),
        vae=AutoencoderKL(**VAE),
        scheduler=DDIMScheduler(**SCHEDULER),
        image_encoder=CLIPVisionModelWithProjection(CLIPVisionConfig(**VISION)),
    )


def _depthmaster() -> DepthMasterPipeline:
    unet = FourierUNet(**UNET | {"in_channels": 4})
    return DepthMasterPipeline(unet=unet, vae=AutoencoderKL(**VAE), **_text())


def _flow() -> FlowMatchEulerDiscreteScheduler:
    """A schedule reads its own numbers, so it is made of real ones even where networks are counted only."""
    with unset_fake_temporarily():
        return FlowMatchEulerDiscreteScheduler()


def _depthfm() -> DepthFMPipeline:
    return DepthFMPipeline(
        unet=UNet2DConditionModel(**UNET),
        vae=AutoencoderKL(**VAE),
        scheduler=_flow(),
        prompt=FixedPrompt(),
    )


def _ppd() -> PPDPipeline:
    encoder = Dinov2Model(Dinov2Config(**DINOV2_LARGE))
    return PPDPipeline(PixelDiT(), encoder, _flow())


def _marigold_v2() -> MarigoldV2Pipeline:
    # diffusers' defaults are the sizes of Qwen-Image; it has a prompt of some tokens of 3584 channels.
    transformer, vae = QwenImageTransformer2DModel(), AutoencoderKLQwenImage()
    return MarigoldV2Pipeline(transformer, vae, _flow(), FixedPrompt(PROMPT_TOKENS, 3584))


def _transformers() -> TransformersDepthPipeline:
    backbone = Dinov2Config(
        **DINOV2_LARGE, out_indices=[5, 12, 18, 24], reshape_hidden_states=False, apply_layernorm=True
    )
    config = DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=1024,
        neck_hidden_sizes=[256, 512, 1024, 1024],
        fusion_hidden_size=256,
    )
    model = DepthAnythingForDepthEstimation(config)
    return TransformersDepthPipeline(model, DirectScheduler(timestep=0), DA2_PREPARATION)


#: Marigold v1-1, Marigold E2E-FT, Lotus-G, GeoWizard v1, ..., Depth Anything V2 Large for ``transformers``.
FULL_SIZES: dict[str, Callable[[], Any]] = {
    "marigold": _marigold,
    "e2e-ft": _e2e_ft,
    "lotus": _lotus,
    "geowizard": _geowizard,
    "depthmaster": _depthmaster,
    "depthfm": _depthfm,
    "ppd": _ppd,
    "marigold-v2": _marigold_v2,
    "transformers": _transformers,
}
