"""Latents of rendered scenes: encoded once, cached on disk, drawn in batches.

Data flow: shard -> flips and colour jitter -> VAE encoder -> float16 latents -> a batch of one shape.
Paper: S3.1 (the prior works in the latent space of a VAE).
"""

from __future__ import annotations

import os
from pathlib import Path

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKL
from safetensors.torch import load_file, save_file

from examples.training.data import (
    SHARD,
    jitter,
    normalise_disparity,
    read_shard,
    render_as_shard,
    shards,
    train_seeds,
)

__all__ = ["LatentStore", "encode_scenes", "resize_scenes"]


def resize_scenes(
    images: torch.Tensor, depth_m: torch.Tensor, divisor: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Average images and subsample depth to ``1 / divisor`` of the size; both unchanged for 1."""
    if divisor == 1:
        return images, depth_m
    middle = divisor // 2
    return F.avg_pool2d(images, divisor), depth_m[..., middle::divisor, middle::divisor]


@torch.no_grad()
def encode_scenes(
    vae: AutoencoderKL, images: torch.Tensor, depth_m: torch.Tensor, generator: torch.Generator, flip: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """Encode as Marigold does: encoder mode times ``scaling_factor``.

    Args:
        vae: frozen autoencoder; its device is used.
        images: ``(N, 3, H, W)`` in [0, 1].
        depth_m: ``(N, 1, H, W)`` metres, inf for sky.
        generator: draws the colour jitter.
        flip: mirror left and right.

    Returns:
        Image and depth latents ``(N, 4, H/4, W/4)`` float16 on the VAE's device.
    """
    device = vae.device
    image = 2.0 * jitter(images.to(device), generator) - 1.0
    target = normalise_disparity(depth_m.to(device)).expand(-1, 3, -1, -1)
    if flip:
        image, target = image.flip(-1), target.flip(-1)
    with torch.autocast(device.type, dtype=torch.bfloat16):
        moments = [vae.encode(x).latent_dist.mode() for x in (image, target)]
    scale = vae.config.scaling_factor
    return tuple((latent.float() * scale).half() for latent in moments)


class LatentStore:
    """Latents that one process trains on; grows while scenes are rendered.

    With several processes, each uses every ``world``-th shard. Encoded shards are cached, so that a continued
    run does not encode them again. With ``fresh=True`` (a GPU) nothing is stored, and each batch is rendered.

    Args:
        cache: the cache folder of ``data.render_shards``.
        vae: frozen autoencoder.
        divisor: 2 for the low-resolution stage, 1 for the full one.
        variants: encoded versions of each scene (mirror image, colours).
        rank: index of this process.
        world: number of processes.
        fresh: render every batch on the VAE's device instead.
    """

    def __init__(
        self,
        cache: Path,
        vae: AutoencoderKL,
        divisor: int,
        variants: int = 2,
        rank: int = 0,
        world: int = 1,
        fresh: bool = False,
    ) -> None:
        self.cache = Path(cache)
        self.vae = vae
        self.divisor = divisor
        self.variants = variants
        self.rank, self.world, self.fresh = rank, world, fresh
        self._folder = self.cache / f"latents-{_fingerprint(vae)}-{divisor}-disparity"
        self._items: list[tuple[torch.Tensor, torch.Tensor]] = []
        self._known: set[int] = set()

    def __len__(self) -> int:
        """Number of scenes that can be drawn."""
        return SHARD * len(self._items) // self.variants

    def refresh(self, most: int) -> int:
        """Add new shards of the cache, newest first; encoded ones are only read.

        Args:
            most: shards to encode, >= 0.

        Returns:
            Number of added shards.
        """
        if self.fresh:
            return 0
        before = len(self._known)
        for index in reversed(shards(self.cache)):
            if index % self.world != self.rank or index in self._known:
                continue
            if not self._path(index).exists():
                if most == 0:
                    continue
                most -= 1
            self._known.add(index)
            self._items += self._encoded(index)
        return len(self._known) - before

    def batch(self, size: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw image and depth latents ``(size, 4, h, w)`` float32, all of the same shape."""
        if self.fresh:
            return self._render(size, generator)
        first = self._items[int(torch.randint(len(self._items), (), generator=generator))]
        same = [item for item in self._items if item[0].shape == first[0].shape]
        shard = torch.randint(len(same), (size,), generator=generator).tolist()
        scene = torch.randint(SHARD, (size,), generator=generator).tolist()
        picked = [(same[a][0][b], same[a][1][b]) for a, b in zip(shard, scene, strict=True)]
        return tuple(torch.stack(part).float() for part in zip(*picked, strict=True))

    def _path(self, index: int) -> Path:
        return self._folder / f"{index:06d}.safetensors"

    def _encoded(self, index: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
        path = self._path(index)
        if not path.exists():
            self._folder.mkdir(parents=True, exist_ok=True)
            images, depth = resize_scenes(*read_shard(self.cache, index), self.divisor)
            generator = torch.Generator().manual_seed(index)
            start = int(torch.randint(2, (), generator=generator))
            parts = {}
            for variant in range(self.variants):
                latents = encode_scenes(self.vae, images, depth, generator, flip=bool((start + variant) % 2))
                parts[f"image{variant}"], parts[f"depth{variant}"] = (x.cpu().contiguous() for x in latents)
            part = path.with_suffix(f".part{os.getpid()}")
            save_file(parts, part)
            part.replace(path)
        parts = load_file(path)
        return [(parts[f"image{v}"], parts[f"depth{v}"]) for v in range(len(parts) // 2)]

    def _render(self, size: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        index = int(torch.randint(2**24, (), generator=generator))
        seeds = [seed for k in range(-(-size // SHARD)) for seed in train_seeds(index + k)][:size]
        images, depth = render_as_shard(index, seeds, str(self.vae.device))
        images, depth = resize_scenes(images, depth, self.divisor)
        flip = bool(torch.randint(2, (), generator=generator))
        return tuple(x.float() for x in encode_scenes(self.vae, images, depth, generator, flip))


def _fingerprint(vae: AutoencoderKL) -> str:
    """Return a fingerprint of the encoder's weights, so that latents of another VAE are never used."""
    weight = vae.encoder.conv_in.weight.detach().half().float().cpu().double()
    return f"{abs(int((weight.abs().sum() * 1e6).item())) % 16**6:06x}"
