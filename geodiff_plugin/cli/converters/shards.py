"""Copies a sharded network tensor by tensor, changing some, with at most one new shard in memory.

Data flow: a folder of safetensors, ``name, tensor -> tensor`` -> a folder of safetensors of our own shards.
Paper: none.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from geodiff_plugin._checks import bad_value

__all__ = ["SHARD_BYTES", "rewrite_shards", "shapes_of", "weight_files"]

#: Most bytes of a new shard, and so of what is held at a time.
SHARD_BYTES = 2_000_000_000
STEM = "diffusion_pytorch_model"
BYTES = {"F64": 8, "F32": 4, "BF16": 2, "F16": 2, "I64": 8, "I32": 4, "I8": 1, "U8": 1, "BOOL": 1}


def weight_files(folder: Path, name: str) -> list[Path]:
    """The safetensors of a component.

    Args:
        folder: of the component.
        name: of the argument that it came from, for the message.

    Raises:
        ValueError: none there; an index that names a file which is not.
    """
    index = folder / f"{STEM}.safetensors.index.json"
    if index.is_file():
        files = [folder / f for f in sorted(set(json.loads(index.read_text("utf-8"))["weight_map"].values()))]
    else:
        files = sorted(folder.glob("*.safetensors"))
    missing = [file.name for file in files if not file.is_file()]
    if missing or not files:
        got = f"one without {', '.join(missing)}" if missing else "one without"
        bad_value(name, f"a folder with safetensors in {folder}", got, "Fetch it anew.")
    return files


def shapes_of(files: list[Path]) -> dict[str, tuple[Path, tuple[int, ...], int]]:
    """Name -> file, shape and bytes of every tensor, read from the headers alone."""
    found = {}
    for file in files:
        with safe_open(file, "pt") as opened:
            for name in opened.keys():  # noqa: SIM118 - no mapping
                part = opened.get_slice(name)
                shape, size = tuple(part.get_shape()), BYTES[part.get_dtype()]
                for side in shape:
                    size *= side
                found[name] = (file, shape, size)
    return found


def _plan(sizes: dict[str, int]) -> list[list[str]]:
    """Names by shard, in their order, each shard of at most ``SHARD_BYTES`` unless one tensor is more."""
    shards: list[list[str]] = [[]]
    held = 0
    for name, size in sizes.items():
        if shards[-1] and held + size > SHARD_BYTES:
            shards.append([])
            held = 0
        shards[-1].append(name)
        held += size
    return shards


def rewrite_shards(files: list[Path], folder: Path, change: Callable[[str, Tensor], Tensor]) -> None:
    """Write the weights of a component anew.

    Args:
        files: of the component.
        folder: an existing one to fill; the names are those that diffusers looks for.
        change: a tensor of that name to another of its shape and dtype.
    """
    known = shapes_of(files)
    shards = _plan({name: size for name, (_, _, size) in known.items()})
    weight_map: dict[str, str] = {}
    for i, names in enumerate(shards):
        suffix = "" if len(shards) == 1 else f"-{i + 1:05d}-of-{len(shards):05d}"
        target, held = f"{STEM}{suffix}.safetensors", {}
        for file in dict.fromkeys(known[name][0] for name in names):
            with safe_open(file, "pt") as opened:
                for name in (n for n in names if known[n][0] == file):
                    held[name] = change(name, opened.get_tensor(name)).contiguous()
        save_file(held, folder / target, metadata={"format": "pt"})
        weight_map |= dict.fromkeys(names, target)
    if len(shards) > 1:
        index = {
            "metadata": {"total_size": sum(size for _, _, size in known.values())},
            "weight_map": weight_map,
        }
        (folder / f"{STEM}.safetensors.index.json").write_text(json.dumps(index, indent=2), encoding="utf-8")
