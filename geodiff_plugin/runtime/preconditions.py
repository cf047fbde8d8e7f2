"""Checks of a pipeline before a guided call.

Data flow: pipeline, adapter, gradient -> nothing, or one clear error.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from geodiff_plugin._checks import bad_type, bad_value, check_choice, check_number, refuse
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.priors.pipelines.base import RESAMPLING
from geodiff_plugin.runtime.noise_levels import check_scheduler

__all__ = ["check_arguments", "check_guidable", "check_network_input", "check_offloading", "needs_network"]

#: What every stock pipeline's call takes, whatever the prior.
STOCK_ARGUMENTS = (
    *("output_type", "resample_method_input", "resample_method_output", "batch_size", "num_inference_steps"),
    *("processing_resolution", "ensemble_size", "generator", "latents"),
)


def check_arguments(call: Mapping[str, Any], images: int) -> None:
    """Refuse arguments of the call that no pipeline takes, in our own words.

    What the stock pipeline refuses in a sentence that names the argument is left to it.

    Args:
        call: arguments of the stock call by name.
        images: number of left images.

    Raises:
        TypeError, ValueError: another output type than ``"np"`` and ``"pt"``; a number of steps, a
            resolution, a batch or ensemble size that is no whole number or too small; a way of resampling
            that does not exist; no generator, or a list of another number than that of all members; latents
            that are not finite.
    """
    missing = [name for name in STOCK_ARGUMENTS if name not in call]
    if missing:
        refuse(
            f"The pipeline's __call__ must name the arguments of the stock pipeline that it overrides; "
            f"it has no {', '.join(missing)}. A **kwargs that hands them on hides them: write them out."
        )
    check_choice(call["output_type"], "output_type", ("np", "pt"))
    check_choice(call["resample_method_input"], "resample_method_input", RESAMPLING)
    if call["resample_method_output"] is not None:
        check_choice(call["resample_method_output"], "resample_method_output", RESAMPLING)
    check_number(call["batch_size"], "batch_size", 1, 1 << 20, integer=True)
    for name, least in (("num_inference_steps", 1), ("processing_resolution", 0)):
        if call[name] is not None:
            check_number(call[name], name, least, 1 << 20, integer=True)
    members = images * check_number(call["ensemble_size"], "ensemble_size", 1, 1 << 20, integer=True)
    given = call["generator"]
    generators = given if isinstance(given, list) else [] if given is None else [given]
    if not all(isinstance(generator, torch.Generator) for generator in generators):
        bad_type("generator", "None, a torch.Generator or a list of them", given)
    if isinstance(given, list) and len(given) != members:
        expected = (
            f"one torch.Generator, or a list of {members}: one for every image and member of its ensemble"
        )
        bad_value("generator", expected, f"a list of {len(given)}")
    latents = call["latents"]
    if isinstance(latents, torch.Tensor) and not latents.isfinite().all():
        bad_value("latents", "finite", "NaN or infinity in it")


def check_guidable(pipe: Any, prior: DepthPrior, guidance: GeometryGuidance) -> None:
    """Refuse a pipeline that cannot be guided as configured, while nothing has been computed yet.

    Args:
        pipe: the pipeline.
        prior: its adapter.
        guidance: what was configured.

    Raises:
        TypeError, ValueError: a scheduler, offloading, casting or network that cannot be guided.
    """
    check_scheduler(pipe.scheduler)
    check_offloading(pipe, guidance.config.gradient)
    check_casting(pipe, guidance)
    if needs_network(guidance):
        check_network_input(prior)


def needs_network(guidance: GeometryGuidance) -> bool:
    """Whether gradients of z_t are taken through the network."""
    return guidance.config.gradient == "full" and _moves_latents(guidance)


def _moves_latents(guidance: GeometryGuidance) -> bool:
    return guidance.config.optimize_latents and guidance.updates.inner_steps > 0


def check_network_input(prior: DepthPrior) -> None:
    """Refuse the full gradient if z_t is no input of the network.

    Raises:
        ValueError: it is not, so that there is no gradient through it.
    """
    if prior.network_input is None:
        cure = "z_t is no input of its network, so only the clean latent can be moved."
        bad_value("gradient", "'denoised' with this prior", "'full'", cure)


def check_offloading(pipe: Any, gradient: str) -> None:
    """Refuse offloading that takes weights away before the backward pass needs them.

    Raises:
        ValueError: sequential or group offloading, or model offloading with the full gradient.
    """
    modules = [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)]
    for module in modules:
        for child in module.modules():
            hook = getattr(child, "_hf_hook", None)
            names = {type(h).__name__ for h in getattr(hook, "hooks", [hook] if hook else [])}
            sequential = "AlignDevicesHook" in names and any(
                getattr(h, "offload", False) for h in getattr(hook, "hooks", [hook])
            )
            registry = getattr(child, "_diffusers_hook", None)
            grouped = registry is not None and any("group_offloading" in name for name in registry.hooks)
            if sequential or grouped:
                bad_value(
                    "pipe",
                    "without sequential or group CPU offloading while guided",
                    f"{type(module).__name__} whose weights leave the device after each forward",
                    "The backward pass needs them: use pipe.enable_model_cpu_offload() or pipe.to(device).",
                )
    if gradient == "full" and getattr(pipe, "_all_hooks", None):
        bad_value(
            "gradient",
            "'denoised' with enable_model_cpu_offload()",
            "'full'",
            "Decoding pushes the U-Net to the CPU before its backward pass; "
            "use gradient='denoised' or pipe.to(device).",
        )


def check_casting(pipe: Any, guidance: GeometryGuidance) -> None:
    """Refuse layerwise casting of a module that gradients go through: its weights are others by then.

    Raises:
        ValueError: it is cast, and the latents are moved by gradients.
    """
    if not _moves_latents(guidance):
        return
    modules = pipe.components.values() if guidance.config.gradient == "full" else [getattr(pipe, "vae", None)]
    for module in modules:
        children = module.modules() if isinstance(module, torch.nn.Module) else ()
        registries = [getattr(child, "_diffusers_hook", None) for child in children]
        if any(registry is not None and "layerwise_casting" in registry.hooks for registry in registries):
            bad_value(
                "pipe",
                "without layerwise casting where gradients go through",
                f"{type(module).__name__} whose weights are cast after each layer",
                "Leave inner_steps at 0, or load the pipeline in half precision.",
            )
