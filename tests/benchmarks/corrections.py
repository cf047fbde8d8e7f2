"""Which match fits are worth their cost: error of the default with fewer or coarser ones, or a tiny decoder.

Data flow: rendered pairs, parameters -> AbsRel with the bundled prior and with emulated ones -> table.

    python -m tests.benchmarks.corrections --pairs 3 match_fits=4 match_fits=2
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from diffusers.utils import logging as diffusers_logging

from geodiff_plugin.evaluation.baselines import PriorCache, Settings, find_method
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from tests.lab.options import STRENGTHS
from tests.lab.strength import EmulatedPrior

__all__ = ["main"]

#: The prior that ships, next to the keys of ``STRENGTHS``.
BUNDLED = "bundled"
#: Longer side for emulated priors, pixels; the bundled one has its own.
RESOLUTION = 256


def _error_and_seconds(
    sample: StereoSample, parameters: str, settings: Settings, cache: PriorCache
) -> tuple[float, float]:
    method = find_method(f"guided:{parameters}" if parameters else "guided")
    started = time.process_time()
    depth_m = method.run(sample, settings, cache).depth_m
    seconds = time.process_time() - started
    return evaluate_depth(depth_m, sample.depth_m, sample.valid, None)["abs_rel"], seconds


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "parameters", nargs="+", help="NAME=VALUE[+NAME=VALUE] each; the first is the reference"
    )
    parser.add_argument(
        "--data", default="synthetic:3", help="synthetic:N, or a folder with dense ground truth"
    )
    parser.add_argument(
        "--priors", nargs="*", default=[BUNDLED, "exact", "10%"], help=f"of {[BUNDLED, *STRENGTHS]}"
    )
    parser.add_argument("--steps", type=int, default=4)
    typed = parser.parse_args(arguments)
    diffusers_logging.set_verbosity_error()
    torch.set_num_threads(1)
    settings, cache = Settings(steps=typed.steps), PriorCache()
    emulated = EmulatedPrior() if set(typed.priors) - {BUNDLED} else None
    twin = PriorCache()
    twin.evidence = cache.evidence
    if emulated is not None:
        twin.get = lambda _: enable_geometry_guidance(emulated.pipe)  # type: ignore[method-assign]
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    print(
        "pair, prior, parameters, AbsRel, CPU seconds of the call (the first of a pair makes its evidence)",
        flush=True,
    )
    for ref in find_pairs(Path(typed.data)):
        sample: Any = load(ref)
        for prior in typed.priors:
            own = settings if prior == BUNDLED else replace(settings, resolution=RESOLUTION)
            if prior != BUNDLED:
                emulated.answer(sample, STRENGTHS[prior], RESOLUTION)
            for parameters in typed.parameters:
                one = _error_and_seconds(sample, parameters, own, cache if prior == BUNDLED else twin)
                found.setdefault((prior, parameters), []).append(one)
                print(f"{ref.label:<28}{prior:<10}{parameters:<36}{one[0]:.4f}{one[1]:>8.2f}", flush=True)
    print(f"\n{'prior':<10}{'parameters':<36}{'AbsRel':>8}{'change':>9}{'worst':>9}{'CPU s':>8}")
    for prior in typed.priors:
        base = [error for error, _ in found[prior, typed.parameters[0]]]
        for parameters in typed.parameters:
            errors, seconds = zip(*found[prior, parameters], strict=True)
            change = [e - b for e, b in zip(errors, base, strict=True)]
            sums = (sum(errors), sum(change), max(change) * len(base), sum(seconds))
            mean, moved, worst, taken = (value / len(base) for value in sums)
            print(f"{prior:<10}{parameters:<36}{mean:>8.4f}{moved:>+9.4f}{worst:>+9.4f}{taken:>8.2f}")


if __name__ == "__main__":
    main()
