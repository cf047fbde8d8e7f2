"""Images in, metric depth out: the guided call of a Marigold-style pipeline.

Hop: left image(s) + ``GeometryGuidance`` -> stock call with guidance inside -> ``MetricDepthOutput``.
Paper: S4, Figure 3 (fig:framework).
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

import torch
from diffusers import DiffusionPipeline, MarigoldDepthPipeline
from torch import Tensor

from geodiff_plugin._checks import bad_type, bad_value
from geodiff_plugin.ensembling import ensemble_metric
from geodiff_plugin.guidance import GeometryGuidance
from geodiff_plugin.integration.run import GuidedRun
from geodiff_plugin.output import assemble_output
from geodiff_plugin.priors import find_adapter

__all__ = ["GuidedMarigoldDepthPipeline", "disable_geometry_guidance", "enable_geometry_guidance"]


class _GuidedCall:
    """What a pipeline class gains: a ``__call__`` that takes ``guidance``, metric ensembling while guided.

    Mixed in before the stock class, whose call does all the rest: preprocessing, latents, loop, resizing.
    """

    _guided_run: GuidedRun | None = None

    @torch.no_grad()
    def __call__(
        self,
        image: Any,
        *args: Any,
        guidance: GeometryGuidance | None = None,
        callback_on_step_end: Callable[..., dict[str, Tensor] | None] | None = None,
        **kwargs: Any,
    ) -> Any:
        """The stock call; with ``guidance`` its depth is in metres.

        Args:
            image: left image(s), as the stock call takes them.
            *args: as the stock call takes them.
            guidance: the second view; ``None`` is the stock call, bit for bit.
            callback_on_step_end: ``f(pipe, i, t, {"latents", "metric_depth", "loss", "scale", "shift"})``;
                ``latents`` in what it returns replace the pipeline's.
            **kwargs: as the stock call takes them.

        Returns:
            ``MetricDepthOutput``, or with ``return_dict=False`` the stock tuple (prediction, uncertainty,
            latent).

        Raises:
            TypeError: ``guidance`` is no ``GeometryGuidance``; a scheduler that cannot be guided.
            ValueError: inputs that do not fit each other; offloading that forbids guidance.
            RuntimeError: called inside ``torch.inference_mode()``.
        """
        if guidance is None:
            if callback_on_step_end is not None:
                bad_value("callback_on_step_end", "given together with guidance", "guidance=None")
            return super().__call__(image, *args, **kwargs)
        if not isinstance(guidance, GeometryGuidance):
            bad_type("guidance", "a GeometryGuidance", guidance, "GeometryGuidance(right, K, E)")
        if torch.is_inference_mode_enabled():
            raise RuntimeError(
                "A guided call needs gradients, which torch.inference_mode() forbids; "
                "use torch.no_grad() or nothing."
            )
        bound = inspect.signature(super().__call__).bind(image, *args, **kwargs)
        bound.apply_defaults()
        call = bound.arguments
        asked = call["num_inference_steps"]
        call["num_inference_steps"] = guidance.denoising_steps(asked, self.default_denoising_steps)
        wants_dict, wants_latent = call["return_dict"], call["output_latent"]
        processor, device = self.image_processor, self._execution_device
        native = processor.preprocess(image, 0, device=device, dtype=torch.float32)  # [-1, 1], padded
        resolution = call["processing_resolution"]
        resolution = self.default_processing_resolution if resolution is None else resolution
        padded, padding, size = processor.preprocess(image, resolution, call["resample_method_input"], device)
        lefts_01 = (native[0][:, :, : size[0], : size[1]] + 1.0) / 2.0  # (N, 3, H, W)
        content = (padded.shape[-2] - padding[0], padded.shape[-1] - padding[1])
        run = GuidedRun(
            self,
            find_adapter(self)(self),
            guidance,
            guidance.prepare(lefts_01),
            call["ensemble_size"],
            call["batch_size"],
            content,
            callback_on_step_end,
        )
        self._guided_run = run
        try:
            with run:
                stock = super().__call__(**{**call, "return_dict": True, "output_latent": True})
        finally:
            del self._guided_run
        output = assemble_output(
            stock, run, guidance, lefts_01, call["match_input_resolution"], call["output_type"]
        )
        output.latent = stock.latent if wants_latent else None
        return output if wants_dict else (output.prediction, output.uncertainty, output.latent)

    def decode_prediction(self, pred_latent: Tensor) -> Tensor:
        """Stock decode; while guided, metres instead of the clipped relative map."""
        if self._guided_run is None:
            return super().decode_prediction(pred_latent)
        return self._guided_run.metric_prediction(pred_latent)

    def ensemble_depth(self, depth: Tensor, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor | None]:
        """Stock ensembling; while guided, the median of members that are in metres already."""
        if self._guided_run is None:
            return super().ensemble_depth(depth, *args, **kwargs)
        return ensemble_metric(depth, kwargs.get("reduction", "median"))

    def save_pretrained(self, *args: Any, **kwargs: Any) -> None:
        """Save the stock pipeline: the folder loads where this package is not installed."""
        guided = type(self)
        self.__class__ = _stock_class(guided)
        try:
            self.save_pretrained(*args, **kwargs)
        finally:
            self.__class__ = guided


class GuidedMarigoldDepthPipeline(_GuidedCall, MarigoldDepthPipeline):
    """``MarigoldDepthPipeline`` whose call takes ``guidance``; ``from_pretrained`` as always."""


def _stock_class(guided: type) -> type:
    """The class that guidance was mixed into."""
    return next(c for c in guided.__mro__ if not issubclass(c, _GuidedCall))


@functools.cache
def _guided_class(stock: type) -> type:
    if stock is MarigoldDepthPipeline:
        return GuidedMarigoldDepthPipeline
    return type(
        f"Guided{stock.__name__}", (_GuidedCall, stock), {"__doc__": GuidedMarigoldDepthPipeline.__doc__}
    )


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
    if not isinstance(pipe, _GuidedCall):
        pipe.__class__ = _guided_class(type(pipe))
    return pipe


def disable_geometry_guidance(pipe: DiffusionPipeline) -> DiffusionPipeline:
    """Undo ``enable_geometry_guidance``; on a pipeline that is not enabled it does nothing."""
    if isinstance(pipe, _GuidedCall):
        pipe.__class__ = _stock_class(type(pipe))
    return pipe
