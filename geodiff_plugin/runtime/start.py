"""What a call starts from beside noise: the previous frame (as SDEdit, Meng et al. 2022), a depth prompt."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
import torch.nn.functional as F
from diffusers import DDIMScheduler
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from geodiff_plugin._checks import bad_type, bad_value
from geodiff_plugin.algorithm.correction import prior_error, refine_depth
from geodiff_plugin.algorithm.evidence import Evidence
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.geometry import image_size
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.matching import Matches, with_points
from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.runtime.noise_levels import noise_level, trailing_timesteps
from geodiff_plugin.scale.space import SPACES

#: Longer side of the depth prompt, pixels.
PROMPT_LONG_EDGE = 256


@dataclass(frozen=True)
class WarmStart:
    """Where a call starts, after the frame before."""

    near_m: Tensor  # (N * E,) metres, depth of the nearest end of the relative map
    far_m: Tensor  # (N * E,) metres, of its farthest end
    skipped: int = 0  # steps of the schedule that are left out
    latents: Tensor | None = None  # (N * E, C, h, w) what the first remaining step begins with, or noise


def plan_warm_start(
    pipe: Any, prior: DepthPrior, guidance: GeometryGuidance, call: Mapping[str, Any], size: tuple[int, int]
) -> WarmStart | None:
    """The start that ``guidance.previous`` gives to a call on a padded grid ``size``; ``None`` without it.

    The latent is taken over by a DDIM of two steps or more. Others take over the scale alone. ``InputError``
    for an output of other images, members or size, or of a prior of another space.
    """
    previous = guidance.previous
    if previous is None:
        return None
    assert previous.latent is not None and previous.scale is not None  # GeometryGuidance has checked that
    # Not their product alone: three members of one image are no start for three images.
    given, wanted = tuple(previous.scale.shape), (len(guidance.inputs), call["ensemble_size"])
    if given != wanted:
        bad_value("previous", "an output of {} images of {} members".format(*wanted), given)
    if previous.space not in (None, prior.space):  # None of one that was put together by hand
        expected = f"the output of a prior whose map is affine in {prior.space}"
        bad_value("previous", expected, f"one in {previous.space}", "Use one prior for a whole sequence.")
    device, steps = pipe._execution_device, call["num_inference_steps"]
    # Its lengths may have become a metric prior's metres, where those of this call are in baselines.
    metres = 1.0 if guidance.unit else previous.rescaled
    affine = (cast(Tensor, v) for v in (previous.scale, previous.shift, previous.global_scale))
    ends = SPACES[prior.space].range_of(*(v.flatten().float() for v in affine))
    near, far = (end.to(device) / metres for end in ends)
    skipped = min(steps - 1, round(steps * guidance.config.warm_start))
    if skipped < 1 or not isinstance(pipe.scheduler, DDIMScheduler):
        return WarmStart(near, far)
    z0, factor = previous.latent.to(device), pipe.image_processor.config.vae_scale_factor
    latent_size = tuple(side // factor for side in size)
    if tuple(z0.shape[-2:]) != latent_size:
        cure = "A frame of another size begins a sequence of its own."
        bad_value("previous", f"an output with a latent of {latent_size}", f"{tuple(z0.shape[-2:])}", cure)
    noise = _noise(z0, prior, call, device)
    scheduler = copy.deepcopy(pipe.scheduler)
    scheduler.set_timesteps(steps)
    trailing = trailing_timesteps(scheduler, steps) if guidance.config.respace else None
    timesteps = scheduler.timesteps if trailing is None else trailing
    level = noise_level(scheduler, timesteps[skipped])
    latents = level.alpha.to(device) * z0.float() + level.sigma.to(device) * noise.to(device).float()
    return WarmStart(near, far, skipped, latents.to(pipe.dtype))


def _noise(z0: Tensor, prior: DepthPrior, call: Mapping[str, Any], device: torch.device) -> Tensor:
    """Noise for a latent: the call's own ``latents``, or drawn by its generator."""
    noise = call["latents"]
    if noise is None:
        depth = z0[:, prior.depth_channels]
        noise = randn_tensor(depth.shape, generator=call["generator"], device=device, dtype=z0.dtype)
        # What a prior denoises beside depth, GeoWizard's normals, starts from the same noise.
        return noise.repeat(1, z0.shape[1] // depth.shape[1], 1, 1)
    if not isinstance(noise, Tensor):
        bad_type("latents", "None or a torch.Tensor", noise)
    if noise.shape != z0.shape:
        bad_value("latents", f"of shape {tuple(z0.shape)}, as those of previous", f"{tuple(noise.shape)}")
    return noise


def depth_prompt(evidence: Sequence[Evidence], config: GuidanceConfig) -> Tensor | None:
    """``(N, 1, h, w)`` metres: flat maps corrected by matches and points; ``None`` if one has neither."""
    maps = []
    for image in evidence:
        confident, points = Matches.stack([image.reliable]), Matches.stack([image.points])
        target = confident if points is None else with_points(confident, points)
        if target is None:
            return None
        height, width = image_size(image.left_01)
        factor = min(1.0, PROMPT_LONG_EDGE / max(height, width))
        size = max(1, round(height * factor)), max(1, round(width * factor))
        median = 1.0 / target.inverse_depth[target.confidence > 0].median()
        flat, left = median.expand(1, 1, height, width), image.left_01[None]
        error = prior_error(flat, target, left, config=config)
        depth_m, _, _ = refine_depth(flat, target, left, error, config=config)
        maps.append(F.interpolate(depth_m, size, mode="bilinear", antialias=True))
    return torch.cat(maps)
