"""Seconds of a guided call next to the plain call and OpenCV's eight-path semi-global matching.

Data flow: rendered or real pairs -> a table (``python -m tests.benchmarks.calls``).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from geodiff_plugin.bundled import load_bundled_prior
from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.config import DEFAULT, config_from_text
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.matching.build import build_cost_volume
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from tests.benchmarks.matching import (
    data_pairs,
    disparities_of,
    least_seconds,
    sgbm_call,
    textured_pair,
)

__all__ = ["calls_of", "main"]


def calls_of(posed: PosedViews, pipe: Any, parameters: str = "") -> dict[str, Callable[[], object]]:
    """The calls that are compared, by name; each does all of its work every time that it is called.

    Args:
        posed: a pair.
        pipe: a pipeline with guidance enabled.
        parameters: changed parameters of the default preset, ``parameter=value``, several joined by ``+``.
    """
    left, right = posed.left.image_01, posed.rights[0]
    config = config_from_text(parameters.split("+"), DEFAULT, "parameters") if parameters else DEFAULT
    arguments = {"generator": torch.Generator(left.device).manual_seed(0)}

    def guided() -> object:
        Ks, E = (posed.left.camera.K, right.camera.K), np.linalg.inv(right.T_right_from_left)
        guidance = GeometryGuidance(right.image_01, Ks, E, config=config)
        return pipe(left[None], guidance=guidance, **arguments)

    calls = {"plain": lambda: pipe(left[None], **arguments), "guided": guided}
    sgbm = sgbm_call(posed, disparities_of(build_cost_volume(posed), posed.size[1]))
    return calls | {"SGBM": sgbm}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, nargs=2, default=(375, 1242), metavar=("H", "W"))
    parser.add_argument(
        "--data", metavar="DIR", help="folder of pairs, or synthetic:N (default: one synthetic pair)"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--threads", type=int, nargs="+", default=[1], help="numbers of threads, one row each"
    )
    parser.add_argument("--repeats", type=int, default=3, help="number of runs; the fastest is shown")
    parser.add_argument(
        "--parameters", default="", metavar="NAME=VALUE+...", help="changed parameters of the default preset"
    )
    options = parser.parse_args(arguments)
    pipe = enable_geometry_guidance(load_bundled_prior().to(options.device))
    pipe.set_progress_bar_config(disable=True)
    if options.data is None:
        pairs = iter([("made up", textured_pair(tuple(options.size), options.device)[0])])
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
                for key, work in calls_of(pair, pipe, options.parameters).items()
            }
            shown = [f"{seconds[k][0]:.2f} ({seconds[k][1]:.2f})" for k in ("plain", "guided", "SGBM")]
            guided, sgbm = (seconds[k][0] for k in ("guided", "SGBM"))
            size = "{1}x{0}".format(*pair.size)
            table.add_row(name, size, f"{threads}", *shown, f"{guided / sgbm:.1f}")
            total[threads] = total[threads][0] + guided, total[threads][1] + sgbm
    for threads, (guided, sgbm) in total.items():
        table.add_row("all", "", f"{threads}", "", f"{guided:.2f}", f"{sgbm:.2f}", f"{guided / sgbm:.1f}")
    torch.set_num_threads(before)
    Console(width=max(Console().width, 120)).print(table)


if __name__ == "__main__":
    main()
