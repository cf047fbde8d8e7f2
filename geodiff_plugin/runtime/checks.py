"""What a guided call refuses before it computes anything: arguments, images, offloading, casting."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._checks import bad_type, bad_value, check_choice, check_number, refuse
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.priors.pipeline import RESAMPLING
from geodiff_plugin.runtime.noise_levels import check_scheduler

#: What every stock pipeline's call takes, whatever the prior.
STOCK_ARGUMENTS = (
    *("output_type", "resample_method_input", "resample_method_output", "batch_size", "num_inference_steps"),
    *("processing_resolution", "ensemble_size", "generator", "latents"),
)
#: More than any call asks for, of steps, pixels or members.
MOST = 1 << 20


def check_named_arguments(pipeline: type) -> None:
    """Refuse a subclass whose ``__call__`` does not name the arguments of the stock pipeline."""
    named = inspect.signature(pipeline.__call__).parameters
    missing = [name for name in STOCK_ARGUMENTS if name not in named]
    if missing:
        refuse(
            f"The __call__ of {pipeline.__name__} must name the arguments of the stock pipeline that it "
            f"overrides; it has no {', '.join(missing)}. A **kwargs that hands them on hides them: "
            "write them out."
        )


def check_arguments(call: Mapping[str, Any], images: int) -> None:
    """Refuse arguments of the call by name that no pipeline takes, for so many left images, in our own words.

    What the stock pipeline refuses in a sentence that names the argument is left to it.
    """
    check_choice(call["output_type"], "output_type", ("np", "pt"))
    for name in ("resample_method_input", "resample_method_output"):
        if call[name] is not None or name == "resample_method_input":
            check_choice(call[name], name, RESAMPLING)
    for name, least in (("num_inference_steps", 1), ("processing_resolution", 0)):
        if call[name] is not None:
            check_number(call[name], name, least, MOST, integer=True)
    for name in ("batch_size", "ensemble_size"):
        check_number(call[name], name, 1, MOST, integer=True)
    given, members = call["generator"], images * call["ensemble_size"]
    generators = given if isinstance(given, list) else [] if given is None else [given]
    if not all(isinstance(generator, torch.Generator) for generator in generators):
        bad_type("generator", "None, a torch.Generator or a list of them", given)
    if isinstance(given, list) and len(given) != members:
        expected = f"a torch.Generator, or a list of {members}: one for every image and member"
        bad_value("generator", expected, f"a list of {len(given)}")
    latents = call["latents"]
    if isinstance(latents, Tensor) and not latents.isfinite().all():
        bad_value("latents", "finite", "NaN or infinity in it")


def left_images(image: Any) -> Tensor:
    """Left images ``(N, 3, H, W)`` float32 in [0, 1], read as ``GeometryGuidance`` reads right ones.

    ``image`` is a PIL image, numpy ``(H, W, C)``, ``(H, W)`` or ``(N, H, W, C)``, torch ``(C, H, W)``, ``(H,
    W)`` or ``(N, C, H, W)``, or a list of them.
    """
    named = list(_named(image, "image"))
    if not named:
        bad_value("image", "an image or a list of images", "an empty one")
    tensors = [as_image_01(entry, name) for name, entry in named]
    size = tensors[0].shape
    for (name, _), tensor in zip(named, tensors, strict=True):
        if tensor.shape != size:
            expected = f"of {size[2]}x{size[1]} pixels, as {named[0][0]}"
            got = f"{tensor.shape[2]}x{tensor.shape[1]}"
            bad_value(name, expected, got, "Call once for every size.")
    return torch.stack(tensors)


def _named(image: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Every single image with its name in messages; of a batch with its index."""
    several = isinstance(image, list)
    if isinstance(image, (np.ndarray, Tensor)):
        several = image.ndim == 4
        image = image[None] if isinstance(image, Tensor) and image.ndim == 2 else image
    if not several:
        yield name, image
        return
    for i, entry in enumerate(image):
        yield from _named(entry, f"{name}[{i}]")


def needs_network(guidance: GeometryGuidance) -> bool:
    """Whether gradients of z_t are taken through the network."""
    return guidance.config.gradient == "full" and _moves_latents(guidance)


def _moves_latents(guidance: GeometryGuidance) -> bool:
    return guidance.config.optimize_latents and guidance.updates.inner_steps > 0


def check_guidable(pipe: Any, prior: DepthPrior, guidance: GeometryGuidance) -> None:
    """Refuse a pipeline whose scheduler, offloading, casting or network cannot be guided as configured."""
    check_scheduler(pipe.scheduler)
    _check_offloading(pipe, guidance.config.gradient)
    _check_casting(pipe, guidance)
    if needs_network(guidance) and prior.network_input is None:
        cure = "z_t is no input of its network, so only the clean latent can be moved."
        bad_value("gradient", "'denoised' with this prior", "'full'", cure)


def _modules(component: Any) -> Iterator[torch.nn.Module]:
    return component.modules() if isinstance(component, torch.nn.Module) else iter(())


def _check_offloading(pipe: Any, gradient: str) -> None:
    """Refuse offloading that takes weights away before the backward pass needs them."""
    for component in pipe.components.values():
        for module in _modules(component):
            hook = getattr(module, "_hf_hook", None)
            hooks = getattr(hook, "hooks", [hook] if hook else [])
            sequential = any(type(h).__name__ == "AlignDevicesHook" for h in hooks) and any(
                getattr(h, "offload", False) for h in hooks
            )
            if sequential or any("group_offloading" in name for name in _diffusers_hooks(module)):
                expected = "without sequential or group CPU offloading while guided"
                got = f"{type(component).__name__} whose weights leave the device after each forward"
                cure = "The backward pass needs them: use pipe.enable_model_cpu_offload() or pipe.to(device)."
                bad_value("pipe", expected, got, cure)
    if gradient == "full" and getattr(pipe, "_all_hooks", None):
        expected = "'denoised' with enable_model_cpu_offload()"
        cure = "Decoding pushes the U-Net to the CPU before its backward pass; use gradient='denoised' or "
        bad_value("gradient", expected, "'full'", cure + "pipe.to(device).")


def _check_casting(pipe: Any, guidance: GeometryGuidance) -> None:
    """Refuse layerwise casting of a module that gradients go through: its weights are others by then."""
    if not _moves_latents(guidance):
        return
    full = guidance.config.gradient == "full"
    for component in pipe.components.values() if full else [getattr(pipe, "vae", None)]:
        if any("layerwise_casting" in _diffusers_hooks(module) for module in _modules(component)):
            got = f"{type(component).__name__} whose weights are cast after each layer"
            cure = "Leave inner_steps at 0, or load the pipeline in half precision."
            bad_value("pipe", "without layerwise casting where gradients go through", got, cure)


def _diffusers_hooks(module: torch.nn.Module) -> Mapping[str, Any]:
    registry = getattr(module, "_diffusers_hook", None)
    return {} if registry is None else registry.hooks
