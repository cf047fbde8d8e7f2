"""The page: layout, and what happens on every click."""

from __future__ import annotations

import sys
import tempfile
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from shutil import rmtree
from typing import Any, Literal, TypedDict

import gradio as gr

from geodiff_plugin._checks import InputError
from geodiff_plugin.app import look
from geodiff_plugin.app.form import Form, build_form
from geodiff_plugin.app.job import Result, Stopped, run_job
from geodiff_plugin.app.panels import CLOUD_TAB, Panels, build_panels
from geodiff_plugin.app.priors import Priors
from geodiff_plugin.app.results import (
    LARGEST_SIDE,
    Shown,
    comparison,
    everything,
    measurement,
    scene,
)

__all__ = ["THEME", "build_page"]

#: A visitor's result and files are forgotten after this long, and when the tab is closed.
FORGET_AFTER_S = 3 * 3600
THEME = gr.themes.Soft(
    primary_hue="orange",
    secondary_hue="orange",
    neutral_hue="slate",
    font=["system-ui", "sans-serif"],
    font_mono=["ui-monospace", "monospace"],
)


class _Handling(TypedDict):
    queue: bool
    show_progress: Literal["hidden"]
    api_visibility: Literal["private"]


#: Handlers that only the page itself calls.
QUICK: _Handling = {"queue": False, "show_progress": "hidden", "api_visibility": "private"}


class _Desk:
    """Who is being served: one job runs at a time, and each visitor stops only his own."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._stops: dict[str | None, threading.Event] = {}  # by session; a call over the API may have none

    def come(self, visitor: str | None) -> None:
        self._stops[visitor] = threading.Event()

    def leave(self, visitor: str | None) -> None:
        stop = self._stops.get(visitor)
        if stop is not None:
            stop.set()

    def serve(self, visitor: str | None, job: Callable[[threading.Event], Result]) -> Result:
        stop = self._stops.setdefault(visitor, threading.Event())
        try:
            with self._turn:
                return job(stop)
        finally:
            self._stops.pop(visitor, None)


def _forget(shown: Shown | None) -> None:
    if shown is not None:
        rmtree(shown.folder, ignore_errors=True)


def _sentence(error: Exception) -> str:
    """One for the visitor; a defect's traceback goes to the terminal."""
    if isinstance(error, InputError):
        return str(error)
    traceback.print_exception(error, file=sys.stderr)
    return f"This is a defect, not your input: {type(error).__name__}: {error}"


def _shown(result: Result) -> Shown:
    return Shown(
        result,
        Path(tempfile.mkdtemp(prefix="geodiff-")),
        min(1.0, LARGEST_SIDE / max(result.depth_m.shape)),
    )


def _wire_run(
    form: Form, panels: Panels, state: gr.State, clicks: gr.State, tab: gr.State, priors: Priors
) -> _Desk:
    desk, fields = _Desk(), list(form.fields.values())

    def come(request: gr.Request) -> str:
        desk.come(request.session_hash)
        return look.BUSY

    def leave(request: gr.Request) -> str:
        desk.leave(request.session_hash)
        return look.stopped()

    def estimate(
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
        *values: Any,
    ) -> dict[Any, Any]:
        """Depth in metres of the left photograph, with its files."""
        *filled, before, beside, under, least, tab = values
        try:
            wanted = form.request(tuple(filled))
            result = desk.serve(request.session_hash, lambda stop: run_job(wanted, priors, stop, progress))
        except Stopped:
            return {panels.status: look.stopped()}
        except Exception as error:  # whatever it is, the visitor reads a sentence
            return {panels.status: look.failed(_sentence(error))}
        _forget(before)
        shown = _shown(result)
        found = {state: shown, clicks: [], **everything(panels, shown, beside, under)}
        if tab == CLOUD_TAB:
            found[panels.scene], found[panels.points] = scene(shown, least)
        return found

    controls = (panels.beside, panels.under, panels.least_confidence)
    outputs = [
        component
        for component in vars(panels).values()
        if component not in (*controls, panels.tabs, panels.clear)
    ]
    form.run.click(come, outputs=panels.status, **QUICK).then(
        estimate,
        [*fields, state, *controls, tab],
        [*outputs, state, clicks],
        concurrency_limit=1,
        concurrency_id="job",
        show_progress="full",
        show_progress_on=panels.status,
        api_name="estimate",
    )
    form.stop.click(leave, outputs=panels.status, **QUICK)
    return desk


def _wire_panels(panels: Panels, state: gr.State, clicks: gr.State, tab: gr.State) -> None:
    def compare(shown: Shown | None, beside: str) -> Any:
        return gr.skip() if shown is None else comparison(shown, beside)

    def click(
        shown: Shown | None, points: list[tuple[int, int]], under: str, event: gr.SelectData
    ) -> tuple[Any, Any, Any]:
        if shown is None:
            return gr.skip(), gr.skip(), gr.skip()
        points = [*(points if len(points) < 2 else []), tuple(event.index)]
        return (points, *measurement(shown, points, under))

    def redraw(shown: Shown | None, points: list[tuple[int, int]], under: str) -> tuple[Any, Any]:
        return (gr.skip(), gr.skip()) if shown is None else measurement(shown, points, under)

    def clear(shown: Shown | None, under: str) -> tuple[Any, Any, Any]:
        return ([], *redraw(shown, [], under))

    def thin(shown: Shown | None, least: float) -> tuple[Any, Any]:
        return (gr.skip(), gr.skip()) if shown is None else scene(shown, least)

    def turn(shown: Shown | None, least: float, event: gr.SelectData) -> tuple[Any, Any, Any]:
        # A 3D view that gets its file while it is hidden stays empty (gradio 6.31).
        drawn = thin(shown, least) if event.value == CLOUD_TAB else (gr.skip(), gr.skip())
        return (event.value, *drawn)

    measured = [panels.picture, panels.readings]
    panels.beside.change(compare, [state, panels.beside], panels.slider, **QUICK)
    panels.picture.select(click, [state, clicks, panels.under], [clicks, *measured], **QUICK)
    panels.under.change(redraw, [state, clicks, panels.under], measured, **QUICK)
    panels.clear.click(clear, [state, panels.under], [clicks, *measured], **QUICK)
    cloud = [panels.scene, panels.points]
    panels.least_confidence.release(thin, [state, panels.least_confidence], cloud, **QUICK)
    panels.tabs.select(turn, [state, panels.least_confidence], [tab, *cloud], **QUICK)


def build_page(priors: Priors) -> gr.Blocks:
    """The whole page; launch it with ``theme=THEME, css=look.CSS``.

    Args:
        priors: what a visitor may choose.
    """
    with gr.Blocks(
        title="Depth in metres from two photographs",
        analytics_enabled=False,
        delete_cache=(FORGET_AFTER_S, FORGET_AFTER_S),
        fill_width=True,
    ) as page:
        gr.HTML(look.HEADER)
        state = gr.State(None, time_to_live=FORGET_AFTER_S, delete_callback=_forget)
        clicks, tab = gr.State([]), gr.State("")
        with gr.Row(equal_height=False):
            with gr.Column(scale=5, min_width=380):
                form = build_form(priors)
            with gr.Column(scale=8, min_width=480):
                panels = build_panels()
        desk = _wire_run(form, panels, state, clicks, tab, priors)
        _wire_panels(panels, state, clicks, tab)

        def close(request: gr.Request) -> None:
            desk.leave(request.session_hash)

        page.unload(close)
    return page
