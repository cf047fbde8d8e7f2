"""Keep the U-Net's graph for the full gradient, from inside the pipeline's ``no_grad``.

Hop: the denoiser's input -> a detached leaf of its depth half -> the output with its graph, kept aside.
Paper: the gradient to z_t in Algorithm 1 and Eq. 15 (eq:final_score).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from diffusers.hooks import HookRegistry, ModelHook
from torch import Tensor

__all__ = ["DenoiserTap"]

HOOK_NAME = "geodiff_denoiser_tap"


class _TapHook(ModelHook):
    def __init__(self, tap: DenoiserTap) -> None:
        super().__init__()
        self.tap = tap

    def new_forward(self, module: torch.nn.Module, *args: Any, **kwargs: Any) -> Any:
        return self.tap.run(self.fn_ref.original_forward, *args, **kwargs)


class DenoiserTap:
    """Runs the denoiser with gradients to its depth latent, and can run it again at another one.

    Args:
        module: the denoiser.
        split_input: condition and depth latent of its input.

    Used as a context manager: the hook is gone afterwards, whatever happened.
    """

    def __init__(
        self, module: torch.nn.Module, split_input: Callable[[Tensor], tuple[Tensor, Tensor]]
    ) -> None:
        self._module, self._split = module, split_input
        self._call: tuple[Callable[..., Any], Tensor, tuple, dict] | None = None
        self.leaf: Tensor | None = None
        self._output: Tensor | None = None

    def __enter__(self) -> DenoiserTap:
        HookRegistry.check_if_exists_or_initialize(self._module).register_hook(_TapHook(self), HOOK_NAME)
        return self

    def __exit__(self, *exc: object) -> None:
        HookRegistry.check_if_exists_or_initialize(self._module).remove_hook(HOOK_NAME, recurse=False)
        self.release()

    def release(self) -> None:
        """Drop the graph and everything that it holds."""
        self._call = self.leaf = self._output = None

    def run(self, forward: Callable[..., Any], model_input: Tensor, *args: Any, **kwargs: Any) -> Any:
        """The hooked forward: same result, detached; the graph is kept until ``release``."""
        condition, depth_latent = self._split(model_input)
        with torch.enable_grad():
            leaf = (
                depth_latent.detach()
                .to(torch.promote_types(depth_latent.dtype, torch.float32))
                .requires_grad_()
            )
            joined = torch.cat([condition.detach(), leaf.to(condition.dtype)], dim=1)
            result = forward(joined, *args, **kwargs)
        self.leaf = leaf
        self._output = result[0]
        self._call = (forward, condition.detach(), args, kwargs)
        detached = self._output.detach()
        return (detached, *result[1:]) if isinstance(result, tuple) else type(result)(detached)

    def output_at(self, z_t: Tensor) -> Tensor:
        """Network output with its graph to ``z_t (B, C, h, w)`` float32.

        The pipeline's own forward is reused for its own input, so that one update costs no second U-Net call.
        """
        if z_t is self.leaf:
            return self._output
        forward, condition, args, kwargs = self._call
        return forward(torch.cat([condition, z_t.to(condition.dtype)], dim=1), *args, **kwargs)[0]
