"""Seconds of every stage of the matching, on a made-up textured pair.

Hop: nothing -> a table on standard output (``python -m geodiff_plugin.matching.benchmark``).
Paper: none.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from rich.console import Console
from rich.table import Table

from geodiff_plugin.geometry import warp_right_to_left
from geodiff_plugin.matching.aggregation import aggregate
from geodiff_plugin.matching.build import build_cost_volume, pilot_volume
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.matching.mirrored import mirrored_pose_preferred
from geodiff_plugin.matching.plane_sweep import RightView

__all__ = ["main", "measure", "textured_pair"]


def textured_pair(
    size: tuple[int, int], device: str = "cpu", seed: int = 0
) -> tuple[torch.Tensor, RightView, torch.Tensor, torch.Tensor]:
    """A floor, a wall and a box with random texture; the left image is the right one warped by the depth.

    Args:
        size: ``(H, W)``.
        device: where the tensors live.
        seed: of the texture.

    Returns:
        left image ``(3, H, W)`` in [0, 1], right view, ``K_left (3, 3)`` and the depth ``(1, H, W)``, metres.
    """
    height, width = size
    generator = torch.Generator().manual_seed(seed)
    octaves = [torch.rand(1, 3, height // s + 2, width // s + 2, generator=generator) for s in (1, 3, 9, 27)]
    texture = sum(F.interpolate(o, size, mode="bilinear", align_corners=False) for o in octaves) / len(
        octaves
    )
    focal = 0.7 * width
    K = torch.tensor([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    rows = torch.arange(height).view(1, 1, height, 1).expand(1, 1, height, width)
    floor = 1.2 * focal / (rows - 0.45 * height).clamp_min(1.0)
    depth_m = floor.clamp_max(6.0)
    depth_m[..., int(0.3 * height) : int(0.8 * height), int(0.55 * width) : int(0.75 * width)] = 3.0
    T = torch.eye(4)
    T[0, 3] = -0.3
    left = warp_right_to_left(texture, depth_m, K[None], K[None], T[None]).image
    right = (texture[0].to(device), K.to(device), T.to(device))
    return left[0].to(device), right, K.to(device), depth_m[0].to(device)


def measure(size: tuple[int, int], device: str = "cpu") -> dict[str, float]:
    """Seconds by stage.

    Args:
        size: ``(H, W)`` of both images.
        device: where to run.

    Returns:
        seconds by name: the coarse sweep, the volume (which holds a coarse sweep and its matches), one
        aggregation, the matches (two aggregations and the sweep from the right), the check for swapped views.
    """
    left, right, K, _ = textured_pair(size, device)
    volume = build_cost_volume(left, [right], K)  # also warms up
    stages: dict[str, Callable[[], object]] = {
        "coarse sweep": lambda: pilot_volume(left, [right], K),
        "volume": lambda: build_cost_volume(left, [right], K),
        "one aggregation": lambda: aggregate(volume.cost, volume.left_01[0]),
        "matches": lambda: match_volume(volume),
        "swapped?": lambda: mirrored_pose_preferred(left, [right], K),
    }
    seconds = {}
    for name, work in stages.items():
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        seconds[name] = time.perf_counter() - start
    return seconds


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, nargs=2, default=(375, 1242), metavar=("H", "W"))
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args(arguments)
    table = Table("stage", "seconds", title=f"{options.size[1]} x {options.size[0]} on {options.device}")
    for name, seconds in measure(tuple(options.size), options.device).items():
        table.add_row(name, f"{seconds:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
