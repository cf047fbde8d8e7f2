"""Converter of ``ppd.pth``: a transformer on pixels, with the encoder of Depth Anything V2 Large."""

from __future__ import annotations

import json
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
from geodiff_plugin.cli.converters import renamed, save_weights, write_card
from geodiff_plugin.priors.loading import Layout, check_weights, load_component, reading
from geodiff_plugin.priors.ppd import PixelDiT, PPDPipeline

TRANSFORMER = "dit."
KEYS = {
    f"{TRANSFORMER}{name}.weight"
    for name in ("x_embedder.proj", "blocks.0.attn.q_norm", "blocks.0.mlp.fc1", "proj_fusion.0")
}
#: The encoder whose tokens the transformer takes, of Depth Anything V2 Large, as transformers has it.
ENCODER_ID, BACKBONE = "depth-anything/Depth-Anything-V2-Large-hf", "backbone."
SIZES = ("hidden_size", "num_hidden_layers", "num_attention_heads", "mlp_ratio", "image_size", "patch_size")


def _load_encoder(part: str | None) -> Dinov2Model:
    """The encoder out of the folder that ``--with`` names, every weight in its place."""
    source = Path(part or "")
    config, weights = source / "config.json", source / "model.safetensors"
    expected = f"a folder of {ENCODER_ID}: the encoder whose tokens ppd.pth needs"
    cure = f"Fetch it once: hf download {ENCODER_ID} --local-dir da2. ppd_moge.pth needs another."
    if not (config.is_file() and weights.is_file()):
        bad_value("--with", expected, part or "nothing", cure)
    with reading("--with", expected, str(source), cure):
        backbone = json.loads(config.read_text(encoding="utf-8"))["backbone_config"]
        sizes = {name: backbone[name] for name in SIZES if name in backbone}
        state = renamed(load_file(weights), (), BACKBONE)
    with tempfile.TemporaryDirectory() as folder:
        # Through a file: transformers renames on loading, and which names are its own differs by its version.
        save_weights({name: v.float() for name, v in state.items()}, Path(folder) / "model.safetensors")
        Dinov2Config(**sizes, architectures=["Dinov2Model"]).save_pretrained(folder)
        return load_component(Layout(Path(folder), str(source)), "", Dinov2Model, torch.float32)


def _load_transformer(state: Mapping[str, Tensor]) -> PixelDiT:
    """The transformer, of the size that its weights have."""
    width, _, side, _ = state["x_embedder.proj.weight"].shape
    head_size = state["blocks.0.attn.q_norm.weight"].shape[0]
    fusion = state["proj_fusion.0.weight"].shape[1]
    hidden = state["blocks.0.mlp.fc1.weight"].shape[0]
    blocks = {name.split(".")[1] for name in state if name.startswith("blocks.")}
    dit = PixelDiT(width, len(blocks), width // head_size, side // 2, fusion - width, hidden / width)
    wanted = set(dit.state_dict())
    check_weights(wanted - set(state), set(state) - wanted, "the checkpoint")
    dit.load_state_dict(state)
    return dit.eval()


def write(checkpoint: Mapping[str, Any], folder: Path, part: str | None) -> None:
    """Fill an empty folder; ``part`` is what ``--with`` names."""
    dit = _load_transformer(renamed(checkpoint, (), TRANSFORMER))
    encoder = _load_encoder(part)
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
