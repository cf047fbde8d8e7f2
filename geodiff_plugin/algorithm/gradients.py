"""Pull gradients back through networks of half precision, check that they are finite, make steps of them.

Source: Algorithm 1 (plain step), Eq. 15 (eq:final_score), S5.1 (learning rate 1e-2, no optimiser).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

from geodiff_plugin._checks import bad_value

#: The bits of a float32 that hold its exponent; alone they are the power of two at or below the number.
EXPONENT_BITS = 0x7F800000


def power_above(largest: Tensor) -> Tensor:
    """The least power of two above each number of ``(B,)``, which is not negative; float32.

    Below the least normal number it is twice that. Read from the bits, as Apple's GPUs lack ``torch.frexp``.
    """
    below = (largest.float().view(torch.int32) & EXPONENT_BITS).view(torch.float32)
    return 2.0 * below.clamp_min(torch.finfo(torch.float32).tiny)


def pull_back(output: Tensor, source: Tensor, gradient: Tensor) -> Tensor:
    """The gradient in ``source`` of a loss whose gradient in ``output`` is given; frees the graph between.

    Each sample's gradient is first scaled so that its largest entry is between 1/2 and 1: otherwise it could
    under- or overflow in float16. The factor is a power of two, so in float32 it changes nothing.
    """
    unit = power_above(gradient.detach().abs().flatten(1).amax(1))
    scaled = gradient / unit.view(-1, *([1] * (gradient.ndim - 1)))
    (pulled,) = torch.autograd.grad(output, source, scaled.to(output.dtype))
    return pulled * unit.view(-1, *([1] * (pulled.ndim - 1))).to(pulled.dtype)


class FiniteWatch:
    """Records on the device which tensors of a trajectory are finite; ``check`` reads them at the end."""

    def __init__(self) -> None:
        self._names: list[tuple[str, int]] = []
        self._extremes: list[Tensor] = []  # () each, the least and the largest value of every tensor

    def note(self, name: str, step: int, tensor: Tensor) -> None:
        """Record a tensor of a step without waiting for its device; ``name`` is for the message."""
        self._names.append((name, step))
        # Both are finite if all values are: one operation tells them, and the tensor itself is not kept.
        self._extremes += tensor.detach().float().aminmax()

    def check(self, pipe: Any) -> None:
        """Raise ``InputError`` on the first tensor of a pipeline's run that was not finite."""
        if not self._extremes:
            return
        finite = [math.isfinite(value) for value in torch.stack(self._extremes).tolist()]
        if all(finite):
            return
        name, step = self._names[finite.index(False) // 2]
        short = str(pipe.dtype).removeprefix("torch.")  # read here, as stock walks all layers for it
        cure = "Load the prior with dtype=torch.bfloat16 or torch.float32."
        if short != "float16":
            cure = "Are all weights of the prior finite?"
        bad_value(f"{name} of denoising step {step + 1}", f"finite in {short}", "NaN or infinity in it", cure)


#: The plain rule, but the latent follows the loss, a mean over visible pixels, times the number of pixels, by
#: which the caller multiplies the rate. Along the mean the printed step of 1e-2 changes nothing.
SUMMED = "summed"


class Rule(Protocol):
    """How far a gradient moves a tensor; every trajectory has its own instance."""

    def step(self, gradient: Tensor, reference: Tensor | None = None) -> Tensor:
        """What to add, for ``gradient`` (B, ...); ``reference`` (B, ...) is for rules that need it."""


def _per_sample_norm(x: Tensor) -> Tensor:
    norm = x.flatten(1).norm(dim=1) if x.ndim > 1 else x.abs()
    return norm.view(-1, *([1] * (x.ndim - 1)))


class Plain:
    """``-rate * gradient``: Algorithm 1 as printed."""

    def __init__(self, rate: float) -> None:
        self.rate = rate

    def step(self, gradient: Tensor, reference: Tensor | None = None) -> Tensor:
        """As ``Rule``; ``reference`` is not used."""
        return -self.rate * gradient


class Adam:
    """Adam with bias correction, element-wise, so that samples of a batch do not see each other.

    ``to_norm`` scales each sample's gradient to the norm of the reference first.
    """

    def __init__(
        self, rate: float, betas: tuple[float, float] = (0.9, 0.99), eps: float = 1e-10, to_norm: bool = False
    ) -> None:
        self.rate, self.betas, self.eps, self.to_norm = rate, betas, eps, to_norm
        self._count = 0
        self._moments: tuple[Tensor, Tensor] | None = None

    def step(self, gradient: Tensor, reference: Tensor | None = None) -> Tensor:
        """As ``Rule``, for gradients of the same shape at every call; ``to_norm`` uses ``reference``."""
        b1, b2 = self.betas
        if self.to_norm and reference is not None:
            gradient = gradient * (_per_sample_norm(reference) / _per_sample_norm(gradient).clamp_min(1e-8))
        first, second = self._moments or (torch.zeros_like(gradient), torch.zeros_like(gradient))
        self._count += 1
        first = b1 * first + (1 - b1) * gradient
        second = b2 * second + (1 - b2) * gradient * gradient
        self._moments = (first, second)
        corrected = second / (1 - b2**self._count)
        return -self.rate * (first / (1 - b1**self._count)) / (corrected.sqrt() + self.eps)


#: Name in the configuration -> rule for a step size. ``adam-norm`` is Marigold-DC's.
RULES: dict[str, Callable[[float], Rule]] = {
    "plain": Plain,
    SUMMED: Plain,
    "adam": Adam,
    "adam-norm": partial(Adam, betas=(0.9, 0.999), eps=1e-8, to_norm=True),
}
