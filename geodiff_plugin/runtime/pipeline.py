"""Switching guidance on and off for a pipeline object.

Data flow: a live pipeline -> the same object, of a class whose call takes ``guidance`` -> the stock class.
Paper: S4, Figure 3 (fig:framework).
"""

from __future__ import annotations

import functools
from typing import Any

from diffusers import DiffusionPipeline, MarigoldDepthPipeline

from geodiff_plugin.priors import find_adapter
from geodiff_plugin.runtime.guided_call import GuidedCall, stock_class

__all__ = ["GuidedMarigoldDepthPipeline", "disable_geometry_guidance", "enable_geometry_guidance"]


class GuidedMarigoldDepthPipeline(GuidedCall, MarigoldDepthPipeline):
    """``MarigoldDepthPipeline`` whose call takes ``guidance``; ``from_pretrained`` as always."""


@functools.cache
def _guided_class(stock: type) -> type:
    if stock is MarigoldDepthPipeline:
        return GuidedMarigoldDepthPipeline
    members = {"__doc__": GuidedMarigoldDepthPipeline.__doc__, "__reduce__": _reduced}
    return type(f"Guided{stock.__name__}", (GuidedCall, stock), members)


def _reduced(pipe: GuidedCall) -> tuple[Any, ...]:
    """For pickle, which finds no class by name that was made at run time."""
    return _without_state, (stock_class(type(pipe)),), vars(pipe)


def _without_state(stock: type) -> Any:
    return object.__new__(_guided_class(stock))


def enable_geometry_guidance(pipe: DiffusionPipeline) -> DiffusionPipeline:
    """Let a live pipeline take ``guidance=``; nothing else about it changes.

    Args:
        pipe: any pipeline with an adapter in ``PRIORS``.

    Returns:
        The same object, for chaining. Enabling twice is enabling once.

    Raises:
        TypeError: no adapter understands it.
    """
    find_adapter(pipe)
    if not isinstance(pipe, GuidedCall):
        pipe.__class__ = _guided_class(pipe.__class__)
    return pipe


def disable_geometry_guidance(pipe: DiffusionPipeline) -> DiffusionPipeline:
    """Undo ``enable_geometry_guidance``; on a pipeline that is not enabled it does nothing."""
    if isinstance(pipe, GuidedCall):
        pipe.__class__ = stock_class(type(pipe))
    return pipe
