"""Speed and deviation of a guided call with options of diffusers (compile, bfloat16, slicing, offload).

Data flow: a prior, the demo pair -> the same call with each option -> ratio of seconds, largest deviation.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from diffusers.utils import logging as diffusers_logging

from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.priors import load_prior
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.runtime.machine import pick_device

__all__ = ["SWITCHES", "deviation", "main"]


def _compile(pipe: Any) -> None:
    pipe.unet.compile()
    pipe.vae.decoder.compile()


def _channels_last(pipe: Any) -> None:
    pipe.unet.to(memory_format=torch.channels_last)
    pipe.vae.to(memory_format=torch.channels_last)


#: Switch -> what turns it on.
SWITCHES: dict[str, Callable[[Any], Any]] = {
    "as it is": lambda pipe: None,
    "torch.compile of network and decoder": _compile,
    "bfloat16": lambda pipe: pipe.to(torch.bfloat16),
    "channels_last": _channels_last,
    "attention slicing": lambda pipe: pipe.enable_attention_slicing(),
    "VAE slicing": lambda pipe: pipe.vae.enable_slicing(),
    "VAE tiling": lambda pipe: pipe.vae.enable_tiling(),
    "model offload": lambda pipe: pipe.enable_model_cpu_offload(),
}
#: Switches that do something on CUDA only.
CUDA_ONLY = ("model offload",)


def deviation(found: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Mean and greatest deviation of two metric maps, as a fraction of the second."""
    off = np.abs(found / reference - 1.0)
    return float(off.mean()), float(off.max())


def _depth_and_seconds(
    switch: str, prior: str, device: torch.device, repeats: int
) -> tuple[np.ndarray, float]:
    pair = read_demo_pair()
    guidance = GeometryGuidance(pair.right, (pair.rig.K_left, pair.rig.K_right), pair.rig.E)
    pipe = load_prior(prior, device=None if switch in CUDA_ONLY else device)
    pipe.set_progress_bar_config(disable=True)
    SWITCHES[switch](pipe)
    enable_geometry_guidance(pipe)
    taken = []
    for _ in range(repeats + 1):  # the first one compiles
        started = time.perf_counter()
        found = pipe(pair.left, guidance=guidance, generator=torch.Generator("cpu").manual_seed(0))
        taken.append(time.perf_counter() - started)
    return found.prediction[0, ..., 0], min(taken[1:] or taken)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:N or mps")
    parser.add_argument("--prior", default="bundled")
    parser.add_argument("--switches", nargs="*", choices=SWITCHES, help="options to measure (default: all)")
    parser.add_argument("--repeats", type=int, default=2, help="number of calls after the first")
    typed = parser.parse_args(arguments)
    diffusers_logging.set_verbosity_error()
    device = pick_device(typed.device)
    print(
        f"{typed.prior} prior, guided; {device}, {torch.get_num_threads()} threads, torch {torch.__version__}"
    )
    print(f"{'':<40}{'seconds':>9}{'x':>7}{'mean off':>10}{'most off':>10}", flush=True)
    reference: tuple[np.ndarray, float] | None = None
    for switch in dict.fromkeys((next(iter(SWITCHES)), *(typed.switches or SWITCHES))):
        if switch in CUDA_ONLY and device.type != "cuda":
            print(f"{switch:<40}  moves models between CPU and GPU: nothing to do on {device.type}")
            continue
        depth_m, seconds = _depth_and_seconds(switch, typed.prior, device, typed.repeats)
        reference = reference or (depth_m, seconds)
        mean, most = deviation(depth_m, reference[0])
        print(
            f"{switch:<40}{seconds:>9.2f}{seconds / reference[1]:>7.2f}{mean:>10.2%}{most:>10.2%}", flush=True
        )


if __name__ == "__main__":
    main()
