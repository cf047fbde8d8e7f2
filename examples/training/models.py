"""Networks of the bundled prior, and saving them as a pipeline folder.

Data flow: configuration -> VAE, U-Net, scheduler, text parts -> ``MarigoldDepthPipeline`` -> folder on disk.
Paper: S3.1 (a latent diffusion prior of affine-invariant depth); sizes are ours.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import torch
from diffusers import AutoencoderKL, DDIMScheduler, MarigoldDepthPipeline, UNet2DConditionModel
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

from geodiff_plugin.bundled import no_bars

__all__ = [
    "LATENT_SCALE",
    "assemble",
    "build_scheduler",
    "build_text",
    "build_unet",
    "build_vae",
    "save_prior",
]

LATENT_SCALE = 4
"""Image pixels per latent pixel, per side."""

_TEXT_WIDTH = 32


def build_vae() -> AutoencoderKL:
    """A KL autoencoder of 0.65 M parameters: three blocks, 1/4 size, four latent channels.

    Without attention, a latent depends only on its neighbourhood, and the cost per pixel is constant.
    """
    return AutoencoderKL(
        in_channels=3,
        out_channels=3,
        down_block_types=["DownEncoderBlock2D"] * 3,
        up_block_types=["UpDecoderBlock2D"] * 3,
        block_out_channels=[16, 32, 64],
        layers_per_block=1,
        latent_channels=4,
        norm_num_groups=8,
        mid_block_add_attention=False,
        sample_size=256,
    )


def build_unet() -> UNet2DConditionModel:
    """The denoiser, 5.4 M parameters: image latent and noisy depth latent in, v out.

    Attention is used at the two lowest resolutions, where the image has about 200 tokens.
    """
    return UNet2DConditionModel(
        in_channels=8,
        out_channels=4,
        block_out_channels=[32, 64, 96, 128],
        layers_per_block=1,
        down_block_types=["DownBlock2D", "DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"],
        up_block_types=["CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D", "UpBlock2D"],
        cross_attention_dim=_TEXT_WIDTH,
        attention_head_dim=[1, 2, 3, 4],
        norm_num_groups=16,
        sample_size=64,
        use_linear_projection=True,
    )


def build_scheduler() -> DDIMScheduler:
    """DDIM over 1000 steps: v-prediction, trailing spacing, zero terminal signal-to-noise ratio."""
    return DDIMScheduler(
        num_train_timesteps=1000,
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        prediction_type="v_prediction",
        timestep_spacing="trailing",
        rescale_betas_zero_snr=True,
        clip_sample=False,
        set_alpha_to_one=False,
    )


def build_text() -> tuple[CLIPTextModel, CLIPTokenizer]:
    """Build a text encoder and a tokenizer for the empty prompt.

    Returns:
        One layer of width 32 with random weights, and a tokenizer over printable ASCII of length 77.
    """
    letters = [chr(code) for code in range(33, 127)]
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(letter + "</w>" for letter in letters)]
    tokenizer = CLIPTokenizer(vocab={t: i for i, t in enumerate(tokens)}, merges=[], model_max_length=77)
    config = CLIPTextConfig(
        vocab_size=len(tokens),
        hidden_size=_TEXT_WIDTH,
        intermediate_size=2 * _TEXT_WIDTH,
        num_hidden_layers=1,
        num_attention_heads=2,
        max_position_embeddings=77,
        bos_token_id=0,
        eos_token_id=1,
        pad_token_id=1,
        projection_dim=_TEXT_WIDTH,
    )
    return CLIPTextModel(config).eval(), tokenizer


def assemble(
    vae: AutoencoderKL,
    unet: UNet2DConditionModel,
    text: tuple[CLIPTextModel, CLIPTokenizer],
    steps: int = 1,
    resolution: int = 256,
) -> MarigoldDepthPipeline:
    """Assemble the stock pipeline from the given parts.

    Args:
        vae: autoencoder with its ``scaling_factor`` set.
        unet: denoiser.
        text: encoder and tokenizer from ``build_text`` or a loaded pipeline.
        steps: default number of denoising steps, >= 1.
        resolution: default processing resolution: the longer side in pixels, a multiple of 4.

    Returns:
        ``MarigoldDepthPipeline`` that uses the given modules, without a progress bar.
    """
    pipeline = MarigoldDepthPipeline(
        unet=unet,
        vae=vae,
        scheduler=build_scheduler(),
        text_encoder=text[0],
        tokenizer=text[1],
        prediction_type="disparity",
        scale_invariant=True,
        shift_invariant=True,
        default_denoising_steps=steps,
        default_processing_resolution=resolution,
    )
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def save_prior(pipeline: MarigoldDepthPipeline, folder: str | Path) -> Path:
    """Write the pipeline as float16 safetensors, replacing ``folder`` once everything is written.

    Args:
        pipeline: any dtype and device; not changed.
        folder: target; files that diffusers does not write (a model card) are kept.

    Returns:
        The folder.
    """
    folder = Path(folder)
    fresh, stale = folder.with_name(folder.name + ".new"), folder.with_name(folder.name + ".old")
    for leftover in (fresh, stale):
        shutil.rmtree(leftover, ignore_errors=True)
    parts = {name: _half_copy(part) for name, part in pipeline.components.items()}
    settings = {
        key: value for key, value in pipeline.config.items() if not key.startswith("_") and key not in parts
    }
    with no_bars():
        MarigoldDepthPipeline(**parts, **settings).save_pretrained(fresh, safe_serialization=True)
    if folder.is_dir():
        for extra in folder.glob("*.md"):
            shutil.copy2(extra, fresh / extra.name)
        folder.rename(stale)
    fresh.rename(folder)
    shutil.rmtree(stale, ignore_errors=True)
    return folder


def _half_copy(part: object) -> object:
    """A float16 copy of a module on the CPU (text encoders in float32); anything else unchanged."""
    if not isinstance(part, torch.nn.Module):
        return part
    if isinstance(part, CLIPTextModel):
        copy = type(part)(part.config)
        # transformers loads in the file's dtype and diffusers in float32, so float16 would not match.
        copy.load_state_dict({name: value.detach().cpu() for name, value in part.state_dict().items()})
        return copy.float().eval()
    # from_config uses the class's default for values that were defaults when the module was built
    # (scaling_factor), so the configuration is written again.
    # Names that start with an underscore hold the path it was loaded from.
    config = {key: value for key, value in part.config.items() if key[0] != "_"}
    copy = type(part).from_config(config)
    copy.register_to_config(**config)
    copy.load_state_dict({name: value.detach().cpu() for name, value in part.state_dict().items()})
    return copy.half().eval()
