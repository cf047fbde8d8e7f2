"""Implements ``geodiff live``: opens the cameras, estimates depth of the newest frames, and writes them."""

from __future__ import annotations

import csv
import time
from collections import deque
from collections.abc import Generator
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import dataclass, field
from typing import IO, Any, Self

import numpy as np

from geodiff_plugin.findings import Severity
from geodiff_plugin.formats import (
    Packing,
    check_new,
    created_folder,
    locked_folder,
    raise_unwritable,
    save_png,
    write_depth_mm,
    write_sigma_mm,
)
from geodiff_plugin.jobs.notices import Notify, silent
from geodiff_plugin.jobs.options import AUTO, LiveOptions
from geodiff_plugin.jobs.prior import prior_of_options
from geodiff_plugin.jobs.reading import read_pair
from geodiff_plugin.jobs.report import depth_summary, measurable_limit, single_map
from geodiff_plugin.jobs.writing import thresholds
from geodiff_plugin.plotting import as_rgb_image
from geodiff_plugin.result.readings import measured
from geodiff_plugin.runtime.machine import pick_device
from geodiff_plugin.streaming.loop import LiveFrame, live
from geodiff_plugin.streaming.rig import RigSetup, Setup
from geodiff_plugin.streaming.sources import CameraSource
from geodiff_plugin.trust import MatchedFraction

#: Files and folders of the output folder.
LEFT, DEPTH, SIGMA, INTRINSICS, TABLE = "left", "depth", "sigma", "K.txt", "frames.csv"
#: Columns of the table, and of the lines of ``--json``.
COLUMNS = (
    *("frame", "latency_ms", "near_m", "median_m", "far_m", "confidence"),
    *("verdict", "reasons", "checked"),
)
#: Number of results over which the current rate is measured.
RECENT = 10


@dataclass(frozen=True, eq=False)
class LiveResult:
    """A frame with its depth ``(H, W)`` in metres (0 where there is none), and its row of the table."""

    frame: LiveFrame
    depth_m: np.ndarray
    row: dict[str, Any]

    @property
    def measured_m(self) -> np.ndarray:
        """The depth, 0 where it is too far to be measured."""
        return measured(self.depth_m, self.depth_m > 0, measurable_limit(self.frame.output))


def live_results(
    options: LiveOptions, *, notify: Notify = silent, pipe: Any = None
) -> Generator[LiveResult, None, None]:
    """Implement ``geodiff live``: yield the result of each processed frame, and write it to ``options.out``.

    Args:
        options: options of the command.
        notify: receives messages for the user, such as assumptions.
        pipe: a guided pipeline, used in place of the prior of the options.

    Raises:
        InputError: invalid options, cameras or files.
    """
    options.check_all()
    pair = options.as_pair()
    pair.config()  # raises if options contradict each other, before a camera is opened
    with ExitStack() as stack:
        writer = None if options.out is None else stack.enter_context(FrameWriter(options))
        realtime = not options.every_frame
        size = options.frame_size()
        packing = None if options.side_by_side in (None, AUTO) else Packing(options.side_by_side)
        source = CameraSource(options.source, packing, size=size, realtime=realtime)
        stack.callback(source.close)
        if pipe is None:
            pipe = prior_of_options(pair, pick_device(options.device), None if notify is silent else notify)
        call: dict[str, Any] = {"every_frame": options.every_frame, "check_every": options.check_every}
        call |= {"seed": options.seed} | options.call()
        frames = live(pipe, source, _setup(options, source, notify), **call)
        stack.enter_context(closing(frames))
        for count, frame in enumerate(frames, 1):
            result = _result(frame, *thresholds(options))
            if writer is not None:
                writer.write(result)
            yield result
            if count == options.frames:
                return


def _setup(options: LiveOptions, source: CameraSource, notify: Notify) -> Setup:
    """Return the function that reads the cameras and masks of the options for the first frame."""

    def setup(left: np.ndarray, right: np.ndarray) -> RigSetup:
        packing = source.packing if options.side_by_side else None
        inputs = read_pair(options.as_pair(), (left, right), packing=packing)
        for finding in inputs.guidance.findings:
            if finding.severity is Severity.ASSUMPTION:
                notify(f"assumed: {finding}")
        of_left, of_right = inputs.cameras
        return RigSetup((of_left, of_right), inputs.guidance, inputs.masks)

    return setup


def _result(frame: LiveFrame, min_confidence: float = 0.0, max_sigma: float | None = None) -> LiveResult:
    """Summarise a frame, without the depths that are not ``reliable`` under the thresholds."""
    output = frame.output
    reliable = output.reliable(min_confidence, max_sigma)
    depth_m = single_map(output.prediction * reliable).astype(np.float32)
    depth = depth_summary(depth_m, None)
    matched = output.verdict.facts[MatchedFraction]
    known = {
        name: depth[f"{key}_m"] for name, key in (("near_m", "min"), ("median_m", "median"), ("far_m", "max"))
    }
    row = {
        "frame": frame.number,
        "latency_ms": round(1000 * frame.latency_s),
        **{name: None if np.isnan(value) else round(value, 3) for name, value in known.items()},
        "confidence": None if matched is None or matched.confidence is None else round(matched.confidence, 3),
        "verdict": output.verdict.status,
        "reasons": " ".join(output.verdict.reasons),
        "checked": frame.checked,
    }
    return LiveResult(frame, depth_m, row)


class FrameWriter(AbstractContextManager["FrameWriter"]):
    """Writes results as they come, as an RGB-D sequence; the folder is locked meanwhile.

    The first result replaces the files of an earlier run. Without any result, the folder stays as it was.

    Args:
        options: options with ``out`` and ``overwrite``.

    Raises:
        InputError: the folder contains files, is in use, or cannot be written.
    """

    def __init__(self, options: LiveOptions) -> None:
        assert options.out is not None
        self._folder = check_new(options.out, options.overwrite)
        self._stack = ExitStack()
        self._file: IO[str] | None = None

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            try:
                stack.enter_context(created_folder(self._folder))
            except OSError as error:
                raise_unwritable(self._folder, error)
            stack.enter_context(locked_folder(self._folder))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _begin(self, first: LiveResult) -> IO[str]:
        """Delete the files of an earlier run, and write what precedes the images of the first result."""
        for name in (LEFT, DEPTH, SIGMA):
            (self._folder / name).mkdir(exist_ok=True)
            for path in self._folder.glob(f"{name}/*.png"):
                path.unlink()
        file = open(self._folder / TABLE, "w", newline="", encoding="utf-8")  # noqa: SIM115 - closed with the stack
        self._stack.enter_context(file)
        csv.DictWriter(file, COLUMNS).writeheader()
        np.savetxt(self._folder / INTRINSICS, np.asarray(first.frame.output.K)[0])
        return file

    def write(self, result: LiveResult) -> None:
        """Write the images of a result, then its row."""
        name = f"{result.frame.number:06d}.png"
        sigma = result.frame.output.sigma
        try:
            if self._file is None:
                self._file = self._begin(result)
            save_png(as_rgb_image(result.frame.left), self._folder / LEFT / name)
            write_depth_mm(self._folder / DEPTH / name, result.depth_m)
            if sigma is not None:
                sigma_m = np.where(result.depth_m > 0, single_map(sigma), np.nan)
                write_sigma_mm(self._folder / SIGMA / name, sigma_m)
            csv.DictWriter(self._file, COLUMNS).writerow(result.row)
            self._file.flush()
        except OSError as error:
            raise_unwritable(self._folder, error)


@dataclass
class LiveMeter:
    """Measures the rate and the latency of a run."""

    results: int = 0
    frames: int = 0  # of the source up to the last result
    not_trusted: int = 0
    latencies_ms: list[float] = field(default_factory=list)
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT + 1))
    _started: float | None = None

    def add(self, result: LiveResult) -> None:
        """Count a result that has just arrived."""
        now = time.perf_counter()
        frame = result.frame
        self._started = now if self._started is None else self._started
        self._times.append(now)
        self.results, self.frames = self.results + 1, frame.number + 1
        self.not_trusted += not frame.output.verdict.trusted
        self.latencies_ms.append(1000 * frame.latency_s)

    @property
    def rate_hz(self) -> float:
        """Results per second over the last ones; NaN for the first."""
        return _rate(len(self._times), self._times[-1] - self._times[0]) if self._times else float("nan")

    def totals(self) -> dict[str, Any]:
        """Return the numbers of the whole run; the rate is counted from the first result."""
        elapsed_s = 0.0 if self._started is None else self._times[-1] - self._started
        latencies = self.latencies_ms or [float("nan")]
        return {
            "results": self.results,
            "skipped": self.frames - self.results,
            "not_trusted": self.not_trusted,
            "rate_hz": _rate(self.results, elapsed_s),
            "latency_ms_median": float(np.median(latencies)),
            "latency_ms_95": float(np.quantile(latencies, 0.95)),
        }


def _rate(results: int, elapsed_s: float) -> float:
    """Return results per second from the first to the last of some results; NaN if there is only one."""
    return (results - 1) / elapsed_s if results > 1 and elapsed_s > 0 else float("nan")
