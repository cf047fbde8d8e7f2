"""Count the operations of several ways to call a Marigold pipeline.

Data flow: a way and a size -> calls of each network; networks without data -> operations of each call.
Paper: S5.4 (cost).

Nothing runs at full size: the calls of each network are counted in narrow ones at a low resolution, and the
operations of one call at full size on tensors without data.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from torch.utils.flop_counter import FlopCounterMode

from examples.fitted_lora import draw_points
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.runtime.codec import TINY, tiny_autoencoder
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from tests.benchmarks.full_sizes import UNET, VAE
from tests.benchmarks.random_marigold import EMPTY_PROMPT_TOKENS, narrowed, random_marigold, random_tiny

__all__ = [
    "WAYS",
    "Calls",
    "Size",
    "call_of",
    "calls_of_all",
    "count_calls",
    "count_operations",
    "tiny_folder",
]

#: Ways in the order of the table, with what the guidance is given; the first is what the others are compared
#: with.
WAYS: dict[str, dict[str, Any] | None] = {
    "plain": None,
    "guided": {},
    "guided, matches fitted at every step": {"match_fits": 10_000},
    "guided, tiny decoder": {"decoder": TINY},
    "Marigold-DC": {},
}
PLAIN, MARIGOLD_DC = next(iter(WAYS)), list(WAYS)[-1]
#: Points of Marigold-DC's loop, drawn from the demo pair's ground truth.
POINTS = 500
#: Where the calls of a way are counted: nothing of it depends on the size.
COUNTED_WIDTH, COUNTED_RESOLUTION = 0.05, 64

#: Kind of call -> how often: ``network``, ``decode``, ``encode`` and the tiny two; with ``+ back`` where a
#: gradient goes back through it.
Calls = dict[str, int]


@dataclass(frozen=True)
class Size:
    """What is measured.

    Attributes:
        width: share of the published channels.
        resolution: longer side of what the prior works on, pixels.
        steps: denoising steps of all ways but Marigold-DC.
        dc_steps: of Marigold-DC; 50 are published.
        dtype: of the networks.
        repeats: calls after the first one, the fastest of which is timed; 0 times the first one.
    """

    width: float = 1.0
    resolution: int = 768
    steps: int = 4
    dc_steps: int = 50
    dtype: str = "float32"
    repeats: int = 2


def call_of(way: str, pipe: Any, size: Size, folder: str) -> Callable[[], Any]:
    """One call on the demo pair, ready to be made.

    Args:
        way: of ``WAYS``.
        pipe: with guidance enabled.
        size: what is measured.
        folder: of a tiny autoencoder.
    """
    pair = read_demo_pair()
    options: dict[str, Any] = {
        "processing_resolution": size.resolution,
        "num_inference_steps": size.dc_steps if way == MARIGOLD_DC else size.steps,
    }
    cameras = (pair.rig.K_left, pair.rig.K_right), pair.rig.E
    if way == MARIGOLD_DC:
        points = draw_points(pair, POINTS).astype(np.float32)
        options["guidance"] = GeometryGuidance.marigold_dc(points, pair.rig.K_left)
    elif way != PLAIN:
        parameters = {name: folder if value == TINY else value for name, value in WAYS[way].items()}
        options["guidance"] = GeometryGuidance(pair.right, *cameras, **parameters)
    return lambda: pipe(pair.left, generator=torch.Generator("cpu").manual_seed(0), **options)


@contextmanager
def _counted(networks: Sequence[tuple[Any, str, str]], calls: Counter[str]) -> Iterator[None]:
    """Count calls of ``(network, method, kind)``, those that a gradient goes back through apart.

    A batch of n counts as n calls, because it takes n times the operations.
    """

    def counting(own: Callable[..., Any], kind: str) -> Callable[..., Any]:
        def counted(*args: Any, **kwargs: Any) -> Any:
            result = own(*args, **kwargs)
            first = result[0] if isinstance(result, tuple) else next(iter(result.values()))
            goes_back = isinstance(first, torch.Tensor) and first.requires_grad
            calls[kind + (" + back" if goes_back else "")] += len(args[0])
            return result

        return counted

    with ExitStack() as stack:
        for network, method, kind in networks:
            stack.enter_context(patch.object(network, method, counting(getattr(network, method), kind)))
        yield


def count_calls(way: str, size: Size, folder: str) -> Calls:
    """Calls of each network in one call of the pipeline, counted in narrow networks at a low resolution.

    Args:
        way: of ``WAYS``.
        size: of which the steps are read.
        folder: of a tiny autoencoder.
    """
    pipe = random_marigold(width=COUNTED_WIDTH)
    pipe.set_progress_bar_config(disable=True)
    calls: Counter[str] = Counter()
    tiny = tiny_autoencoder(pipe, folder)
    networks = [(pipe.unet, "forward", "network")]
    networks += [(pipe.vae, method, method) for method in ("decode", "encode")]
    networks += [(tiny, method, f"tiny {method}") for method in ("decode", "encode")]
    call = call_of(way, enable_geometry_guidance(pipe), replace(size, resolution=COUNTED_RESOLUTION), folder)
    with _counted(networks, calls):
        call()
    return dict(calls)


def calls_of_all(size: Size) -> dict[str, Calls]:
    """``count_calls`` of every way, with a tiny autoencoder of random weights."""
    with tempfile.TemporaryDirectory() as parent:
        folder = tiny_folder(parent, COUNTED_WIDTH)
        return {way: count_calls(way, size, folder) for way in WAYS}


def count_operations(size: Size) -> dict[str, int]:
    """Floating-point operations of one call of each kind, by tensors without data.

    Args:
        size: width and resolution; the image is 4:3.
    """
    height, width = round(0.75 * size.resolution / 64) * 64, round(size.resolution / 64) * 64
    with torch.device("meta"):
        unet = UNet2DConditionModel(**narrowed(UNET, size.width)).eval().requires_grad_(False)
        vae = AutoencoderKL(**narrowed(VAE, size.width)).eval().requires_grad_(False)
        tiny = random_tiny(width=size.width).requires_grad_(False)
        z = torch.empty(1, 4, height // 8, width // 8)
        image = torch.empty(1, 3, height, width)
        prompt = torch.empty(1, EMPTY_PROMPT_TOKENS, UNET["cross_attention_dim"])
        t = torch.empty((), dtype=torch.long)

    def counted(run: Callable[[Any], Any], of: torch.Tensor, back: bool = False) -> int:
        given = of.clone().requires_grad_(back)
        with FlopCounterMode(display=False) as counter, torch.set_grad_enabled(back):
            result = run(given * 1.0)  # what counts takes no leaf for the input of a network
            if back:
                torch.autograd.grad(result.sum(), given)
        return int(counter.get_total_flops())

    def network(z_t: torch.Tensor) -> torch.Tensor:
        return unet(torch.cat([z_t, z_t], 1), t, encoder_hidden_states=prompt, return_dict=False)[0]

    def decode(z_0: torch.Tensor) -> torch.Tensor:
        return vae.decode(z_0, return_dict=False)[0]

    return {
        "network": counted(network, z),
        "network + back": counted(network, z, back=True),
        "decode": counted(decode, z),
        "decode + back": counted(decode, z, back=True),
        "encode": counted(lambda x: vae.encode(x).latent_dist.mean, image),
        "tiny decode": counted(lambda v: tiny.decode(v, return_dict=False)[0], z),
        "tiny encode": counted(lambda x: tiny.encode(x, return_dict=False)[0], image),
    }


def tiny_folder(parent: str, width: float) -> str:
    """Save a tiny autoencoder with random weights below ``parent``; its folder."""
    folder = Path(parent) / "tiny"
    random_tiny(width=width).save_pretrained(folder)
    return str(folder)
