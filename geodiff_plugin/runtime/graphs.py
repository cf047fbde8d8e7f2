"""CUDA graphs for the networks of a guided call, one per input size, and a faster half-precision group norm.

Without graphs, a U-Net at 768 pixels keeps a large GPU busy for only a quarter of the time that Python takes
to launch its kernels. A graph launches all kernels at once. It is replayed with other inputs, so it cannot
compute gradients.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import Tensor

from geodiff_plugin._internal.checks import raise_input_error
from geodiff_plugin._internal.kernels import has_kernel, use_kernel
from geodiff_plugin.runtime.hooks import layers_of, networks_of, replaced, weights_of

#: Maximum number of input sizes per network with a graph; calls at further sizes run eagerly.
MAX_SIZES = 8
#: Dtypes in which torch's group norm takes half of the decoding time.
HALF = (torch.float16, torch.bfloat16)


@functools.cache
def _recording_stream(device: torch.device) -> torch.cuda.Stream:
    """Return one recording stream per device, shared by all graphs.

    torch's default capture stream belongs to the device that is current at its first use. Kernels launched on
    another device than the stream's are not recorded, and no replay repeats them.
    """
    return torch.cuda.Stream(device)


class _Graph:
    """A recorded forward pass on a device, with its fixed input and output tensors."""

    def __init__(
        self, forward: Callable[..., Any], args: list[Any], kwargs: dict[str, Any], device: torch.device
    ) -> None:
        self._inputs = [value.clone() for value in _tensors(args, kwargs)]
        self._latest = torch.cuda.current_stream(device)  # stream of the latest access to inputs and outputs
        fixed = iter(self._inputs)
        args = [next(fixed) if isinstance(value, Tensor) else value for value in args]
        kwargs = {k: next(fixed) if isinstance(v, Tensor) else v for k, v in kwargs.items()}
        with torch.cuda.device(device):
            self._graph = torch.cuda.CUDAGraph()
            # Another thread, which prepares the next pair, may use the device during capture.
            stream = _recording_stream(device)
            with torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local"):
                self._output = forward(*args, **kwargs)

    def replay(self, args: list[Any], kwargs: dict[str, Any]) -> Any:
        """Replay with other inputs of the same sizes; returns a copy, since the next replay overwrites it."""
        stream = torch.cuda.current_stream(self._latest.device)
        if stream != self._latest:  # another thread's stream: do not overwrite tensors that are still read
            stream.wait_stream(self._latest)
            self._latest = stream
        for fixed, value in zip(self._inputs, _tensors(args, kwargs), strict=True):
            fixed.copy_(value)
        self._graph.replay()
        if isinstance(self._output, Tensor):
            return self._output.clone()
        return tuple(part.clone() for part in self._output)


def _processor_of(module: torch.nn.Module) -> Any:
    """Return a layer's attention processor, if any; ``getattr`` is slow if there is none."""
    return vars(module).get("processor", module._modules.get("processor"))


def _tensors(args: list[Any], kwargs: dict[str, Any]) -> list[Tensor]:
    return [value for value in (*args, *kwargs.values()) if isinstance(value, Tensor)]


def _is_recordable(output: Any) -> bool:
    parts = output if type(output) is tuple else (output,)
    return all(isinstance(part, Tensor) for part in parts)


class GraphedForward:
    """Forward pass of a network: eager at the first call of a size, recorded at the second, then replayed.

    Always eager if a gradient is needed, off CUDA, or if arguments or output are not only tensors.
    """

    def __init__(self, network: torch.nn.Module) -> None:
        self._network = network
        self._signature: Any = None
        self._graphs: dict[Any, _Graph | None] = {}

    def forget_if_changed(self) -> None:
        """Drop the graphs if the network's weights or layers were replaced."""
        layers = layers_of(self._network)
        signature = (
            [weight.data_ptr() for weight in weights_of(layers)],
            [(id(layer), id(_processor_of(layer))) for layer in layers],
        )
        if signature != self._signature:
            self._graphs.clear()
            self._signature = signature

    def call(self, forward: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Compute ``forward(*args, **kwargs)``, from a graph if possible."""
        key = self._key(args, kwargs)
        if key is None:
            return forward(*args, **kwargs)
        graph = self._graphs.get(key)
        if graph is None:
            if key not in self._graphs:
                output = forward(*args, **kwargs)
                if _is_recordable(output) and len(self._graphs) < MAX_SIZES:
                    self._graphs[key] = None
                return output
            device = next(self._network.parameters()).device
            graph = self._graphs[key] = _Graph(forward, *_arguments_on(device, args, kwargs), device)
        return graph.replay(list(args), kwargs)

    def _key(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Return the key under which calls share a graph; ``None`` if no graph can be used."""
        on_device = [tensor for tensor in _tensors(list(args), kwargs) if tensor.is_cuda]
        if torch.is_grad_enabled() or not on_device:
            return None
        described: list[Any] = [torch.is_autocast_enabled("cuda"), torch.get_autocast_dtype("cuda")]
        described.append(use_kernel(on_device[0]))  # selects the group norm of a VAE
        for name, value in (*enumerate(args), *sorted(kwargs.items())):
            if isinstance(value, Tensor):
                described.append((name, tuple(value.shape), value.stride(), value.dtype))
            elif value is None or isinstance(value, (bool, int, float, str)):
                described.append((name, value))
            else:
                return None
        return tuple(described)


def _arguments_on(
    device: torch.device, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> tuple[list[Any], dict[str, Any]]:
    """Move tensor arguments to the device: a timestep may be on the CPU, which a graph cannot read."""

    def to_device(value: Any) -> Any:
        return value.to(device) if isinstance(value, Tensor) else value

    return [to_device(value) for value in args], {name: to_device(value) for name, value in kwargs.items()}


def _has_faster_norm(norm: torch.nn.GroupNorm, own: Callable[[Tensor], Tensor], x: Tensor) -> bool:
    """Return whether the kernel is faster and no gradient is needed."""
    needs_gradient = torch.is_grad_enabled() and x.requires_grad
    return not needs_gradient and x.dtype in HALF and x.is_contiguous() and norm.weight is not None


@has_kernel("runtime.kernels.group_norm.group_norm", when=_has_faster_norm)
def _group_norm(norm: torch.nn.GroupNorm, own: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Apply a group norm through its own forward method."""
    return own(x)


class FasterNetworks:
    """CUDA graphs and faster norms for a pipeline's ``unet`` and ``vae``, active only in guided calls."""

    def __init__(self, pipe: Any) -> None:
        self._graphs: dict[int, GraphedForward] = {}
        self.check(pipe)

    @staticmethod
    def check(pipe: Any) -> None:
        """Raise an error for networks that leave the device between calls."""
        offloaded = getattr(pipe, "_all_hooks", None) or any(
            getattr(module, "_hf_hook", None) is not None for module in networks_of(pipe)
        )
        if offloaded:
            raise_input_error(
                "cuda_graphs=True needs networks that stay on the device: a CUDA graph reads their weights "
                "at fixed addresses. Use pipe.to('cuda') without offloading, or omit cuda_graphs."
            )

    @contextmanager
    def attached(self, pipe: Any) -> Iterator[None]:
        """Patch the networks and restore them at exit; the graphs are kept for the next call."""
        self.check(pipe)
        vae = getattr(pipe, "vae", None)
        recorded = [
            getattr(pipe, "unet", None),
            *(getattr(vae, side, None) for side in ("encoder", "decoder")),
        ]
        with ExitStack() as stack:
            for norm in [] if vae is None else layers_of(vae):
                if type(norm) is torch.nn.GroupNorm:
                    faster = functools.partial(_group_norm, norm, norm.forward)
                    stack.enter_context(replaced(norm, "forward", faster))
            for network in recorded:
                if isinstance(network, torch.nn.Module):
                    graphs = self._graphs.setdefault(id(network), GraphedForward(network))
                    graphs.forget_if_changed()
                    own = functools.partial(graphs.call, network.forward)
                    stack.enter_context(replaced(network, "forward", own))
            yield
