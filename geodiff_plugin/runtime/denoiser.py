"""Hook on the denoiser that keeps its graph for the full gradient, inside the pipeline's ``no_grad``.

Data flow: the network's first argument -> a detached leaf of its depth channels -> the output with its graph.
Paper: the gradient to z_t in Algorithm 1 and Eq. 15 (eq:final_score).
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from geodiff_plugin.runtime.channels import put_channels
from geodiff_plugin.runtime.hiding import hide_method

__all__ = ["DenoiserTap"]


class DenoiserTap:
    """Runs the network with gradients to its depth latent, and can run it again at another one.

    Args:
        owner: object whose method the loop calls: the U-Net, or a pipeline of ours.
        method: name of the method, ``"forward"`` of a module; its first argument holds the latent.
        channels: which channels of that argument are the depth latent.

    Used as a context manager: the method is as it was afterwards, whatever happened. The instance gets an
    attribute that hides its class's method, so that hooks and compiled forwards below are called as ever.

    Attributes:
        leaf: ``(B, C, h, w)`` the depth latent of the latest call, float32 or wider, requires a gradient.
    """

    def __init__(self, owner: Any, method: str, channels: slice) -> None:
        self._owner, self._method, self._channels = owner, method, channels
        self._at: Callable[[Tensor], Any] | None = None  # the latest call at another latent
        self._leaf: Tensor | None = None
        self._output: Tensor | None = None

    def __enter__(self) -> DenoiserTap:
        own = getattr(self._owner, self._method)
        thread = threading.get_ident()

        @functools.wraps(own)
        def tapped(model_input: Tensor, *args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != thread:  # a stock call of another pipeline with the same network
                return own(model_input, *args, **kwargs)
            return self.run(own, model_input, *args, **kwargs)

        self._restore = hide_method(self._owner, self._method, tapped)
        return self

    def __exit__(self, *exc: object) -> None:
        self._restore()
        self.release()

    @property
    def leaf(self) -> Tensor:
        """Of the latest call, which was not released yet."""
        assert self._leaf is not None
        return self._leaf

    def release(self) -> None:
        """Drop the graph and everything that it holds."""
        self._at = self._leaf = self._output = None

    def run(self, forward: Callable[..., Any], model_input: Tensor, *args: Any, **kwargs: Any) -> Any:
        """The tapped call: same result, detached; the graph is kept until ``release``."""
        model_input = model_input.detach()
        wide = torch.promote_types(model_input.dtype, torch.float32)
        kind = model_input.device.type
        mixed, precision = torch.is_autocast_enabled(kind), torch.get_autocast_dtype(kind)

        def at(z_t: Tensor) -> Any:
            # Guided steps leave the user's autocast, under which the other arguments were made.
            with torch.enable_grad(), torch.autocast(kind, precision, enabled=mixed):
                joined = put_channels(model_input, self._channels, z_t.to(model_input.dtype))
                return forward(joined, *args, **kwargs)

        self._at, self._leaf = at, model_input[:, self._channels].to(wide).requires_grad_()
        result = at(self._leaf)
        self._output = _first(result)
        detached = self._output.detach()
        if isinstance(result, Tensor):
            return detached
        return (detached, *result[1:]) if isinstance(result, tuple) else type(result)(detached)

    def output_at(self, z_t: Tensor) -> Tensor:
        """Network output with its graph to ``z_t (B, C, h, w)`` float32.

        The pipeline's own forward is reused for its own input: one update costs no second network call.
        """
        assert self._at is not None and self._output is not None
        return self._output if z_t is self._leaf else _first(self._at(z_t))


def _first(result: Any) -> Tensor:
    """The tensor out of a tensor, a tuple or a ``BaseOutput``."""
    return result if isinstance(result, Tensor) else result[0]
