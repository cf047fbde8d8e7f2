"""Run ``geodiff live``: print rate, latency and depth while it runs; show the depth in a window or a page."""

from __future__ import annotations

import json
import math
import time
from contextlib import AbstractContextManager, ExitStack, closing
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from geodiff_plugin._internal.checks import raise_input_error
from geodiff_plugin.jobs import (
    LiveMeter,
    LiveOptions,
    LiveResult,
    Notify,
    collected_warnings,
    live_results,
    say,
    silent,
)
from geodiff_plugin.plotting import SmoothedRange, as_rgb_image, colour_depth

if TYPE_CHECKING:
    from geodiff_plugin.app.live import LivePage

#: Seconds from one printed line to the next.
PRINT_EVERY_S = 1.0
#: Keys that close the window: q and Escape.
CLOSING_KEYS = (ord("q"), 27)


def run_live(options: LiveOptions) -> None:
    """Process frames until the source ends, Ctrl-C is pressed or the window is closed; print the totals."""
    meter = LiveMeter()
    notify = silent if options.quiet else say
    with collected_warnings(), ExitStack() as stack:
        window = stack.enter_context(_Window("geodiff live")) if options.window else None
        page = stack.enter_context(_served_page(options, notify)) if options.app else None
        results = stack.enter_context(closing(live_results(options, notify=notify)))
        printer = _Printer(options)
        try:
            for result in results:
                meter.add(result)
                printer.result(result, meter.rate_hz)
                if page is not None:
                    page.show(result, line_of(result, meter.rate_hz))
                if window is not None and not window.show(result):
                    break
        except KeyboardInterrupt:  # the usual end of a run with a camera
            pass
    if not (options.quiet or options.json):
        print(totals_line(meter.totals()))


def _served_page(options: LiveOptions, notify: Notify) -> LivePage:
    """Serve the page of ``--app``."""
    from geodiff_plugin.app.live import LivePage  # imports the web app

    page = LivePage(options.host, options.port)
    notify(f"Serving on {page.address} (Ctrl-C stops the command)")
    return page


class _Printer:
    """Prints results as lines of JSON, or at most one summary per second."""

    def __init__(self, options: LiveOptions) -> None:
        self._options = options
        self._printed = -math.inf

    def result(self, result: LiveResult, rate_hz: float) -> None:
        """Print a result and the current rate."""
        if self._options.json:
            print(json.dumps(result.row | {"rate_hz": _number(rate_hz)}), flush=True)
        elif not self._options.quiet and time.perf_counter() - self._printed >= PRINT_EVERY_S:
            self._printed = time.perf_counter()
            print(line_of(result, rate_hz), flush=True)


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
        self._range = SmoothedRange()
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
        near, far = self._range.update(result.measured_m, result.depth_m)
        shown = np.hstack(
            [np.asarray(as_rgb_image(result.frame.left)), colour_depth(result.depth_m, near, far)]
        )
        cv2.imshow(self._title, cv2.cvtColor(shown, cv2.COLOR_RGB2BGR))
        pressed = cv2.waitKey(1)
        return pressed not in CLOSING_KEYS and cv2.getWindowProperty(self._title, cv2.WND_PROP_VISIBLE) >= 1
