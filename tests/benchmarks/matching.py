"""CPU seconds of every stage of the matching, next to OpenCV's eight-path semi-global matching.

Data flow: rendered or real pairs -> a table (``python -m tests.benchmarks.matching``).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from rich.console import Console
from rich.table import Table

from geodiff_plugin.cameras import Camera, PosedViews, View
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.geometry import plane_rays, warp_right_to_left
from geodiff_plugin.matching.aggregation import aggregate
from geodiff_plugin.matching.build import build_cost_volume, coarse_volume, inverse_pose_preferred, to_grid
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.matching.sweep import sweep_planes
from geodiff_plugin.matching.volume import CostVolume
from tests.views import posed_of

__all__ = [
    "data_pairs",
    "disparities_of",
    "least_seconds",
    "main",
    "measure",
    "sgbm_call",
    "textured_pair",
]


def textured_pair(
    size: tuple[int, int], device: str = "cpu", seed: int = 0
) -> tuple[PosedViews, torch.Tensor]:
    """A floor, a wall and a box with random texture; the left image is the right one warped by the depth.

    Args:
        size: ``(H, W)``.
        device: where the tensors live.
        seed: of the texture.

    Returns:
        left view and right one, and the depth ``(1, H, W)``, metres.
    """
    height, width = size
    generator = torch.Generator().manual_seed(seed)
    octaves = [torch.rand(1, 3, height // s + 2, width // s + 2, generator=generator) for s in (1, 3, 9, 27)]
    texture = sum(F.interpolate(o, size, mode="bilinear", align_corners=False) for o in octaves) / len(
        octaves
    )
    focal = 0.7 * width
    camera = Camera(np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]]))
    rows = torch.arange(height).view(1, 1, height, 1).expand(1, 1, height, width)
    floor = 1.2 * focal / (rows - 0.45 * height).clamp_min(1.0)
    depth_m = floor.clamp_max(6.0)
    depth_m[..., int(0.3 * height) : int(0.8 * height), int(0.55 * width) : int(0.75 * width)] = 3.0
    T = np.eye(4)
    T[0, 3] = -0.3
    left = warp_right_to_left(texture, depth_m, plane_rays(depth_m, [camera], [camera], [T])).image
    right = View.single(texture[0].to(device), camera, T)
    return PosedViews(View.single(left[0].to(device), camera, np.eye(4)), (right,)), depth_m[0].to(device)


def data_pairs(root: str, device: str = "cpu") -> Iterator[tuple[str, PosedViews]]:
    """Name and pair of every sample of a folder, or of rendered ones (``synthetic:N``), as ``find_pairs``."""
    for ref in find_pairs(root):
        sample = load(ref)
        left, right = (as_image_01(image, "image").to(device) for image in (sample.left, sample.right))
        yield ref.label, posed_of(left, sample.K_left, (right, sample.K_right, np.linalg.inv(sample.E)))


def least_seconds(work: Callable[[], object], device: str, repeats: int) -> tuple[float, float]:
    """Least CPU seconds and least seconds of a clock of several runs, after one to warm up.

    OpenCV has as many threads as torch.
    """
    cpu = clock = math.inf
    threads = cv2.getNumThreads()
    cv2.setNumThreads(torch.get_num_threads())
    for turn in range(repeats + 1):
        cpu_start, start = time.process_time(), time.perf_counter()
        work()
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        if turn:
            cpu = min(cpu, time.process_time() - cpu_start)
            clock = min(clock, time.perf_counter() - start)
    cv2.setNumThreads(threads)
    return cpu, clock


def measure(posed: PosedViews, device: str = "cpu", repeats: int = 3) -> tuple[dict[str, float], CostVolume]:
    """Seconds by stage.

    Args:
        posed: a pair.
        device: where its images live.
        repeats: the least of so many is taken.

    Returns:
        seconds by name: the coarse sweep, the volume (which holds a coarse sweep and its matches), the sweep
        alone, one aggregation of four paths, the matches (one aggregation and a half), the check for swapped
        views as it is made after them, and ``"evidence"``, all of it once; and the volume.
    """
    volume = build_cost_volume(posed)
    matches = match_volume(volume)
    left, *rights = (view._replace(image_01=grey(view.image_01)) for view in (posed.left, *posed.rights))
    swept = to_grid(PosedViews(left, tuple(rights)), DEFAULT.sweep_pixels)

    def evidence() -> None:
        found = match_volume(build_cost_volume(posed))
        inverse_pose_preferred(posed, found)

    stages: dict[str, Callable[[], object]] = {
        "coarse sweep": lambda: coarse_volume(posed),
        "volume": lambda: build_cost_volume(posed),
        "sweep": lambda: sweep_planes(swept, volume.inverse_depth),
        "one aggregation": lambda: aggregate(volume.levels, volume.left_01[0]),
        "matches": lambda: match_volume(volume),
        "swapped?": lambda: inverse_pose_preferred(posed, matches),
        "evidence": evidence,
    }
    kind = 1 if device.startswith("cuda") else 0  # a GPU's work takes no CPU seconds
    return {name: least_seconds(work, device, repeats)[kind] for name, work in stages.items()}, volume


def disparities_of(volume: CostVolume, width: int) -> int:
    """As many whole pixels of the image as the planes span for the median pixel, a multiple of 16."""
    near = volume.parallax[0].median_shift(float(volume.inverse_depth[-1])) * width / volume.size[1]
    return 16 * math.ceil(min(near, width / 2) / 16) if math.isfinite(near) else 128


def sgbm_call(posed: PosedViews, disparities: int) -> Callable[[], object]:
    """OpenCV's ``StereoSGBM`` with eight paths on the same images.

    Args:
        posed: a pair, whose images may differ in size.
        disparities: a multiple of 16, as ``disparities_of`` gives it.

    Returns:
        What does the work when it is called.
    """
    # It needs images of one size; what they show does not change its time.
    views = posed.left, posed.rights[0]
    images = [F.interpolate(view.image_01[None], posed.size)[0].mul(255).byte() for view in views]
    left, right = (np.ascontiguousarray(image.permute(1, 2, 0).cpu().numpy()) for image in images)
    penalties = {"P1": 8 * 3 * 25, "P2": 32 * 3 * 25}
    checks = {"disp12MaxDiff": 1, "uniquenessRatio": 10, "speckleWindowSize": 100, "speckleRange": 2}
    matcher = cv2.StereoSGBM_create(0, disparities, 5, mode=cv2.STEREO_SGBM_MODE_HH, **penalties, **checks)

    return lambda: matcher.compute(left, right)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, nargs=2, default=(375, 1242), metavar=("H", "W"))
    parser.add_argument(
        "--data", metavar="DIR", help="folder of pairs, or synthetic:N (default: one synthetic pair)"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3, help="number of runs; the fastest is shown")
    parser.add_argument(
        "--disparities", type=int, help="number of disparities of SGBM (default: the range of the planes)"
    )
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    if options.data is None:
        pairs = iter([("made up", textured_pair(tuple(options.size), options.device)[0])])
    else:
        pairs = data_pairs(options.data, options.device)
    table, ratios = None, []
    for name, pair in pairs:
        seconds, volume = measure(pair, options.device, options.repeats)
        disparities = options.disparities or disparities_of(volume, pair.size[1])
        sgbm = least_seconds(sgbm_call(pair, disparities), "cpu", options.repeats)[0]
        if table is None:
            title = f"seconds on {options.device}, threads: {options.threads}"
            table = Table("pair", "size", "planes", *seconds, "SGBM", "evidence / SGBM", title=title)
        size = "{1}x{0}".format(*pair.size)
        ratios.append(seconds["evidence"] / sgbm)
        shown = [f"{sgbm:.2f} ({disparities})", f"{ratios[-1]:.2f}"]
        table.add_row(name, size, f"{len(volume.levels)}", *(f"{s:.3f}" for s in seconds.values()), *shown)
    console = Console(width=None if table is None else max(Console().width, 170))
    console.print(table)
    if ratios:
        console.print(f"mean ratio {np.mean(ratios):.2f}, largest {max(ratios):.2f}")


if __name__ == "__main__":
    main()
