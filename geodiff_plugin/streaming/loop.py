"""``live``: metric depth of the newest frame of a rig, whenever the network is free.

Three threads work at once. One reads frames and keeps the newest. One prepares the evidence of the next frame
(``rig``) while the third, the caller's, runs the network on the current one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin._internal.checks import bad_type, captured_warnings, check_choice, check_number
from geodiff_plugin._internal.threads import WithinCores
from geodiff_plugin.config import PRESETS, GuidanceConfig
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.streaming.newest import Newest
from geodiff_plugin.streaming.rig import LiveRig, PreparedFrame, Setup, setup_of_rig
from geodiff_plugin.streaming.sources import CameraSource, StereoFrame
from geodiff_plugin.types import Rig

#: Number of frames from one check of poses, images and borders to the next.
CHECK_EVERY = 100
#: Number of threads that compute at the same time and share the cores.
THREADS = 2
#: Seconds to wait at the end for a source that is blocked in a read.
SOURCE_END_S = 2.0


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """The result of a frame.

    Attributes:
        output: depth, confidence and verdict, as from a guided call.
        left: its left image ``(H, W, 3)`` without lens distortion, RGB, uint8 or float in [0, 1].
        number: number of the frame in the source, from 0; frames that were skipped count.
        stamp: ``StereoFrame.stamp``.
        latency_s: seconds from the arrival of the frame to its result.
        checked: whether poses, images and borders were checked with this frame.
    """

    output: MetricDepthOutput
    left: np.ndarray
    number: int
    stamp: Any
    latency_s: float
    checked: bool


@dataclass(frozen=True, eq=False)
class _Numbered:
    """A frame with its number in the source."""

    frame: StereoFrame
    number: int


def live(
    pipe: Any,
    source: int | str | Path | Sequence[int | str | Path] | Iterable[Any],
    rig: Rig | Setup,
    *,
    preset: str = "fast",
    config: GuidanceConfig | None = None,
    mask: Any = None,
    right_mask: Any = None,
    check_every: int = CHECK_EVERY,
    every_frame: bool = False,
    seed: int = 0,
    **call: Any,
) -> Generator[LiveFrame, None, None]:
    """Estimate the metric depth of frames as they arrive; the newest frame is always next.

    >>> for frame in live(pipe, (0, 1), read_calibration("calib.txt")):
    ...     print(frame.output.verdict.status, frame.latency_s)

    Args:
        pipe: a pipeline, for which guidance is enabled.
        source: a camera, video or stream with both views side by side (a device number, a path or a URL), two
            of them, or an iterable of ``StereoFrame`` or ``(left, right)``. It is read in its own thread.
        rig: calibration of the two cameras, from ``read_calibration``; lens distortion is removed. Or a
            function that makes the setup of the rig from its first frame.
        preset: hyperparameters, as in ``GeometryGuidance``, except ``pose``, which follows from
            ``check_every``.
        config: hyperparameters in place of a preset.
        mask: valid pixels of the left images, as in ``GeometryGuidance``; ignored if ``rig`` is a function.
        right_mask: the same for the right images.
        check_every: number of frames from one check of poses, images and borders to the next. The frames in
            between use its result. 0 uses the poses as given.
        every_frame: whether to process every frame in order, without skipping any.
        seed: seed of the noise, the same for every frame, which keeps flicker low.
        **call: further arguments of the pipeline call, such as ``num_inference_steps``.

    Yields:
        The result of each processed frame. Closing the iterator ends the threads.

    Raises:
        InputError: invalid arguments, a source that cannot be read, or frames that do not match the rig.
    """
    if config is None:
        config = PRESETS[check_choice(preset, "preset", PRESETS)]
    check_number(check_every, "check_every", 0, 1e9, integer=True)
    if not (isinstance(rig, Rig) or callable(rig)):
        bad_type("rig", "a Rig", rig, "Read one with read_calibration(path).")
    setup = setup_of_rig(rig, config, mask, right_mask) if isinstance(rig, Rig) else rig
    enable_geometry_guidance(pipe)
    live_rig = LiveRig(setup, pipe._execution_device, check_every, among=THREADS, kernels=pipe._uses_kernels)
    run = partial(_run, pipe, seed=seed, call=call)
    return _results(run, _opened(source, realtime=not every_frame), live_rig, waits=every_frame)


def _opened(source: Any, *, realtime: bool) -> Iterable[Any]:
    """Open a source that OpenCV reads; other iterables are returned as they are."""
    if isinstance(source, (int, str, Path)):
        source = (source,)
    if isinstance(source, (tuple, list)) and all(isinstance(each, (int, str, Path)) for each in source):
        return CameraSource(source, realtime=realtime)
    if not isinstance(source, Iterable):
        bad_type("source", "a device number, a path, a URL, two of them, or an iterable of frames", source)
    return source


def _results(
    run: Callable[[PreparedFrame], MetricDepthOutput], source: Iterable[Any], rig: LiveRig, *, waits: bool
) -> Generator[LiveFrame, None, None]:
    """Run the threads and yield the results."""
    arrived = Newest[_Numbered](waits=waits)
    ready = Newest[tuple[_Numbered, PreparedFrame]](waits=True)

    def read() -> None:
        for number, frame in enumerate(source):
            if not arrived.put(_Numbered(_as_frame(frame), number)):
                break

    def prepare() -> None:
        while (numbered := arrived.take()) is not None:
            if not ready.put((numbered, rig.prepare(numbered.frame))):
                break

    reader = _started(read, arrived, "geodiff-live-source")
    preparer = _started(prepare, ready, "geodiff-live-evidence")
    try:
        while (next_one := ready.take()) is not None:
            numbered, prepared = next_one
            output = run(prepared)
            frame = numbered.frame
            latency_s = time.perf_counter() - frame.arrived_s
            yield LiveFrame(output, prepared.left, numbered.number, frame.stamp, latency_s, prepared.checked)
    finally:
        arrived.close()
        ready.close()
        preparer.join()
        reader.join(SOURCE_END_S)
        if isinstance(source, CameraSource) and not reader.is_alive():
            source.close()


def _started(work: Callable[[], None], target: Newest[Any], name: str) -> threading.Thread:
    """Start a thread that fills ``target``; its end, or its error, reaches the thread that takes from it."""

    def fill() -> None:
        try:
            work()
        except BaseException as error:
            target.close(error)
        else:
            target.close()

    thread = threading.Thread(target=fill, name=name, daemon=True)
    thread.start()
    return thread


def _as_frame(frame: Any) -> StereoFrame:
    """Convert an item of a source."""
    if isinstance(frame, StereoFrame):
        return frame
    if not (isinstance(frame, (tuple, list)) and len(frame) == 2):
        bad_type("a frame of the source", "a StereoFrame or (left, right)", frame)
    return StereoFrame(*frame)


def _run(pipe: Any, prepared: PreparedFrame, *, seed: int, call: dict[str, Any]) -> MetricDepthOutput:
    """Make the guided call; its messages are in the output."""
    noise = torch.Generator("cpu").manual_seed(seed)
    with captured_warnings(), WithinCores(THREADS):
        output: MetricDepthOutput = pipe(
            prepared.left, guidance=prepared.guidance, **{"generator": noise} | call
        )
    prepared.guidance.evidence_store = None
    return output
