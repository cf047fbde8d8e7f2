"""Gradient rules: how far one gradient moves a tensor.

Data flow: gradient and its state -> a step to be added.
Paper: Algorithm 1 (plain step); S5.1 (learning rate 1e-2, no optimiser); ``adam-norm`` is Marigold-DC's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import torch
from torch import Tensor

__all__ = ["RULES", "Adam", "NormMatched", "Plain", "Rule"]


def _per_sample_norm(x: Tensor) -> Tensor:
    norm = x.flatten(1).norm(dim=1) if x.ndim > 1 else x.abs()
    return norm.view(-1, *([1] * (x.ndim - 1)))


@dataclass
class Plain:
    """``-rate * gradient``: Algorithm 1 as printed."""

    rate: float

    def step(self, gradient: Tensor, reference: Tensor | None = None) -> Tensor:
        """The step for ``gradient`` (any shape, batch first); ``reference`` is not used."""
        return -self.rate * gradient


@dataclass
class NormMatched:
    """``-rate * gradient * |reference| / |gradient|`` per sample: a fixed share of the predicted noise."""

    rate: float

    def step(self, gradient: Tensor, reference: Tensor | None = None) -> Tensor:
        """The step for ``gradient`` (B, ...); ``reference`` (B, ...) sets its length, 1 without it.

        A zero gradient gives a zero step.
        """
        length = _per_sample_norm(reference) if reference is not None else 1.0
        return -self.rate * gradient * (length / _per_sample_norm(gradient).clamp_min(1e-12))


@dataclass
class Adam:
    """Adam with bias correction; its moments live as long as the object, that is one trajectory.

    Element-wise, so that samples of a batch do not see each other.

    Attributes:
        rate: step size.
        betas: decay of the two moments.
        eps: least denominator.
        to_norm: scale each sample's gradient to the norm of the reference first, which weighs the steps of
            a schedule against each other in the moments.
        count: steps so far.
        moments: of the gradient and of its square.
    """

    rate: float
    betas: tuple[float, float] = (0.9, 0.99)
    eps: float = 1e-10
    to_norm: bool = False
    count: int = 0
    moments: tuple[Tensor, Tensor] | None = field(default=None, repr=False)

    def step(self, gradient: Tensor, reference: Tensor | None = None) -> Tensor:
        """The step for ``gradient`` (same shape at every call), ``reference`` used by ``to_norm``."""
        b1, b2 = self.betas
        if self.to_norm and reference is not None:
            gradient = gradient * (_per_sample_norm(reference) / _per_sample_norm(gradient).clamp_min(1e-8))
        first, second = self.moments or (torch.zeros_like(gradient), torch.zeros_like(gradient))
        self.count += 1
        first = b1 * first + (1 - b1) * gradient
        second = b2 * second + (1 - b2) * gradient * gradient
        self.moments = (first, second)
        corrected = second / (1 - b2**self.count)
        return -self.rate * (first / (1 - b1**self.count)) / (corrected.sqrt() + self.eps)


class Rule(Protocol):
    """What the entries of ``RULES`` make of a rate."""

    def step(self, gradient: Tensor, reference: Tensor | None = None) -> Tensor:
        """What to add, for ``gradient`` (B, ...); ``reference`` (B, ...) is there for rules that need it."""


#: Name in the configuration -> rule. A rule is made anew for every trajectory.
RULES: dict[str, Callable[[float], Rule]] = {
    "plain": Plain,
    "adam": Adam,
    "norm": NormMatched,
    "adam-norm": partial(Adam, betas=(0.9, 0.999), eps=1e-8, to_norm=True),
}
