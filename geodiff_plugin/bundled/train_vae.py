"""First stage: the autoencoder, on small crops of rendered images and depth maps.

Hop: shards -> crops -> ``AutoencoderKL`` with its ``scaling_factor`` set.
Paper: none (the paper takes Stable Diffusion's autoencoder as it is).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKL
from safetensors.torch import load_file, save_file
from tqdm import tqdm

from geodiff_plugin.bundled.data import jitter, normalise_depth, read_shard, shards
from geodiff_plugin.bundled.models import build_vae

__all__ = ["finish_vae", "load_vae", "save_vae", "train_vae", "vae_loss"]

_KL = 3e-5
_EDGE = 0.5


class _Crops:
    """Random crops of a few shards held in memory; half of a batch is images, half depth."""

    def __init__(self, cache: Path, keep: int = 40) -> None:
        self._cache, self._keep = cache, keep
        self._held: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}

    def draw(self, batch: int, side: int, generator: torch.Generator) -> torch.Tensor:
        """``(batch, 3, side, side)`` in [-1, 1]."""
        have = shards(self._cache)
        fresh = [i for i in have if i not in self._held]
        if fresh and (len(self._held) < self._keep or torch.rand((), generator=generator) < 0.02):
            if len(self._held) >= self._keep:
                self._held.pop(next(iter(self._held)))
            index = fresh[0] if len(self._held) < self._keep else fresh[-1]
            images, depth = read_shard(self._cache, index)
            self._held[index] = (images, normalise_depth(depth))
        names = list(self._held)
        images, depth = self._held[names[int(torch.randint(len(names), (), generator=generator))]]
        zoom = int(torch.randint(1, 3, (), generator=generator))
        zoom = zoom if min(images.shape[-2:]) >= zoom * side else 1
        pieces = []
        for i in range(batch):
            scene = int(torch.randint(len(images), (), generator=generator))
            source = images if i % 2 == 0 else depth
            h, w = (
                int(torch.randint(n - zoom * side + 1, (), generator=generator)) for n in images.shape[-2:]
            )
            piece = source[scene : scene + 1, :, h : h + zoom * side : 1, w : w + zoom * side]
            if i % 2 == 0:
                piece = 2.0 * jitter(F.avg_pool2d(piece, zoom), generator) - 1.0
            else:
                piece = piece[..., ::zoom, ::zoom].expand(-1, 3, -1, -1)
            pieces.append(piece)
        return torch.cat(pieces)


def vae_loss(vae: AutoencoderKL, x: torch.Tensor, generator: torch.Generator | None = None) -> torch.Tensor:
    """Reconstruction (L1 and squared), slope of edges, and a weak pull of the latents to a unit Gaussian.

    Args:
        vae: autoencoder in training.
        x: ``(N, 3, H, W)`` in [-1, 1].
        generator: of the posterior sample.

    Returns:
        Scalar.
    """
    posterior = vae.encode(x).latent_dist
    y = vae.decode(posterior.sample(generator)).sample.float()
    error = (y - x).abs()
    slopes = [((y - x).diff(dim=axis)).abs().mean() for axis in (-1, -2)]
    mean, logvar = posterior.mean.float(), posterior.logvar.float()
    kl = 0.5 * (mean.square() + logvar.exp() - 1.0 - logvar).mean()
    return error.mean() + (y - x).square().mean() + _EDGE * sum(slopes) + _KL * kl


def train_vae(
    folder: Path,
    cache: Path,
    seconds: float,
    device: torch.device,
    seed: int,
    batch: int = 8,
    rate: float = 2e-3,
    iterations: int | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> AutoencoderKL:
    """Train the autoencoder, or load it when the run has finished it before.

    Args:
        folder: the run's folder; the result is ``vae.safetensors`` there.
        cache: rendered shards.
        seconds: wall-clock budget.
        device: where to train.
        seed: of crops and weights.
        batch: crops in a batch.
        rate: top learning rate.
        iterations: a fixed number of iterations instead of the budget.
        say: takes a progress line.

    Returns:
        Frozen autoencoder with its ``scaling_factor`` set from the spread of depth latents.
    """
    path = folder / "vae.safetensors"
    if path.exists():
        return load_vae(path, device)
    torch.manual_seed(seed)
    vae = build_vae().to(device).train()
    generator = torch.Generator().manual_seed(seed)
    crops = _Crops(cache)
    optimiser = torch.optim.AdamW(vae.parameters(), lr=rate, betas=(0.9, 0.99), weight_decay=1e-4)
    start, step, done = time.monotonic(), 0, 0.0
    bar = tqdm(total=1000, desc="VAE", unit="permille", mininterval=10)
    while done < 1.0:
        for group in optimiser.param_groups:
            group["lr"] = (
                rate * min(1.0, (step + 1) / 100) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))
            )
        side = 64 if done < 0.75 else 128
        x = crops.draw(batch if side == 64 else max(batch // 3, 2), side, generator).to(device)
        with torch.autocast(device.type, dtype=torch.bfloat16):
            loss = vae_loss(vae, x)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(vae.parameters(), 1.0)
        optimiser.step()
        step += 1
        done = min(1.0, step / iterations if iterations else (time.monotonic() - start) / max(seconds, 1e-6))
        bar.update(int(1000 * done) - bar.n)
        if step % 100 == 0:
            bar.set_postfix(loss=f"{loss.item():.4f}", step=step)
            say(f"vae step {step} loss {loss.item():.4f}")
    bar.close()
    finish_vae(vae, cache)
    save_vae(vae, path)
    return load_vae(path, device)


@torch.no_grad()
def finish_vae(vae: AutoencoderKL, cache: Path, most: int = 8) -> float:
    """Set ``scaling_factor`` so that depth latents have unit spread.

    Args:
        vae: trained autoencoder.
        cache: rendered shards; the first ``most`` are measured.
        most: number of shards.

    Returns:
        The factor.
    """
    vae.eval().requires_grad_(False)
    latents = []
    for index in shards(cache)[:most]:
        target = normalise_depth(read_shard(cache, index)[1]).expand(-1, 3, -1, -1).to(vae.device)
        latents.append(vae.encode(target).latent_dist.mode().float().flatten())
    factor = round(1.0 / float(torch.cat(latents).std().clamp(min=1e-6)), 5)
    vae.register_to_config(scaling_factor=factor)
    return factor


def save_vae(vae: AutoencoderKL, path: Path) -> None:
    """Write weights and scaling factor to one safetensors file, whole or not at all."""
    part = path.with_suffix(".part")
    tensors = {name: value.detach().cpu().contiguous() for name, value in vae.state_dict().items()}
    save_file(
        tensors | {"scaling_factor": torch.tensor(vae.config.scaling_factor, dtype=torch.float64)}, part
    )
    part.replace(path)


def load_vae(path: Path, device: torch.device) -> AutoencoderKL:
    """Read what ``save_vae`` wrote; frozen, in eval mode."""
    tensors = load_file(path)
    vae = build_vae()
    vae.register_to_config(scaling_factor=float(tensors.pop("scaling_factor")))
    vae.load_state_dict(tensors)
    return vae.to(device).eval().requires_grad_(False)
