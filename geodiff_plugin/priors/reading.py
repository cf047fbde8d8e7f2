"""Turns errors of the libraries that read weights into one-sentence errors.

Data flow: whatever diffusers, transformers and safetensors raise over a folder
    -> ``ValueError`` that names it.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from safetensors import SafetensorError

from geodiff_plugin._checks import bad_value

__all__ = ["check_device", "check_finite", "reading"]

#: What the libraries are known to raise over a damaged or foreign folder.
ERRORS = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    ImportError,
    RuntimeError,  # RecursionError and torch's are among them
    SafetensorError,
)
LONGEST_REASON = 200


def _reason(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    text = lines[0] if lines else type(error).__name__
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]}..."


@contextmanager
def reading(what: str, expected: str, got: str, cure: str) -> Iterator[None]:
    """Turn an error of a library into one sentence.

    Args:
        what: is read, the subject of the sentence.
        expected: of it.
        got: came instead; the library's own first line is added.
        cure: what to do.

    Raises:
        ValueError: in the place of anything in ``ERRORS``.
    """
    try:
        yield
    except ERRORS as error:
        reason = _reason(error)
    else:
        return
    bad_value(what, expected, f"{got} ({reason})", cure)


def check_finite(module: torch.nn.Module, where: str | Path) -> None:
    """Refuse weights with NaN or infinity in them, naming the first.

    Raises:
        ValueError: there is any.
    """
    for name, weight in module.named_parameters():
        if weight.numel() and weight.is_floating_point() and weight.device.type != "meta":
            low, high = weight.detach().aminmax()  # one pass; NaN comes through
            if not bool(torch.isfinite(low) & torch.isfinite(high)):
                cure = "The file is damaged, or was trained or converted so: fetch it anew."
                bad_value(f"weights in {where}", "finite", f"NaN or infinity in {name}", cure)


def check_device(device: str | torch.device) -> torch.device:
    """A device that this machine has.

    Raises:
        ValueError: it has not.
    """
    try:
        found = torch.device(device)
        torch.empty(1, device=found)
    except (RuntimeError, AssertionError, NotImplementedError, TypeError) as error:
        reason = _reason(error)
    else:
        return found
    bad_value("device", "one that PyTorch has on this machine", f"{str(device)!r} ({reason})", "Try 'cpu'.")
