"""Networks of a guided call as CUDA graphs, one a size, and a faster group norm in half precision.

A U-Net of 768 pixels keeps a large card busy for a quarter of the time that Python takes to launch its
kernels. A graph launches all of them at once. It is replayed with other inputs, so only calls without
gradients can use it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import Tensor

from geodiff_plugin._checks import refuse
from geodiff_plugin._kernels import use_kernel
from geodiff_plugin.runtime.hooks import layers_of, networks_of, replaced, weights_of

#: Sizes of which a network keeps a graph; calls of further ones run as always.
MOST_SIZES = 8
#: Number formats in which torch's group norm takes half of a decode.
HALF = (torch.float16, torch.bfloat16)


@functools.cache
def _recording_stream(device: torch.device) -> torch.cuda.Stream:
    """One for all graphs of a device: torch's own is of the device that is the current one at its first use.

    What is launched on another device than that of the stream is not recorded, and no replay repeats it.
    """
    return torch.cuda.Stream(device)


class _Graph:
    """A recorded forward on a device: the tensors that it reads, and those that it writes."""

    def __init__(
        self, forward: Callable[..., Any], args: list[Any], kwargs: dict[str, Any], device: torch.device
    ) -> None:
        self._inputs = [value.clone() for value in _tensors(args, kwargs)]
        self._latest = torch.cuda.current_stream(device)  # what it read and wrote last, it did there
        fixed = iter(self._inputs)
        args = [next(fixed) if isinstance(value, Tensor) else value for value in args]
        kwargs = {k: next(fixed) if isinstance(v, Tensor) else v for k, v in kwargs.items()}
        with torch.cuda.device(device):
            self._graph = torch.cuda.CUDAGraph()
            # Another thread, which prepares the next pair, may use the device meanwhile.
            stream = _recording_stream(device)
            with torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local"):
                self._output = forward(*args, **kwargs)

    def replay(self, args: list[Any], kwargs: dict[str, Any]) -> Any:
        """The output for other inputs of the same sizes, as a copy: the next replay writes over it."""
        stream = torch.cuda.current_stream(self._latest.device)
        if stream != self._latest:  # that of another thread: it must not write over what is still read
            stream.wait_stream(self._latest)
            self._latest = stream
        for fixed, value in zip(self._inputs, _tensors(args, kwargs), strict=True):
            fixed.copy_(value)
        self._graph.replay()
        if isinstance(self._output, Tensor):
            return self._output.clone()
        return tuple(part.clone() for part in self._output)


def _processor_of(module: torch.nn.Module) -> Any:
    """What computes the attention of a layer, if it is one; ``getattr`` is slow where there is none."""
    return vars(module).get("processor", module._modules.get("processor"))


def _tensors(args: list[Any], kwargs: dict[str, Any]) -> list[Tensor]:
    return [value for value in (*args, *kwargs.values()) if isinstance(value, Tensor)]


def _is_recordable(output: Any) -> bool:
    parts = output if type(output) is tuple else (output,)
    return all(isinstance(part, Tensor) for part in parts)


class GraphedForward:
    """The forward of a network: eager at the first call of a size, recorded at the second, then replayed.

    Eager as well where a gradient is needed, off CUDA, and where arguments or output are more than tensors.
    """

    def __init__(self, network: torch.nn.Module) -> None:
        self._network = network
        self._made_of: Any = None
        self._graphs: dict[Any, _Graph | None] = {}

    def forget_if_changed(self) -> None:
        """Drop graphs that read other weights than the network now has, or run other layers."""
        layers = layers_of(self._network)
        made_of = (
            [weight.data_ptr() for weight in weights_of(layers)],
            [(id(layer), id(_processor_of(layer))) for layer in layers],
        )
        if made_of != self._made_of:
            self._graphs.clear()
            self._made_of = made_of

    def call(self, forward: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """``forward(*args, **kwargs)``."""
        key = self._key(args, kwargs)
        if key is None:
            return forward(*args, **kwargs)
        graph = self._graphs.get(key)
        if graph is None:
            if key not in self._graphs:
                output = forward(*args, **kwargs)
                if _is_recordable(output) and len(self._graphs) < MOST_SIZES:
                    self._graphs[key] = None
                return output
            device = next(self._network.parameters()).device
            graph = self._graphs[key] = _Graph(forward, *_on(device, args, kwargs), device)
        return graph.replay(list(args), kwargs)

    def _key(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """What calls that share a graph have in common; ``None`` where none can be used."""
        on_device = [tensor for tensor in _tensors(list(args), kwargs) if tensor.is_cuda]
        if torch.is_grad_enabled() or not on_device:
            return None
        described: list[Any] = [torch.is_autocast_enabled("cuda"), torch.get_autocast_dtype("cuda")]
        described.append(use_kernel(on_device[0]))  # the norms of a VAE
        for name, value in (*enumerate(args), *sorted(kwargs.items())):
            if isinstance(value, Tensor):
                described.append((name, tuple(value.shape), value.stride(), value.dtype))
            elif value is None or isinstance(value, (bool, int, float, str)):
                described.append((name, value))
            else:
                return None
        return tuple(described)


def _on(
    device: torch.device, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> tuple[list[Any], dict[str, Any]]:
    """Arguments whose tensors lie on the device: a timestep may lie on the CPU, which a graph cannot read."""

    def moved(value: Any) -> Any:
        return value.to(device) if isinstance(value, Tensor) else value

    return [moved(value) for value in args], {name: moved(value) for name, value in kwargs.items()}


def _fast_group_norm(norm: torch.nn.GroupNorm, own: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """The norm by a kernel where that is faster and no gradient is needed, else its own forward."""
    needs_gradient = torch.is_grad_enabled() and x.requires_grad
    suits = x.dtype in HALF and x.is_contiguous() and norm.weight is not None
    if needs_gradient or not suits or not use_kernel(x):
        return own(x)
    from geodiff_plugin.runtime import kernels

    return kernels.group_norm(x, norm.num_groups, norm.weight, norm.bias, norm.eps)


class FasterNetworks:
    """Graphs and norms of a pipeline's ``unet`` and ``vae``, if any, in place within guided calls only."""

    def __init__(self, pipe: Any) -> None:
        self._graphs: dict[int, GraphedForward] = {}
        self.check(pipe)

    @staticmethod
    def check(pipe: Any) -> None:
        """Refuse networks that leave the device between calls."""
        offloaded = getattr(pipe, "_all_hooks", None) or any(
            getattr(module, "_hf_hook", None) is not None for module in networks_of(pipe)
        )
        if offloaded:
            refuse(
                "graphs=True needs networks that stay on the device: a CUDA graph reads their weights where "
                "they were. Use pipe.to('cuda') without offloading, or leave graphs out."
            )

    @contextmanager
    def attached(self, pipe: Any) -> Iterator[None]:
        """Put them in place; at exit the networks are as they were. The graphs are kept for the next call."""
        self.check(pipe)
        vae = getattr(pipe, "vae", None)
        recorded = [
            getattr(pipe, "unet", None),
            *(getattr(vae, side, None) for side in ("encoder", "decoder")),
        ]
        with ExitStack() as stack:
            for norm in [] if vae is None else layers_of(vae):
                if type(norm) is torch.nn.GroupNorm:
                    faster = functools.partial(_fast_group_norm, norm, norm.forward)
                    stack.enter_context(replaced(norm, "forward", faster))
            for network in recorded:
                if isinstance(network, torch.nn.Module):
                    graphs = self._graphs.setdefault(id(network), GraphedForward(network))
                    graphs.forget_if_changed()
                    own = functools.partial(graphs.call, network.forward)
                    stack.enter_context(replaced(network, "forward", own))
            yield
