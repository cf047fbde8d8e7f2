"""Gradients through networks of half precision: a power of two per sample in, the same power out.

Data flow: gradient of the loss in a decoded map, float32 -> gradient in the latent, float32.
Paper: the gradients of Algorithm 1 and Eq. 15 (eq:final_score).

The loss is a mean, so a gradient in one pixel may be below float16's least number (a mean over a whole image)
or, scaled by any constant that lifts it, above its greatest (a mean over a handful of known points).
"""

from __future__ import annotations

import torch
from torch import Tensor

from geodiff_plugin._checks import bad_value

__all__ = ["FiniteWatch", "pull_back"]


def pull_back(output: Tensor, source: Tensor, gradient: Tensor) -> Tensor:
    """The gradient in ``source`` of a loss whose gradient in ``output`` is known; frees the graph between.

    Args:
        output: ``(B, ...)`` with its graph to ``source``.
        source: ``(B, ...)`` float32 or wider, requires a gradient.
        gradient: as ``output``, float32 or wider.

    Returns:
        As ``source``. Between the two, the largest entry of every sample is between 1/2 and 1. The factor is
        a power of two, so that in float32 the result is what it would be without it.
    """
    largest = gradient.detach().abs().flatten(1).amax(1)
    unit = torch.ldexp(torch.ones_like(largest), torch.frexp(largest).exponent)
    scaled = gradient / unit.view(-1, *([1] * (gradient.ndim - 1)))
    (pulled,) = torch.autograd.grad(output, source, scaled.to(output.dtype))
    return pulled * unit.view(-1, *([1] * (pulled.ndim - 1))).to(pulled.dtype)


class FiniteWatch:
    """Remembers which tensors of a trajectory were finite, on their device, and is asked once at the end."""

    def __init__(self) -> None:
        self._names: list[tuple[str, int]] = []
        self._finite: list[Tensor] = []

    def note(self, name: str, step: int, tensor: Tensor) -> None:
        """Look at a tensor; nothing waits for the device.

        Args:
            name: what it is, for the message.
            step: index of the denoising step.
            tensor: any.
        """
        self._names.append((name, step))
        self._finite.append(torch.isfinite(tensor.detach()).all())

    def check(self, dtype: torch.dtype) -> None:
        """Name the first tensor that was not finite.

        Args:
            dtype: of the prior's networks, for the message.

        Raises:
            ValueError: there is one.
        """
        if not self._finite:
            return
        finite = torch.stack(self._finite).cpu()
        if finite.all():
            return
        name, step = self._names[int((~finite).nonzero()[0])]
        short = str(dtype).removeprefix("torch.")
        cure = "Load the prior with dtype=torch.bfloat16 or torch.float32."
        if short != "float16":
            cure = "Are all weights of the prior finite?"
        bad_value(f"{name} of denoising step {step + 1}", f"finite in {short}", "NaN or infinity in it", cure)
