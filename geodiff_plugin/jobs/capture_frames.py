"""Processes the frames of a capture, with one process per core, shards or Ray."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import psutil  # a dependency of accelerate

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin._internal.threads import WithinCores, available_cores
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.jobs.capture_frame import is_made, make_frame
from geodiff_plugin.jobs.capture_poses import RunKeys, reopened_capture
from geodiff_plugin.jobs.journal import Item, Journal, Record, Shard, shard_files
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.jobs.prior import prior_of_capture
from geodiff_plugin.jobs.processes import ProcessEnded, WorkerProcess, can_have_workers, close_all
from geodiff_plugin.jobs.runner import Runner, on_ray
from geodiff_plugin.runtime.machine import pick_device

#: File with one line for each finished frame.
JOURNAL = "frames.jsonl"
#: Memory per process for the bundled prior at 640x480, in bytes; unknown for larger priors.
PROCESS_BYTES = 1.5e9


def run_frames(
    capture: Capture, options: CaptureOptions, names: Sequence[str], keys: RunKeys, progress: bool
) -> list[Record]:
    """Process the frames that are not done yet, with one process per core; return the reports in order."""
    path = options.out / JOURNAL
    shard = Shard.of(options.shard)
    if options.overwrite:
        for each in (path, *shard_files(path).values()) if shard.whole else (shard.path(path),):
            each.unlink(missing_ok=True)
    items = [Item(name, inputs=keys.frames_key, head={"frame": name}) for name in names]
    with Journal(path, shard) as journal:
        runner = Runner(
            shard.part(items),
            journal,
            noun="frame",
            is_recoverable=(InputError, OSError, ValueError, RuntimeError),
            progress=progress,
            whole=lambda item, _: is_made(item, options.out / item.key),
        )
        if options.engine == "ray" and shard.whole:
            make_all = partial(_frame_by_name, replace(options, overwrite=False), keys)
            return runner.run_elsewhere(partial(on_ray("items_on_actors"), make_all, options))
        make = partial(make_frame, capture, options, cache(partial(prior_of_capture, options)))
        count = _processes(options, len(runner.left)) if shard.whole else 1
        if count > 1:
            return _in_processes(runner, make, options, keys, count)
        with WithinCores(1 if options.shard else shard.count):
            return runner.run(make)


def _frame_by_name(options: CaptureOptions, keys: RunKeys) -> Callable[[str], Record]:
    """Return an actor's function from the name of a frame to its record."""
    capture = reopened_capture(options, keys)
    loaded = cache(partial(prior_of_capture, options))
    return lambda name: make_frame(capture, options, loaded, Item(name, inputs=keys.frames_key))


def _in_processes(
    runner: Runner, make: Callable[[Item], Record], options: CaptureOptions, keys: RunKeys, count: int
) -> list[Record]:
    """Process the frames with ``count`` processes including this one, which share the cores."""
    helping = partial(_help, replace(options, overwrite=False), keys, count)
    helpers = [WorkerProcess(__name__, extended=True) for _ in range(count - 1)]

    def make_here(item: Item) -> Record:
        with WithinCores(1 + sum(helper.alive for helper in helpers)):
            return make(item)

    try:
        return runner.run_with(helpers, helping, make_here)
    finally:
        close_all(helpers)


def _help(options: CaptureOptions, keys: RunKeys, count: int, item: Item) -> Record:
    """Process a frame in a worker process."""
    with WithinCores(count):
        try:
            capture, pipe = _ready(options, keys)
        except Exception as error:  # e.g. a prior registered only in the first process
            raise ProcessEnded(f"A worker process cannot start: {error}") from error
        return make_frame(capture, options, lambda: pipe, item)


@cache
def _ready(options: CaptureOptions, keys: RunKeys) -> tuple[Capture, Any]:
    """Return the capture and the prior of a worker process."""
    return reopened_capture(options, keys), prior_of_capture(options)


def _processes(options: CaptureOptions, left: int) -> int:
    """Return the number of processes for this many frames: on a CPU one per core, as memory allows."""
    if not can_have_workers():
        return 1
    on_cpu = pick_device(options.device).type == "cpu"
    held = int(psutil.virtual_memory().available / PROCESS_BYTES)
    wanted = options.processes or (min(available_cores(), max(1, held)) if on_cpu else 1)
    return max(1, min(wanted, left))
