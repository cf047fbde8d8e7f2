"""Converter of folders whose weights are pickled ``.bin`` files.

Data flow: .bin files -> .safetensors of the names that diffusers and transformers look for; text files are
    copied.
Paper: none.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.converters.reading import read_checkpoint

__all__ = ["convert_folder"]

#: What is copied beside weights: configs, vocabularies, licences.
COPIED = (".json", ".txt", ".md", ".model", ".safetensors")


def _safe_name(name: str) -> str:
    """Of ``pytorch_model.bin`` (transformers) or ``diffusion_pytorch_model.bin`` (diffusers), or a shard."""
    name = name.replace(".bin", ".safetensors")
    return name.replace("pytorch_model", "model") if name.startswith("pytorch_model") else name


def convert_folder(source: Path, folder: Path) -> None:
    """Write the same folder with safetensors.

    Args:
        source: of one component or several.
        folder: an empty one to fill.

    Raises:
        ValueError: no .bin file in it, or one that cannot be read.
    """
    if not any(source.rglob("*.bin")):
        cure = "One with .safetensors needs no conversion: give it to --prior."
        bad_value(
            "SRC", "a checkpoint file, or a folder with .bin weights", f"the folder {source} without", cure
        )
    for path in sorted(p for p in source.rglob("*") if p.is_file()):
        target = folder / path.relative_to(source)
        safe = target.with_name(_safe_name(path.name))
        if path.suffix == ".bin":
            if not (source / safe.relative_to(folder)).is_file():  # else it is copied
                safe.parent.mkdir(parents=True, exist_ok=True)
                save_file(_own_memory(read_checkpoint(path)), safe, metadata={"format": "pt"})
        elif path.name.endswith(".bin.index.json"):
            index = json.loads(path.read_text(encoding="utf-8"))
            index["weight_map"] = {key: _safe_name(name) for key, name in index["weight_map"].items()}
            safe.parent.mkdir(parents=True, exist_ok=True)
            safe.write_text(json.dumps(index, indent=2), encoding="utf-8")
        elif path.suffix in COPIED or path.name.upper().startswith("LICEN"):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)


def _own_memory(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Safetensors refuses tensors that share memory (tied weights) or have gaps."""
    return {name: value.clone(memory_format=torch.contiguous_format) for name, value in state.items()}
