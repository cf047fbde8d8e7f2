"""One tiny random pipeline per key of ``PRIORS``, for the contract tests and as folders to try.

Weights are drawn by a seed, images processed at 64 pixels; every function makes a new pipeline.
"""

import string

import numpy as np
import torch
from diffusers import (
    AutoencoderKL,
    DDIMScheduler,
    DiffusionPipeline,
    FlowMatchEulerDiscreteScheduler,
    UNet2DConditionModel,
)
from transformers import (
    CLIPTextConfig,
    CLIPTextModel,
    CLIPVisionConfig,
    CLIPVisionModelWithProjection,
    Dinov2Config,
    Dinov2Model,
)

from examples.marigold_v2 import tiny_marigold_v2
from geodiff_plugin.priors import load_prior
from geodiff_plugin.priors.components import DirectScheduler, FixedPrompt
from geodiff_plugin.priors.convert import unet_config
from geodiff_plugin.priors.depthfm import DepthFMPipeline
from geodiff_plugin.priors.depthmaster import DepthMasterPipeline, FourierUNet
from geodiff_plugin.priors.geowizard import IMAGE_EMBEDDING, TEXT_PROMPT, GeoWizardPipeline
from geodiff_plugin.priors.lotus import LotusPipeline
from geodiff_plugin.priors.marigold import E2EFTPipeline
from geodiff_plugin.priors.ppd import PixelDiT, PPDPipeline
from tests.contracts.tiny_transformers import make_transformers
from tests.parity import depthfm_reference, depthmaster_reference, geowizard_reference, lotus_reference
from tests.tiny import (
    SCHEDULER,
    make_marigold,
    make_text_encoder,
    make_tokenizer,
    make_unet,
    make_vae,
    quiet,
)

#: Under the groups of 32 that Stable Diffusion's has.
TINY_VAE = {"block_out_channels": (8,) * 4, "norm_num_groups": 4}
AT_64 = {"default_processing_resolution": 64}


def make_e2e_ft() -> E2EFTPipeline:
    """Marigold's networks, one step from zeros."""
    scheduler = DDIMScheduler(**SCHEDULER | {"rescale_betas_zero_snr": False})
    parts = make_unet().eval(), make_vae().eval(), scheduler, make_text_encoder().eval(), make_tokenizer()
    return quiet(E2EFTPipeline(*parts, prediction_type="depth", **AT_64))


def make_depthfm(noising_step: int = 400) -> DepthFMPipeline:
    """Diffusers' own initialisation, where no layer is 0; two steps."""
    torch.manual_seed(0)
    small = {"channel_mult": [1, 1], "num_res_blocks": 1, "attention_resolutions": [1]}
    networks = (
        UNet2DConditionModel(**unet_config(depthfm_reference.HPARAMS | small)).eval(),
        AutoencoderKL(**depthfm_reference.VAE | TINY_VAE).eval(),
    )
    prompt = FixedPrompt(5, depthfm_reference.HPARAMS["context_dim"])
    parts = (*networks, FlowMatchEulerDiscreteScheduler(), prompt, noising_step)
    return quiet(DepthFMPipeline(*parts, default_denoising_steps=2, **AT_64))


def make_depthmaster() -> DepthMasterPipeline:
    """A U-Net on the image latent alone."""
    torch.manual_seed(0)
    small = {"block_out_channels": (32, 32), "cross_attention_dim": lotus_reference.TEXT["hidden_size"]}
    parts = (
        FourierUNet(**depthmaster_reference.UNET | small).eval(),
        AutoencoderKL(**depthmaster_reference.VAE | TINY_VAE).eval(),
        CLIPTextModel(CLIPTextConfig(**lotus_reference.TEXT)).eval(),
    )
    return quiet(DepthMasterPipeline(*parts, make_tokenizer(), **AT_64))


def make_geowizard(version: int = 1) -> GeoWizardPipeline:
    """Of a version, two steps."""
    torch.manual_seed(0)
    reference = geowizard_reference
    if version == 1:
        encoder = CLIPVisionModelWithProjection(CLIPVisionConfig(**reference.VISION))
        reported = {"image_encoder": encoder.eval()}
    else:
        text_encoder = CLIPTextModel(CLIPTextConfig(**reference.TEXT)).eval()
        reported = {"text_encoder": text_encoder, "tokenizer": make_tokenizer(string.ascii_lowercase)}
    width = IMAGE_EMBEDDING if version == 1 else TEXT_PROMPT
    unet = UNet2DConditionModel(**reference.UNET, projection_class_embeddings_input_dim=width).eval()
    parts = unet, AutoencoderKL(**reference.VAE).eval(), DDIMScheduler(**reference.SCHEDULER)
    return quiet(GeoWizardPipeline(*parts, **reported, default_denoising_steps=2, **AT_64))


def make_lotus(kind: str = "g", space: str = "disparity") -> LotusPipeline:
    """Lotus ``"g"`` or ``"d"``."""
    torch.manual_seed(0)
    parts = (
        UNet2DConditionModel(**lotus_reference.UNET, in_channels={"g": 8, "d": 4}[kind]).eval(),
        AutoencoderKL(**lotus_reference.VAE).eval(),
        CLIPTextModel(CLIPTextConfig(**lotus_reference.TEXT)).eval(),
    )
    return quiet(LotusPipeline(*parts, make_tokenizer(), DirectScheduler(timestep=999), space, **AT_64))


def make_ppd() -> PPDPipeline:
    """At the area of 64 x 48, two steps; PyTorch's own initialisation, where nothing is 0."""
    torch.manual_seed(0)
    size = {"hidden_size": 64, "num_hidden_layers": 1, "num_attention_heads": 1, "mlp_ratio": 1}
    parts = (
        PixelDiT(hidden_size=16, depth=2, num_heads=2, semantic_size=64, mlp_ratio=1.0).eval(),
        Dinov2Model(Dinov2Config(**size, image_size=28, patch_size=14)).eval(),
    )
    return quiet(PPDPipeline(*parts, FlowMatchEulerDiscreteScheduler(), default_denoising_steps=2, **AT_64))


def make_map() -> DiffusionPipeline:
    """Needs ``CALL["map"]`` in its call."""
    return quiet(load_prior("map"))


TINY = {
    "marigold-v2": tiny_marigold_v2,
    "marigold": make_marigold,
    "e2e-ft": make_e2e_ft,
    "lotus": make_lotus,
    "geowizard": make_geowizard,
    "depthmaster": make_depthmaster,
    "depthfm": make_depthfm,
    "ppd": make_ppd,
    "transformers": make_transformers,
    "map": make_map,
}

_MAP = np.add.outer(np.linspace(3.0, 1.0, 21), 0.2 * np.sin(np.arange(33.0)))
_MAP[5:9, 20:25] = np.nan
#: What a call of a prior must be given next to the image.
CALL: dict[str, dict[str, np.ndarray]] = {"map": {"depth_map": _MAP}}
