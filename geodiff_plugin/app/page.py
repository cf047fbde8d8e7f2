"""The page: its layout, and what happens on every click."""

from __future__ import annotations

import re
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from shutil import rmtree
from typing import Any, Literal, TypedDict

import gradio as gr
import numpy as np

from geodiff_plugin._checks import InputError
from geodiff_plugin.app import look
from geodiff_plugin.app.form import Form, build_form
from geodiff_plugin.app.job import Priors, Result, Stopped, run_job
from geodiff_plugin.app.panels import CLOUD_TAB, Panels, build_panels
from geodiff_plugin.app.pictures import legend_of_depth, legend_of_share
from geodiff_plugin.app.results import (
    NAMES,
    Pixels,
    Shown,
    measurement,
    readings_csv,
    write_files,
    write_scene,
)
from geodiff_plugin.cli.report import depth_summary

#: A visitor's uploads, result and files are deleted after this long, and when the tab is closed.
FORGET_AFTER_S = 600
#: Where the cloud is looked at from: degrees around it and down from above, and a share of its depth.
VIEW_ANGLES, VIEW_FROM = (90, 75), 1.05


class _Handling(TypedDict):
    queue: bool
    show_progress: Literal["hidden"]
    api_visibility: Literal["private"]


#: Handlers that only the page itself calls.
QUICK: _Handling = {"queue": False, "show_progress": "hidden", "api_visibility": "private"}


class _Desk:
    """Who is being served: one job runs at a time, and each visitor stops only his own.

    Args:
        kept: files that the page itself shows. The cache names files by their content, so a visitor who runs
            an example has the file of its thumbnail.
    """

    def __init__(self, kept: Iterable[str] = ()) -> None:
        self._kept = {Path(path).resolve() for path in kept}
        self._turn = threading.Lock()
        self._stops: dict[str | None, threading.Event] = {}  # by session; a call over the API may have none
        self._uploads: dict[str | None, set[Path]] = {}

    def come(self, visitor: str | None) -> None:
        self._stops[visitor] = threading.Event()

    def stop(self, visitor: str | None) -> None:
        stop = self._stops.get(visitor)
        if stop is not None:
            stop.set()

    def note(self, visitor: str | None, paths: Iterable[Path]) -> None:
        """Files of a visitor, each in a folder of its own that is deleted when he leaves."""
        self._uploads.setdefault(visitor, set()).update(paths)

    def leave(self, visitor: str | None) -> None:
        self.stop(visitor)
        temporary = Path(tempfile.gettempdir()).resolve()
        for path in self._uploads.pop(visitor, ()):
            if temporary in path.resolve().parents and path.resolve() not in self._kept:
                rmtree(path.parent, ignore_errors=True)

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


def for_visitors(sentence: str, paths: Iterable[Path]) -> str:
    """A sentence without the server's paths and without options of the command line."""
    for path in paths:
        sentence = sentence.replace(str(path), path.name)
    return re.sub(r" \([^()]*--[^()]*\)", "", sentence)


def _sentence(error: Exception, paths: Iterable[Path]) -> str:
    """One for the visitor; a defect's traceback goes to the terminal."""
    if isinstance(error, InputError):
        return for_visitors(str(error), paths)
    traceback.print_exception(error, file=sys.stderr)
    return f"This is a defect, not your input: {type(error).__name__}."


def _figures(result: Result) -> list[tuple[str, str]]:
    """Numbers for the banner; of a result that is not trusted only what is there, not how good it is."""
    visible, confidence = result.map("visible"), result.map("confidence")
    depth = depth_summary(result.depth_m, visible)
    seconds = (f"{sum(result.seconds.values()):.1f} s", "computing")
    if not result.output.verdict.trusted:
        return [(f"{depth['median_m']:.2f} m, unconfirmed", "median depth"), seconds]
    figures = [(f"{depth['min_m']:.2f} m to {depth['max_m']:.2f} m", "nearest and farthest")]
    figures.append((f"{depth['median_m']:.2f} m", "median depth"))
    if visible is not None:
        figures.append((f"{100 * visible.mean():.0f} %", "seen by both cameras"))
    if confidence is not None:
        figures.append((f"{100 * np.median(confidence):.0f} %", "median confidence"))
    return [*figures, seconds]


def _cameras(result: Result) -> str:
    """The cameras as understood."""
    K, sentences = result.K, []
    for name, rig in zip(("right", "third"), result.guidance.rigs, strict=False):
        x, y, z = rig.E[:3, 3]
        ways = {"right": x, "left": -x, "below": y, "above": -y, "before": z, "behind": -z}
        way = max(ways, key=lambda side: ways[side])
        sentences.append(f"the {name} one {np.linalg.norm(rig.E[:3, 3]):.3g} m away, {way}")
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    return f"Left camera: fx {fx:.1f}, fy {fy:.1f}, cx {cx:.1f}, cy {cy:.1f} px; {'; '.join(sentences)}."


def _everything(panels: Panels, shown: Shown, beside: str, under: str) -> dict[Any, Any]:
    """Every panel's value for a new result, but the cloud's, which is drawn when its tab is opened."""
    result, paths = shown.result, list(shown.result.request.files())
    verdict = result.output.verdict
    sentences = list(dict.fromkeys([*verdict.reasons, *result.warnings]))
    sentences = [s for s in sentences if s != verdict.sentence]
    picture, words = measurement(shown, [], under)
    values: dict[Any, Any] = {
        panels.status: look.finished(
            verdict.status,
            _figures(result),
            [for_visitors(sentence, paths) for sentence in sentences],
            _cameras(result),
        ),
        panels.measure_verdict: look.banner(verdict.status),
        panels.files_verdict: look.banner(verdict.status),
        panels.slider: (shown.picture(beside), shown.picture("depth")),
        panels.depth_legend: legend_of_depth(result.depth_m),
        panels.picture: picture,
        panels.readings: words,
        panels.files: [str(path) for path in write_files(shown.folder, result)],
        panels.table: None,
    }
    captions = {
        "confidence": (1.0, "Confidence: probability that a depth is within 10 % of the truth"),
        "photometric_error": (
            shown.most_error,
            "Difference between the photograph and the other view brought to it; dark where they agree",
        ),
    }
    for name, (most, caption) in captions.items():
        drawn = shown.picture(name)
        values[getattr(panels, name)] = drawn
        values[getattr(panels, f"{name}_legend")] = "" if drawn is None else legend_of_share(most, caption)
    return values


def _scene(shown: Shown, least_confidence: float) -> tuple[Any, str]:
    """The view of the cloud of confident points from behind the cameras, and a line about it."""
    path = shown.folder / f"scene-{round(100 * least_confidence)}.glb"
    count = write_scene(path, shown.result, least_confidence)
    share = 100 * count / shown.result.depth_m.size
    away = VIEW_FROM * float(np.percentile(shown.result.depth_m, 90))
    view = gr.Model3D(str(path), camera_position=(*VIEW_ANGLES, away))
    return view, f'<div class="legend-caption">{count:,} points, {share:.0f} % of the pixels</div>'


def _wire_run(
    form: Form, panels: Panels, state: gr.State, points: gr.State, tab: gr.State, priors: Priors
) -> _Desk:
    desk, fields = _Desk(form.examples.keep_in_cache), list(form.fields.values())
    controls = (panels.beside, panels.under, panels.least_confidence)
    fixed = (*controls, panels.tabs, panels.pixel, panels.add, panels.clear)
    shows = [component for component in vars(panels).values() if component not in fixed]

    def come(request: gr.Request) -> str:
        desk.come(request.session_hash)
        return look.BUSY

    def stop(request: gr.Request) -> str:
        desk.stop(request.session_hash)
        return look.stopped()

    def nothing(status: str) -> dict[Any, Any]:
        """No result, and why."""
        empty = dict.fromkeys(shows)
        empty |= {each: "" for each in shows if isinstance(each, gr.HTML)}
        return {**empty, panels.readings: look.HOW_TO_MEASURE, panels.status: status, state: None, points: []}

    def estimate(
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
        *values: Any,
    ) -> dict[Any, Any]:
        """Depth in metres of the left photograph, with its files."""
        *filled, before, beside, under, least, tab = values
        _forget(before)
        uploads: list[Path] = []
        try:
            wanted = form.request(tuple(filled))
            uploads = list(wanted.files())
            desk.note(request.session_hash, uploads)
            result = desk.serve(request.session_hash, lambda stop: run_job(wanted, priors, stop, progress))
            shown = Shown(result, Path(tempfile.mkdtemp(prefix="geodiff-")))
            desk.note(request.session_hash, [shown.folder / "everything.zip"])
            values_now = {state: shown, points: [], **_everything(panels, shown, beside, under)}
        except Stopped:
            return nothing(look.stopped())
        except Exception as error:  # whatever it is, the visitor reads a sentence
            return nothing(look.failed(_sentence(error, uploads)))
        if tab == CLOUD_TAB:
            values_now[panels.scene], values_now[panels.points] = _scene(shown, least)
        return values_now

    def take(event: gr.SelectData) -> list[Any]:
        return form.example(int(event.index))

    chosen = form.examples.select(take, outputs=fields, **QUICK)
    for name, begins in (("estimate", form.run.click), ("example", chosen.then)):
        begins(come, outputs=panels.status, js=look.RUN_BEGINS, **QUICK).then(
            estimate,
            [*fields, state, *controls, tab],
            [*shows, state, points],
            concurrency_limit=1,
            concurrency_id="job",
            show_progress="full",
            show_progress_on=panels.status,
            api_name=name if name == "estimate" else False,
        ).then(None, js=look.RUN_ENDS, queue=False)
    form.stop.click(stop, outputs=panels.status, **QUICK)
    files = [field for field in fields if hasattr(field, "upload")]
    changes = [event for field in files for event in (field.upload, field.clear)]
    gr.on(changes, None, js=look.CHANGED, queue=False)
    return desk


def _wire_panels(panels: Panels, state: gr.State, points: gr.State, tab: gr.State) -> None:
    def compare(shown: Shown | None, beside: str) -> Any:
        return gr.skip() if shown is None else (shown.picture(beside), shown.picture("depth"))

    def redraw(shown: Shown | None, pixels: Pixels, under: str) -> tuple[Any, ...]:
        if shown is None:
            return gr.skip(), gr.skip(), gr.skip(), gr.skip()
        path = shown.folder / "measurements.csv"
        path.write_text(readings_csv(shown, pixels), encoding="utf-8")
        return pixels, *measurement(shown, pixels, under), str(path) if pixels else None

    def click(shown: Shown | None, pixels: Pixels, under: str, event: gr.SelectData) -> tuple[Any, ...]:
        return redraw(shown, [*pixels, tuple(event.index)][-len(NAMES) :], under)

    def add(shown: Shown | None, pixels: Pixels, under: str, typed: str) -> tuple[Any, ...]:
        numbers = [int(word) for word in re.findall(r"\d{1,6}", typed or "")]
        if shown is None or len(numbers) != 2:
            return gr.skip(), gr.skip(), "Type two whole numbers: x, y." if shown else gr.skip(), gr.skip()
        at = (round(numbers[0] * shown.scale), round(numbers[1] * shown.scale))
        return redraw(shown, [*pixels, at][-len(NAMES) :], under)

    def clear(shown: Shown | None, under: str) -> tuple[Any, ...]:
        return redraw(shown, [], under)

    def thin(shown: Shown | None, least: float) -> tuple[Any, Any]:
        return (gr.skip(), gr.skip()) if shown is None else _scene(shown, least)

    def turn(shown: Shown | None, least: float, event: gr.SelectData) -> tuple[Any, Any, Any]:
        # A 3D view that gets its file while it is hidden stays empty (gradio 6.31).
        drawn = thin(shown, least) if event.value == CLOUD_TAB else (gr.skip(), gr.skip())
        return (event.value, *drawn)

    measured = [points, panels.picture, panels.readings, panels.table]
    panels.beside.change(compare, [state, panels.beside], panels.slider, **QUICK)
    panels.picture.select(click, [state, points, panels.under], measured, **QUICK)
    panels.under.change(redraw, [state, points, panels.under], measured, **QUICK)
    typed = [state, points, panels.under, panels.pixel]
    gr.on([panels.add.click, panels.pixel.submit], add, typed, measured, **QUICK)
    panels.clear.click(clear, [state, panels.under], measured, **QUICK)
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
        delete_cache=(FORGET_AFTER_S // 10, FORGET_AFTER_S),
        fill_width=True,
    ) as page:
        gr.HTML(look.HEADER)
        state = gr.State(None, time_to_live=FORGET_AFTER_S, delete_callback=_forget)
        points, tab = gr.State([]), gr.State("")
        with gr.Row(equal_height=False):
            with gr.Column(scale=5, min_width=340, elem_id="form"):
                form = build_form(priors)
            with gr.Column(scale=8, min_width=340, elem_id="results"):
                panels = build_panels()
        desk = _wire_run(form, panels, state, points, tab, priors)
        _wire_panels(panels, state, points, tab)

        def close(request: gr.Request) -> None:
            desk.leave(request.session_hash)

        page.load(None, js=look.WATCH_FORM)
        page.unload(close)
    return page
