"""What converters share: reading pickles as plain data, never code; files of safetensors; the model card."""

from __future__ import annotations

import importlib
import json
import os
import pickle
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from geodiff_plugin._checks import InputError, bad_value

__all__ = [
    "read_checkpoint",
    "read_tensor",
    "rewrite_weights",
    "save_weights",
    "shapes_of",
    "weight_files",
    "write_card",
]

INDEX = "diffusion_pytorch_model.safetensors.index.json"
_reconstruct = importlib.import_module("numpy._core.multiarray")._reconstruct

#: A numpy array in a checkpoint is rebuilt by these; files of numpy 1 call the module ``numpy.core``.
NUMPY_PARTS: list[Any] = [
    (_reconstruct, "numpy.core.multiarray._reconstruct"),
    (_reconstruct, "numpy._core.multiarray._reconstruct"),
    np.ndarray,
    np.dtype,
    *(type(np.dtype(name)) for name in ("float16", "float32", "float64", "int64")),
]


def read_checkpoint(path: str | Path) -> Mapping[str, Any]:
    """What ``torch.save`` put into a file, on the CPU; nothing in it is run.

    Args:
        path: the file.

    Returns:
        The mapping that it holds.

    Raises:
        ValueError: no such file; no checkpoint, or a damaged one; one that holds more than plain data; one
            that holds no mapping.
    """
    path = Path(path)
    if not os.path.isfile(path):
        bad_value("SRC", "a checkpoint file or a folder in diffusers' layout", path, "Check the path.")
    content = _unpickle(path)
    if not isinstance(content, Mapping):
        bad_value(str(path), "a checkpoint that holds a mapping", type(content).__name__)
    return content


def read_tensor(path: Path) -> Tensor:
    """The one tensor that ``torch.save`` put into a file, read as ``read_checkpoint`` reads.

    Raises:
        ValueError: as there; one that holds no tensor.
    """
    if not path.is_file():
        bad_value(str(path), "a file written by torch.save", "none", "Check the path.")
    content = _unpickle(path)
    if not isinstance(content, Tensor):
        bad_value(str(path), "a file that holds a tensor", type(content).__name__)
    return content


def _unpickle(path: Path) -> Any:
    try:
        with torch.serialization.safe_globals(NUMPY_PARTS):
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        if "GLOBAL" in str(error) or "Unsupported class" in str(error):
            names = _foreign_names(path)
            cure = (
                "Unpickling it would run code, which is never done: ask its authors for safetensors, or, "
                "if you trust it, save its weights anew without those objects."
            )
            bad_value(str(path), "a checkpoint of tensors, numbers and text", f"one with {names}", cure)
        _no_checkpoint(path, error, "it is no pickle of weights")  # torch's own advice is to run its code
    except (RuntimeError, EOFError, KeyError, ValueError, OSError) as error:
        _no_checkpoint(path, error, (str(error).splitlines() or [type(error).__name__])[0])


def _no_checkpoint(path: Path, error: Exception, reason: str) -> NoReturn:
    raise InputError(
        f"{path} must be a checkpoint written by torch.save; got one that cannot be read ({reason}). "
        "Fetch it anew and compare its size with the original's."
    ) from error


def _foreign_names(path: Path) -> str:
    try:
        with torch.serialization.safe_globals(NUMPY_PARTS):
            return ", ".join(sorted(torch.serialization.get_unsafe_globals_in_checkpoint(path)))
    except (RuntimeError, ValueError):  # files from before PyTorch 1.6 cannot be listed
        return "other objects"


def weight_files(folder: Path, name: str) -> list[Path]:
    """The safetensors of a component.

    Args:
        folder: of the component.
        name: of the argument that it came from, for the message.

    Raises:
        ValueError: none there; an index that names a file which is not.
    """
    index = folder / INDEX
    if index.is_file():
        files = [folder / f for f in sorted(set(json.loads(index.read_text("utf-8"))["weight_map"].values()))]
    else:
        files = sorted(folder.glob("*.safetensors"))
    missing = [file.name for file in files if not file.is_file()]
    if missing or not files:
        got = f"one without {', '.join(missing)}" if missing else "one without"
        bad_value(name, f"a folder with safetensors in {folder}", got, "Fetch it anew.")
    return files


def shapes_of(files: list[Path]) -> dict[str, tuple[int, ...]]:
    """Shape of every tensor by its name, read from the headers alone."""
    found = {}
    for file in files:
        with safe_open(file, "pt") as opened:
            for name in opened.keys():  # noqa: SIM118 - no mapping
                found[name] = tuple(opened.get_slice(name).get_shape())
    return found


def rewrite_weights(files: list[Path], folder: Path, change: Callable[[str, Tensor], Tensor]) -> None:
    """Write the weights of a component anew, file by file, with at most one of them in memory.

    Args:
        files: of the component, by ``weight_files``.
        folder: an existing one to fill; the names stay, so that their index does too.
        change: a tensor of that name to another of its shape and dtype.
    """
    for file in files:
        with safe_open(file, "pt") as opened:
            names = list(opened.keys())
            save_weights({name: change(name, opened.get_tensor(name)) for name in names}, folder / file.name)
    index = files[0].parent / INDEX
    if index.is_file():
        shutil.copyfile(index, folder / INDEX)


def save_weights(state: Mapping[str, Tensor], path: Path) -> None:
    """Write safetensors, which refuse tensors that share memory (tied weights) or have gaps."""
    apart = {name: value.clone(memory_format=torch.contiguous_format) for name, value in state.items()}
    save_file(apart, path, metadata={"format": "pt"})


def write_card(folder: Path, licence: str, text: str) -> None:
    """``README.md`` with the licence where it is looked for on load.

    Args:
        folder: of the weights.
        licence: its identifier, such as ``"mit"``.
        text: where the weights come from, a sentence or two.
    """
    (folder / "README.md").write_text(f"---\nlicense: {licence}\n---\n\n{text}\n", encoding="utf-8")
