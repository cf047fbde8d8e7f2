"""Converter of Marigold V2 (arXiv 2609.08084): base, trained checkpoint and prompt to a folder."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusers import FlowMatchEulerDiscreteScheduler
from diffusers import __version__ as diffusers_version
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.converters import fixed_prompt, read_checkpoint, renamed, save_weights, write_card
from geodiff_plugin.priors.components import FixedPrompt
from geodiff_plugin.priors.loading import check_weights
from geodiff_plugin.priors.marigold_v2 import SPACE_OF_CHECKPOINT, MarigoldV2Pipeline

MARIGOLD_V2 = "marigold-v2"
TRAINABLES = "trainables.safetensors"
PROMPT_FOLDER, PROMPT = "qwen_text_embeddings", "qwen_edit_2509_qwen_depth_realimg512"
INDEX = "diffusion_pytorch_model.safetensors.index.json"
#: What loads the parts that are written, but for the space; they are never in memory together.
INDEX_OF_PRIOR: dict[str, Any] = {
    "_class_name": MarigoldV2Pipeline.__name__,
    "_diffusers_version": diffusers_version,
    "transformer": ["diffusers", "QwenImageTransformer2DModel"],
    "vae": ["diffusers", "AutoencoderKLQwenImage"],
    "scheduler": ["diffusers", "FlowMatchEulerDiscreteScheduler"],
    "prompt": [FixedPrompt.__module__, FixedPrompt.__name__],
    "sample_latent": False,
    "default_denoising_steps": 1,
    "default_processing_resolution": 768,
}
#: Component in the checkpoint -> folder in the base.
FOLDERS = {"Diffuser": "transformer", "VAE": "vae"}
#: Names in the checkpoint -> those in the base, of a LoRA's factors with ``" A"`` or ``" B"`` behind.
NAMES = ((r"\.base_layer\.", "."), (r"\.lora_([AB])(\.default)?\.weight$", r".weight \1"))


def merged(name: str, weight: Tensor, trained: Mapping[str, Tensor]) -> Tensor:
    """A weight of the base with what was trained: in its place, or added to it in float32.

    Alpha is the rank in every published configuration, so the product of the factors counts once.
    """
    weight = trained.get(name, weight).to(weight.dtype)
    if f"{name} A" not in trained:
        return weight
    return (weight.float() + trained[f"{name} B"].float() @ trained[f"{name} A"].float()).to(weight.dtype)


def _check_trained(trained: Mapping[str, Tensor], base: set[str], where: str) -> None:
    """Refuse a checkpoint of another base, by names, before anything is written."""
    factored = {name[:-2] for name in trained if " " in name}
    lacking = [f"{name} of factor {f}" for name in factored for f in "AB" if f"{name} {f}" not in trained]
    check_weights(lacking, {name.partition(" ")[0] for name in trained} - base, where)


def _base_files(base: Path, name: str) -> tuple[list[Path], set[str]]:
    """The safetensors of a component of the base, and the names of their tensors."""
    folder = base / name
    if not os.path.isfile(folder / "config.json"):
        bad_value("BASE", f"a folder of Qwen/Qwen-Image-Edit-2509 with {name}/", base, "Check the path.")
    names = {path.name for path in folder.glob("*.safetensors")}
    if (folder / INDEX).is_file():
        names = set(json.loads((folder / INDEX).read_text("utf-8"))["weight_map"].values())
    files = [folder / file for file in sorted(names)]
    missing = [file.name for file in files if not file.is_file()]
    if missing or not files:
        got = f"one without {', '.join(missing)}" if missing else "one without"
        bad_value("BASE", f"a folder with safetensors in {folder}", got, "Fetch it anew.")
    tensors = set[str]()
    for file in files:
        with safe_open(file, "pt") as opened:
            tensors |= set(opened.keys())
    return files, tensors


def read_prompt(folder: Path) -> Tensor:
    """The first prompt of the two ``.pt`` files, without its padding: ``(1, n, C)``."""
    files = (folder / f"{PROMPT}_prompt_{part}.pt" for part in ("embeds", "mask"))
    embedding, mask = (read_checkpoint(file, Tensor) for file in files)
    return embedding[:1, mask[0] > 0]


def _space(file: Path, requested: str | None) -> str:
    """As requested, or as the checkpoint's folder is called."""
    name = file.resolve().parent.name
    space = requested or SPACE_OF_CHECKPOINT.get(name.split("-")[0].lower())
    if space is None:
        cure = "Keep the authors' folder name, or say with --space what its map is affine in."
        bad_value("CHECKPOINT", "in a folder called Log-*, Uniform-* or Disparity-*", repr(name), cure)
    return space


def _prompt_folder(file: Path, requested: str | None) -> Path:
    """As requested, or where the authors' download has it: beside ``depth/``."""
    beside = [parent / PROMPT_FOLDER for parent in file.resolve().parents]
    for folder in beside if requested is None else [Path(requested)]:
        if folder.is_dir():
            return folder
    expected = f"the folder {PROMPT_FOLDER} of huawei-bayerlab/marigold-v2-0"
    bad_value("--with", expected, requested or "none beside", f"Name it: --with .../{PROMPT_FOLDER}")


def convert_marigold_v2(
    base: Path, checkpoint: Path, folder: Path, prompts: str | None, space: str | None
) -> None:
    """Write the folder of a prior; at most one file of the base is in memory.

    Of the base, Qwen-Image-Edit-2509 in diffusers' layout, ``transformer/`` and ``vae/`` are read; the
    checkpoint is a folder with ``trainables.safetensors``, or that file.
    """
    file = checkpoint / TRAINABLES if os.path.isdir(checkpoint) else checkpoint
    if not os.path.isfile(file) or file.suffix != ".safetensors":
        expected = f"a folder of huawei-bayerlab/marigold-v2-0 with {TRAINABLES}, such as depth/Log-stage2"
        bad_value("CHECKPOINT", expected, checkpoint, "Check the path.")
    space, prompt = _space(file, space), read_prompt(_prompt_folder(file, prompts))
    state = load_file(file)
    trained = {part: renamed(state, NAMES, f"{part}.") for part in FOLDERS}
    files = {}
    for part, name in FOLDERS.items():
        files[name], tensors = _base_files(base, name)
        _check_trained(trained[part], tensors, str(file))
    if not any(name.endswith(" A") for name in trained["Diffuser"]):
        bad_value(str(file), "a checkpoint of Marigold V2 with a LoRA (Diffuser.*.lora_A.*)", "one without")
    for part, name in FOLDERS.items():
        (folder / name).mkdir(parents=True)
        for copied in ("config.json", INDEX):
            if (base / name / copied).is_file():
                shutil.copyfile(base / name / copied, folder / name / copied)
        for source in files[name]:
            whole = {key: merged(key, v, trained[part]) for key, v in load_file(source).items()}
            save_weights(whole, folder / name / source.name)
    component = fixed_prompt(prompt)
    component.to(prompt.dtype if prompt.is_floating_point() else torch.float32)
    component.save_pretrained(folder / "prompt")
    FlowMatchEulerDiscreteScheduler().save_pretrained(folder / "scheduler")
    index = INDEX_OF_PRIOR | {"prediction_type": space}
    (folder / "model_index.json").write_text(json.dumps(index, indent=2), encoding="utf-8")
    write_card(
        folder,
        "apache-2.0",
        "Marigold V2 (huawei-bayerlab/marigold-v2-0) on Qwen-Image-Edit-2509 (Qwen), both Apache-2.0, "
        "converted by `geodiff convert marigold-v2`.",
    )
