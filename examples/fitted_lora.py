"""Depth completion from known points: by guidance, and by fitting a LoRA per image (Marigold V2's authors).

The fit takes 100 Adam steps through the transformer per image; the guided call takes one pass. By default the
script runs on a tiny prior with random weights, whose depth is meaningless:

    python -m examples.fitted_lora --points 500
    python -m examples.fitted_lora --points 500 --prior marigold-v2 --device cuda
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from examples.marigold_v2 import tiny_marigold_v2
from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.bundled.demo_pair import DemoPair, read_demo_pair
from geodiff_plugin.priors.marigold_v2 import MarigoldV2Pipeline

#: Lower clamp of depth in metres, as in the authors' code.
MIN_M = 1e-3
#: Upper clamp of depth in metres, as in the authors' code.
MAX_M = 1000.0
#: Layers of a block with a LoRA, the same as in the checkpoint.
TARGETS = re.compile(
    r"transformer_blocks\.(\d+)\.(attn\.(to_[qkv]|to_out\.0|add_[qkv]_proj|to_add_out)"
    r"|(img|txt)_mlp\.net\.(0\.proj|2))"
)


@dataclass(frozen=True)
class FittedLora:
    """Hyperparameters of the fit (defaults: the authors').

    Attributes:
        steps: number of Adam steps.
        rank: rank and alpha of the LoRA.
        last_blocks: number of last transformer blocks with a LoRA, 0 for all.
        rate: learning rate of the LoRA.
        rate_affine: learning rate of scale and shift in log depth.
        seed: seed of the LoRA's initialisation.
    """

    steps: int = 100
    rank: int = 16
    last_blocks: int = 12
    rate: float = 1e-3
    rate_affine: float = 0.03
    seed: int = 0


@contextmanager
def _adapter(transformer: torch.nn.Module, options: FittedLora) -> Iterator[list[Tensor]]:
    """Add low-rank terms to the outputs of linear layers, initially zero; remove them at the end."""
    found = [(name, m, TARGETS.fullmatch(name)) for name, m in transformer.named_modules()]
    found = [(int(hit[1]), module) for _, module, hit in found if hit]
    first = 1 + max(block for block, _ in found) - options.last_blocks if options.last_blocks else 0
    generator = torch.Generator().manual_seed(options.seed)
    parameters, hooks = [], []
    for module in (module for block, module in found if block >= first):
        bound = module.in_features**-0.5  # initialisation of a linear layer
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
    """Return least-squares scale and shift of log depth at the points."""
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
        pipe: pipeline affine in log depth; unchanged afterwards.
        image: one image, in any form accepted by the pipeline.
        points_m: ``(H, W)`` metres in the image's size, 0 where unknown.
        options: the authors' by default; 0 steps return the initial least-squares fit.
        resolution: longer side for the prior, pixels (``None``: the pipeline's default).

    Returns:
        ``(H, W)`` metres.

    Raises:
        ValueError: the prior is not affine in log depth.

    Source: ``evaluation/depth_completion/run_marigold_v2.py`` of huawei-bayerlab/marigold-v2, with the loss
    on the image's own pixels. The LoRA is implemented with hooks, so it needs no further package.
    """
    options = FittedLora() if options is None else options
    if pipe.config.prediction_type != "log":
        bad_value("the prior", "affine in log depth", f"{pipe.config.prediction_type!r}")
    resolution = pipe.default_processing_resolution if resolution is None else resolution
    device = pipe._execution_device
    padded, _, _ = pipe.image_processor.preprocess(image, resolution, device=device, dtype=pipe.dtype)
    points_m = points_m.to(device)
    known = points_m > 0
    target = points_m[known]
    size = tuple(points_m.shape)
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
    """Minimise L1 + L2 in metres at the points with Adam; return the depth after the last step."""
    nearest, farthest = (float(torch.tensor(m).log()) for m in (MIN_M, MAX_M))

    def metres(a: Tensor, b: Tensor) -> Tensor:
        return torch.exp(torch.clamp(a * relative() + b, nearest, farthest))

    with torch.no_grad():
        a, b = _least_squares(relative()[known], target.clamp_min(MIN_M).log())
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
        # The last block's text output is unused, so its LoRA has no gradient.
        gradients = torch.autograd.grad(loss, [*parameters, a, b], allow_unused=True)
        for parameter, gradient in zip([*parameters, a, b], gradients, strict=True):
            parameter.grad = gradient
        optimiser.step()
    with torch.no_grad():
        return metres(a, b)


#: Longer side for the tiny prior; a prior folder has its own default.
TINY_RESOLUTION = 192


@dataclass(frozen=True)
class Completion:
    """Result of one completion method.

    Attributes:
        name: name of the method.
        seconds: duration of its call.
        passes: number of passes through the transformer; each step of a fitted LoRA also has a backward pass.
        mae_m: mean absolute error in metres over ground truth that was not given.
        abs_rel: mean relative error over the same pixels.
    """

    name: str
    seconds: float
    passes: int
    mae_m: float
    abs_rel: float


def draw_points(pair: DemoPair, count: int, seed: int = 0) -> np.ndarray:
    """Return ``(H, W)`` metres with ``count`` pixels of the ground truth, 0 elsewhere."""
    rows, columns = np.nonzero(pair.valid)
    chosen = np.random.default_rng(seed).choice(len(rows), min(count, len(rows)), replace=False)
    points = np.zeros_like(pair.depth_m)
    points[rows[chosen], columns[chosen]] = pair.depth_m[rows[chosen], columns[chosen]]
    return points


def compare_completions(
    pipe: MarigoldV2Pipeline, pair: DemoPair, points: np.ndarray, resolution: int, options: FittedLora
) -> list[Completion]:
    """Run every method once, after a warm-up call.

    Args:
        pipe: pipeline affine in log depth.
        pair: the image and its ground truth.
        points: ``(H, W)`` metres, 0 where unknown.
        resolution: longer side for the prior, pixels.
        options: options of the fitted LoRA.
    """
    guided_pipe = enable_geometry_guidance(pipe)
    pipe.set_progress_bar_config(disable=True)
    scored = pair.valid & (points == 0)

    def fitted(steps: int) -> Callable[[], np.ndarray]:
        own = FittedLora(**vars(options) | {"steps": steps})
        sparse = torch.from_numpy(points)
        return lambda: complete_by_lora(pipe, pair.left, sparse, own, resolution).cpu().numpy()

    def guided(**overrides: Any) -> Callable[[], np.ndarray]:
        guidance = GeometryGuidance.from_points(points, pair.rig.K_left, **overrides)
        return lambda: guided_pipe(pair.left, guidance=guidance, processing_resolution=resolution).prediction[
            0, ..., 0
        ]

    passes: list[int] = []
    counter = pipe.transformer.register_forward_hook(lambda *_: passes.append(1))
    pipe(pair.left, processing_resolution=resolution)
    ways: dict[str, Callable[[], Any]] = {
        "scale and shift by least squares": fitted(0),
        f"LoRA fitted in {options.steps} steps": fitted(options.steps),
        "GeometryGuidance.from_points": guided(),
        "the same, min_steps=1": guided(min_steps=1),
    }
    found = []
    for name, way in ways.items():
        passes.clear()
        started = time.perf_counter()
        depth_m = way()  # on the CPU, so that the device has finished
        seconds = time.perf_counter() - started
        error = np.abs(depth_m - pair.depth_m)[scored]
        relative = float((error / pair.depth_m[scored]).mean())
        found.append(Completion(name, seconds, len(passes), float(error.mean()), relative))
    counter.remove()
    return found


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--points", type=int, default=500, help="number of points drawn from the demo pair's ground truth"
    )
    parser.add_argument("--prior", help="folder from `geodiff convert marigold-v2`, in log depth")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args(argv)

    resolution = TINY_RESOLUTION
    if options.prior is None:
        pipe = tiny_marigold_v2().to(options.device)
        name = "tiny Marigold V2 with random weights"
    else:
        half = torch.float32 if options.device == "cpu" else torch.bfloat16
        pipe = load_prior(options.prior, device=options.device, dtype=half)
        name = options.prior
        if not isinstance(pipe, MarigoldV2Pipeline):
            bad_value("--prior", "a Marigold V2 in log depth", options.prior)
        resolution = pipe.default_processing_resolution
    pair = read_demo_pair()
    print(f"{name}; {options.points} points of the demo pair's ground truth; longer side {resolution} px")
    print(f"{options.device}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    print(f"{'':<34}{'seconds':>9}{'passes':>8}{'MAE m':>9}{'AbsRel':>9}", flush=True)
    points = draw_points(pair, options.points)
    for way in compare_completions(pipe, pair, points, resolution, FittedLora()):
        numbers = f"{way.seconds:>9.2f}{way.passes:>8}{way.mae_m:>9.3f}{way.abs_rel:>9.3f}"
        print(f"{way.name:<34}{numbers}", flush=True)


if __name__ == "__main__":
    main()
