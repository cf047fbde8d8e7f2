"""Changes to a live pipeline during a guided call, each restored afterwards.

Each context manager restores the pipeline at exit and can be re-entered: while a callback runs, the pipeline
is as the user left it. The guided ``step`` is the DDIM line of Algorithm 1.
"""

from __future__ import annotations

import copy
import functools
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import torch
from diffusers import DDIMScheduler
from torch import Tensor

from geodiff_plugin._internal.threads import WithinCores
from geodiff_plugin.runtime.noise_levels import trailing_timesteps

_Answer = TypeVar("_Answer")
_LOCKS: WeakKeyDictionary[Any, threading.RLock] = WeakKeyDictionary()
_LOCKS_GUARD = threading.Lock()
#: Layer attributes in which accelerate and diffusers store their hooks.
HOOKS = frozenset({"_hf_hook", "_diffusers_hook"})


def put_channels(whole: Tensor, channels: slice, part: Tensor) -> Tensor:
    """Replace ``channels`` of ``whole (B, C, h, w)`` by ``part (B, c, h, w)``; ``part`` itself if c = C."""
    start, stop, _ = channels.indices(whole.shape[1])
    if stop - start == whole.shape[1]:
        return part
    return torch.cat([whole[:, :start], part, whole[:, stop:]], dim=1)


@contextmanager
def replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Set an attribute of the instance ``owner`` and restore it at exit."""
    before = vars(owner).get(name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        if before is None:
            delattr(owner, name)
        else:
            setattr(owner, name, before)


@contextmanager
def frozen_weights(pipe: Any) -> Iterator[None]:
    """Disable ``requires_grad`` for every weight of a pipeline, so that no graph is kept for them."""
    thawed = [weight for weight in Layers.of(pipe).weights if weight.requires_grad]
    for weight in thawed:
        weight.requires_grad_(False)
    try:
        yield
    finally:
        for weight in thawed:
            weight.requires_grad_(True)


def networks_of(pipe: Any) -> list[torch.nn.Module]:
    """Return the components of a pipeline that are torch modules."""
    return [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)]


def layers_of(network: torch.nn.Module) -> list[torch.nn.Module]:
    """Return the modules of ``network.modules()``, each once, in arbitrary order.

    ``modules()`` nests one generator per level and takes ten times as long: milliseconds during which a GPU
    idles.
    """
    found = dict[int, torch.nn.Module]()
    queue = [network]
    while queue:
        layer = queue.pop()
        if id(layer) not in found:
            found[id(layer)] = layer
            queue += [part for part in layer._modules.values() if part is not None]
    return list(found.values())


def weights_of(layers: Iterable[torch.nn.Module]) -> list[torch.nn.Parameter]:
    """Return the parameters of layers, each once."""
    weights = (weight for layer in layers for weight in layer._parameters.values() if weight is not None)
    return list({id(weight): weight for weight in weights}.values())


@dataclass(frozen=True, eq=False)
class Layers:
    """Properties of a pipeline's layers, collected in a single scan per call.

    Attributes:
        weights: parameters of all layers, each once.
        hooked: pairs (network, layer) for layers with hooks of diffusers or accelerate.
    """

    weights: list[torch.nn.Parameter]
    hooked: list[tuple[torch.nn.Module, torch.nn.Module]]

    @classmethod
    def of(cls, pipe: Any) -> Layers:
        """Scan all networks of a pipeline."""
        layers = [(network, layer) for network in networks_of(pipe) for layer in layers_of(network)]
        hooked = [each for each in layers if not HOOKS.isdisjoint(vars(each[1]))]
        return cls(weights_of(layer for _, layer in layers), hooked)

    @property
    def device(self) -> torch.device | None:
        """Device of all weights; ``None`` if they are on several devices or if hooks may move them."""
        devices = set() if self.hooked else {weight.device for weight in self.weights}
        return devices.pop() if len(devices) == 1 else None


def images_in_float32(
    processor: Any, seen: Any = None, preprocessed: Any = None
) -> AbstractContextManager[None]:
    """Make an image processor work in float32: float16 cannot represent 65535, the white of a 16-bit image.

    ``preprocessed`` is the output of ``preprocess`` for the image ``seen`` with the arguments of the call, if
    it already ran.
    """
    stock = processor.preprocess

    def preprocess(
        image: Any,
        processing_resolution: int | None = None,
        resample_method_input: str = "bilinear",
        device: torch.device | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Any:
        arguments = image, processing_resolution, resample_method_input, device, torch.float32
        is_done = preprocessed is not None and image is seen
        images, *rest = preprocessed if is_done else stock(*arguments)
        return images.to(dtype), *rest

    return replaced(processor, "preprocess", preprocess)


class PipelineLock:
    """Locks for a call: on its pipeline and, if guided, also on the networks and the CPU threads."""

    def __init__(self, pipe: Any, guided: bool) -> None:
        owners = [pipe, *networks_of(pipe)] if guided else [pipe]
        with _LOCKS_GUARD:
            locks = {id(lock): lock for lock in (_LOCKS.setdefault(o, threading.RLock()) for o in owners)}
        # All threads acquire the locks in the same order, so that no deadlock is possible.
        self._contexts: list[Any] = [lock for _, lock in sorted(locks.items())]
        self._contexts += [WithinCores()] if guided else []
        self._stack = ExitStack()

    def __enter__(self) -> PipelineLock:
        with ExitStack() as stack:
            for context in self._contexts:
                stack.enter_context(context)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def released_during(self, function: Callable[..., _Answer]) -> Callable[..., _Answer]:
        """Wrap a function so that it runs with all locks released and reacquires them before it returns."""

        def unlocked(*args: Any, **kwargs: Any) -> _Answer:
            self.__exit__()
            try:
                return function(*args, **kwargs)
            finally:
                self.__enter__()

        return unlocked


class DenoiserHook:
    """Forward hook: runs the network with a gradient to its depth latent, and again at other latents.

    An instance attribute of ``owner`` overrides its ``method`` and calls it, so other hooks and compiled
    forward methods still run. ``channels`` of the method's first argument are the depth latent.

    Source: the gradient with respect to z_t in Algorithm 1 and Eq. 15 (eq:final_score).
    """

    def __init__(self, owner: Any, method: str, channels: slice) -> None:
        self._owner, self._method, self._channels = owner, method, channels
        self._rerun: Callable[[Tensor], Any] | None = None  # repeats the latest call at another latent
        self._leaf: Tensor | None = None
        self._output: Tensor | None = None

    @contextmanager
    def attached(self) -> Iterator[None]:
        """Override the method; restore it and drop the graph at exit."""
        stock = getattr(self._owner, self._method)
        thread = threading.get_ident()

        @functools.wraps(stock)
        def hooked_method(model_input: Tensor, *args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != thread:  # stock call of another pipeline that shares the network
                return stock(model_input, *args, **kwargs)
            return self._run(stock, model_input, *args, **kwargs)

        try:
            with replaced(self._owner, self._method, hooked_method):
                yield
        finally:
            self.release()

    @property
    def leaf(self) -> Tensor:
        """Depth latent ``(B, C, h, w)`` of the latest call, float32 or wider, requires a gradient."""
        assert self._leaf is not None
        return self._leaf

    def release(self) -> None:
        """Drop the graph."""
        self._rerun = self._leaf = self._output = None

    def _run(self, forward: Callable[..., Any], model_input: Tensor, *args: Any, **kwargs: Any) -> Any:
        """Call the network with the same result, detached; the graph is kept until ``release``."""
        model_input = model_input.detach()
        wide = torch.promote_types(model_input.dtype, torch.float32)
        kind = model_input.device.type
        mixed, precision = torch.is_autocast_enabled(kind), torch.get_autocast_dtype(kind)

        def at(z_t: Tensor) -> Any:
            # Guided steps run outside the user's autocast, in which the other arguments were made.
            with torch.enable_grad(), torch.autocast(kind, precision, enabled=mixed):
                spliced = put_channels(model_input, self._channels, z_t.to(model_input.dtype))
                return forward(spliced, *args, **kwargs)

        self._rerun = at
        self._leaf = model_input[:, self._channels].to(wide).requires_grad_()
        result = at(self._leaf)
        self._output = _first(result)
        detached = self._output.detach()
        if isinstance(result, Tensor):
            return detached
        return (detached, *result[1:]) if isinstance(result, tuple) else type(result)(detached)

    def output_at(self, z_t: Tensor) -> Tensor:
        """Return the network output with its graph to ``z_t (B, C, h, w)`` float32.

        The latest call's output is reused at its own latent, so the first update needs no second forward
        pass.
        """
        assert self._rerun is not None and self._output is not None
        return self._output if z_t is self._leaf else _first(self._rerun(z_t))


def _first(result: Any) -> Tensor:
    """Return the tensor in a tensor, a tuple or a ``BaseOutput``."""
    return result if isinstance(result, Tensor) else result[0]


class GuidedScheduler:
    """A copy of the scheduler whose ``set_timesteps`` starts a trajectory and whose ``step`` is guided.

    Other pipelines that share the scheduler are not guided, and the user's scheduler keeps its state. If the
    user replaced a method on the instance, that instance is used instead of a copy, since the method usually
    refers to it; all its attributes are restored.

    ``step`` receives its timesteps on the CPU, where diffusers keeps the tables they index: a lookup on
    another device would synchronize. DDIM receives Python integers, which saves nine operations per step.

    ``run`` is a ``GuidedRun``. Its ``guide`` returns the inputs of the stock step and the offset to add to
    ``z_{t-1}``. ``trailing_spacing`` runs a DDIM scheduler with leading spacing as trailing.
    """

    def __init__(self, pipe: Any, run: Any, trailing_spacing: bool) -> None:
        self._pipe, self._run, self._trailing_spacing = pipe, run, trailing_spacing
        original = pipe.scheduler
        is_patched = any(name in vars(original) for name in ("set_timesteps", "step"))
        self._scheduler = original if is_patched else copy.copy(original)
        self._inside = dict(vars(self._scheduler)) | self._wrapped()
        # Of the current trajectory, from ``set_timesteps`` on.
        self._timesteps: Tensor  # on the CPU
        self._numbers: list[int | float]  # the same
        self._done: int  # number of steps

    @contextmanager
    def attached(self) -> Iterator[None]:
        """Install the guided scheduler on the pipeline; re-entering during a call continues it."""
        original = self._pipe.scheduler
        outside = vars(self._scheduler)
        self._scheduler.__dict__ = self._inside
        # Bypass ``DiffusionPipeline.__setattr__``, which would rewrite the pipeline's config.
        object.__setattr__(self._pipe, "scheduler", self._scheduler)
        try:
            yield
        finally:
            self._scheduler.__dict__ = outside
            object.__setattr__(self._pipe, "scheduler", original)

    def release(self) -> None:
        """Break the reference cycle between this object and the wrapped methods after a call."""
        self._inside = {}
        self._run = None

    def _wrapped(self) -> dict[str, Callable[..., Any]]:
        """Return the two guided methods as instance attributes that override the methods of the class."""
        scheduler = self._scheduler
        stock_set_timesteps, stock_step = scheduler.set_timesteps, scheduler.step
        is_ddim = getattr(stock_step, "__func__", None) is DDIMScheduler.step

        @functools.wraps(stock_set_timesteps)
        def set_timesteps(*args: Any, **kwargs: Any) -> None:
            device = kwargs.get("device")
            if device is not None:
                kwargs["device"] = "cpu"
            stock_set_timesteps(*args, **kwargs)
            timesteps = scheduler.timesteps
            if self._trailing_spacing:
                trailing = trailing_timesteps(scheduler, len(timesteps))
                timesteps = timesteps if trailing is None else trailing
            self._timesteps = timesteps.cpu()
            self._numbers = self._timesteps.tolist()
            self._done = 0
            self._run.begin(self._timesteps)
            # The pipeline's loop iterates over these timesteps on its own device.
            scheduler.timesteps = self._timesteps.to(device, non_blocking=True)

        @functools.wraps(stock_step)
        def step(model_output: Tensor, timestep: Any, sample: Tensor, *args: Any, **kwargs: Any) -> Any:
            given = timestep
            scheduler.timesteps = self._timesteps
            timestep = self._timesteps[self._done]
            self._done += 1
            output, z_t, offset = self._run.guide(model_output, timestep, sample)
            number = self._numbers[self._done - 1] if is_ddim else timestep
            result = stock_step(output, number, z_t, *args, **kwargs)
            is_tuple = isinstance(result, tuple)
            previous = result[0] if is_tuple else result.prev_sample
            if offset is not None:
                previous = (previous.float() + offset).to(previous.dtype)
            previous = self._run.after_step(torch.as_tensor(given, device=previous.device), previous)
            if is_tuple:
                return (previous, *result[1:])
            result.prev_sample = previous
            return result

        return {"set_timesteps": set_timesteps, "step": step}
