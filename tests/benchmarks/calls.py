"""Seconds of a guided call beside the plain call and OpenCV's eight-path semi-global matching.

Data flow: rendered or real pairs -> a table (``python -m tests.benchmarks.calls``).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from geodiff_plugin.bundled import load_bundled_prior
from geodiff_plugin.config import DEFAULT, config_from_text
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.matching.build import build_cost_volume
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.types import PosedViews
from tests.benchmarks.matching import (
    Pair,
    data_pairs,
    disparities_of,
    least_seconds,
    sgbm_call,
    textured_pair,
)

__all__ = ["calls_of", "main"]


def calls_of(pair: Pair, pipe: Any, knobs: str = "") -> dict[str, Callable[[], object]]:
    """The calls that are compared, by name; each does all of its work every time that it is called.

    Args:
        pair: left image, right view, ``K_left``.
        pipe: a pipeline with guidance enabled.
        knobs: changes of the default preset, ``knob=value``, several joined by ``+``.
    """
    left, (right, K_right, T), K = pair
    config = config_from_text(knobs.split("+"), DEFAULT, "knobs") if knobs else DEFAULT
    arguments = {"generator": torch.Generator(left.device).manual_seed(0)}

    def guided() -> object:
        guidance = GeometryGuidance(right, (K, K_right), torch.linalg.inv(T), config=config)
        return pipe(left[None], guidance=guidance, **arguments)

    calls = {"plain": lambda: pipe(left[None], **arguments), "guided": guided}
    sgbm = sgbm_call(pair, disparities_of(build_cost_volume(PosedViews(left, (pair[1],), K)), left.shape[-1]))
    return calls | {"SGBM": sgbm}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, nargs=2, default=(375, 1242), metavar=("H", "W"))
    parser.add_argument("--data", metavar="DIR", help="pairs in it, or synthetic:N; by default a made-up one")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, nargs="+", default=[1], help="one row for each")
    parser.add_argument("--repeats", type=int, default=3, help="the least of so many is shown")
    parser.add_argument("--knobs", default="", metavar="KNOB=VALUE+...", help="changes of the default preset")
    options = parser.parse_args(arguments)
    pipe = enable_geometry_guidance(load_bundled_prior().to(options.device))
    pipe.set_progress_bar_config(disable=True)
    if options.data is None:
        pairs = iter([("made up", textured_pair(tuple(options.size), options.device)[:3])])
    else:
        pairs = data_pairs(options.data, options.device)
    title = f"CPU seconds (seconds of a clock) on {options.device}"
    table = Table("pair", "size", "threads", "plain", "guided", "SGBM", "guided / SGBM", title=title)
    before, total = torch.get_num_threads(), dict.fromkeys(options.threads, (0.0, 0.0))
    for name, pair in pairs:
        for threads in options.threads:
            torch.set_num_threads(threads)
            seconds = {
                key: least_seconds(work, options.device, options.repeats)
                for key, work in calls_of(pair, pipe, options.knobs).items()
            }
            shown = [f"{seconds[k][0]:.2f} ({seconds[k][1]:.2f})" for k in ("plain", "guided", "SGBM")]
            guided, sgbm = (seconds[k][0] for k in ("guided", "SGBM"))
            size = f"{pair[0].shape[-1]}x{pair[0].shape[-2]}"
            table.add_row(name, size, f"{threads}", *shown, f"{guided / sgbm:.1f}")
            total[threads] = total[threads][0] + guided, total[threads][1] + sgbm
    for threads, (guided, sgbm) in total.items():
        table.add_row("all", "", f"{threads}", "", f"{guided:.2f}", f"{sgbm:.2f}", f"{guided / sgbm:.1f}")
    torch.set_num_threads(before)
    Console(width=max(Console().width, 120)).print(table)


if __name__ == "__main__":
    main()
