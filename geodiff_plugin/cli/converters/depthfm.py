"""Converter of ``depthfm-v1.ckpt``: CompVis' U-Net and empty prompt; the VAE is Stable Diffusion 1.5's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, UNet2DConditionModel
from diffusers.loaders.single_file_utils import convert_ldm_unet_checkpoint
from torch import Tensor

from geodiff_plugin.cli.converters import fixed_prompt, write_card
from geodiff_plugin.priors.depthfm import DepthFMPipeline
from geodiff_plugin.priors.loading import check_weights, reading

KEYS = {"state_dict", "ldm_hparams", "noising_step", "empty_text_embedding"}
#: A copy of runwayml/stable-diffusion-v1-5, which the authors name and which is gone.
VAE_ID = "stable-diffusion-v1-5/stable-diffusion-v1-5"
#: What diffusers' conversion expects before every name.
LDM_PREFIX = "model.diffusion_model."


def unet_config(hparams: Mapping[str, Any]) -> dict[str, Any]:
    """Config of ``UNet2DConditionModel`` for the options of a CompVis ``UNetModel``.

    Options that change the weights' names or shapes in another way are noticed when these are loaded.
    """
    width, mults = hparams["model_channels"], hparams["channel_mult"]
    attends = [2**level in set(hparams["attention_resolutions"]) for level in range(len(mults))]
    kinds = ["CrossAttn" if attending else "" for attending in attends]
    return {
        "in_channels": hparams["in_channels"],
        "out_channels": hparams["out_channels"],
        "layers_per_block": hparams["num_res_blocks"],
        "cross_attention_dim": hparams["context_dim"],
        "block_out_channels": tuple(width * mult for mult in mults),
        "use_linear_projection": hparams.get("use_linear_in_transformer", False),
        # diffusers' name for the number of heads, for reasons of its history.
        "attention_head_dim": hparams["num_heads"],
        "down_block_types": tuple(f"{kind}DownBlock2D" for kind in kinds),
        "up_block_types": tuple(f"{kind}UpBlock2D" for kind in reversed(kinds)),
    }


def _load_unet(state: Mapping[str, Tensor], hparams: Mapping[str, Any]) -> UNet2DConditionModel:
    config = unet_config(hparams)
    unet = UNet2DConditionModel(**config)
    wanted = unet.state_dict().keys()
    converted = convert_ldm_unet_checkpoint({LDM_PREFIX + k: v for k, v in state.items()}, config)
    fitting = {name: value for name, value in converted.items() if name in wanted}
    taken = {id(value) for value in fitting.values()}
    unexpected = [name for name, value in state.items() if id(value) not in taken]
    check_weights(wanted - fitting.keys(), unexpected, "the checkpoint's state_dict")
    unet.load_state_dict(fitting)
    return unet


def _load_vae(part: str | None) -> AutoencoderKL:
    source = part or VAE_ID
    expected = "a folder or hub id of Stable Diffusion 1.5, or of its VAE (the checkpoint has none)"
    subfolder = "" if (Path(source) / "config.json").is_file() else "vae"
    with reading("--with", expected, repr(source), f"Fetch it once: hf download {VAE_ID}."):
        return AutoencoderKL.from_pretrained(source, subfolder=subfolder, use_safetensors=True)


def write(checkpoint: Mapping[str, Any], folder: Path, part: str | None) -> None:
    """Fill an empty folder; ``part`` is what ``--with`` names."""
    unet = _load_unet(checkpoint["state_dict"], checkpoint["ldm_hparams"])
    embedding = torch.as_tensor(checkpoint["empty_text_embedding"])
    prompt = fixed_prompt(embedding.reshape(1, *embedding.shape[-2:]))
    noising_step, scheduler = int(checkpoint["noising_step"]), FlowMatchEulerDiscreteScheduler()
    pipe = DepthFMPipeline(unet, _load_vae(part), scheduler, prompt, noising_step=noising_step)
    pipe.save_pretrained(folder)
    write_card(
        folder,
        "mit",
        "DepthFM (CompVis/depth-fm), converted by `geodiff convert`. The VAE is that of Stable Diffusion 1.5 "
        "and the U-Net was fine-tuned from it, so its CreativeML Open RAIL-M licence applies as well.",
    )
