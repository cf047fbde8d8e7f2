"""Cache of rendered scenes on disk, and the normalised disparity that the prior learns.

Data flow: seeds -> ``synthetic.render_mono`` -> shards (uint8 images, float16 depth in metres)
    -> [-1, 1] targets.
Paper: none; the target is inverse depth, normalised like Marigold's (2 % and 98 % quantiles).
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

__all__ = [
    "HELD_OUT_SEED",
    "SCORED_M",
    "SHARD",
    "SHAPES",
    "STREETS_AT",
    "held_out",
    "jitter",
    "normalise_disparity",
    "read_shard",
    "render_as_shard",
    "render_shards",
    "shards",
    "shard_kind",
    "shard_size",
    "train_seeds",
]

SHARD = 16
"""Scenes in one shard; all of one shape."""

SHAPES = ((192, 256), (128, 416), (192, 256), (192, 192), (192, 256), (128, 416), (256, 192), (160, 288))
"""Image sizes (H, W) that shards cycle through: landscape mostly, KITTI's 3.3:1, square, portrait, 16:9."""

STREETS_AT = 1
"""The shard of each cycle that shows only streets, because images of this width are taken from cars."""

HELD_OUT_SEED = 1
"""Held-out scenes have the seeds 1, 2, ...; training scenes start at one million."""

SCORED_M = 80.0
"""Held-out scenes are scored up to here, metres: as far as outdoor ground truth reaches."""

_TRAIN_SEED = 1_000_000


def shard_size(index: int) -> tuple[int, int]:
    """Image size (H, W) of a shard."""
    return SHAPES[index % len(SHAPES)]


def shard_kind(index: int) -> str | None:
    """Kind of scene in a shard, None for all kinds."""
    return "street" if index % len(SHAPES) == STREETS_AT else None


def render_as_shard(index: int, seeds: list[int], device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Images ``(N, 3, H, W)`` in [0, 1] and metres ``(N, 1, H, W)``, with the shard's size and kind."""
    from tests.scenes import render_mono

    return render_mono(seeds, shard_size(index), device, augment=True, kind=shard_kind(index))


def train_seeds(index: int) -> list[int]:
    """Scene seeds of a training shard."""
    return [_TRAIN_SEED + index * SHARD + i for i in range(SHARD)]


def held_out(
    count: int, size: tuple[int, int] = (192, 256), device: str = "cpu"
) -> tuple[torch.Tensor, torch.Tensor]:
    """Render scenes that are not used for training.

    Args:
        count: number of scenes, >= 1.
        size: image size (H, W).
        device: device for rendering.

    Returns:
        Images ``(N, 3, H, W)`` float32 in [0, 1] and depth ``(N, 1, H, W)`` float32 in metres, inf for sky;
        on the CPU.
    """
    from tests.scenes import render_mono

    images, depths = [], []
    for start in range(0, count, SHARD):
        seeds = [HELD_OUT_SEED + i for i in range(start, min(start + SHARD, count))]
        image, depth = render_mono(seeds, size=size, device=device, augment=True)
        images.append(image.cpu())
        depths.append(depth.cpu())
    return torch.cat(images), torch.cat(depths)


def normalise_disparity(depth_m: torch.Tensor) -> torch.Tensor:
    """Convert depth to the training target: inverse depth, normalised by its quantiles.

    Inverse depth is more precise at near range. With an error of 0.1 (0.2) in [-1, 1] that is as smooth as
    a prior's, normalised depth gives the rectified street pairs an aligned AbsRel of .13 to .22 (.27 to .47),
    normalised disparity .07 to .16 (.18 to .26, one .68), and near objects, which a second view
    resolves best, keep their shape.

    Args:
        depth_m: ``(N, 1, H, W)`` metres, inf for sky.

    Returns:
        ``(N, 1, H, W)`` float32 in [-1, 1]: the 2 % quantile of inverse depth and the sky are -1, the
        98 % quantile is 1; a scene of constant depth is 0.
    """
    inverse = torch.where(depth_m.isfinite(), 1.0 / depth_m.float().clamp_min(1e-3), torch.inf)
    ordered = inverse.flatten(1).sort(dim=1).values  # inf is sorted last
    count = ordered.isfinite().sum(dim=1, keepdim=True)
    low = ordered.gather(1, (0.02 * (count - 1)).long().clamp(min=0))[..., None, None]
    high = ordered.gather(1, (0.98 * (count - 1)).long().clamp(min=0))[..., None, None]
    spread = (high - low) / high  # relative, and so independent of the scene's scale
    unit = ((inverse - low) / (high - low).clamp(min=1e-9)).clamp(0.0, 1.0)
    unit = torch.where(inverse.isfinite(), unit, torch.zeros_like(unit))
    usable = (count[..., None, None] > 0) & (spread > 1e-4)
    return torch.where(usable, 2.0 * unit - 1.0, torch.zeros(()).to(unit))


def jitter(images_01: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Change colour and exposure of each image at random; one in four becomes grey.

    Args:
        images_01: ``(N, 3, H, W)`` in [0, 1].
        generator: CPU generator; all draws are made on the CPU.

    Returns:
        The same shape and device, in [0, 1].
    """
    n = images_01.shape[0]

    def draw(low: float, high: float, width: int = 1) -> torch.Tensor:
        return (low + (high - low) * torch.rand(n, width, 1, 1, generator=generator)).to(images_01.device)

    grey = images_01.mean(dim=1, keepdim=True)
    saturation = torch.where(draw(0.0, 1.0) < 0.25, torch.zeros_like(draw(0, 1)), draw(0.4, 1.5))
    x = grey + saturation * (images_01 - grey)
    x = x * torch.where(saturation > 0, draw(0.85, 1.18, 3), torch.ones_like(draw(0, 1))) * draw(0.75, 1.3)
    x = x.clamp(0.0, 1.0) ** draw(0.7, 1.45)
    middle = x.mean(dim=(1, 2, 3), keepdim=True)
    return (middle + draw(0.7, 1.3) * (x - middle)).clamp(0.0, 1.0)


def shards(cache: Path) -> list[int]:
    """Return the indices of the complete shards in the cache, in order."""
    return sorted(int(path.stem) for path in Path(cache).glob("scenes/*.safetensors"))


def read_shard(cache: Path, index: int) -> tuple[torch.Tensor, torch.Tensor]:
    """One shard: images ``(16, 3, H, W)`` float32 in [0, 1], depth ``(16, 1, H, W)`` float32 metres."""
    parts = load_file(Path(cache) / "scenes" / f"{index:06d}.safetensors")
    return parts["images"].float() / 255.0, parts["depth"].float()


def render_shards(cache: Path, first: int, stop: int, step: int = 1, device: str = "cpu") -> Iterator[int]:
    """Render the training shards ``first, first + step, ...`` below ``stop`` that the cache lacks.

    Args:
        cache: folder; shards go to ``scenes/``, written atomically.
        first: index of the first shard.
        stop: end of the range.
        step: stride, for several workers.
        device: device for rendering.

    Yields:
        The index of each new shard.
    """
    folder = Path(cache) / "scenes"
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(first, stop, step):
        path = folder / f"{index:06d}.safetensors"
        if path.exists():
            continue
        images, depth = render_as_shard(index, train_seeds(index), device)
        part = path.with_suffix(f".part{os.getpid()}")
        pixels = (images.clamp(0, 1) * 255.0).round().to(torch.uint8)
        save_file({"images": pixels.cpu().contiguous(), "depth": depth.half().cpu().contiguous()}, part)
        part.replace(path)
        yield index


def main(argv: list[str] | None = None) -> None:
    """Fill a cache: ``python -m examples.training.data --cache DIR --stop 1000``."""
    parser = argparse.ArgumentParser(description="Render training scenes into a cache.")
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--stop", type=int, default=1000, help="end of the shard range; 16 scenes per shard")
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--parent", type=int, help="stop when this process is no longer the parent")
    options = parser.parse_args(argv)
    torch.set_num_threads(options.threads)
    for _ in render_shards(options.cache, options.first, options.stop, options.step, options.device):
        if options.parent is not None and os.getppid() != options.parent:
            break


if __name__ == "__main__":
    main()
