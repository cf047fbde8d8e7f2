"""A LoRA kept apart from its base, since a base in 4 bits cannot be merged with it.

Source: LoRA, arXiv 2106.09685; NF4, arXiv 2305.14314.

``peft`` puts it on, ``bitsandbytes`` holds 4-bit weights; both are extras of the package.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import torch
from diffusers import BitsAndBytesConfig, QwenImageTransformer2DModel
from safetensors.torch import load_file

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.loading import check_weights, load_component

__all__ = [
    "LORAS",
    "LORA_FILE",
    "LORA_FOLDER",
    "SKIPPED",
    "check_extras",
    "has_lora",
    "load_with_lora",
]

#: Merged into the base; beside a base as its files have it; beside a base that is loaded in 4 bits.
LORAS = ("merged", "apart", "4bit")
LORA_FOLDER, LORA_FILE = "lora", "lora.safetensors"
#: Not quantised, as in the authors' runs.
SKIPPED = ["transformer_blocks.0.img_mod"]
DOWN, UP = ".lora_A.weight", ".lora_B.weight"


def check_extras(lora: str) -> None:
    """Refuse what this machine cannot load, before 40 GB are read.

    Args:
        lora: of ``LORAS``.

    Raises:
        ValueError: no peft; for ``"4bit"`` no CUDA device or no bitsandbytes.
    """
    if lora == "4bit" and not torch.cuda.is_available():
        cure = "bitsandbytes computes with 4-bit weights on CUDA alone; convert with --lora merged or apart."
        bad_value("the device", "a CUDA device for a base in 4 bits", "none", cure)
    needed = {"merged": (), "apart": ("peft",), "4bit": ("peft", "bitsandbytes")}[lora]
    for package in needed:
        if find_spec(package) is None:
            cure = f'pip install "geodiff-plugin[{package}]", or convert with --lora merged.'
            bad_value("the environment", f"one with {package} for a LoRA kept apart", "none", cure)


def has_lora(transformer: Any) -> bool:
    """Whether an adapter of peft is on it."""
    return bool(getattr(transformer, "peft_config", None))


def load_with_lora(layout: Layout, dtype: torch.dtype) -> QwenImageTransformer2DModel:
    """The transformer of a folder with the LoRA that lies beside it.

    Args:
        layout: of a folder that ``geodiff convert marigold-v2 ... --lora apart`` (or ``4bit``) wrote.
        dtype: of the base, or what a base in 4 bits computes in.

    Raises:
        ValueError: no peft, no bitsandbytes, no CUDA device; weights that do not fit.
    """
    lora = layout.index.get("lora", "apart")
    check_extras(lora)
    base = load_component(
        layout, "transformer", QwenImageTransformer2DModel, dtype, _quantisation(lora, dtype)
    )
    file = layout.folder / LORA_FOLDER / LORA_FILE
    state = load_file(file)
    from peft import LoraConfig

    targets = sorted(name.removesuffix(DOWN) for name in state if name.endswith(DOWN))
    if not targets:
        bad_value(str(file), f"a LoRA with weights called *{DOWN}", "none of that name")
    rank = state[targets[0] + DOWN].shape[0]
    base.add_adapter(LoraConfig(r=rank, lora_alpha=rank, target_modules=targets))
    named = {name.replace(".weight", ".default.weight"): value.to(dtype) for name, value in state.items()}
    wanted = {name for name, _ in base.named_parameters() if ".lora_" in name}
    check_weights(wanted - set(named), set(named) - wanted, str(file))
    base.load_state_dict(named, strict=False)
    return base.to(dtype).eval() if lora == "apart" else base.eval()


def _quantisation(lora: str, dtype: torch.dtype) -> dict[str, Any]:
    if lora != "4bit":
        return {}
    return {
        "quantization_config": BitsAndBytesConfig(
            load_in_4bit=True,
            bnb_4bit_quant_type="nf4",
            bnb_4bit_compute_dtype=dtype,
            llm_int8_skip_modules=SKIPPED,
        )
    }
