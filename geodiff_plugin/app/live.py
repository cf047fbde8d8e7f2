"""Serves a page with the newest result of ``geodiff live`` (``--app``)."""

from __future__ import annotations

import html
import threading
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import numpy as np

from geodiff_plugin.app import launch
from geodiff_plugin.jobs import LiveResult
from geodiff_plugin.plotting import SmoothedRange, depth_figure

#: Seconds after which an open page asks for a newer result.
REFRESH_S = 0.5
TITLE = "Live metric depth"
WAITING = "Waiting for the first frame."


class _Newest(NamedTuple):
    """A result, the ends of its colours in metres, and its status line."""

    result: LiveResult
    near: float | None
    far: float | None
    line: str


class Drawn(NamedTuple):
    """A result as HTML: number of the frame (-1 before the first), depth map and status."""

    number: int
    depth: str
    status: str


class LiveView:
    """The newest result, which is drawn when a page asks for it, and only once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._range = SmoothedRange()
        self._newest: _Newest | None = None
        self._drawn = Drawn(-1, "", f'<div class="box box-quiet" role="status">{WAITING}</div>')

    def put(self, result: LiveResult, line: str) -> None:
        """Replace the newest result; ``line`` describes it."""
        self._newest = _Newest(result, *self._range.update(result.measured_m, result.depth_m), line)

    def drawn(self) -> Drawn:
        """Return the newest result as HTML."""
        with self._lock:  # of several visitors, the first one draws
            newest = self._newest
            if newest is not None and newest.result.frame.number != self._drawn.number:
                self._drawn = _draw(newest)
            return self._drawn


def _draw(newest: _Newest) -> Drawn:
    from geodiff_plugin.app import results, templates
    from geodiff_plugin.trust import summarise

    frame = newest.result.frame
    figure = depth_figure(newest.result.depth_m, newest.near, newest.far, unit=frame.output.unit)
    address = results.data_url(results.shrunk(np.asarray(figure)))
    tone = summarise(frame.output.verdict, frame.output.findings).tone.value
    status = f'<div class="verdict {tone}" role="status">{html.escape(newest.line)}</div>'
    return Drawn(frame.number, templates.image(address, "Depth in colours, with a scale"), status)


def build_live_page(view: LiveView) -> Any:
    """Build the page, a ``gradio.Blocks``, that shows the newest result of a view."""
    import gradio as gr

    from geodiff_plugin.app.form import QUICK

    def newer(number: int) -> list[Any]:
        drawn = view.drawn()
        return [gr.skip()] * len(drawn) if drawn.number == number else list(drawn)

    with gr.Blocks(title=TITLE, analytics_enabled=False) as page:
        gr.HTML(f'<div class="head"><h1>{TITLE}</h1></div>')
        first = view.drawn()
        number, depth = gr.State(first.number), gr.HTML(first.depth, elem_id="live-depth")
        status = gr.HTML(first.status, elem_id="live-status")
        timer = gr.Timer(REFRESH_S)
        timer.tick(newer, number, [number, depth, status], **QUICK)
    return page


class LivePage(AbstractContextManager["LivePage"]):
    """A served page with the newest result; it is closed at the end of the context.

    Attributes:
        address: URL of the page.

    Raises:
        InputError: gradio is not installed, or the address cannot be used.
    """

    def __init__(self, host: str, port: int | None) -> None:
        launch.prepare_server()
        self._view = LiveView()
        self._page = build_live_page(self._view)
        where = {"server_name": host, "server_port": port, "share": False}
        with launch.address_errors(host, port):
            _, self.address, _ = launch.launch_blocks(self._page, **where, prevent_thread_lock=True)

    def __exit__(self, *_: object) -> None:
        self._page.close(verbose=False)

    def show(self, result: LiveResult, line: str) -> None:
        """Show a result and the line that describes it."""
        self._view.put(result, line)
