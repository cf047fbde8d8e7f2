"""Backpropagates through half-precision networks, checks for finite values, and computes update steps.

Source: Algorithm 1 (plain step), Eq. 15 (eq:final_score), S5.1 (learning rate 1e-2, no optimizer named).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

from geodiff_plugin._internal.checks import bad_value

#: Exponent bits of a float32. Alone they encode the largest power of two that does not exceed the number.
EXPONENT_BITS = 0x7F800000


def power_above(largest: Tensor) -> Tensor:
    """Return the least power of two above each non-negative number of ``(B,)``, float32.

    Numbers below the smallest normal number give twice that number. Bits are used because Apple GPUs lack
    ``torch.frexp``.
    """
    below = (largest.float().view(torch.int32) & EXPONENT_BITS).view(torch.float32)
    return 2.0 * below.clamp_min(torch.finfo(torch.float32).tiny)


def backpropagate(output: Tensor, source: Tensor, gradient: Tensor) -> Tensor:
    """Return the gradient in ``source`` of a loss with the given gradient in ``output``; frees the graph.

    Each sample's gradient is first scaled so that its largest entry is between 1/2 and 1; otherwise it could
    under- or overflow in float16. The factor is a power of two, so it is exact in float32.
    """
    unit = power_above(gradient.detach().abs().flatten(1).amax(1))
    scaled = gradient / unit.view(-1, *([1] * (gradient.ndim - 1)))
    (pulled,) = torch.autograd.grad(output, source, scaled.to(output.dtype))
    return pulled * unit.view(-1, *([1] * (pulled.ndim - 1))).to(pulled.dtype)


class FiniteWatch:
    """Records on the device whether the tensors of a trajectory are finite; ``check`` reads the result."""

    def __init__(self) -> None:
        self._names: list[tuple[str, int]] = []
        self._extremes: list[Tensor] = []  # 0-d minimum and maximum of every tensor

    def record(self, name: str, step: int, tensor: Tensor) -> None:
        """Record a tensor of a step without synchronizing; ``name`` is used in the message."""
        self._names.append((name, step))
        # All values are finite if both extremes are: this takes one operation and does not keep the tensor.
        self._extremes += tensor.detach().float().aminmax()

    def check(self, pipe: Any) -> None:
        """Raise ``InputError`` for the first tensor of a pipeline's run that was not finite."""
        if not self._extremes:
            return
        finite = [math.isfinite(value) for value in torch.stack(self._extremes).tolist()]
        if all(finite):
            return
        name, step = self._names[finite.index(False) // 2]
        short = str(pipe.dtype).removeprefix("torch.")  # the stock property walks all layers
        hint = "Load the prior with dtype=torch.bfloat16 or torch.float32."
        if short != "float16":
            hint = "Check that all weights of the prior are finite."
        bad_value(f"{name} of denoising step {step + 1}", f"finite in {short}", "NaN or infinity", hint)


#: Plain steps in which the latent's loss, a mean over visible pixels, is multiplied by the number of pixels:
#: the caller multiplies the rate. With the mean, the printed rate of 1e-2 has no effect.
SUMMED = "summed"


class Optimizer(Protocol):
    """Converts gradients of a tensor to steps; every trajectory has its own instance."""

    def step(self, gradient: Tensor, reference: Tensor | None = None) -> Tensor:
        """Return the change for ``gradient`` (B, ...); some optimizers use ``reference`` (B, ...)."""


def _per_sample_norm(x: Tensor) -> Tensor:
    norm = x.flatten(1).norm(dim=1) if x.ndim > 1 else x.abs()
    return norm.view(-1, *([1] * (x.ndim - 1)))


class Plain:
    """Plain gradient descent, ``-rate * gradient``: Algorithm 1 as printed."""

    def __init__(self, rate: float) -> None:
        self.rate = rate

    def step(self, gradient: Tensor, reference: Tensor | None = None) -> Tensor:
        """Return the change as in ``Optimizer.step``; ``reference`` is not used."""
        return -self.rate * gradient


class Adam:
    """Adam with bias correction, element-wise, so that the samples of a batch are independent.

    With ``to_norm`` each sample's gradient is first scaled to the norm of the reference.
    """

    def __init__(
        self, rate: float, betas: tuple[float, float] = (0.9, 0.99), eps: float = 1e-10, to_norm: bool = False
    ) -> None:
        self.rate, self.betas, self.eps, self.to_norm = rate, betas, eps, to_norm
        self._count = 0
        self._moments: tuple[Tensor, Tensor] | None = None

    def step(self, gradient: Tensor, reference: Tensor | None = None) -> Tensor:
        """Return the change, for gradients of one shape at every call; ``to_norm`` uses ``reference``."""
        b1, b2 = self.betas
        if self.to_norm and reference is not None:
            gradient = gradient * (_per_sample_norm(reference) / _per_sample_norm(gradient).clamp_min(1e-8))
        first, second = self._moments or (torch.zeros_like(gradient), torch.zeros_like(gradient))
        self._count += 1
        first = b1 * first + (1 - b1) * gradient
        second = b2 * second + (1 - b2) * gradient * gradient
        self._moments = (first, second)
        second_unbiased = second / (1 - b2**self._count)
        return -self.rate * (first / (1 - b1**self._count)) / (second_unbiased.sqrt() + self.eps)


#: Optimizer by its name in the configuration, made for a step size. ``adam-norm`` is Marigold-DC's.
OPTIMIZERS: dict[str, Callable[[float], Optimizer]] = {
    "plain": Plain,
    SUMMED: Plain,
    "adam": Adam,
    "adam-norm": partial(Adam, betas=(0.9, 0.999), eps=1e-8, to_norm=True),
}
