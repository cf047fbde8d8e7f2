"""Memory of every prior at full size, counted with fake tensors.

Data flow: architecture -> one step under ``FakeTensorMode``
    -> bytes of weights and of activations.

Run ``python -m tests.benchmarks.memory [KEY ...]`` for the table of docs/reference/priors.md.
"""

from __future__ import annotations

import gc
import sys
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from diffusers import MarigoldDepthPipeline
from diffusers.utils import logging as diffusers_logging
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

try:
    from transformers.initialization import no_init_weights
except ImportError:  # transformers 4
    from transformers.modeling_utils import no_init_weights

from geodiff_plugin.priors import prior_of
from geodiff_plugin.priors.marigold_v2 import MarigoldV2Pipeline
from tests.benchmarks.full_sizes import FULL_SIZES

__all__ = ["Memory", "count_memory", "four_bit_bytes", "main"]

#: (H, W) of the image that is counted.
SIZE = (576, 768)
DTYPE = torch.bfloat16
#: Of a weight in NF4: half a byte, and a float32 for every 64 of them.
NF4_BYTES = 0.5 + 4 / 64
#: Not quantised, as in the authors' runs.
SKIPPED = ("transformer_blocks.0.img_mod",)
#: Of the LoRA of Marigold V2, and the layers of its transformer that have none.
LORA_RANK, WITHOUT_LORA = 128, ("img_mod.1", "txt_mod.1", "linear_1", "linear_2", "proj_out")


@dataclass(frozen=True)
class Memory:
    """Bytes of one sample's step, bfloat16.

    Attributes:
        parameters: number of them.
        weights: bytes of them.
        plain: next to the weights at the peak of an unguided step and decode.
        denoised: the same with the gradient from the map to the clean latent.
        full: with the gradient through the network to z_t; ``None`` where the network sees none.
        four_bit_weights: bytes of the weights where the prior may keep its LoRA next to a base in 4 bits.
    """

    parameters: int
    weights: int
    plain: int
    denoised: int
    full: int | None
    four_bit_weights: int | None = None


class _LiveBytes(TorchDispatchMode):
    """Sums the storages that operations make while they live; ``peak`` is the most at any time.

    Args:
        weights: what is there already; a transposed weight, as a linear layer makes one, is no new storage.
    """

    def __init__(self, weights: Sequence[Tensor] = ()) -> None:
        super().__init__()
        self.live = self.peak = 0
        self._known: dict[int, Any] = {w.untyped_storage()._cdata: None for w in weights}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(result):
            if isinstance(tensor, Tensor):
                self._notice(tensor.untyped_storage())
        return result

    def _notice(self, storage: torch.UntypedStorage) -> None:
        key = storage._cdata
        if key in self._known:
            return
        size = storage.nbytes()

        def gone(_: Any) -> None:
            self.live -= size
            self._known.pop(key, None)

        self._known[key] = weakref.ref(storage, gone)
        self.live += size
        self.peak = max(self.peak, self.live)


def _step(pipe: Any, image: Tensor, with_graph: bool) -> tuple[Tensor, Tensor]:
    """Latents and the network's output of one step; ``with_graph`` from the latents on."""
    t = torch.tensor(999)
    with torch.no_grad():
        if isinstance(pipe, MarigoldDepthPipeline):
            image_latent, z = pipe.prepare_latents(image, None, None, 1, 1)
            prompt = image_latent.new_zeros(1, 2, pipe.unet.config.cross_attention_dim)
        else:
            condition = pipe.prepare_condition(image, 1, 1, None)
            z = pipe.prepare_latents(condition, None)
    z = z.detach().requires_grad_(with_graph)
    with torch.set_grad_enabled(with_graph):
        if isinstance(pipe, MarigoldDepthPipeline):
            joined = torch.cat([image_latent, z], dim=1)
            return z, pipe.unet(joined, t, encoder_hidden_states=prompt, return_dict=False)[0]
        return z, pipe.denoise(z, t, condition)


def _peak(pipe: Any, prior: Any, gradient: str | None, weights: Sequence[Tensor]) -> int:
    """Most bytes next to the weights in one step of one sample, ``gradient`` as in ``GeometryGuidance``."""
    gc.collect()
    with _LiveBytes(weights) as counted:
        image = torch.zeros(1, 3, *SIZE, dtype=DTYPE)
        z, output = _step(pipe, image, gradient == "full")
        z0 = output[:, prior.depth_channels]
        if gradient == "denoised":
            z = z0 = z0.detach().requires_grad_()
        with torch.set_grad_enabled(gradient is not None):
            x = prior.decode(z0)
        if gradient is not None:
            torch.autograd.grad(x.sum(), z)
    return counted.peak


def count_memory(key: str) -> Memory:
    """Count one prior; nothing of its size is allocated.

    Args:
        key: of ``PRIORS``.
    """
    with FakeTensorMode(allow_non_fake_inputs=True):
        default = torch.get_default_dtype()
        torch.set_default_dtype(DTYPE)
        try:
            with no_init_weights():  # some initialisations read numbers, of which there are none here
                pipe = FULL_SIZES[key]()
        finally:
            torch.set_default_dtype(default)
        modules = [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)]
        weights = [p for m in modules for p in m.requires_grad_(False).eval().parameters()]
        prior, total = prior_of(pipe), sum(p.numel() * p.element_size() for p in weights)
        four_bit = None
        if isinstance(pipe, MarigoldV2Pipeline):
            own = sum(p.numel() * p.element_size() for p in pipe.transformer.parameters())
            four_bit = total - own + four_bit_bytes(pipe.transformer)
        return Memory(
            sum(p.numel() for p in weights),
            total,
            _peak(pipe, prior, None, weights),
            _peak(pipe, prior, "denoised", weights),
            None if prior.network_input is None else _peak(pipe, prior, "full", weights),
            four_bit,
        )


def four_bit_bytes(transformer: torch.nn.Module, rank: int = LORA_RANK) -> int:
    """Bytes of a transformer of Marigold V2 as its authors hold it: NF4, and a LoRA next to it in float32.

    Args:
        transformer: the base, of any dtype.
        rank: of the LoRA.
    """
    total = 0
    for name, module in transformer.named_modules():
        own = sum(p.numel() for p in module.parameters(recurse=False))
        if isinstance(module, torch.nn.Linear) and not name.startswith(SKIPPED):
            total += int(module.weight.numel() * NF4_BYTES) + 2 * (own - module.weight.numel())
            if not name.endswith(WITHOUT_LORA):
                total += 4 * rank * (module.in_features + module.out_features)
        else:
            total += 2 * own
    return total


def _row(label: str, parameters: int, weights: int, memory: Memory) -> str:
    columns = [
        "-" if beside is None else f"{(weights + beside) / 1e9:.1f} GB"
        for beside in (memory.plain, memory.denoised, memory.full)
    ]
    return f"| {label} | {parameters / 1e6:.0f} M | {' | '.join(columns)} |"


def main(keys: Sequence[str] = ()) -> None:
    """Print the table as Markdown, GB of 1e9 bytes, weights included.

    Args:
        keys: of the priors to count; none for all.
    """
    diffusers_logging.set_verbosity_error()
    print("| prior | parameters | plain | denoised | full |")
    print("| --- | --- | --- | --- | --- |")
    for key in keys or FULL_SIZES:
        memory = count_memory(key)
        print(_row(f"`{key}`", memory.parameters, memory.weights, memory), flush=True)
        if memory.four_bit_weights is not None:
            label = f"`{key}`, base in 4 bits"
            print(_row(label, memory.parameters, memory.four_bit_weights, memory), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
