"""Training of the autoencoder on small crops of rendered images and depth maps.

Data flow: shards -> crops -> ``AutoencoderKL`` with its ``scaling_factor`` set.
Paper: none (the paper uses Stable Diffusion's autoencoder).
"""

from __future__ import annotations

import time
from pathlib import Path

import torch
import torch.nn.functional as F
from accelerate import Accelerator
from diffusers import AutoencoderKL
from safetensors.torch import load_file, save_file
from tqdm import tqdm

from examples.training.data import jitter, normalise_disparity, read_shard, shards
from examples.training.models import build_vae
from examples.training.schedule import learning_rate

__all__ = ["edge_error", "finish_vae", "load_vae", "save_vae", "train_vae", "vae_loss"]

_KL = 2e-4
_EDGE = 0.5


class _Crops:
    """Random crops from a few shards in memory; half of a batch is images, half depth."""

    def __init__(self, cache: Path, keep: int = 40) -> None:
        self._cache, self._keep = cache, keep
        self._held: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}

    def draw(self, batch: int, side: int, generator: torch.Generator) -> torch.Tensor:
        """``(batch, 3, side, side)`` in [-1, 1]; the side is at most the scene's."""
        have = shards(self._cache)
        fresh = [i for i in have if i not in self._held]
        if fresh and (len(self._held) < self._keep or torch.rand((), generator=generator) < 0.02):
            if len(self._held) >= self._keep:
                self._held.pop(next(iter(self._held)))
            index = fresh[0] if len(self._held) < self._keep else fresh[-1]
            images, depth = read_shard(self._cache, index)
            self._held[index] = (images, normalise_disparity(depth))
        names = list(self._held)
        images, depth = self._held[names[int(torch.randint(len(names), (), generator=generator))]]
        side = min(side, *images.shape[-2:])
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


def edge_error(difference: torch.Tensor) -> torch.Tensor:
    """Weighted mean gradient magnitude of a difference ``(N, C, H, W)``: penalizes blurred edges."""
    return _EDGE * sum(difference.diff(dim=axis).abs().mean() for axis in (-1, -2))


def vae_loss(vae: AutoencoderKL, x: torch.Tensor, generator: torch.Generator | None = None) -> torch.Tensor:
    """Reconstruction (L1 and squared), gradients at edges, and a weak KL term towards a unit Gaussian.

    Args:
        vae: autoencoder in training.
        x: ``(N, 3, H, W)`` in [-1, 1].
        generator: draws the posterior sample.

    Returns:
        Scalar.
    """
    posterior = vae.encode(x).latent_dist
    y = vae.decode(posterior.sample(generator)).sample.float()
    error = (y - x).abs()
    mean, logvar = posterior.mean.float(), posterior.logvar.float()
    kl = 0.5 * (mean.square() + logvar.exp() - 1.0 - logvar).mean()
    return error.mean() + (y - x).square().mean() + edge_error(y - x) + _KL * kl


class _Loss(torch.nn.Module):
    """``vae_loss`` as a module, for training with several processes."""

    def __init__(self, vae: AutoencoderKL) -> None:
        super().__init__()
        self.vae = vae

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Loss of a batch ``(N, 3, H, W)``."""
        return vae_loss(self.vae, x)


def train_vae(
    folder: Path,
    cache: Path,
    accelerator: Accelerator,
    seconds: float,
    seed: int,
    batch: int = 4,
    rate: float = 2e-3,
    iterations: int | None = None,
) -> AutoencoderKL:
    """Train or resume the autoencoder, or load it if this run has already finished it.

    Args:
        folder: the run's folder; the result is ``vae.safetensors`` there.
        cache: rendered shards.
        accelerator: device, precision and processes.
        seconds: wall-clock budget.
        seed: seed of crops and weights.
        batch: crops in a batch of one process.
        rate: maximum learning rate.
        iterations: a fixed number of iterations instead of the budget.

    Returns:
        Frozen autoencoder with its ``scaling_factor`` set from the spread of depth latents.
    """
    path = folder / "vae.safetensors"
    device = accelerator.device
    if path.exists():
        return load_vae(path, device)
    unfinished = folder / "vae-unfinished.safetensors"
    torch.manual_seed(seed)
    vae = load_vae(unfinished, device) if unfinished.exists() else build_vae().to(device)
    base = float(load_file(unfinished)["seconds"]) if unfinished.exists() else 0.0
    vae.train().requires_grad_(True)
    generator = torch.Generator().manual_seed(seed + 7919 * int(base) + accelerator.process_index)
    crops = _Crops(cache)
    optimiser = torch.optim.AdamW(vae.parameters(), lr=rate, betas=(0.9, 0.99), weight_decay=1e-4)
    network, prepared = accelerator.prepare(_Loss(vae), optimiser)
    start = time.monotonic()
    step = 0
    done = 0.0
    saved = 0.0
    first = accelerator.is_main_process
    bar = tqdm(total=1000, desc="VAE", unit="permille", mininterval=10, disable=not first)
    while True:
        spent = base + time.monotonic() - start
        fraction = torch.tensor(
            step / iterations if iterations else spent / max(seconds, 1e-6), device=device
        )
        done = float(accelerator.reduce(fraction, "mean"))
        if done >= 1.0:
            break
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(rate, done, step, warm_up=100)
        side = 64 if done < 0.8 else 128
        x = crops.draw(batch if side == 64 else max(batch // 2, 2), side, generator).to(device)
        loss = network(x)
        accelerator.backward(loss)
        accelerator.clip_grad_norm_(network.parameters(), 1.0)
        prepared.step()
        prepared.zero_grad(set_to_none=True)
        step += 1
        if first and step % 100 == 0:
            bar.update(int(1000 * done) - bar.n)
            bar.set_postfix(loss=f"{loss.item():.4f}", step=step)
        if first and spent - saved > 60.0:
            save_vae(vae, unfinished, spent)
            saved = spent
    bar.close()
    if first:
        finish_vae(vae, cache)
        save_vae(vae, path)
        unfinished.unlink(missing_ok=True)
    accelerator.wait_for_everyone()
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
        target = normalise_disparity(read_shard(cache, index)[1]).expand(-1, 3, -1, -1).to(vae.device)
        latents.append(vae.encode(target).latent_dist.mode().float().flatten())
    factor = round(1.0 / float(torch.cat(latents).std().clamp(min=1e-6)), 5)
    vae.register_to_config(scaling_factor=factor)
    return factor


def save_vae(vae: AutoencoderKL, path: Path, seconds: float = 0.0) -> None:
    """Write weights, scaling factor and training seconds to one safetensors file, atomically."""
    part = path.with_suffix(".part")
    numbers = {"scaling_factor": vae.config.scaling_factor, "seconds": seconds}
    tensors = {name: value.detach().cpu().contiguous() for name, value in vae.state_dict().items()}
    save_file(tensors | {k: torch.tensor(v, dtype=torch.float64) for k, v in numbers.items()}, part)
    part.replace(path)


def load_vae(path: Path, device: torch.device) -> AutoencoderKL:
    """Load a file from ``save_vae``; frozen, in eval mode."""
    tensors = load_file(path)
    vae = build_vae()
    vae.register_to_config(scaling_factor=float(tensors.pop("scaling_factor")))
    tensors.pop("seconds")
    vae.load_state_dict(tensors)
    return vae.to(device).eval().requires_grad_(False)
