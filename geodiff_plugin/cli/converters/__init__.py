"""Converters of published checkpoints, one kind a file, and what they share; ``cli.convert`` names them."""

from __future__ import annotations

import importlib
import os
import pickle
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.components import FixedPrompt

_reconstruct = importlib.import_module("numpy._core.multiarray")._reconstruct
#: A numpy array in a checkpoint is rebuilt by these; files of numpy 1 call the module ``numpy.core``.
NUMPY_PARTS: list[Any] = [
    (_reconstruct, "numpy.core.multiarray._reconstruct"),
    (_reconstruct, "numpy._core.multiarray._reconstruct"),
    np.ndarray,
    np.dtype,
    *(type(np.dtype(name)) for name in ("float16", "float32", "float64", "int64")),
]


def read_checkpoint(path: Path, kind: type[Any] = Mapping) -> Any:
    """What ``torch.save`` put into a file, on the CPU: a mapping, or a ``kind``; nothing in it is run."""
    if not os.path.isfile(path):
        bad_value("SRC", "a checkpoint file or a folder in diffusers' layout", path, "Check the path.")
    try:
        with torch.serialization.safe_globals(NUMPY_PARTS):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, ValueError, OSError) as error:
        got = "one that cannot be read (is it cut off?)"  # torch's own advice may be to run its code
        cure = "Fetch it anew and compare its size with the original's."
        if "GLOBAL" in str(error) or "Unsupported class" in str(error):
            got = "one that cannot be read (it holds more than tensors, numbers and text)"
            cure = "Unpickling it would run code, which is never done: ask its authors for safetensors."
        bad_value(str(path), "a checkpoint written by torch.save", got, cure)
    if not isinstance(content, kind):
        bad_value(str(path), f"a checkpoint that holds a {kind.__name__.lower()}", type(content).__name__)
    return content


def renamed(state: Mapping[str, Any], table: Sequence[tuple[str, str]], prefix: str = "") -> dict[str, Any]:
    """The weights whose names start with ``prefix``, without it, renamed by regular expressions in order."""
    result = {}
    for key in state:
        if str(key).startswith(prefix):
            name = str(key).removeprefix(prefix)
            for pattern, replacement in table:
                name = re.sub(pattern, replacement, name)
            result[name] = state[key]
    return result


def save_weights(state: Mapping[str, Tensor], path: Path) -> None:
    """Write safetensors, which refuse tensors that share memory (tied weights) or have gaps."""
    apart = {name: value.clone(memory_format=torch.contiguous_format) for name, value in state.items()}
    save_file(apart, path, metadata={"format": "pt"})


def fixed_prompt(embedding: Tensor) -> FixedPrompt:
    """The component that holds a prompt's embedding ``(1, n, C)``."""
    prompt = FixedPrompt(*embedding.shape[1:])
    prompt.load_state_dict({"embedding": embedding.float()})
    return prompt


def write_card(folder: Path, licence: str, text: str) -> None:
    """``README.md``: the licence where it is looked for on load, and where the weights come from."""
    (folder / "README.md").write_text(f"---\nlicense: {licence}\n---\n\n{text}\n", encoding="utf-8")
