"""A tiny autoencoder of depth maps: ``python -m examples.training.train_tiny --help``.

Data flow: crops of rendered depth -> the prior's autoencoder (teacher) -> ``AutoencoderTiny`` with the
    same latent -> folder for the parameter ``decoder``.
Paper: none; the network is TAESD's (O. Boer Bohan, github.com/madebyollin/taesd), the loss is ours.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKL, AutoencoderTiny
from tqdm import tqdm

from examples.training.data import normalise_disparity, read_shard, shards
from examples.training.schedule import learning_rate
from examples.training.train_vae import edge_error
from geodiff_plugin._internal.checks import bad_value, check_number
from geodiff_plugin.bundled import no_bars

__all__ = ["build_tiny", "distillation_loss", "draw_maps", "main", "perturbed", "train_tiny"]

#: Weight of the latents' squared error relative to the error of maps.
_CODE = 0.2
#: Fraction of the latents that are blurred.
_BLURRED = 0.5
#: Maximum standard deviation of the noise added to all latents.
_NOISE = 0.2
#: Side of a crop, pixels.
_SIDE = 64
_SAY_EVERY = 500


def build_tiny(vae: AutoencoderKL, width: int = 16) -> AutoencoderTiny:
    """Build an untrained tiny autoencoder for the teacher's latents: 2 or 3 blocks per level, 0 at full size.

    Args:
        vae: teacher; defines levels and latent channels.
        width: channels of every layer, >= 1.
    """
    levels = len(vae.config.block_out_channels)
    half = (2,) * (levels - 2)
    return AutoencoderTiny(
        encoder_block_out_channels=(width,) * levels,
        decoder_block_out_channels=(width,) * levels,
        num_encoder_blocks=(0, *half, 3),
        num_decoder_blocks=(3, *half, 0),
        latent_channels=vae.config.latent_channels,
    )


def draw_maps(disparity: torch.Tensor, batch: int, side: int, generator: torch.Generator) -> torch.Tensor:
    """Draw random crops of relative maps like the ones that guidance decodes and encodes.

    A random power of normalised inverse depth also covers maps of depth and log depth. Half of the maps
    are inverted; range and offset vary, as in early estimates.

    Args:
        disparity: ``(N, 1, H, W)`` normalised inverse depth in [-1, 1].
        batch: number of crops.
        side: side of a crop, pixels; at most the image's.
        generator: CPU generator.

    Returns:
        ``(batch, 3, side, side)``, about [-1, 1]; the three channels are equal.
    """
    side = min(side, *disparity.shape[-2:])

    def draw(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand((batch, 1, 1, 1), generator=generator)

    crops = []
    for _ in range(batch):
        i, y, x = (
            int(torch.randint(n, (), generator=generator))
            for n in (len(disparity), *(n - side + 1 for n in disparity.shape[-2:]))
        )
        crops.append(disparity[i, :, y : y + side, x : x + side])
    unit = (torch.stack(crops) + 1.0) / 2.0
    bent = 2.0 * unit ** torch.exp(draw(-1.0, 1.0)) - 1.0
    turned = torch.where(draw(0.0, 1.0) < 0.5, bent, -bent)
    return (draw(0.6, 1.1) * turned + draw(-0.1, 0.1)).expand(-1, 3, -1, -1)


def perturbed(codes: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Perturb latents of unit spread like estimates of a clean latent: half are blurred, all are noisy."""
    blurred = F.avg_pool2d(F.pad(codes, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    one_each = (len(codes), 1, 1, 1)
    pick = torch.rand(one_each, generator=generator).to(codes.device) < _BLURRED
    level = _NOISE * torch.rand(one_each, generator=generator).to(codes.device)
    grain = torch.randn(codes.shape, generator=generator).to(codes.device)
    return torch.where(pick, blurred, codes) + level * grain


def distillation_loss(
    tiny: AutoencoderTiny, vae: AutoencoderKL, maps: torch.Tensor, generator: torch.Generator
) -> torch.Tensor:
    """Compute the student's error relative to its teacher: decoded maps, latents, and reconstructed maps.

    Args:
        tiny: student, in training.
        vae: teacher, frozen.
        maps: ``(N, 3, H, W)``.
        generator: CPU generator of the perturbation.

    Returns:
        Scalar.
    """
    scale = vae.config.scaling_factor
    shift = vae.config.get("shift_factor") or 0.0
    with torch.no_grad():
        codes = scale * (vae.encode(maps).latent_dist.mode() - shift)
        latents = perturbed(codes, generator)
        target = vae.decode(latents / scale + shift).sample.mean(dim=1, keepdim=True)
    found = tiny.encode(maps).latents
    return (
        _map_error(tiny.decode(latents).sample, target)
        + _map_error(tiny.decode(found).sample, maps.mean(dim=1, keepdim=True))
        + _CODE * (found - codes).square().mean()
    )


def _map_error(images: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean absolute error of the channels' mean, which a prior reads, and of its gradient."""
    error = images.mean(dim=1, keepdim=True) - target
    return error.abs().mean() + edge_error(error)


def train_tiny(
    vae: AutoencoderKL,
    cache: Path,
    seconds: float,
    width: int = 16,
    batch: int = 8,
    rate: float = 3e-3,
    seed: int = 0,
    steps: int | None = None,
    notify: Callable[[str], None] = lambda line: None,
) -> AutoencoderTiny:
    """Distil a tiny autoencoder from a prior's autoencoder.

    Args:
        vae: teacher, frozen; its device is used.
        cache: rendered shards, at least one.
        seconds: wall-clock budget, > 0.
        width: channels of the student.
        batch: crops per step.
        rate: maximum learning rate.
        seed: seed of weights and crops.
        steps: a fixed number of steps instead of the budget.
        notify: receives a progress line every 500 steps.

    Returns:
        The student, frozen.

    Raises:
        ValueError: the cache has no shard.
    """
    have = shards(cache)
    if not have:
        hint = "Fill it by `python -m examples.training.data --cache DIR --stop 64`."
        bad_value("cache", "a folder with rendered shards", cache, hint)
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    tiny = build_tiny(vae, width).to(vae.device).train()
    optimiser = torch.optim.AdamW(tiny.parameters(), lr=rate, betas=(0.9, 0.99), weight_decay=1e-4)
    start = time.monotonic()
    step = 0
    losses = []
    while (done := step / steps if steps else (time.monotonic() - start) / seconds) < 1.0:
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(rate, done, step, warm_up=100)
        if step % 16 == 0:
            shard = have[int(torch.randint(len(have), (), generator=generator))]
            disparity = normalise_disparity(read_shard(cache, shard)[1])
        maps = draw_maps(disparity, batch, _SIDE, generator).to(vae.device)
        loss = distillation_loss(tiny, vae, maps, generator)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(tiny.parameters(), 1.0)
        optimiser.step()
        step += 1
        losses.append(loss.detach())
        if len(losses) == _SAY_EVERY:
            notify(f"step {step}, {100 * done:.0f} % done, loss {float(torch.stack(losses).mean()):.4f}")
            losses.clear()
    return tiny.eval().requires_grad_(False)


def main(argv: list[str] | None = None) -> None:
    """Command line; see ``--help``."""
    parser = argparse.ArgumentParser(prog="python -m examples.training.train_tiny", description=__doc__)
    parser.add_argument("--prior", required=True, help="pipeline folder or hub id of the teacher autoencoder")
    parser.add_argument("--cache", type=Path, required=True, help="rendered scenes, see training.data")
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--steps", type=int, help="a fixed number of steps instead of --minutes")
    parser.add_argument("--width", type=int, default=16, help="channels; 64 for an autoencoder of full size")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    check_number(options.minutes, "minutes", 0.001, 1e5)
    with no_bars():
        vae = AutoencoderKL.from_pretrained(
            options.prior, subfolder="vae", dtype=torch.float32, use_safetensors=True
        )
    tiny = train_tiny(
        vae.to(options.device).eval().requires_grad_(False),
        options.cache,
        60.0 * options.minutes,
        width=options.width,
        batch=options.batch,
        seed=options.seed,
        steps=options.steps,
        notify=tqdm.write,
    )
    tiny.half().save_pretrained(options.out, safe_serialization=True)


if __name__ == "__main__":
    main()
