"""Depth completion as Marigold V2's authors do it: a second LoRA, fitted to the known points of each image.

Data flow: pipeline, image, sparse metres -> 100 Adam steps through the transformer -> metres.
Paper: none (Marigold V2, arXiv 2609.08084): the peer of ``GeometryGuidance.from_points`` on that prior.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.marigold_v2 import MarigoldV2Pipeline

__all__ = ["FittedLora", "complete_by_lora"]

#: Metres that the authors clamp to.
NEAREST_M, FARTHEST_M = 1e-3, 1000.0
#: Layers of a block that carry the checkpoint's LoRA, and so this one.
TARGETS = re.compile(
    r"transformer_blocks\.(\d+)\.(attn\.(to_[qkv]|to_out\.0|add_[qkv]_proj|to_add_out)"
    r"|(img|txt)_mlp\.net\.(0\.proj|2))"
)


@dataclass(frozen=True)
class FittedLora:
    """Their hyperparameters.

    Attributes:
        steps: of Adam.
        rank: of the LoRA; its alpha is the same.
        last_blocks: how many of the last transformer blocks get one, 0 for all.
        rate: of the LoRA.
        rate_affine: of scale and shift in log depth.
        seed: of the LoRA's start.
    """

    steps: int = 100
    rank: int = 16
    last_blocks: int = 12
    rate: float = 1e-3
    rate_affine: float = 0.03
    seed: int = 0


@contextmanager
def _adapter(transformer: torch.nn.Module, options: FittedLora) -> Iterator[list[Tensor]]:
    """Low-rank additions to the outputs of linear layers, zero at first, taken off again at the end."""
    found = [(name, m, TARGETS.fullmatch(name)) for name, m in transformer.named_modules()]
    found = [(int(hit[1]), module) for _, module, hit in found if hit]
    first = 1 + max(block for block, _ in found) - options.last_blocks if options.last_blocks else 0
    generator = torch.Generator().manual_seed(options.seed)
    parameters, hooks = [], []
    for module in (module for block, module in found if block >= first):
        bound = module.in_features**-0.5  # as a linear layer starts
        down = torch.rand(options.rank, module.in_features, generator=generator) * 2 * bound - bound
        up = torch.zeros(module.out_features, options.rank)
        pair = [x.to(transformer.device).requires_grad_() for x in (down, up)]

        def add(_: Any, inputs: tuple[Tensor], output: Tensor, pair: list[Tensor] = pair) -> Tensor:
            down, up = (factor.to(inputs[0].dtype) for factor in pair)
            return output + F.linear(F.linear(inputs[0], down), up)

        hooks.append(module.register_forward_hook(add))
        parameters += pair
    try:
        yield parameters
    finally:
        for hook in hooks:
            hook.remove()


def _least_squares(relative: Tensor, log_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Scale and shift of log depth at the points."""
    design = torch.stack([relative.double(), torch.ones_like(relative.double())], 1)
    return torch.linalg.lstsq(design, log_depth.double()[:, None]).solution[:, 0].float().unbind()


def complete_by_lora(
    pipe: MarigoldV2Pipeline,
    image: Any,
    points_m: Tensor,
    options: FittedLora | None = None,
    resolution: int | None = None,
) -> Tensor:
    """Fit a LoRA, a scale and a shift to the points of one image.

    Args:
        pipe: affine in log depth; left as it was.
        image: one image, as the pipeline takes it.
        points_m: ``(H, W)`` metres of the image's size, 0 where unknown.
        options: theirs by default; 0 steps leave the least-squares fit that they start from.
        resolution: longer side for the prior, pixels; the pipeline's own for ``None``.

    Returns:
        ``(H, W)`` metres.

    Raises:
        ValueError: a prior that is not affine in log depth.

    Source: ``evaluation/depth_completion/run_marigold_v2.py`` of huawei-bayerlab/marigold-v2, with the loss
    on the image's own pixels. The LoRA is made of hooks, so that nothing has to be installed for it.
    """
    options = FittedLora() if options is None else options
    if pipe.config.prediction_type != "log":
        bad_value("the prior", "affine in log depth, as theirs", f"{pipe.config.prediction_type!r}")
    resolution = pipe.default_processing_resolution if resolution is None else resolution
    device = pipe._execution_device
    padded, _, _ = pipe.image_processor.preprocess(image, resolution, device=device, dtype=pipe.dtype)
    points_m = points_m.to(device)
    known = points_m > 0
    target, size = points_m[known], tuple(points_m.shape)
    weights = [p for m in (pipe.transformer, pipe.vae) for p in m.parameters()]
    flags = [p.requires_grad for p in weights]
    for parameter in weights:
        parameter.requires_grad_(False)
    try:
        with _adapter(pipe.transformer, options) as parameters:
            with torch.no_grad():
                condition = pipe.prepare_condition(padded, 1, 1, None)
            pipe.set_timesteps(1, device)

            def relative() -> Tensor:
                z = condition["image_latent"]
                z0 = z.float() - pipe.denoise(z, pipe.scheduler.timesteps[0], condition).float()
                x = 2.0 * pipe.decode_prediction(z0) - 1.0
                return F.interpolate(x, size, mode="bilinear", align_corners=False)[0, 0]

            return _fit(relative, parameters, known, target, options)
    finally:
        for parameter, flag in zip(weights, flags, strict=True):
            parameter.requires_grad_(flag)


def _fit(
    relative: Any, parameters: list[Tensor], known: Tensor, target: Tensor, options: FittedLora
) -> Tensor:
    """Adam on L1 + L2 in metres at the points; the depth after the last step."""
    nearest, farthest = (float(torch.tensor(m).log()) for m in (NEAREST_M, FARTHEST_M))

    def metres(a: Tensor, b: Tensor) -> Tensor:
        return torch.exp(torch.clamp(a * relative() + b, nearest, farthest))

    with torch.no_grad():
        a, b = _least_squares(relative()[known], target.clamp_min(NEAREST_M).log())
    a, b = a.clone().requires_grad_(), b.clone().requires_grad_()
    groups = [
        {"params": parameters, "lr": options.rate},
        {"params": [a, b], "lr": options.rate_affine},
    ]
    optimiser = torch.optim.Adam(groups)
    for _ in range(options.steps):
        with torch.enable_grad():
            found = metres(a, b)[known]
            loss = F.l1_loss(found, target) + F.mse_loss(found, target)
        optimiser.zero_grad()
        # The last block's answer to the prompt is read by nobody, so its LoRA has no gradient.
        gradients = torch.autograd.grad(loss, [*parameters, a, b], allow_unused=True)
        for parameter, gradient in zip([*parameters, a, b], gradients, strict=True):
            parameter.grad = gradient
        optimiser.step()
    with torch.no_grad():
        return metres(a, b)
