"""Milliseconds per frame of a live rig on a CPU, by size and preset.

python -m tests.benchmarks.live

Data flow: the demo pair at several sizes, as frames of a rig -> CPU time of evidence and call, wall time of
    both at once -> a table on standard output.

CPU time of one thread hardly depends on other processes; wall-clock time does, so it needs an idle machine.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from geodiff_plugin import enable_geometry_guidance, live, load_prior
from geodiff_plugin._internal.checks import captured_warnings
from geodiff_plugin._internal.threads import available_cores
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.config import PRESETS
from geodiff_plugin.streaming.rig import LiveRig, setup_of_rig
from geodiff_plugin.streaming.sources import StereoFrame
from geodiff_plugin.types import Rig
from tests.benchmarks.cost import resized_pair

__all__ = ["FrameCost", "demo_rig", "main", "measure"]

WIDTHS, SHOWN_PRESETS = (320, 640, 1280), ("fast", "default")
#: Frames before the measured ones: the first is checked, and both fill caches.
WARM_UP = 2


class FrameCost(NamedTuple):
    """Median milliseconds of a frame.

    Attributes:
        check: CPU time of the evidence of a frame with which the rig is checked.
        evidence: the same for the frames in between.
        call: CPU time of network, fits and refinement.
        wall: wall-clock time from one result to the next, with evidence and call in two threads.
    """

    check: float
    evidence: float
    call: float
    wall: float


def demo_rig(width: int) -> tuple[Rig, StereoFrame]:
    """The demo pair at a width, as a frame of a rig."""
    pair = read_demo_pair()
    left, right, Ks = resized_pair(pair, width)
    cameras = [
        replace(camera, K=K, size=None) for camera, K in zip((pair.rig.left, pair.rig.right), Ks, strict=True)
    ]
    rig = replace(pair.rig, left=cameras[0], right=cameras[1])
    return rig, StereoFrame(*(np.rint(255 * each).astype(np.uint8) for each in (left, right)))


def measure(pipe: Any, width: int, preset: str, frames: int = 5) -> FrameCost:
    """Measure the frames of a live rig.

    Args:
        pipe: a guided pipeline.
        width: of both views, pixels.
        preset: hyperparameters.
        frames: number of measured frames, >= 2.
    """
    rig, frame = demo_rig(width)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    prepared = LiveRig(setup_of_rig(rig, PRESETS[preset]), torch.device("cpu"), 10**9)
    seconds = []
    for _ in range(WARM_UP + frames):
        started = time.process_time()
        ready = prepared.prepare(frame)
        done = time.process_time()
        with captured_warnings():
            pipe(ready.left, guidance=ready.guidance, generator=torch.Generator().manual_seed(0))
        seconds.append((done - started, time.process_time() - done))
    torch.set_num_threads(threads)
    evidence, call = np.median(seconds[WARM_UP:], axis=0)
    results = live(pipe, [frame] * (WARM_UP + frames), rig, preset=preset, every_frame=True)
    arrived = [time.perf_counter() for _ in results]
    wall = np.median(np.diff(arrived)[WARM_UP - 1 :])
    return FrameCost(*(1000 * float(each) for each in (seconds[0][0], evidence, call, wall)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--widths", type=int, nargs="+", default=WIDTHS, help="widths of the views, 4:3")
    parser.add_argument("--presets", nargs="+", default=SHOWN_PRESETS)
    parser.add_argument("--prior", default="bundled")
    parser.add_argument("--frames", type=int, default=5, help="measured frames; the median counts")
    options = parser.parse_args(arguments)
    pipe = enable_geometry_guidance(load_prior(options.prior))
    pipe.set_progress_bar_config(disable=True)
    table = new_table(
        ("size, preset", "check", "evidence", "call", "CPU ms/frame", "wall ms/frame", "frames/s")
    )
    for width in options.widths:
        for preset in options.presets:
            cost = measure(pipe, width, preset, options.frames)
            numbers = (cost.check, cost.evidence, cost.call, cost.evidence + cost.call, cost.wall)
            row = (f"{number:.0f}" for number in numbers)
            table.add_row(f"{width}x{3 * width // 4}, {preset}", *row, f"{1000 / cost.wall:.2f}")
    show(table, f"{options.prior} on {available_cores()} CPU cores; CPU times of one thread, in ms")


if __name__ == "__main__":
    main()
