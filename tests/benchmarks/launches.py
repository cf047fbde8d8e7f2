"""Torch operations and kernel launches of a guided call on the code path of CUDA, counted without a card.

    python -m tests.benchmarks.launches

Data flow: the demo pair, a narrow Marigold with random weights -> operations of every stage, networks apart.

On a GPU the host sends one operation after the other, and where they are small their number is the time.
Stages run as on CUDA, but a kernel's launch is counted and not made; what such a stage returns is its
reference's result, which is not counted. The host's own operations on cameras are counted as well: they take
as long. Views, which launch nothing, are shown apart.
"""

from __future__ import annotations

import argparse
import functools
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import torch
from diffusers.utils import logging as diffusers_logging
from torch.utils._python_dispatch import TorchDispatchMode
from triton.runtime.jit import KernelInterface

from geodiff_plugin import _kernels
from geodiff_plugin.bundled import load_bundled_prior
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from tests.benchmarks.cost import resized_pair
from tests.benchmarks.measuring import holders
from tests.benchmarks.random_marigold import random_marigold

__all__ = ["Counted", "count_guided_call", "host_milliseconds"]

#: Functions that choose between a kernel and its reference: pure functions of tensors.
WITH_KERNELS = (
    "sweep_planes",
    "match_volume",
    "solve_field",
    "smooth_floor",
    "MetricMap.__call__",
    "MetricMap.relative",
    "solve_robust",
    "edge_links",
    "_residuals",
    "_spread",
    "_levels",
    "off_edges",
    "_towards_smoothed",
    "_best_range",
    "fit_to_points",
    "refine_to_matches",
    "sharpen_edges",
    "_step_shares",
    "_voted",
    "_enlarged",
    "_warped",
    "_photometric_error",
    "depth_confidence",
    "reject_reflections",
    "_of_matches_and_depth",
    "known_share",
    "with_hidden",
    "_grounds_on_grid",
    "_known_of",
)
#: Functions, and methods as ``Class.method``, whose operations are shown apart; each without those below it.
STAGES = (
    "clean",
    "measure_fit",
    "refine_views",
    "build_cost_volume",
    "pilot_volume",
    "sweep_planes",
    "match_volume",
    "inverse_pose_preferred",
    "reliable_matches",
    "Trajectory.find_scale",
    "search_scale",
    "fit_to_points",
    "refine_to_matches",
    "reject_reflections",
    "prior_error",
    "correction_target",
    "fit_depth",
    "solve_field",
    "solve_robust",
    "finish",
    "sharpen_edges",
    "vote_depth",
    "reprojection",
    "depth_confidence",
    "measure_indicators",
    "stack_results",
)
#: What belongs to no stage: the host's loop, resizing, and the hooks of the call.
ELSEWHERE = "elsewhere"


@dataclass
class Counted:
    """What a call did, by stage.

    Attributes:
        operations: torch operations, views among them.
        views: operations that only describe a tensor anew.
        launches: of Triton kernels.
    """

    operations: Counter[str] = field(default_factory=Counter)
    views: Counter[str] = field(default_factory=Counter)
    launches: Counter[str] = field(default_factory=Counter)


class _Watching:
    """Follows a call through its stages, networks and references apart."""

    def __init__(self) -> None:
        super().__init__()
        self.stages, self._off = [ELSEWHERE], 0

    def turns(self) -> None:
        """Called before another stage begins or ends, or nothing is watched, or something is again."""

    @contextmanager
    def off(self) -> Iterator[None]:
        """Watch nothing within the block."""
        self.turns()
        self._off += 1
        try:
            yield
        finally:
            self.turns()
            self._off -= 1

    def unwatched(self, own: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with nothing of it watched."""

        @functools.wraps(own)
        def call(*args: Any, **kwargs: Any) -> Any:
            with self.off():
                return own(*args, **kwargs)

        return call

    def within(self, stage: str, own: Callable[..., Any]) -> Callable[..., Any]:
        """The function, as a stage."""

        @functools.wraps(own)
        def call(*args: Any, **kwargs: Any) -> Any:
            self.turns()
            self.stages.append(stage)
            try:
                return own(*args, **kwargs)
            finally:
                self.turns()
                self.stages.pop()

        return call

    def copied(self, own: Callable[..., Any]) -> Callable[..., Any]:
        """A function that copies from the host to the device."""
        return own

    def by_reference(self, own: Callable[..., Any]) -> Callable[..., Any]:
        """The function watched with its kernels, whose launches change nothing; its reference's result."""

        @functools.wraps(own)
        def call(*args: Any, **kwargs: Any) -> Any:
            if not self._off:
                own(*args, **kwargs)
            with self.off(), _kernels.without_kernels():
                return own(*args, **kwargs)

        return call

    def launch(self, kernel: Any, grid: Any) -> Callable[..., None]:
        """In place of ``kernel[grid]``."""
        return lambda *args, **kwargs: None


class Counting(_Watching, TorchDispatchMode):
    """Counts the operations of this thread into the stage that runs."""

    def __init__(self) -> None:
        super().__init__()
        self.counted = Counted()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not self._off:
            self.counted.operations[self.stages[-1]] += 1
            self.counted.views[self.stages[-1]] += func.is_view
        made = func(*args, **kwargs or {})
        # What no kernel fills must be no index out of bounds.
        return made.zero_() if "empty" in func.name() else made

    def copied(self, own: Callable[..., Any]) -> Callable[..., Any]:
        """One operation, also where host and device are one."""

        @functools.wraps(own)
        def call(*args: Any, **kwargs: Any) -> Any:
            self.counted.operations[self.stages[-1]] += not self._off
            return own(*args, **kwargs)

        return call

    def launch(self, kernel: Any, grid: Any) -> Callable[..., None]:
        """In place of ``kernel[grid]``: counts."""

        def counted(*args: Any, **kwargs: Any) -> None:
            if not self._off:
                self.counted.launches[self.stages[-1]] += 1

        return counted


class _Clocking(_Watching):
    """Takes the time of this thread by the stage that runs."""

    def __init__(self) -> None:
        super().__init__()
        self.milliseconds, self._since = Counter[str](), 0.0

    def turns(self) -> None:
        """Give the time since the last turn to the stage that ran."""
        now = time.thread_time()
        if not self._off:
            self.milliseconds[self.stages[-1]] += 1e3 * (now - self._since)
        self._since = now

    def __enter__(self) -> None:
        self._filled = ExitStack()
        for owner, name in ((torch, "empty"), (torch, "empty_like"), (torch.Tensor, "new_empty")):
            zeros = getattr(owner, name.replace("empty", "zeros"))
            self._filled.enter_context(patch.object(owner, name, zeros))  # no index out of bounds
        self._since = time.thread_time()

    def __exit__(self, *error: object) -> None:
        self.turns()
        self._filled.close()


@contextmanager
def as_on_cuda(watching: Counting | _Clocking, pipe: Any) -> Iterator[None]:
    """Stages take the way that they take on CUDA, and are watched."""
    with ExitStack() as stack:

        def put(owner: Any, name: str, value: Any) -> None:
            stack.enter_context(patch.object(owner, name, value))

        put(_kernels, "interpreting", lambda: True)
        put(KernelInterface, "__getitem__", lambda kernel, grid: watching.launch(kernel, grid))
        for name in WITH_KERNELS:
            for owner, attribute, own in list(holders(name)):
                put(owner, attribute, watching.by_reference(own))
        for owner, attribute, own in list(holders("to_device_of")):
            put(owner, attribute, watching.copied(own))
        for name in STAGES:
            for owner, attribute, own in list(holders(name)):
                put(owner, attribute, watching.within(name, own))
        for network, method in ((pipe.unet, "forward"), (pipe.vae, "encode"), (pipe.vae, "decode")):
            put(network, method, watching.unwatched(getattr(network, method)))
        stack.enter_context(watching)
        yield


def guided_demo_call(pipe: Any, side: int | None, **options: Any) -> Callable[[], object]:
    """A guided call of the demo pair, resized to a longer side, by a pipeline with guidance enabled."""
    pipe.set_progress_bar_config(disable=True)
    pair = read_demo_pair()
    left, right, cameras = pair.left, pair.right, (pair.rig.K_left, pair.rig.K_right)
    if side is not None:
        left, right, (*cameras,) = resized_pair(pair, side)
    guidance = GeometryGuidance(right, tuple(cameras), pair.rig.E)
    generator = torch.Generator("cpu")
    return lambda: pipe(left, guidance=guidance, generator=generator.manual_seed(0), **options)


def count_guided_call(resolution: int = 768, side: int | None = None) -> Counted:
    """Operations and launches of one guided call of the demo pair, without its networks.

    Args:
        resolution: longer side of what the prior works on, pixels.
        side: longer side of the photographs, pixels; ``None`` for the demo pair's own.
    """
    pipe, counting = enable_geometry_guidance(random_marigold(width=0.01)), Counting()
    call = guided_demo_call(pipe, side, processing_resolution=resolution, num_inference_steps=4)
    with as_on_cuda(counting, pipe):
        call()
    return counting.counted


def host_milliseconds(side: int = 160, repeats: int = 15) -> dict[str, float]:
    """Median milliseconds of the host in a guided call of the bundled prior, by stage, without its networks.

    They are those of one thread, which the machine's other work does not lengthen. On pictures this small
    torch's operations take the time of their dispatch. What OpenCV does in threads of its own is not seen.
    """
    pipe = enable_geometry_guidance(load_bundled_prior())
    call, taken = guided_demo_call(pipe, side), list[Counter[str]]()
    for _ in range(repeats + 1):
        clocking = _Clocking()
        with as_on_cuda(clocking, pipe):
            call()
        taken.append(clocking.milliseconds)
    return {stage: statistics.median(each[stage] for each in taken[1:]) for stage in (*STAGES, ELSEWHERE)}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--resolution", type=int, default=768, help="longer side of the map, pixels")
    parser.add_argument("--host", action="store_true", help="the host's milliseconds instead, bundled prior")
    diffusers_logging.set_verbosity_error()
    typed = parser.parse_args()
    if typed.host:
        torch.set_num_threads(1)
        table = new_table(("stage", "ms"))
        found = host_milliseconds()
        for stage, milliseconds in (*found.items(), ("in all", sum(found.values()))):
            table.add_row(stage, f"{milliseconds:.2f}")
        show(table)
        return
    counted = count_guided_call(typed.resolution)
    table = new_table(("stage", "operations", "of them views", "Triton launches"))
    parts = counted.operations, counted.views, counted.launches
    for stage in (*STAGES, ELSEWHERE):
        table.add_row(stage, *(str(each[stage]) for each in parts))
    table.add_row("in all", *(str(each.total()) for each in parts))
    show(table)


if __name__ == "__main__":
    main()
