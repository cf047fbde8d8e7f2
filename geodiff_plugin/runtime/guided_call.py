"""Enables and disables guidance on a live pipeline, and checks and runs guided calls (S4)."""

from __future__ import annotations

import copy
import functools
import inspect
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from diffusers import DiffusionPipeline, MarigoldDepthPipeline
from torch import Tensor
from tqdm.auto import tqdm

from geodiff_plugin._internal.checks import (
    bad_type,
    bad_value,
    captured_warnings,
    check_choice,
    check_number,
    raise_input_error,
    warn,
)
from geodiff_plugin._internal.compilation import compile_kernels
from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin._internal.threads import BackgroundTask
from geodiff_plugin.algorithm.prompt import depth_prompt
from geodiff_plugin.algorithm.schedule import count_steps
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.evidence.inputs import left_alphas, left_images
from geodiff_plugin.evidence.plan import EvidencePlan
from geodiff_plugin.findings import Finding, dedupe
from geodiff_plugin.formats import in_stored_pixels
from geodiff_plugin.priors import DepthPrior, prior_of
from geodiff_plugin.priors.pipeline import RESAMPLING, DepthDiffusionPipeline
from geodiff_plugin.result.ensemble import ensemble_metric
from geodiff_plugin.result.output import MetricDepthOutput, image_labels
from geodiff_plugin.runtime.codec import MapCodec, ProcessingGrid, tiny_autoencoder
from geodiff_plugin.runtime.graphs import FasterNetworks
from geodiff_plugin.runtime.hooks import Layers, PipelineLock
from geodiff_plugin.runtime.noise_levels import check_scheduler
from geodiff_plugin.runtime.run import GuidedRun, StepCallback
from geodiff_plugin.trust import NOT_TRUSTED

#: Arguments that every stock pipeline's ``__call__`` takes, for any prior.
STOCK_ARGUMENTS = (
    *("output_type", "resample_method_input", "resample_method_output", "batch_size", "num_inference_steps"),
    *("processing_resolution", "ensemble_size", "generator", "latents"),
)
#: Maximum number of steps, pixels and ensemble members per call.
MAX_COUNT = 1 << 20

# ``GuidedCall`` is mixed in before a class that provides all attributes of a stock pipeline.
_Stock: Any = MarigoldDepthPipeline if TYPE_CHECKING else object


class GuidedCall(_Stock):
    """Mixin for a stock pipeline: ``__call__`` takes ``guidance`` and then returns metric depth."""

    _guided_run: GuidedRun | None = None
    _faster: FasterNetworks | None = None  # of guided calls with ``cuda_graphs=True``
    _uses_kernels: bool = True

    @torch.no_grad()
    def __call__(
        self,
        image: Any,
        *args: Any,
        guidance: GeometryGuidance | None = None,
        callback_on_step_end: Callable[..., dict[str, Tensor] | None] | None = None,
        strict: bool = False,
        **kwargs: Any,
    ) -> Any:
        """Run the stock call; with ``guidance`` its depth is in metres.

        Args:
            image: left image(s) in any form the stock call takes; with guidance also in any form of
                ``right``.
            *args: passed to the stock call.
            guidance: the second view. With ``None`` the call equals the stock call bit for bit.
            callback_on_step_end: ``f(pipe, i, t, {"latents", "metric_depth", "loss", "scale", "shift"})``. If
                it returns ``latents``, they replace the pipeline's. The other values come from the latest
                guided step and ``None`` before the first.
            strict: whether to raise an error if a depth is not trusted or not judged (``output.verdict``).
            **kwargs: passed to the stock call.

        Returns:
            ``MetricDepthOutput``, or with ``return_dict=False`` the stock tuple (prediction, uncertainty,
            latent).

        Raises:
            InputError: ``guidance`` is not a ``GeometryGuidance``, the scheduler or offloading mode cannot be
                guided, an image has an unsupported form, or inputs do not match each other.
            RuntimeError: gradient updates inside ``torch.inference_mode()``, or a call from a hook of a
                network during a guided call. ``callback_on_step_end`` may call the pipeline, guided or not:
                the pipeline is restored while the callback runs. A call from another thread waits.
        """
        if guidance is None and (callback_on_step_end is not None or strict):
            name = "strict" if callback_on_step_end is None else "callback_on_step_end"
            bad_value(name, "passed only with guidance", "guidance=None")
        with PipelineLock(self, guidance is not None) as held:
            if self._guided_run is not None:
                raise RuntimeError(
                    "A guided call of this pipeline is in progress; call it again from "
                    "callback_on_step_end or after the call, but not from a hook of its networks."
                )
            if guidance is None:
                return super().__call__(image, *args, **kwargs)
            _check_guided_call(guidance, callback_on_step_end)
            plain_torch = without_kernels(not self._uses_kernels)
            with torch.inference_mode(False), torch.no_grad(), plain_torch, captured_warnings() as warned:
                call = _bind(super().__call__, image, *args, **kwargs)
                output, stock = self._call_guided(call, guidance, callback_on_step_end, held, warned)
        labelled = zip(image_labels(len(output.verdicts)), output.verdicts, strict=True)
        untrusted = " ".join(
            f"{label}{verdict.summary}" for label, verdict in labelled if not verdict.trusted
        )
        if strict and untrusted:
            raise_input_error(untrusted)
        if output.verdict.status == "not trusted":
            warn(Finding(NOT_TRUSTED, untrusted), stacklevel=3)
        output.latent = stock.latent if call["output_latent"] else None
        return output if call["return_dict"] else (output.prediction, output.uncertainty, output.latent)

    def _call_guided(
        self,
        call: dict[str, Any],
        guidance: GeometryGuidance,
        callback: StepCallback | None,
        held: PipelineLock,
        warned: Sequence[Finding],
    ) -> tuple[MetricDepthOutput, Any]:
        """Run a guided call; returns its output and the stock output, and updates ``call`` in place.

        ``warned`` is read last, after everything that can warn.
        """
        lefts = in_stored_pixels(call["image"]) if guidance.as_stored else call["image"]
        lefts_01 = left_images(lefts)  # (N, 3, H, W)
        prior = prior_of(self)
        _check_arguments(call, len(lefts_01))
        steps, rounds = count_guided_steps(self, guidance, call["num_inference_steps"])
        resampling = call["resample_method_output"] or "bilinear"
        call |= {"num_inference_steps": steps, "resample_method_output": resampling}
        layers = Layers.of(self)
        _check_guidable(self, prior, guidance, layers)
        tiny = tiny_autoencoder(self, guidance.config.decoder)
        unlocked = None if callback is None else held.released_during(callback)
        if prior.deterministic and call["ensemble_size"] > 1:
            call |= _one_member(call)
        device = layers.device or super()._execution_device
        compile_kernels(device, logging.getLogger(__name__).info)
        guidance.check_left_images(lefts_01)
        lefts_01, guidance = guidance.with_valid_pixels(lefts_01, left_alphas(lefts))
        call["image"] = lefts_01 = lefts_01.to(device)
        plans = BackgroundTask(lambda: _plan_evidence(guidance, lefts_01), device, own_stream=True)
        try:
            codec = MapCodec(self, prior, self._processing_grid(call, device), tiny)
            if prior.takes_prompt and call.get("prompt_depth") is None:
                evidence = [plan.evidence for plan in plans.result()]
                call["prompt_depth"] = depth_prompt(evidence, guidance.config)
            run = GuidedRun(codec, guidance, plans.result, call, rounds, unlocked)
            stock = self._run_stock(run, call)
            with torch.autocast(device.type, enabled=False):
                return run.output(stock, dedupe(guidance.findings, warned)), stock
        finally:
            _close(plans)

    def _run_stock(self, run: GuidedRun, call: dict[str, Any]) -> Any:
        """Run the stock call inside a guided run."""
        fixed = {"return_dict": True, "output_latent": True, "output_type": "pt"}
        try:
            with run:
                return super().__call__(**call | fixed)
        finally:
            run.release()

    def _processing_grid(self, call: dict[str, Any], device: torch.device) -> ProcessingGrid:
        """Run the stock preprocessing once and return the grid that the stock call will denoise on.

        Images are channels-last, as in a stock call, unless latents are given: Marigold does not accept that
        combination. The copy, 144 MB at 12 megapixels, is not kept.
        """
        layout = torch.channels_last if call["latents"] is None else torch.contiguous_format
        image = call["image"].contiguous(memory_format=layout)
        resolution = call["processing_resolution"]
        resolution = self.default_processing_resolution if resolution is None else resolution
        preprocess = self.image_processor.preprocess
        found = preprocess(image, resolution, call["resample_method_input"], device)
        image, padding, _ = found
        return ProcessingGrid((image.shape[-2] - padding[0], image.shape[-1] - padding[1]), padding, found)

    @property
    def _execution_device(self) -> torch.device:
        """The run's device while guided, otherwise the stock value, found without repeated scans."""
        if self._guided_run is not None:
            return self._guided_run.device
        return Layers.of(self).device or super()._execution_device

    def progress_bar(self, iterable: Any = None, total: int | None = None, **kwargs: Any) -> Any:
        """Return the stock progress bar; disabled while guided, since the run shows one bar for all steps."""
        if self._guided_run is None:
            return super().progress_bar(iterable, total, **kwargs)
        return tqdm(iterable, total=total, disable=True)

    def decode_prediction(self, pred_latent: Tensor) -> Tensor:
        """Decode as in the stock pipeline; while guided, to metres instead of the clipped relative map."""
        if self._guided_run is None:
            return super().decode_prediction(pred_latent)
        return self._guided_run.metric_prediction(pred_latent)

    def ensemble_depth(self, depth: Tensor, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor | None]:
        """Ensemble as in the stock pipeline; while guided, take the median of metric members."""
        if self._guided_run is None:
            return super().ensemble_depth(depth, *args, **kwargs)
        lower = self._guided_run.config.even_ensemble == "lower"
        return ensemble_metric(depth, kwargs.get("reduction", "median"), lower)

    def combine_members(self, maps: Tensor, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor | None]:
        """Combine ensembles as the prior does; while guided, with ``ensemble_depth`` for every image."""
        if self._guided_run is None:
            return super().combine_members(maps, *args, **kwargs)
        return DepthDiffusionPipeline.combine_members(self, maps, *args, **kwargs)

    def save_pretrained(self, *args: Any, **kwargs: Any) -> None:
        """Save the stock pipeline, so that the folder loads without this package."""
        with PipelineLock(self, guided=False):
            twin = copy.copy(self)
        twin.__class__ = _stock_class(type(self))
        twin.save_pretrained(*args, **kwargs)


def _plan_evidence(guidance: GeometryGuidance, lefts_01: Tensor) -> list[EvidencePlan]:
    """Run phase 1 in float32, independent of the user's autocast."""
    with torch.autocast(lefts_01.device.type, enabled=False):
        return guidance.plan_evidence(lefts_01)


def _close(plans: BackgroundTask[list[EvidencePlan]]) -> None:
    """Wait until all work of phase 1 has ended, even if its result was not needed.

    The caller's stream waits as well, so that memory still being read is not reused.
    """
    if not plans.failed:
        for plan in plans.result():
            plan.close()


def _bind(stock_call: Callable[..., Any], *args: Any, **kwargs: Any) -> dict[str, Any]:
    """Return all arguments of the stock call by name, with defaults and the prior's own arguments."""
    signature = inspect.signature(stock_call)
    bound = signature.bind(*args, **kwargs)
    bound.apply_defaults()
    call = dict(bound.arguments)
    for name, parameter in signature.parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD:
            call |= call.pop(name)
    return call


def _check_named_arguments(pipeline: type) -> None:
    """Raise an error for a subclass whose ``__call__`` does not name the stock arguments."""
    named = inspect.signature(pipeline.__call__).parameters
    if missing := [name for name in STOCK_ARGUMENTS if name not in named]:
        raise_input_error(
            f"{pipeline.__name__}.__call__ must name the arguments of the stock pipeline that it overrides; "
            f"missing: {', '.join(missing)}. Write them out: **kwargs hides them."
        )


def _check_guided_call(guidance: Any, callback: Any) -> None:
    if not isinstance(guidance, GeometryGuidance):
        bad_type("guidance", "a GeometryGuidance", guidance, "Create one with GeometryGuidance(right, K, E).")
    if callback is not None and not callable(callback):
        bad_type("callback_on_step_end", "a function", callback)
    if torch.is_inference_mode_enabled() and guidance.updates.guidance_steps > 0:
        raise RuntimeError(
            "Gradient updates (guidance_steps) are not possible under torch.inference_mode(); "
            "use torch.no_grad() or no context."
        )


def count_guided_steps(pipe: Any, guidance: GeometryGuidance, requested: int | None) -> tuple[int, int]:
    """Return the number of denoising steps of a guided call and of guidance rounds per step.

    ``requested`` is the number that the user asked for, or ``None``.
    """
    wanted = guidance.denoising_steps(requested, pipe.default_denoising_steps)
    return count_steps(wanted, requested, prior_of(pipe).max_steps)


def _check_arguments(call: Mapping[str, Any], images: int) -> None:
    """Check the arguments common to all pipelines; ``images`` is the number of left images."""
    check_choice(call["output_type"], "output_type", ("np", "pt"))
    check_choice(call["resample_method_input"], "resample_method_input", RESAMPLING)
    check_choice(call["resample_method_output"] or "bilinear", "resample_method_output", RESAMPLING)
    for name, minimum in (("num_inference_steps", 1), ("processing_resolution", 0)):
        if call[name] is not None:
            check_number(call[name], name, minimum, MAX_COUNT, integer=True)
    for name in ("batch_size", "ensemble_size"):
        check_number(call[name], name, 1, MAX_COUNT, integer=True)
    given = call["generator"]
    members = images * call["ensemble_size"]
    generators = given if isinstance(given, list) else [given]
    if given is not None and not all(isinstance(each, torch.Generator) for each in generators):
        bad_type("generator", "None, a torch.Generator or a list of them", given)
    if isinstance(given, list) and len(given) != members:
        expected = f"a torch.Generator, or a list of {members}, one per image and ensemble member"
        bad_value("generator", expected, f"a list of {len(given)}")
    latents = call["latents"]
    if isinstance(latents, Tensor) and not latents.isfinite().all():
        bad_value("latents", "finite", "NaN or infinity")


def _check_guidable(pipe: Any, prior: DepthPrior, guidance: GeometryGuidance, layers: Layers) -> None:
    """Raise an error if the scheduler, offloading, casting or network cannot be guided as configured."""
    check_scheduler(pipe.scheduler)
    full = guidance.config.gradient == "full"
    for network, layer in layers.hooked:
        needs_gradient = guidance.moves_latents and (full or network is getattr(pipe, "vae", None))
        _check_weights_stay(type(network).__name__, layer, needs_gradient)
    if full and getattr(pipe, "_all_hooks", None):
        expected = "'denoised' with enable_model_cpu_offload()"
        hint = "Decoding moves the U-Net to the CPU before its backward pass; use gradient='denoised' or "
        bad_value("gradient", expected, "'full'", hint + "pipe.to(device).")
    if guidance.through_network and prior.network_input is None:
        hint = "z_t is not an input of its network, so only the clean latent can be updated."
        bad_value("gradient", "'denoised' with this prior", "'full'", hint)


def _check_weights_stay(name: str, module: torch.nn.Module, needs_gradient: bool) -> None:
    """Raise an error for hooks that offload or cast weights before the backward pass needs them."""
    registry, hook = vars(module).get("_diffusers_hook"), vars(module).get("_hf_hook")
    of_diffusers = "" if registry is None else " ".join(registry.hooks)
    of_accelerate = [h for h in getattr(hook, "hooks", [hook]) if type(h).__name__ == "AlignDevicesHook"]
    if any(h.offload for h in of_accelerate) or "group_offloading" in of_diffusers:
        expected = "without sequential or group CPU offloading while guided"
        hint = "The backward pass needs them: use pipe.enable_model_cpu_offload() or pipe.to(device)."
        bad_value("pipe", expected, f"{name}, whose weights leave the device after each forward pass", hint)
    if needs_gradient and "layerwise_casting" in of_diffusers:
        hint = "Set guidance_steps=0, or load the pipeline in half precision."
        got = f"{name}, whose weights are cast after each layer"
        bad_value("pipe", "without layerwise casting of differentiated networks", got, hint)


def _one_member(call: dict[str, Any]) -> dict[str, Any]:
    """Return the changed arguments that run a single member of a deterministic prior."""
    first = slice(None, None, call["ensemble_size"])
    changed = {"ensemble_size": 1, "output_uncertainty": False}
    for name, kind in (("generator", list), ("latents", Tensor)):
        if isinstance(call[name], kind):
            changed[name] = call[name][first]
    sentence = "This prior is deterministic, so only one ensemble member is computed."
    warn(Finding("prior.one-member", sentence), stacklevel=5)
    return changed


class GuidedMarigoldDepthPipeline(GuidedCall, MarigoldDepthPipeline):
    """``MarigoldDepthPipeline`` whose call takes ``guidance``; ``from_pretrained`` is unchanged.

    >>> pipe = GuidedMarigoldDepthPipeline.from_pretrained("prs-eth/marigold-depth-v1-1")
    >>> depth_m = pipe(left, guidance=GeometryGuidance(right, K, E)).prediction
    """


def _stock_class(guided: type) -> type:
    """Return the class that ``GuidedCall`` was mixed into."""
    return next(c for c in guided.__mro__ if not issubclass(c, GuidedCall))


@functools.cache
def _guided_class(stock: type) -> type:
    if stock is MarigoldDepthPipeline:
        return GuidedMarigoldDepthPipeline
    return type(f"Guided{stock.__name__}", (GuidedCall, stock), {"__doc__": GuidedCall.__doc__})


def enable_geometry_guidance(
    pipe: DiffusionPipeline, *, cuda_graphs: bool | None = None, kernels: bool | None = None
) -> DiffusionPipeline:
    """Let a live pipeline accept ``guidance=``. Returns the same object, otherwise unchanged.

    An omitted option keeps its value, initially ``cuda_graphs=False`` and ``kernels=True``. Calls without
    ``guidance`` ignore both.

    Args:
        pipe: a pipeline of a prior in ``PRIORS``.
        cuda_graphs: whether guided calls on CUDA run the U-Net and VAE as CUDA graphs, recorded at the second
            call of each size, and the VAE's half-precision group norms with a Triton kernel, equal within
            rounding. Each graph holds its own memory. Networks that gradients pass through run eagerly.
        kernels: whether to run Triton kernels where they exist; ``False`` runs their references.

    Raises:
        InputError: no adapter in ``PRIORS`` supports the pipeline, its ``__call__`` hides the stock
            arguments, or ``cuda_graphs`` is combined with offloading.
    """
    prior_of(pipe)
    faster = FasterNetworks(pipe) if cuda_graphs else None
    if not isinstance(pipe, GuidedCall):
        _check_named_arguments(type(pipe))
        pipe.__class__ = _guided_class(pipe.__class__)
    if cuda_graphs is not None:
        pipe._faster = faster
    if kernels is not None:
        pipe._uses_kernels = kernels
    return pipe


def disable_geometry_guidance(pipe: DiffusionPipeline) -> DiffusionPipeline:
    """Undo ``enable_geometry_guidance``; does nothing if guidance is not enabled."""
    if isinstance(pipe, GuidedCall):
        pipe.__class__ = _stock_class(type(pipe))
        for name in {"_faster", "_uses_kernels"} & set(vars(pipe)):
            delattr(pipe, name)
    return pipe
