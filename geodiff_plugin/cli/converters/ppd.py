"""Converter of ``ppd.pth``: a transformer on pixels, with the encoder of Depth Anything V2 Large."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusers import FlowMatchEulerDiscreteScheduler
from safetensors.torch import load_file
from torch import Tensor
from transformers import Dinov2Config, Dinov2Model

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.converters import read_checkpoint, renamed, save_weights, write_card
from geodiff_plugin.priors.loading import Layout, check_weights, load_component
from geodiff_plugin.priors.ppd import PixelDiT, PPDPipeline

TRANSFORMER, IN_CHECKPOINT, IN_FILE, IN_FOLDER = "dit.", "sem_encoder.pretrained.", "pretrained.", "backbone."
#: The same weights as depth_anything_v2_vitl.pth, as transformers has them.
ENCODER_ID = "depth-anything/Depth-Anything-V2-Large-hf"
ENCODER_FILE = "depth_anything_v2_vitl.pth"
#: Every DINOv2 has heads of this width.
HEAD_SIZE = 64
#: Depth Anything's names of its encoder's weights -> those of transformers, but for ``qkv``, three there.
ENCODER_NAMES = (
    (r"^(cls_token|mask_token)$", r"embeddings.\1"),
    (r"^pos_embed$", "embeddings.position_embeddings"),
    (r"^patch_embed\.proj\.", "embeddings.patch_embeddings.projection."),
    (r"^norm\.", "layernorm."),
    (r"^blocks\.", "encoder.layer."),
    (r"\.attn\.proj\.", ".attention.output.dense."),
    (r"\.attn\.qkv\.", ".attention.attention.qkv."),
    (r"\.ls([12])\.gamma$", r".layer_scale\1.lambda1"),
)


def _encoder_in_transformers_names(state: Mapping[str, Any], prefix: str) -> dict[str, Tensor]:
    result: dict[str, Tensor] = {}
    for name, value in renamed(state, ENCODER_NAMES, prefix).items():
        if ".qkv." in name:
            parts = zip(("query", "key", "value"), value.chunk(3), strict=True)
            result |= {name.replace("qkv", part): third for part, third in parts}
        else:
            result[name] = value
    return result


def _encoder_state(checkpoint: Mapping[str, Any], part: str | None) -> dict[str, Tensor]:
    """The encoder in transformers' names: out of the checkpoint itself, or what ``--with`` names."""
    source, state = Path(part or ""), {}
    if part is None:
        state = _encoder_in_transformers_names(checkpoint, IN_CHECKPOINT)
    elif source.is_file():
        state = _encoder_in_transformers_names(read_checkpoint(source), IN_FILE)
    elif (source / "model.safetensors").is_file():
        state = renamed(load_file(source / "model.safetensors"), (), IN_FOLDER)
    if not state:
        expected = f"{ENCODER_FILE} or a folder of {ENCODER_ID}: the encoder whose tokens ppd.pth needs"
        cure = f"Fetch it once: hf download {ENCODER_ID} --local-dir da2. ppd_moge.pth needs another."
        bad_value("--with", expected, part or "nothing", cure)
    return state


def _load_encoder(state: dict[str, Tensor], where: str) -> Dinov2Model:
    """The encoder, of the size that its weights have, every one of them in its place."""
    try:
        width = state["embeddings.cls_token"].shape[-1]
        patch = state["embeddings.patch_embeddings.projection.weight"].shape[-1]
        positions = state["embeddings.position_embeddings"].shape[1] - 1
        hidden = state["encoder.layer.0.mlp.fc1.weight"].shape[0]
    except KeyError as error:
        bad_value(where, "the weights of a DINOv2 encoder", f"none called {error}")
    layers = {hit[1] for name in state if (hit := re.match(r"encoder\.layer\.(\d+)\.", name))}
    config = Dinov2Config(
        hidden_size=width,
        num_hidden_layers=len(layers),
        num_attention_heads=width // HEAD_SIZE,
        mlp_ratio=hidden // width,
        image_size=round(positions**0.5) * patch,
        patch_size=patch,
        use_mask_token="embeddings.mask_token" in state,
    )
    with tempfile.TemporaryDirectory() as folder:
        # Through a file: transformers renames on loading, and which names are its own differs by its version.
        save_weights({name: v.float() for name, v in state.items()}, Path(folder) / "model.safetensors")
        text = json.dumps(config.to_dict() | {"architectures": ["Dinov2Model"]})
        (Path(folder) / "config.json").write_text(text, encoding="utf-8")
        return load_component(Layout(Path(folder), where), "", Dinov2Model, torch.float32)


def _load_transformer(state: Mapping[str, Tensor]) -> PixelDiT:
    """The transformer, of the size that its weights have."""
    try:
        width, _, side, _ = state["x_embedder.proj.weight"].shape
        head_size = state["blocks.0.attn.q_norm.weight"].shape[0]
        fusion = state["proj_fusion.0.weight"].shape[1]
        hidden = state["blocks.0.mlp.fc1.weight"].shape[0]
    except KeyError as error:
        bad_value("the checkpoint", "the weights of Pixel-Perfect Depth", f"none called dit.{error.args[0]}")
    blocks = {name.split(".")[1] for name in state if name.startswith("blocks.")}
    dit = PixelDiT(width, len(blocks), width // head_size, side // 2, fusion - width, hidden / width)
    wanted = set(dit.state_dict())
    check_weights(wanted - set(state), set(state) - wanted, "the checkpoint")
    dit.load_state_dict(state)
    return dit.eval()


def recognises(checkpoint: Mapping[str, Any]) -> bool:
    """Whether a checkpoint is of this kind, by its keys."""
    return {f"{TRANSFORMER}x_embedder.proj.weight", f"{TRANSFORMER}proj_fusion.0.weight"} <= set(checkpoint)


def write(checkpoint: Mapping[str, Any], folder: Path, part: str | None) -> None:
    """Fill an empty folder; ``part`` is what ``--with`` names."""
    dit = _load_transformer(renamed(checkpoint, (), TRANSFORMER))
    encoder = _load_encoder(_encoder_state(checkpoint, part), part or "the checkpoint")
    if encoder.config.hidden_size != dit.config.semantic_size:
        expected = f"{dit.config.semantic_size} wide, as the checkpoint's tokens"
        got = f"{encoder.config.hidden_size} wide, another size of Depth Anything V2"
        bad_value("the encoder of --with", expected, got)
    PPDPipeline(dit, encoder, FlowMatchEulerDiscreteScheduler()).save_pretrained(folder)
    write_card(
        folder,
        "cc-by-nc-4.0",
        "Pixel-Perfect Depth (gangweix/pixel-perfect-depth, Apache-2.0), converted by `geodiff convert`. "
        "The encoder of Depth Anything V2 Large, without which it cannot run, is CC-BY-NC-4.0.",
    )
