"""Converter of ``depthfm-v1.ckpt``: CompVis' U-Net and empty prompt; the VAE is Stable Diffusion 1.5's."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, UNet2DConditionModel
from torch import Tensor

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.cli.converters.reading import write_card
from geodiff_plugin.priors.depthfm import DepthFMPipeline
from geodiff_plugin.priors.loading import check_weights
from geodiff_plugin.priors.pipelines.prompts import FixedPrompt

__all__ = ["diffusers_name", "recognises", "unet_config", "write"]

KEYS = {"state_dict", "ldm_hparams", "noising_step", "empty_text_embedding"}
#: A copy of runwayml/stable-diffusion-v1-5, which the authors name and which is gone.
VAE_ID = "stable-diffusion-v1-5/stable-diffusion-v1-5"

#: Options that say nothing about the network's shape or arithmetic at inference.
WITHOUT_EFFECT = {"image_size", "dropout", "legacy", "load_from_ckpt"} | {
    f"use_{name}" for name in ("checkpoint", "fp16", "bf16")
}
#: Options whose only value that diffusers' U-Net can express is this one.
FIXED = {
    "dims": 2,
    "conv_resample": True,
    "use_spatial_transformer": True,
    "transformer_depth": 1,
    "num_classes": None,
    "n_embed": None,
    "num_heads_upsample": -1,
    "use_scale_shift_norm": False,
    "resblock_updown": False,
    "use_new_attention_order": False,
    "disable_self_attentions": None,
    "num_attention_blocks": None,
    "disable_middle_self_attn": False,
    "adm_in_channels": None,
}

RESNET = {
    "in_layers.0": "norm1",
    "in_layers.2": "conv1",
    "emb_layers.1": "time_emb_proj",
    "out_layers.0": "norm2",
    "out_layers.3": "conv2",
    "skip_connection": "conv_shortcut",
}
OUTSIDE = {
    "time_embed.0": "time_embedding.linear_1",
    "time_embed.2": "time_embedding.linear_2",
    "input_blocks.0.0": "conv_in",
    "out.0": "conv_norm_out",
    "out.2": "conv_out",
}
IN_A_BLOCK = re.compile(r"(input_blocks|output_blocks)\.(\d+)\.(\d)\.(.+)|(middle_block)\.([012])\.(.+)")


def unet_config(hparams: Mapping[str, Any]) -> dict[str, Any]:
    """Config of ``UNet2DConditionModel`` for the options of a CompVis ``UNetModel``.

    Args:
        hparams: the constructor's arguments, as the checkpoint holds them.

    Raises:
        ValueError: an option that is missing, unknown, or beyond diffusers' U-Net; naming it.
    """
    rest = {key: value for key, value in hparams.items() if key not in WITHOUT_EFFECT}
    for key, value in FIXED.items():
        if rest.pop(key, value) != value:
            bad_value(f"ldm_hparams[{key!r}]", f"{value!r}, all that is understood", repr(hparams[key]))
    try:
        width, mults = rest.pop("model_channels"), tuple(rest.pop("channel_mult", (1, 2, 4, 8)))
        with_attention = set(rest.pop("attention_resolutions"))
        config = {
            "in_channels": rest.pop("in_channels"),
            "out_channels": rest.pop("out_channels"),
            "layers_per_block": rest.pop("num_res_blocks"),
            "cross_attention_dim": rest.pop("context_dim"),
        }
    except KeyError as error:
        bad_value("ldm_hparams", f"a mapping with {error}", f"only {', '.join(sorted(hparams))}")
    config["use_linear_projection"] = rest.pop("use_linear_in_transformer", False)
    if not isinstance(config["layers_per_block"], int):
        bad_value("ldm_hparams['num_res_blocks']", "one number for all levels", config["layers_per_block"])
    heads, head_width = rest.pop("num_heads", -1), rest.pop("num_head_channels", -1)
    if heads == head_width == -1:
        bad_value("ldm_hparams", "with num_heads or num_head_channels", "neither")
    if rest:
        bad_value("ldm_hparams", "options of CompVis' UNetModel", f"also {', '.join(sorted(rest))}")
    channels = tuple(width * mult for mult in mults)
    kinds = ["CrossAttn" if 2**level in with_attention else "" for level in range(len(mults))]
    return config | {
        "block_out_channels": channels,
        # diffusers' name for the number of heads, for reasons of its history.
        "attention_head_dim": heads if head_width == -1 else tuple(c // head_width for c in channels),
        "down_block_types": tuple(f"{kind}DownBlock2D" for kind in kinds),
        "up_block_types": tuple(f"{kind}UpBlock2D" for kind in reversed(kinds)),
    }


def diffusers_name(name: str, layers: int) -> str | None:
    """Name of a CompVis U-Net's weight in diffusers' U-Net.

    Args:
        name: such as ``"input_blocks.1.0.in_layers.0.weight"``.
        layers: residual blocks per level of the way down.

    Returns:
        Such as ``"down_blocks.0.resnets.0.norm1.weight"``; ``None`` for a name of neither.
    """
    module, _, kind = name.rpartition(".")
    if module in OUTSIDE:
        return f"{OUTSIDE[module]}.{kind}"
    found = IN_A_BLOCK.fullmatch(name)
    if found is None:
        return None
    side, index, part, rest, middle, middle_part, middle_rest = found.groups()
    if middle:
        return _in_module(
            "mid_block", ("resnets.0", "attentions.0", "resnets.1")[int(middle_part)], middle_rest
        )
    if side == "input_blocks":
        level, layer = divmod(int(index) - 1, layers + 1)
        place = f"down_blocks.{level}"
        if layer == layers:  # the level's last entry makes the map smaller
            return f"{place}.downsamplers.0.conv.{kind}" if rest == f"op.{kind}" else None
    else:
        level, layer = divmod(int(index), layers + 1)
        place = f"up_blocks.{level}"
        if rest == f"conv.{kind}":
            return f"{place}.upsamplers.0.conv.{kind}"
    return _in_module(place, f"{'resnets' if part == '0' else 'attentions'}.{layer}", rest)


def _in_module(place: str, part: str, rest: str) -> str | None:
    """A weight of a residual block, whose layers have other names, or of a transformer, where all agree."""
    if part.startswith("attentions"):
        return f"{place}.{part}.{rest}"
    layer, _, kind = rest.rpartition(".")
    return f"{place}.{part}.{RESNET[layer]}.{kind}" if layer in RESNET else None


def _load_unet(state: Mapping[str, Tensor], hparams: Mapping[str, Any]) -> UNet2DConditionModel:
    config = unet_config(hparams)
    unet = UNet2DConditionModel(**config)
    renamed = {name: diffusers_name(name, config["layers_per_block"]) for name in state}
    wanted, ours = set(unet.state_dict()), {new: old for old, new in renamed.items()}
    unexpected = [old for old, new in renamed.items() if new not in wanted]
    check_weights(wanted - set(ours), unexpected, "the checkpoint's state_dict")
    try:
        unet.load_state_dict({new: state[old] for new, old in ours.items()})
    except RuntimeError as error:  # torch's message lists every tensor of another shape
        bad_value("the checkpoint's state_dict", "of the shapes of its ldm_hparams", str(error))
    return unet


def _load_vae(part: str | None) -> AutoencoderKL:
    source = part or VAE_ID
    expected = "a folder or hub id of Stable Diffusion 1.5, or of its VAE (the checkpoint has none)"
    if not Path(source).is_dir() and (source.count("/") != 1 or source.startswith((".", "/", "~"))):
        bad_value("--with", expected, repr(source), "Check the path.")
    subfolder = "" if (Path(source) / "config.json").is_file() else "vae"
    try:
        return AutoencoderKL.from_pretrained(source, subfolder=subfolder, use_safetensors=True)
    except (OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"--with must be {expected}; got {source!r}, which cannot be loaded ({reason}). "
            f"Fetch it once: hf download {VAE_ID}."
        ) from error


def recognises(checkpoint: Mapping[str, Any]) -> bool:
    """Whether a checkpoint is of this kind, by its keys."""
    return KEYS <= set(checkpoint)


def write(checkpoint: Mapping[str, Any], folder: Path, part: str | None) -> None:
    """Fill an empty folder; ``part`` is what ``--with`` names."""
    unet = _load_unet(checkpoint["state_dict"], checkpoint["ldm_hparams"])
    embedding = torch.as_tensor(checkpoint["empty_text_embedding"]).float()
    embedding = embedding.reshape(1, *embedding.shape[-2:])
    prompt = FixedPrompt(*embedding.shape[1:])
    prompt.load_state_dict({"embedding": embedding})
    pipe = DepthFMPipeline(
        unet,
        _load_vae(part),
        FlowMatchEulerDiscreteScheduler(),
        prompt,
        noising_step=int(checkpoint["noising_step"]),
    )
    pipe.save_pretrained(folder)
    write_card(
        folder,
        "mit",
        "DepthFM (CompVis/depth-fm), converted by `geodiff convert`. The VAE is that of Stable Diffusion 1.5 "
        "and the U-Net was fine-tuned from it, so its CreativeML Open RAIL-M licence applies as well.",
    )
