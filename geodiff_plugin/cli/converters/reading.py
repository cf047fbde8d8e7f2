"""Safe reading of pickled checkpoints: tensors, numbers and text, never code.

Data flow: .ckpt, .pth, .pt or .bin -> what was saved in it.
Paper: none.
"""

from __future__ import annotations

import importlib
import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._checks import InputError, bad_value

__all__ = ["read_checkpoint", "read_tensor"]

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
