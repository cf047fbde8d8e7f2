"""Switch guidance on a live pipeline on and off, check what cannot be guided, and guide a call (S4)."""

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

from geodiff_plugin._checks import bad_type, bad_value, check_choice, check_number, noted, refuse, warn
from geodiff_plugin._compilation import compile_kernels
from geodiff_plugin._kernels import without_kernels
from geodiff_plugin._threads import BackgroundTask
from geodiff_plugin.algorithm.prompt import depth_prompt
from geodiff_plugin.algorithm.schedule import count_steps
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.evidence.inputs import left_images
from geodiff_plugin.formats.images import in_stored_pixels
from geodiff_plugin.messages import Message, distinct
from geodiff_plugin.priors import DepthPrior, prior_of
from geodiff_plugin.priors.pipeline import RESAMPLING, DepthDiffusionPipeline
from geodiff_plugin.result.ensemble import ensemble_metric
from geodiff_plugin.result.output import MetricDepthOutput, image_labels
from geodiff_plugin.runtime.codec import MapCodec, ProcessingGrid, tiny_autoencoder
from geodiff_plugin.runtime.graphs import FasterNetworks
from geodiff_plugin.runtime.hooks import Exclusive, Layers
from geodiff_plugin.runtime.noise_levels import check_scheduler
from geodiff_plugin.runtime.run import GuidedRun, StepCallback

#: What every stock pipeline's call takes, whatever the prior.
STOCK_ARGUMENTS = (
    *("output_type", "resample_method_input", "resample_method_output", "batch_size", "num_inference_steps"),
    *("processing_resolution", "ensemble_size", "generator", "latents"),
)
#: Upper bound on the steps, pixels and members that a call may ask for.
MOST = 1 << 20

# ``GuidedCall`` is mixed in before a class that has all attributes of a stock pipeline.
_Stock: Any = MarigoldDepthPipeline if TYPE_CHECKING else object


class GuidedCall(_Stock):
    """Mixin for a stock pipeline: ``__call__`` takes ``guidance``, and a guided ensemble is in metres."""

    _guided_run: GuidedRun | None = None
    _faster: FasterNetworks | None = None  # networks of guided calls, of ``graphs=True``
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
        """The stock call; with ``guidance`` its depth is in metres.

        Args:
            image: left image(s), as the stock call takes them; guided, also in any form of ``right``.
            *args: as the stock call takes them.
            guidance: the second view; ``None`` is the stock call, bit for bit.
            callback_on_step_end: ``f(pipe, i, t, {"latents", "metric_depth", "loss", "scale", "shift"})``;
                if it returns ``latents`` they replace the pipeline's. The other values are those of the last
                step that was corrected or updated, and ``None`` before the first.
            strict: a depth that is not trusted, or not judged (``output.verdict``), is an error.
            **kwargs: as the stock call takes them.

        Returns:
            ``MetricDepthOutput``, or with ``return_dict=False`` (prediction, uncertainty, latent) as stock.

        Raises:
            InputError: ``guidance`` is no ``GeometryGuidance``; a scheduler or offloading that cannot be
                guided; an image in a form that is not supported; inputs that do not fit each other.
            RuntimeError: updates inside ``torch.inference_mode()``, or a call by a hook on a network during a
                guided call. ``callback_on_step_end`` may call the pipeline, guided or not: it is restored
                while the callback runs. A call in another thread waits.
        """
        if guidance is None and (callback_on_step_end is not None or strict):
            name = "strict" if callback_on_step_end is None else "callback_on_step_end"
            bad_value(name, "given together with guidance", "guidance=None")
        with Exclusive(self, guidance is not None) as held:
            if self._guided_run is not None:
                raise RuntimeError(
                    "This pipeline is in the middle of a guided call; call it again from "
                    "callback_on_step_end, or afterwards, but not from a hook of its networks."
                )
            if guidance is None:
                return super().__call__(image, *args, **kwargs)
            _check_guided_call(guidance, callback_on_step_end)
            plain_torch = without_kernels(not self._uses_kernels)
            with torch.inference_mode(False), torch.no_grad(), plain_torch, noted() as warned:
                call = _bind(super().__call__, image, *args, **kwargs)
                output, stock = self._call_guided(call, guidance, callback_on_step_end, held, warned)
        labelled = zip(image_labels(len(output.verdicts)), output.verdicts, strict=True)
        untrusted = " ".join(label + verdict.sentence for label, verdict in labelled if not verdict.trusted)
        if strict and untrusted:
            refuse(untrusted)
        if output.verdict.status == "not trusted":
            warn(Message("verdict.not-trusted", untrusted), stacklevel=3)
        output.latent = stock.latent if call["output_latent"] else None
        return output if call["return_dict"] else (output.prediction, output.uncertainty, output.latent)

    def _call_guided(
        self,
        call: dict[str, Any],
        guidance: GeometryGuidance,
        callback: StepCallback | None,
        held: Exclusive,
        warned: Sequence[Message],
    ) -> tuple[MetricDepthOutput, Any]:
        """The output, and that of the stock call; ``call`` is updated to its final arguments.

        ``warned`` is read last, when everything that warns has been done.
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
        call["image"] = lefts_01 = lefts_01.to(device)
        guidance.check_left_images(lefts_01)
        evidence = BackgroundTask(lambda: _prepared(guidance, lefts_01), device, own_stream=True)
        try:
            codec = MapCodec(self, prior, self._processing_grid(call, device), tiny)
            if prior.takes_prompt and call.get("prompt_depth") is None:
                call["prompt_depth"] = depth_prompt(evidence.result(), guidance.config)
            run = GuidedRun(codec, guidance, evidence.result, call, rounds, unlocked)
            stock = self._run_stock(run, call)
            with torch.autocast(device.type, enabled=False):
                return run.output(stock, distinct(guidance.warned, warned)), stock
        finally:
            evidence.close()

    def _run_stock(self, run: GuidedRun, call: dict[str, Any]) -> Any:
        """The stock call within a run."""
        fixed = {"return_dict": True, "output_latent": True, "output_type": "pt"}
        try:
            with run:
                return super().__call__(**call | fixed)
        finally:
            run.release()

    def _processing_grid(self, call: dict[str, Any], device: torch.device) -> ProcessingGrid:
        """The grid that the stock call will denoise on, by the stock preprocessing, which is done once.

        It reads pictures with channels last, as in a stock call, but with given latents, where Marigold does
        not accept that. The copy, 144 MB at 12 megapixels, is not kept.
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
        """As stock, which looks through all layers several times; while guided, where the run is."""
        if self._guided_run is not None:
            return self._guided_run.device
        return Layers.of(self).device or super()._execution_device

    def progress_bar(self, iterable: Any = None, total: int | None = None, **kwargs: Any) -> Any:
        """Stock progress bars; while guided they are off, because the run shows one bar for all."""
        if self._guided_run is None:
            return super().progress_bar(iterable, total, **kwargs)
        return tqdm(iterable, total=total, disable=True)

    def decode_prediction(self, pred_latent: Tensor) -> Tensor:
        """Stock decode; while guided, metres instead of the clipped relative map."""
        if self._guided_run is None:
            return super().decode_prediction(pred_latent)
        return self._guided_run.metric_prediction(pred_latent)

    def ensemble_depth(self, depth: Tensor, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor | None]:
        """Stock ensembling; while guided, the median of members that are in metres already."""
        if self._guided_run is None:
            return super().ensemble_depth(depth, *args, **kwargs)
        lower = self._guided_run.config.even_ensemble == "lower"
        return ensemble_metric(depth, kwargs.get("reduction", "median"), lower)

    def put_together(self, maps: Tensor, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor | None]:
        """The prior's way to combine ensembles; while guided, ``ensemble_depth`` for every image."""
        if self._guided_run is None:
            return super().put_together(maps, *args, **kwargs)
        return DepthDiffusionPipeline.put_together(self, maps, *args, **kwargs)

    def save_pretrained(self, *args: Any, **kwargs: Any) -> None:
        """Save the stock pipeline, so that the folder loads without this package."""
        with Exclusive(self, guided=False):
            twin = copy.copy(self)
        twin.__class__ = _stock_class(type(self))
        twin.save_pretrained(*args, **kwargs)


def _prepared(guidance: GeometryGuidance, lefts_01: Tensor) -> list[Evidence]:
    """Act 1, in float32 whatever the user's autocast."""
    with torch.autocast(lefts_01.device.type, enabled=False):
        return guidance.evidence_of(lefts_01)


def _bind(stock_call: Callable[..., Any], *args: Any, **kwargs: Any) -> dict[str, Any]:
    """All arguments of the stock call by name, with defaults and those that a prior adds."""
    signature = inspect.signature(stock_call)
    bound = signature.bind(*args, **kwargs)
    bound.apply_defaults()
    call = dict(bound.arguments)
    for name, parameter in signature.parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD:
            call |= call.pop(name)
    return call


def _check_named_arguments(pipeline: type) -> None:
    """Refuse a subclass whose ``__call__`` does not name the arguments of the stock pipeline."""
    named = inspect.signature(pipeline.__call__).parameters
    if missing := [name for name in STOCK_ARGUMENTS if name not in named]:
        refuse(
            f"The __call__ of {pipeline.__name__} must name the arguments of the stock pipeline that it "
            f"overrides; it has no {', '.join(missing)}. A **kwargs that hands them on hides them: "
            "write them out."
        )


def _check_guided_call(guidance: Any, callback: Any) -> None:
    if not isinstance(guidance, GeometryGuidance):
        bad_type("guidance", "a GeometryGuidance", guidance, "Make one: GeometryGuidance(right, K, E).")
    if callback is not None and not callable(callback):
        bad_type("callback_on_step_end", "a function", callback)
    if torch.is_inference_mode_enabled() and guidance.updates.inner_steps > 0:
        raise RuntimeError(
            "Gradient updates (inner_steps) are not possible under torch.inference_mode(); "
            "use torch.no_grad() or nothing."
        )


def count_guided_steps(pipe: Any, guidance: GeometryGuidance, requested: int | None) -> tuple[int, int]:
    """Denoising steps of a guided call, of which the user ``requested`` so many, and rounds in each."""
    wanted = guidance.denoising_steps(requested, pipe.default_denoising_steps)
    return count_steps(wanted, requested, prior_of(pipe).max_steps)


def _check_arguments(call: Mapping[str, Any], images: int) -> None:
    """Refuse arguments that no pipeline takes; ``images`` is the number of left images."""
    check_choice(call["output_type"], "output_type", ("np", "pt"))
    check_choice(call["resample_method_input"], "resample_method_input", RESAMPLING)
    check_choice(call["resample_method_output"] or "bilinear", "resample_method_output", RESAMPLING)
    for name, least in (("num_inference_steps", 1), ("processing_resolution", 0)):
        if call[name] is not None:
            check_number(call[name], name, least, MOST, integer=True)
    for name in ("batch_size", "ensemble_size"):
        check_number(call[name], name, 1, MOST, integer=True)
    given, members = call["generator"], images * call["ensemble_size"]
    generators = given if isinstance(given, list) else [given]
    if given is not None and not all(isinstance(each, torch.Generator) for each in generators):
        bad_type("generator", "None, a torch.Generator or a list of them", given)
    if isinstance(given, list) and len(given) != members:
        expected = f"a torch.Generator, or a list of {members}: one for every image and member"
        bad_value("generator", expected, f"a list of {len(given)}")
    latents = call["latents"]
    if isinstance(latents, Tensor) and not latents.isfinite().all():
        bad_value("latents", "finite", "NaN or infinity in it")


def _check_guidable(pipe: Any, prior: DepthPrior, guidance: GeometryGuidance, layers: Layers) -> None:
    """Refuse a pipeline whose scheduler, offloading, casting or network cannot be guided as configured."""
    check_scheduler(pipe.scheduler)
    full = guidance.config.gradient == "full"
    for network, layer in layers.hooked:
        differentiated = guidance.moves_latents and (full or network is getattr(pipe, "vae", None))
        _check_weights_stay(type(network).__name__, layer, differentiated)
    if full and getattr(pipe, "_all_hooks", None):
        expected = "'denoised' with enable_model_cpu_offload()"
        cure = "Decoding pushes the U-Net to the CPU before its backward pass; use gradient='denoised' or "
        bad_value("gradient", expected, "'full'", cure + "pipe.to(device).")
    if guidance.through_network and prior.network_input is None:
        cure = "z_t is no input of its network, so only the clean latent can be moved."
        bad_value("gradient", "'denoised' with this prior", "'full'", cure)


def _check_weights_stay(name: str, module: torch.nn.Module, differentiated: bool) -> None:
    """Refuse hooks that offload or cast weights before a backward pass needs them."""
    registry, hook = vars(module).get("_diffusers_hook"), vars(module).get("_hf_hook")
    of_diffusers = "" if registry is None else " ".join(registry.hooks)
    of_accelerate = [h for h in getattr(hook, "hooks", [hook]) if type(h).__name__ == "AlignDevicesHook"]
    if any(h.offload for h in of_accelerate) or "group_offloading" in of_diffusers:
        expected = "without sequential or group CPU offloading while guided"
        cure = "The backward pass needs them: use pipe.enable_model_cpu_offload() or pipe.to(device)."
        bad_value("pipe", expected, f"{name} whose weights leave the device after each forward", cure)
    if differentiated and "layerwise_casting" in of_diffusers:
        cure = "Leave inner_steps at 0, or load the pipeline in half precision."
        got = f"{name} whose weights are cast after each layer"
        bad_value("pipe", "without layerwise casting where gradients go through", got, cure)


def _one_member(call: dict[str, Any]) -> dict[str, Any]:
    """The arguments to change so that a prior that always gives the same map runs one member only."""
    first = slice(None, None, call["ensemble_size"])
    changed = {"ensemble_size": 1, "output_uncertainty": False}
    for name, kind in (("generator", list), ("latents", Tensor)):
        if isinstance(call[name], kind):
            changed[name] = call[name][first]
    sentence = "This prior gives the same map every time: only one member runs."
    warn(Message("prior.one-member", sentence), stacklevel=5)
    return changed


class GuidedMarigoldDepthPipeline(GuidedCall, MarigoldDepthPipeline):
    """``MarigoldDepthPipeline`` whose call takes ``guidance``; ``from_pretrained`` as always.

    >>> pipe = GuidedMarigoldDepthPipeline.from_pretrained("prs-eth/marigold-depth-v1-1")
    >>> depth_m = pipe(left, guidance=GeometryGuidance(right, K, E)).prediction
    """


def _stock_class(guided: type) -> type:
    """The class that ``GuidedCall`` was mixed into."""
    return next(c for c in guided.__mro__ if not issubclass(c, GuidedCall))


@functools.cache
def _guided_class(stock: type) -> type:
    if stock is MarigoldDepthPipeline:
        return GuidedMarigoldDepthPipeline
    return type(f"Guided{stock.__name__}", (GuidedCall, stock), {"__doc__": GuidedCall.__doc__})


def enable_geometry_guidance(
    pipe: DiffusionPipeline, *, graphs: bool | None = None, kernels: bool | None = None
) -> DiffusionPipeline:
    """Let a live pipeline take ``guidance=``; nothing else about it changes. Returns the same object.

    An option that is left out stays as it is, at first ``graphs=False`` and ``kernels=True``; calls without
    ``guidance`` heed neither.

    Args:
        pipe: a pipeline of a prior in ``PRIORS``.
        graphs: guided calls on CUDA run U-Net and VAE as CUDA graphs, recorded at the second call of a size,
            and the group norms of a VAE in half precision by a kernel, equal within rounding. Each graph
            holds memory of its own. Where gradients go through a network it runs as always.
        kernels: stages run by Triton kernels where there are some; ``False``: by their references.

    Raises:
        InputError: no adapter in ``PRIORS`` understands it, or its call hides the stock arguments; ``graphs``
            with offloading.
    """
    prior_of(pipe)
    faster = FasterNetworks(pipe) if graphs else None
    if not isinstance(pipe, GuidedCall):
        _check_named_arguments(type(pipe))
        pipe.__class__ = _guided_class(pipe.__class__)
    if graphs is not None:
        pipe._faster = faster
    if kernels is not None:
        pipe._uses_kernels = kernels
    return pipe


def disable_geometry_guidance(pipe: DiffusionPipeline) -> DiffusionPipeline:
    """Undo ``enable_geometry_guidance``; on a pipeline that is not enabled it does nothing."""
    if isinstance(pipe, GuidedCall):
        pipe.__class__ = _stock_class(type(pipe))
        for name in {"_faster", "_uses_kernels"} & set(vars(pipe)):
            delattr(pipe, name)
    return pipe
