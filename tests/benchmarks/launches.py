"""Count torch operations and kernel launches of a guided call on the CUDA code path, without a GPU.

    python -m tests.benchmarks.launches

Data flow: the demo pair, a narrow Marigold with random weights -> operations per stage, without networks.
``--without all`` prints instead how many operations each module of kernels saves, ``--without MODULE`` one.

On a GPU the host launches operations one by one, so the number of small operations determines the time.
Stages run as on CUDA, but kernel launches are counted instead of executed, and the reference computes the
result without being counted. Operations of the host on cameras are counted too, because they take as long.
Views, which launch nothing, are listed separately.
"""

from __future__ import annotations

import argparse
import functools
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any
from unittest.mock import patch

import torch
from diffusers.utils import logging as diffusers_logging
from torch.utils._python_dispatch import TorchDispatchMode
from triton.runtime.jit import KernelInterface

from geodiff_plugin._internal import kernels as _kernels
from geodiff_plugin.bundled import load_bundled_prior
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from tests.benchmarks.cost import resized_pair
from tests.benchmarks.measuring import holders
from tests.benchmarks.random_marigold import random_marigold
from tests.stages import stages

__all__ = ["Counted", "count_guided_call", "host_milliseconds"]

#: Functions that have a kernel, which are pure functions of tensors, with the module of the kernel.
WITH_KERNELS = {stage.name: stage.kernel.rpartition(".")[0] for stage in stages()}
#: Functions, and methods as ``Class.method``, whose operations are shown apart; each without those below it.
STAGES = (
    "clean",
    "measure_fit",
    "check_poses",
    "build_cost_volume",
    "coarse_volume",
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
    "fit_target",
    "fit_depth",
    "solve_field",
    "solve_robust",
    "finish",
    "sharpen_edges",
    "filter_depth",
    "reprojection",
    "depth_confidence",
    "measure_result",
    "stack_results",
)
#: What belongs to no stage: the host's loop, resizing, and the hooks of the call.
ELSEWHERE = "elsewhere"


@dataclass
class Counted:
    """What a call did, by stage.

    Attributes:
        operations: torch operations, views among them.
        views: operations that only describe a tensor again.
        launches: of Triton kernels.
    """

    operations: Counter[str] = field(default_factory=Counter)
    views: Counter[str] = field(default_factory=Counter)
    launches: Counter[str] = field(default_factory=Counter)


def _fill(made: Any, values: Any) -> None:
    """Give what a kernel has allocated, in its layout and number type, the values of the reference."""
    if isinstance(made, torch.Tensor):
        made.copy_(values)
    elif isinstance(made, dict):
        for name in made:
            _fill(made[name], values[name])
    elif isinstance(made, (tuple, list)):
        for one, other in zip(made, values, strict=True):
            _fill(one, other)
    elif is_dataclass(made):
        for each in fields(made):
            _fill(getattr(made, each.name), getattr(values, each.name))


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
        """The function watched with its kernel, whose launches change nothing; the reference's values."""

        @functools.wraps(own)
        def call(*args: Any, **kwargs: Any) -> Any:
            made = None if self._off else own(*args, **kwargs)
            with self.off(), _kernels.without_kernels():
                expected = own(*args, **kwargs)
                if made is not None:
                    _fill(made, expected)
            return expected if made is None else made

        return call

    def launch(self, kernel: Any, grid: Any) -> Callable[..., None]:
        """In place of ``kernel[grid]``."""
        return lambda *args, **kwargs: None


class Counting(_Watching, TorchDispatchMode):
    """Counts the operations of this thread into the stage that runs.

    Args:
        without: a module whose kernels are off: the operations of their references are counted.
    """

    def __init__(self, without: str | None = None) -> None:
        super().__init__()
        self.counted, self._without = Counted(), without

    def by_reference(self, own: Callable[..., Any]) -> Callable[..., Any]:
        if WITH_KERNELS[own.__qualname__] != self._without:
            return super().by_reference(own)

        @functools.wraps(own)
        def call(*args: Any, **kwargs: Any) -> Any:
            with _kernels.without_kernels():
                return own(*args, **kwargs)

        return call

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


def count_guided_call(resolution: int = 768, side: int | None = None, without: str | None = None) -> Counted:
    """Operations and launches of one guided call of the demo pair, without its networks.

    Args:
        resolution: longer side of what the prior works on, pixels.
        side: longer side of the images, pixels; ``None`` for the demo pair's own.
        without: a module whose kernels are off, below the package.
    """
    pipe, counting = enable_geometry_guidance(random_marigold(width=0.01)), Counting(without)
    call = guided_demo_call(pipe, side, processing_resolution=resolution, num_inference_steps=4)
    with as_on_cuda(counting, pipe):
        call()
    return counting.counted


def host_milliseconds(side: int = 160, repeats: int = 15) -> dict[str, float]:
    """Median milliseconds of the host in a guided call of the bundled prior, by stage, without its networks.

    They count one thread's CPU time, which other work on the machine does not lengthen. On images this small
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


def _show_saved(modules: Sequence[str], resolution: int) -> None:
    """Print what the kernels of some modules save."""

    def counts(without: str | None) -> tuple[int, int]:
        found = count_guided_call(resolution, without=without)
        return found.operations.total() - found.views.total(), found.launches.total()

    table, (operations, launches) = (
        new_table(("kernels", "operations saved", "Triton launches")),
        counts(None),
    )
    for module in modules:
        references, others = counts(module)
        table.add_row(module, str(references - operations), str(launches - others))
    show(table)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--resolution", type=int, default=768, help="longer side of the map in pixels")
    parser.add_argument(
        "--host", action="store_true", help="measure milliseconds of the host with the bundled prior instead"
    )
    every = sorted({*WITH_KERNELS.values()})
    parser.add_argument(
        "--without", choices=["all", *every], help="count the operations that these kernels save instead"
    )
    diffusers_logging.set_verbosity_error()
    typed = parser.parse_args()
    if typed.without:
        _show_saved(every if typed.without == "all" else [typed.without], typed.resolution)
        return
    if typed.host:
        torch.set_num_threads(1)
        table = new_table(("stage", "ms"))
        found = host_milliseconds()
        for stage, milliseconds in (*found.items(), ("total", sum(found.values()))):
            table.add_row(stage, f"{milliseconds:.2f}")
        show(table)
        return
    counted = count_guided_call(typed.resolution)
    table = new_table(("stage", "operations", "of these, views", "Triton launches"))
    parts = counted.operations, counted.views, counted.launches
    for stage in (*STAGES, ELSEWHERE):
        table.add_row(stage, *(str(each[stage]) for each in parts))
    table.add_row("total", *(str(each.total()) for each in parts))
    show(table)


if __name__ == "__main__":
    main()
