"""Converter of Marigold V2 (arXiv 2609.08084): base, trained checkpoint and prompt to a folder."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from diffusers import FlowMatchEulerDiscreteScheduler
from diffusers import __version__ as diffusers_version
from safetensors import safe_open
from torch import Tensor

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.cli.converters.reading import (
    read_tensor,
    rewrite_weights,
    save_weights,
    shapes_of,
    weight_files,
    write_card,
)
from geodiff_plugin.priors.loading import check_weights
from geodiff_plugin.priors.marigold_v2 import SPACE_OF_CHECKPOINT, MarigoldV2Pipeline
from geodiff_plugin.priors.pipelines.prompts import FixedPrompt
from geodiff_plugin.priors.unmerged_lora import LORA_FILE, LORA_FOLDER, LORAS
from geodiff_plugin.scale.space import SPACES

__all__ = ["MARIGOLD_V2", "Trainables", "convert_marigold_v2", "read_prompt"]

MARIGOLD_V2 = "marigold-v2"
TRAINABLES = "trainables.safetensors"
PROMPT_FOLDER, PROMPT = "qwen_text_embeddings", "qwen_edit_2509_qwen_depth_realimg512"
#: Component in the checkpoint -> folder in the base.
FOLDERS = {"Diffuser": "transformer", "VAE": "vae"}
#: Between a layer's name and that of its two factors, with and without the adapter's own name.
FACTORS = {".lora_A.default.weight": "A", ".lora_B.default.weight": "B"}
FACTORS |= {".lora_A.weight": "A", ".lora_B.weight": "B"}


@dataclass(frozen=True)
class Trainables:
    """What a checkpoint holds for one component, read tensor by tensor.

    Attributes:
        file: the checkpoint.
        factors: ``(name of the base's weight, "A" or "B")`` -> key in the file.
        whole: name of the base's weight or bias -> key of what takes its place.
    """

    file: Path
    factors: Mapping[tuple[str, str], str]
    whole: Mapping[str, str]

    @classmethod
    def of(cls, file: Path, component: str) -> Trainables:
        """Those of ``"Diffuser"`` or ``"VAE"``."""
        factors, whole = {}, {}
        with safe_open(file, "pt") as opened:
            keys = [key for key in opened.keys() if key.startswith(f"{component}.")]  # noqa: SIM118
        for key in keys:
            name = key.removeprefix(f"{component}.")
            ending = next((end for end in FACTORS if name.endswith(end)), None)
            if ending is None:
                whole[name.replace(".base_layer.", ".")] = key
            else:
                factors[name.removesuffix(ending) + ".weight", FACTORS[ending]] = key
        return cls(file, factors, whole)

    def read(self, key: str) -> Tensor:
        """One tensor of the file."""
        with safe_open(self.file, "pt") as opened:
            return opened.get_tensor(key)

    def check(self, base: Mapping[str, tuple[int, ...]]) -> None:
        """Refuse a checkpoint of another base, before anything is written.

        Args:
            base: shapes by name.

        Raises:
            ValueError: weights without a place, half a pair of factors, or of other shapes.
        """
        pairs = {name for name, _ in self.factors}
        lacking = [f"{name} of factor {f}" for name in pairs for f in "AB" if (name, f) not in self.factors]
        check_weights(lacking, (pairs | set(self.whole)) - set(base), str(self.file))
        shapes = shapes_of([self.file])
        for name in sorted(pairs):
            a, b = (shapes[self.factors[name, f]] for f in "AB")
            if len(a) != 2 or len(b) != 2 or (b[0], a[1]) != base[name] or a[0] != b[1]:
                bad_value(f"{name} in {self.file}", f"factors of a matrix {base[name]}", f"{b} times {a}")
        for name, key in self.whole.items():
            if shapes[key] != base[name]:
                bad_value(f"{name} in {self.file}", f"of shape {base[name]}", shapes[key])

    def merged(self, name: str, weight: Tensor) -> Tensor:
        """A weight of the base with what was trained: in its place, or added to it in float32.

        Alpha is the rank in every published configuration, so the product of the factors counts once.
        """
        if name in self.whole:
            weight = self.read(self.whole[name]).to(weight.dtype)
        if (name, "A") not in self.factors:
            return weight
        down, up = (self.read(self.factors[name, f]).float() for f in "AB")
        return (weight.float() + up @ down).to(weight.dtype)


def read_prompt(folder: Path) -> Tensor:
    """The first prompt of the two ``.pt`` files, without its padding: ``(1, n, C)``.

    Raises:
        ValueError: no such files, or not an embedding and its mask.
    """
    embedding, mask = (read_tensor(folder / f"{PROMPT}_prompt_{part}.pt") for part in ("embeds", "mask"))
    if embedding.ndim != 3 or mask.shape != embedding.shape[:2]:
        got = f"shapes {tuple(embedding.shape)} and {tuple(mask.shape)}"
        bad_value(str(folder), "a prompt's embedding (N, L, C) and its mask (N, L)", got)
    known = mask[0] > 0
    count = int(known.sum())
    if count == 0 or not known[:count].all():
        bad_value(f"the mask in {folder}", "of a prompt that is padded at its end", known.int().tolist())
    return embedding[:1, :count].clone()


def _trainables_file(checkpoint: Path) -> Path:
    file = checkpoint / TRAINABLES if os.path.isdir(checkpoint) else checkpoint
    if not os.path.isfile(file) or file.suffix != ".safetensors":
        expected = f"a folder of huawei-bayerlab/marigold-v2-0 with {TRAINABLES}, such as depth/Log-stage2"
        bad_value("CHECKPOINT", expected, checkpoint, "Check the path.")
    return file


def _space(file: Path, requested: str | None) -> str:
    """As requested, or as the checkpoint's folder is called."""
    if requested is not None:
        return check_choice(requested, "--space", SPACES)
    name = file.resolve().parent.name
    space = SPACE_OF_CHECKPOINT.get(name.split("-")[0].lower())
    if space is None:
        cure = "Keep the authors' folder name, or say with --space what its map is affine in."
        bad_value("CHECKPOINT", "in a folder called Log-*, Uniform-* or Disparity-*", repr(name), cure)
    return space


def _prompt_folder(file: Path, requested: str | None) -> Path:
    """As requested, or where the authors' download has it: beside ``depth/``."""
    if requested is not None:
        return Path(requested)
    for parent in file.resolve().parents:
        if (parent / PROMPT_FOLDER).is_dir():
            return parent / PROMPT_FOLDER
    cure = f"Name it: --with .../{PROMPT_FOLDER}"
    bad_value("--with", f"the folder {PROMPT_FOLDER} of huawei-bayerlab/marigold-v2-0", "none beside", cure)


def convert_marigold_v2(
    base: Path, checkpoint: Path, folder: Path, prompts: str | None, space: str | None, lora: str
) -> None:
    """Write the folder of a prior; at most one file of the base is in memory.

    Args:
        base: Qwen-Image-Edit-2509 in diffusers' layout, of which ``transformer/`` and ``vae/`` are read.
        checkpoint: folder with ``trainables.safetensors``, or that file.
        folder: an empty one to fill.
        prompts: folder of the prompt's files; ``None`` looks for it above the checkpoint.
        space: what the map is affine in; ``None`` as the checkpoint's folder says.
        lora: of ``LORAS``: merged into the base, or kept beside a copy of it.

    Raises:
        ValueError: files that are missing or do not fit each other; a space that cannot be determined.
    """
    check_choice(lora, "--lora", LORAS)
    file = _trainables_file(checkpoint)
    space, prompt = _space(file, space), read_prompt(_prompt_folder(file, prompts))
    parts = {}
    for component, name in FOLDERS.items():
        if not os.path.isfile(base / name / "config.json"):
            bad_value("BASE", f"a folder of Qwen/Qwen-Image-Edit-2509 with {name}/", base, "Check the path.")
        files, trained = weight_files(base / name, "BASE"), Trainables.of(file, component)
        trained.check(shapes_of(files))
        parts[component] = files, trained
    if not parts["Diffuser"][1].factors:
        bad_value(str(file), "a checkpoint of Marigold V2 with a LoRA (Diffuser.*.lora_A.*)", "one without")
    for component, (files, trained) in parts.items():
        target = folder / FOLDERS[component]
        target.mkdir(parents=True)
        shutil.copyfile(base / FOLDERS[component] / "config.json", target / "config.json")
        apart = component == "Diffuser" and lora != "merged"
        own = Trainables(file, {}, trained.whole) if apart else trained
        rewrite_weights(files, target, own.merged)
    if lora != "merged":
        _write_lora(parts["Diffuser"][1], folder / LORA_FOLDER)
    _write_rest(folder, prompt, space, lora)


def _write_lora(trained: Trainables, folder: Path) -> None:
    folder.mkdir()
    named = {
        name.removesuffix("weight") + f"lora_{factor}.weight": trained.read(key)
        for (name, factor), key in trained.factors.items()
    }
    save_weights(named, folder / LORA_FILE)


def _write_rest(folder: Path, prompt: Tensor, space: str, lora: str) -> None:
    """Prompt, scheduler, index and card."""
    component = FixedPrompt(*prompt.shape[1:])
    component.load_state_dict({"embedding": prompt.float()})
    component.to(prompt.dtype if prompt.is_floating_point() else torch.float32)
    component.save_pretrained(folder / "prompt")
    FlowMatchEulerDiscreteScheduler().save_pretrained(folder / "scheduler")
    index = {
        "_class_name": MarigoldV2Pipeline.__name__,
        "_diffusers_version": diffusers_version,
        "transformer": ["diffusers", "QwenImageTransformer2DModel"],
        "vae": ["diffusers", "AutoencoderKLQwenImage"],
        "scheduler": ["diffusers", "FlowMatchEulerDiscreteScheduler"],
        "prompt": [FixedPrompt.__module__, FixedPrompt.__name__],
        "prediction_type": space,
        "sample_latent": False,
        "lora": lora,
        "default_denoising_steps": 1,
        "default_processing_resolution": 768,
    }
    (folder / "model_index.json").write_text(json.dumps(index, indent=2), encoding="utf-8")
    write_card(
        folder,
        "apache-2.0",
        "Marigold V2 (huawei-bayerlab/marigold-v2-0) on Qwen-Image-Edit-2509 (Qwen), both Apache-2.0, "
        "converted by `geodiff convert marigold-v2`.",
    )
