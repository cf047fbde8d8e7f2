"""The scheduler of a guided call: ``set_timesteps`` starts a trajectory, ``step`` is guided.

Data flow: ``model_output, t, z_t`` -> guided ``z_{t-1}``, through the scheduler's own ``step``, called once.
Paper: the DDIM line of Algorithm 1.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from geodiff_plugin.runtime.noise_levels import trailing_timesteps

__all__ = ["GuidedScheduler"]


_METHODS = ("set_timesteps", "step")


class GuidedScheduler:
    """Context manager that puts a copy of the pipeline's scheduler in its place, two methods of it wrapped.

    A pipeline that shares the scheduler never meets a guided ``step``, and the state of the user's scheduler
    is what it was. The copy is of the same class with the same config and attributes. It goes onto the
    pipeline past ``DiffusionPipeline.__setattr__``, which would rewrite the pipeline's config. It may be left
    and entered again in the middle of a call, as callbacks are: then the trajectory goes on where it was.

    Its ``step`` gets the timesteps on the CPU, where diffusers keeps the tables that they index: compared
    and looked up on another device, each would be waited for several times a step.

    A scheduler of which the user replaced one of the two methods on the instance is used itself, since such a
    method usually holds on to the instance; all its attributes are put back.

    Args:
        pipe: the live pipeline.
        on_trajectory: called at ``set_timesteps`` with the timesteps; Marigold does so for every chunk.
        on_step: ``(model_output, timestep, z_t) -> (model_output, z_t, shift)``: what the scheduler's own
            step shall be given, and what to add to its ``z_{t-1}`` (``None`` for nothing).
        on_done: ``(timestep, z_{t-1}) -> z_{t-1}``, after the step.
        respace: run a leading DDIM as trailing.
        skipped: steps at the beginning of the schedule that are left out; for a DDIM, whose step asks for the
            timestep alone.
    """

    def __init__(
        self,
        pipe: Any,
        on_trajectory: Callable[[Tensor], None],
        on_step: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor | None]],
        on_done: Callable[[Tensor, Tensor], Tensor],
        respace: bool,
        skipped: int = 0,
    ) -> None:
        self._pipe, self._respace, self._skipped = pipe, respace, skipped
        self._on_trajectory, self._on_step, self._on_done = on_trajectory, on_step, on_done
        theirs = pipe.scheduler
        replaced = any(name in vars(theirs) for name in _METHODS)
        self._scheduler = theirs if replaced else copy.copy(theirs)
        self._inside = dict(vars(self._scheduler)) | self._wrapped()

    def __enter__(self) -> GuidedScheduler:
        self._theirs, self._outside = self._pipe.scheduler, dict(vars(self._scheduler))
        _set_attributes(self._scheduler, self._inside)
        object.__setattr__(self._pipe, "scheduler", self._scheduler)
        return self

    def __exit__(self, *exc: object) -> None:
        self._inside = dict(vars(self._scheduler))
        _set_attributes(self._scheduler, self._outside)
        object.__setattr__(self._pipe, "scheduler", self._theirs)

    def release(self) -> None:
        """Let go of the call, after its end: the wrapped methods and this object hold each other."""
        self._inside = {}

    def _wrapped(self) -> dict[str, Callable[..., Any]]:
        """The two methods as instance attributes, which hide those of the class."""
        scheduler = self._scheduler
        own_set_timesteps, own_step = scheduler.set_timesteps, scheduler.step

        @functools.wraps(own_set_timesteps)
        def set_timesteps(*args: Any, **kwargs: Any) -> None:
            device = kwargs.get("device")
            own_set_timesteps(*args, **kwargs | ({} if device is None else {"device": "cpu"}))
            trailing = trailing_timesteps(scheduler, len(scheduler.timesteps)) if self._respace else None
            self._timesteps = (scheduler.timesteps if trailing is None else trailing).cpu()[self._skipped :]
            self._done = 0
            self._on_trajectory(self._timesteps)
            scheduler.timesteps = self._timesteps.to(device=device)  # what the host's loop is about to take

        @functools.wraps(own_step)
        def step(model_output: Tensor, timestep: Any, sample: Tensor, *args: Any, **kwargs: Any) -> Any:
            given = timestep
            scheduler.timesteps, timestep = self._timesteps, self._timesteps[self._done]
            self._done += 1
            output, z_t, shift = self._on_step(model_output, timestep, sample)
            result = own_step(output, timestep, z_t, *args, **kwargs)
            is_tuple = isinstance(result, tuple)
            previous = result[0] if is_tuple else result.prev_sample
            if shift is not None:
                previous = (previous.float() + shift).to(previous.dtype)
            previous = self._on_done(torch.as_tensor(given, device=previous.device), previous)
            if is_tuple:
                return (previous, *result[1:])
            result.prev_sample = previous
            return result

        return {"set_timesteps": set_timesteps, "step": step}


def _set_attributes(instance: Any, attributes: dict[str, Any]) -> None:
    """Make ``attributes`` all that an instance has."""
    vars(instance).clear()
    vars(instance).update(attributes)
