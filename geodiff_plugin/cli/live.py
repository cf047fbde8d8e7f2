"""Run ``geodiff live`` and print rate, latency and depth while it runs; show the depth in a window."""

from __future__ import annotations

import json
import math
import time
from contextlib import AbstractContextManager, ExitStack, closing
from typing import Any

import cv2
import numpy as np

from geodiff_plugin._internal.checks import raise_input_error
from geodiff_plugin.jobs import (
    LiveMeter,
    LiveOptions,
    LiveResult,
    collected_warnings,
    live_results,
    say,
    silent,
)
from geodiff_plugin.plotting import as_rgb_image, colour_depth, depth_range

#: Seconds from one printed line to the next.
PRINT_EVERY_S = 1.0
#: Fraction of the colour range of the previous frame that is kept, so that colours do not flicker.
KEPT_RANGE = 0.9
#: Keys that close the window: q and Escape.
CLOSING_KEYS = (ord("q"), 27)


def run_live(options: LiveOptions) -> None:
    """Process frames until the source ends, Ctrl-C is pressed or the window is closed; print the totals."""
    meter = LiveMeter()
    printed = -math.inf
    with collected_warnings(), ExitStack() as stack:
        window = stack.enter_context(_Window("geodiff live")) if options.window else None
        notify = silent if options.quiet else say
        results = stack.enter_context(closing(live_results(options, notify=notify)))
        try:
            for result in results:
                meter.add(result)
                if options.json:
                    print(json.dumps(result.row | {"rate_hz": _number(meter.rate_hz)}), flush=True)
                elif not options.quiet and time.perf_counter() - printed >= PRINT_EVERY_S:
                    printed = time.perf_counter()
                    print(line_of(result, meter.rate_hz), flush=True)
                if window is not None and not window.show(result):
                    break
        except KeyboardInterrupt:  # the usual end of a run with a camera
            pass
    if not (options.quiet or options.json):
        print(totals_line(meter.totals()))


def line_of(result: LiveResult, rate_hz: float) -> str:
    """Describe a result and the current rate in one line."""
    row = result.row
    depth = "no valid depth"
    if row["median_m"] is not None:
        depth = f"{row['near_m']:.2f} to {row['far_m']:.2f} m, median {row['median_m']:.2f} m"
    rate = "" if math.isnan(rate_hz) else f"{rate_hz:.1f} frames/s, "
    line = f"frame {row['frame']}: {rate}latency {row['latency_ms']} ms; {depth}; {row['verdict']}"
    return f"{line}: {row['reasons']}" if row["reasons"] else line


def totals_line(totals: dict[str, Any]) -> str:
    """Describe a whole run in one line."""
    if not totals["results"]:
        return "0 frames"
    line = f"{totals['results']} frames, {totals['skipped']} skipped, {totals['not_trusted']} not trusted"
    rate = "" if math.isnan(totals["rate_hz"]) else f"; {totals['rate_hz']:.2f} frames/s"
    return (
        f"{line}{rate}; latency {totals['latency_ms_median']:.0f} ms, 95 % {totals['latency_ms_95']:.0f} ms"
    )


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 2)


class _Window(AbstractContextManager["_Window"]):
    """A window with the left image and the coloured depth next to each other."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._range_m: np.ndarray | None = None
        try:
            cv2.namedWindow(title, cv2.WINDOW_NORMAL)
        except cv2.error:
            raise_input_error(
                "--window needs an OpenCV with windows: install opencv-python in place of "
                "opencv-python-headless."
            )

    def __exit__(self, *_: object) -> None:
        cv2.destroyWindow(self._title)

    def show(self, result: LiveResult) -> bool:
        """Show a result; ``False`` if the user closed the window."""
        if (result.depth_m > 0).any():
            current = np.array(depth_range(result.depth_m))
            kept = current if self._range_m is None else self._range_m
            self._range_m = KEPT_RANGE * kept + (1 - KEPT_RANGE) * current
        near, far = (None, None) if self._range_m is None else self._range_m
        shown = np.hstack(
            [np.asarray(as_rgb_image(result.frame.left)), colour_depth(result.depth_m, near, far)]
        )
        cv2.imshow(self._title, cv2.cvtColor(shown, cv2.COLOR_RGB2BGR))
        pressed = cv2.waitKey(1)
        return pressed not in CLOSING_KEYS and cv2.getWindowProperty(self._title, cv2.WND_PROP_VISIBLE) >= 1
