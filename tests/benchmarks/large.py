"""Peak memory of ``geodiff depth`` on large pairs: ``python -m tests.benchmarks.large``.

Data flow: a rendered pair of W x H -> the command in its own process -> resident memory by stage, error,
    verdict.

The scene has a closed form: a wall that leans back, and a panel in front of it. Their texture has detail at
every scale, so that an image of any size costs one look-up per pixel. The wall is nearer at the bottom, as in
most scenes. With an overhanging wall the prior inverts near and far, and the run is not trusted.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import psutil
from PIL import Image

__all__ = ["main", "measure_depth", "write_large_pair"]

SIZES = ((4000, 3000), (8000, 6000))
BASELINE_M = 0.2
#: The wall ``n . p = 4`` and the panel at 2 m: centre and half sides, metres.
NORMAL, OFFSET_M = np.array([0.15, 0.25, 1.0]), 4.0
PANEL_M, PANEL_AT, PANEL_HALF = 2.0, (-0.2, 0.1), (0.5, 0.35)
#: Texture pixels a metre, and side of the tile that repeats.
DENSITY, TILE = 700.0, 4096
STRIP = 256


def intrinsics(size: tuple[int, int]) -> np.ndarray:
    """K of both views, ``size`` being (width, height)."""
    focal = 0.9 * size[0]
    return np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])


def _tile(seed: int) -> np.ndarray:
    """Noise of every octave, ``(TILE, TILE, 3)`` float32 in [0, 1], that repeats without a seam."""
    rng = np.random.default_rng(seed)
    total, side = np.zeros((TILE, TILE, 3), np.float32), 8
    while side <= TILE:
        noise = rng.normal(size=(side, side, 3)).astype(np.float32)
        padded = np.pad(noise, ((1, 1), (1, 1), (0, 0)), mode="wrap")
        factor = TILE // side
        big = cv2.resize(padded, None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)
        total += big[factor:-factor, factor:-factor]
        side *= 4
    return 0.5 + 0.5 * np.tanh(0.5 * total)


def depth_strip(size: tuple[int, int], rows: range, origin_x: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Depth ``(h, W)`` metres of some rows of a camera at ``origin_x``, and where the panel is."""
    K = intrinsics(size)
    x = ((np.arange(size[0]) - K[0, 2]) / K[0, 0])[None]
    y = ((np.array(rows) - K[1, 2]) / K[1, 1])[:, None]
    wall = (OFFSET_M - NORMAL[0] * origin_x) / (NORMAL[0] * x + NORMAL[1] * y + NORMAL[2])
    across = np.abs(origin_x + PANEL_M * x - PANEL_AT[0]) < PANEL_HALF[0]
    panel = across & (np.abs(PANEL_M * y - PANEL_AT[1]) < PANEL_HALF[1])
    return np.where(panel, PANEL_M, wall), panel


def _view(size: tuple[int, int], origin_x: float, tiles: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """``(H, W, 3)`` uint8."""
    K, image = intrinsics(size), np.empty((size[1], size[0], 3), np.uint8)
    for top in range(0, size[1], STRIP):
        rows = range(top, min(top + STRIP, size[1]))
        depth, panel = depth_strip(size, rows, origin_x)
        across = (np.arange(size[0]) - K[0, 2])[None] / K[0, 0] * depth + origin_x
        down = ((np.array(rows) - K[1, 2]) / K[1, 1])[:, None] * depth
        at = [(DENSITY * v).astype(np.float32) for v in (across, down)]
        wall, front = (cv2.remap(tile, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP) for tile in tiles)
        strip = np.where(panel[..., None], front, wall)
        image[rows.start : rows.stop] = np.rint(strip * 255)
    return image


def write_large_pair(folder: Path, size: tuple[int, int]) -> None:
    """Write ``left.png``, ``right.png`` and ``calib.txt`` of a pair of ``size`` (width, height)."""
    tiles = (_tile(0), _tile(1))
    for name, origin_x in (("left", 0.0), ("right", BASELINE_M)):
        Image.fromarray(_view(size, origin_x, tiles)).save(folder / f"{name}.png", compress_level=1)
    K = intrinsics(size)
    camera = f"[{K[0, 0]} 0 {K[0, 2]}; 0 {K[1, 1]} {K[1, 2]}; 0 0 1]"
    (folder / "calib.txt").write_text(
        f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline={1000 * BASELINE_M}\n"
        f"width={size[0]}\nheight={size[1]}\nndisp={size[0] // 8}\n"
    )


@contextmanager
def _sampled(into: list[tuple[float, int]]) -> Iterator[None]:
    """Append ``(seconds, bytes resident)`` every 10 ms."""
    done, process = threading.Event(), psutil.Process()

    def sample() -> None:
        while not done.wait(0.01):
            into.append((time.perf_counter(), process.memory_info().rss))

    thread = threading.Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def measure_depth(folder: Path) -> dict[str, dict[str, float]]:
    """Run the command on the pair of a folder, to be called in a process of its own.

    Returns:
        ``stage -> {"seconds", "peak_mb"}``, of the whole process, in the order of the stages; ``"start"`` is
        the process with its libraries.
    """
    from geodiff_plugin.jobs.options import DepthOptions, start_pair
    from geodiff_plugin.jobs.pair import depth_pair

    names = {name: folder / f"{name}.png" for name in ("left", "right")}
    out, samples = folder / "out", [(time.perf_counter(), psutil.Process().memory_info().rss)]
    options = DepthOptions(**names, calib=(folder / "calib.txt",), out=out, device="cpu", quiet=True)
    with _sampled(samples), start_pair(options) as held:
        stages = depth_pair(options, folder=held).report["seconds"]
    # The stages follow each other and the last one ends where sampling ends.
    found, end = {}, samples[-1][0]
    for name, seconds in reversed(stages.items()):
        begin = end - seconds
        peak = max((rss for at, rss in samples if begin <= at <= end), default=0)
        found[name], end = {"seconds": seconds, "peak_mb": peak / 1e6}, begin
    return {"start": {"seconds": 0.0, "peak_mb": samples[0][1] / 1e6}} | dict(reversed(found.items()))


def abs_rel(folder: Path, size: tuple[int, int]) -> float:
    """Mean relative error of ``out/depth.npy`` against the closed form, over every pixel."""
    depth_m, total = np.load(folder / "out" / "depth.npy", mmap_mode="r"), 0.0
    for top in range(0, size[1], STRIP):
        rows = range(top, min(top + STRIP, size[1]))
        ground_truth = depth_strip(size, rows)[0]
        total += float(np.abs(depth_m[rows.start : rows.stop] / ground_truth - 1).sum())
    return total / (size[0] * size[1])


def is_trusted(folder: Path) -> bool:
    """Return the verdict in ``out/report.json``."""
    report = json.loads((folder / "out" / "report.json").read_text(encoding="utf-8"))
    return bool(report["verdict"]["status"] == "trusted")


def main(argv: list[str] | None = None) -> None:
    """Print seconds and peak memory by stage for every size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", action="append", help="WxH (default: 4000x3000 and 8000x6000)")
    parser.add_argument("--json", action="store_true", help="print one JSON document instead")
    options = parser.parse_args(argv)
    sizes = [tuple(int(side) for side in text.split("x")) for text in options.size or []] or SIZES
    answers = []
    for size in sizes:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            write_large_pair(folder, size)
            with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as fresh_process:
                stages = fresh_process.submit(measure_depth, folder).result()
            reported = {"abs_rel": abs_rel(folder, size), "trusted": is_trusted(folder)}
            answers.append({"size": size, **reported, "stages": stages})
            if options.json:
                continue
            peak, pixels = max(stage["peak_mb"] for stage in stages.values()), size[0] * size[1]
            own = (peak - stages["start"]["peak_mb"]) * 1e6 / pixels
            judged = "trusted" if reported["trusted"] else "not to be trusted"
            print(
                f"{size[0]}x{size[1]}, {pixels / 1e6:.0f} megapixels, AbsRel "
                f"{reported['abs_rel']:.4f}, {judged}"
            )
            for stage, used in stages.items():
                print(f"  {stage:12} {used['seconds']:8.1f} s {used['peak_mb']:9.0f} MB")
            print(f"  {'peak':12} {'':10} {peak:9.0f} MB, {own:.0f} bytes a pixel over the start", flush=True)
    if options.json:
        print(json.dumps(answers))


if __name__ == "__main__":
    main()
