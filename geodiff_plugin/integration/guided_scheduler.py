"""Intercept a live scheduler for one call: ``set_timesteps`` starts a trajectory, ``step`` is guided.

Hop: ``model_output, t, z_t`` -> guided ``z_{t-1}``, through the scheduler's own ``step``, called once.
Paper: the DDIM line of Algorithm 1.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from geodiff_plugin.integration.schedulers import trailing_timesteps

__all__ = ["GuidedScheduler"]


class GuidedScheduler:
    """Context manager that wraps two methods of a scheduler instance and takes them off again.

    The instance stays the same object of the same class with the same config, so that isinstance,
    ``inspect.signature(step)`` and ``save_pretrained`` see what they always saw.

    Args:
        scheduler: the pipeline's.
        on_trajectory: called at ``set_timesteps`` with the timesteps; Marigold does so for every chunk.
        on_step: ``(model_output, timestep, z_t) -> (model_output, z_t, shift)``: what the scheduler's own
            step shall be given, and what to add to its ``z_{t-1}`` (``None`` for nothing).
        on_done: ``(timestep, z_{t-1}) -> z_{t-1}``, after the step.
        respace: run a leading DDIM as trailing.
    """

    def __init__(
        self,
        scheduler: Any,
        on_trajectory: Callable[[Tensor], None],
        on_step: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor | None]],
        on_done: Callable[[Tensor, Tensor], Tensor],
        respace: bool,
    ) -> None:
        self._scheduler, self._respace = scheduler, respace
        self._on_trajectory, self._on_step, self._on_done = on_trajectory, on_step, on_done

    def __enter__(self) -> GuidedScheduler:
        scheduler = self._scheduler
        own_set_timesteps, own_step = scheduler.set_timesteps, scheduler.step

        @functools.wraps(own_set_timesteps)
        def set_timesteps(*args: Any, **kwargs: Any) -> None:
            own_set_timesteps(*args, **kwargs)
            trailing = trailing_timesteps(scheduler, len(scheduler.timesteps)) if self._respace else None
            if trailing is not None:
                scheduler.timesteps = trailing.to(scheduler.timesteps.device)
            self._on_trajectory(scheduler.timesteps)

        @functools.wraps(own_step)
        def step(model_output: Tensor, timestep: Any, sample: Tensor, *args: Any, **kwargs: Any) -> Any:
            output, z_t, shift = self._on_step(model_output, torch.as_tensor(timestep), sample)
            result = own_step(output, timestep, z_t, *args, **kwargs)
            is_tuple = isinstance(result, tuple)
            previous = result[0] if is_tuple else result.prev_sample
            if shift is not None:
                previous = (previous.float() + shift).to(previous.dtype)
            previous = self._on_done(torch.as_tensor(timestep), previous)
            if is_tuple:
                return (previous, *result[1:])
            result.prev_sample = previous
            return result

        # Instance attributes hide the class's methods until they are deleted.
        scheduler.set_timesteps, scheduler.step = set_timesteps, step
        return self

    def __exit__(self, *exc: object) -> None:
        for name in ("set_timesteps", "step"):
            self._scheduler.__dict__.pop(name, None)
