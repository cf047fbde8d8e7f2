"""The page: its panels, and what happens on every click."""

from __future__ import annotations

import ctypes
import filecmp
import gc
import re
import sys
import tempfile
import threading
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from shutil import rmtree
from types import SimpleNamespace
from typing import Any

import gradio as gr
import numpy as np

from geodiff_plugin._checks import InputError
from geodiff_plugin.app import look, results
from geodiff_plugin.app.form import EXAMPLES, QUICK, TAPS, Form, build_form
from geodiff_plugin.app.job import Priors, Stopped, run_job
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.records import PairResult
from geodiff_plugin.jobs.report import depth_summary
from geodiff_plugin.messages import distinct

#: A visitor's uploads, result and files are deleted after this long, and when the tab is closed.
FORGET_AFTER_S = 600
#: The cloud shows points that are at least this likely to be right.
LEAST_CONFIDENCE = 0.5
#: The cloud is first seen from these angles, in degrees: around it, and down from straight above.
VIEW_ANGLES = (90, 75)
#: It is seen from this distance, as a multiple of its depth, which shows the whole of it.
VIEW_FROM = 1.05
#: Title of the tab whose cloud is made when it is opened.
CLOUD_TAB = "Point cloud"
#: Title of the tab whose files are written when it is opened.
FILES_TAB = "Downloads"
#: Pixels, the same for pictures and cloud, so that nothing jumps from tab to tab.
PANEL_HEIGHT = 560
#: Background of the cloud, as red, green, blue and opacity: colours show best on near black.
NIGHT = (0.09, 0.1, 0.12, 1.0)
THEME = gr.themes.Base(
    primary_hue="teal",
    neutral_hue="slate",
    font=["system-ui", "sans-serif"],
    font_mono=["ui-monospace", "monospace"],
).set(
    button_primary_background_fill="#0f5c66",
    button_primary_background_fill_dark="#0f5c66",
    button_primary_background_fill_hover="#0b464e",
    button_primary_text_color="white",
    body_text_color_subdued="#475569",
    body_text_color_subdued_dark="#b6c2d1",
    block_info_text_color="#475569",
    block_info_text_color_dark="#b6c2d1",
    input_placeholder_color="#64748b",
    input_placeholder_color_dark="#9aa8b9",
    link_text_color_dark="#93c5fd",
    block_label_text_color="#334155",
    block_label_text_color_dark="#cbd5e1",
)


def _forget(job: PairResult | None) -> None:
    """Delete a result's files, and what it has in memory: gradio keeps the states of closed tabs a while."""
    if job is not None:
        _delete([job.folder])
        for name in ("inputs", "output"):
            vars(job.run).pop(name, None)
        gc.collect()
        if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
            trim(0)  # else glibc keeps freed memory, more of it after every job


def _kept(job: PairResult, ended: threading.Event) -> PairResult:
    """The job, unless its visitor stopped it or left during its last stage."""
    if ended.is_set():
        _forget(job)
        raise Stopped
    return job


def _uploads(options: DepthOptions) -> set[Path]:
    """The folders of a visitor's uploads; gradio names them by content, so examples are everybody's."""
    files = (*options.photographs().values(), *options.calib)
    temporary = Path(tempfile.gettempdir()).resolve()
    examples = [path for folder, _ in EXAMPLES for path in folder.iterdir()]
    given = [path for path in files if temporary in path.resolve().parents]
    return {p.parent for p in given if not any(filecmp.cmp(p, each, shallow=False) for each in examples)}


def _delete(folders: Iterable[Path]) -> None:
    for folder in folders:
        rmtree(folder, ignore_errors=True)


def for_visitors(sentence: str) -> str:
    """A sentence of the command line without the server's folders, and with fields for options."""
    sentence = re.sub(r"(?<![\w.])/(?:[^\s/]+/)+", "", sentence)
    sentence = re.sub(r" \([^()]*--[^()]*\)", "", sentence)
    for side in ("left", "right"):
        sentence = re.sub(rf"\b{side.upper()}\b", f"the {side} photograph", sentence)
    return re.sub(r"--(\w)", r"\1", sentence)


def _sentence(error: Exception) -> str:
    """One for the visitor; a defect's traceback goes to the terminal."""
    if isinstance(error, InputError):
        return for_visitors(str(error))
    traceback.print_exception(error, file=sys.stderr)
    return f"This is a defect, not your input: {type(error).__name__}."


def _figures(job: PairResult) -> list[tuple[str, str]]:
    """Numbers for the banner; of a result that is not trusted only what is there, not how good it is."""
    visible, confidence = results.map_of(job, "visible"), results.map_of(job, "confidence")
    depth = depth_summary(results.depth_of(job), visible)
    seconds = (f"{sum(job.run.log.seconds.values()):.1f} s", "computing")
    if not job.run.output.verdict.trusted:
        return [(f"{depth['median_m']:.2f} m, unconfirmed", "median depth"), seconds]
    figures = [
        (f"{depth['min_m']:.2f} m to {depth['max_m']:.2f} m", "nearest and farthest"),
        (f"{depth['median_m']:.2f} m", "median depth"),
    ]
    if visible is not None:
        figures.append((f"{100 * visible.mean():.0f} %", "seen by both cameras"))
    if confidence is not None:
        figures.append((f"{100 * np.median(confidence):.0f} %", "median confidence"))
    return [*figures, seconds]


def _cameras(job: PairResult) -> str:
    """The cameras as understood."""
    (fx, _, cx), (_, fy, cy), _ = results.K_of(job)
    x, y, z = apart = job.run.inputs.guidance.rigs[0].E[:3, 3]
    ways = {"right": x, "left": -x, "below": y, "above": -y, "before": z, "behind": -z}
    way, away = max(ways, key=lambda side: ways[side]), np.linalg.norm(apart)
    lens = f"fx {fx:.1f}, fy {fy:.1f}, cx {cx:.1f}, cy {cy:.1f} px"
    return f"Left camera: {lens}; the right one {away:.3g} m away, {way}."


def _everything(panels: SimpleNamespace, job: PairResult, opened: str) -> dict[Any, Any]:
    """Every panel's value for a new result; the cloud's only while its tab is open."""
    verdict = job.run.output.verdict
    of_verdict = verdict.message and verdict.message.code  # which only sums up the others
    messages = distinct(verdict.reasons, job.run.log.warnings)
    told = [(m.code, for_visitors(m)) for m in messages if m.code != of_verdict]
    marked, words = results.measurement(job, [])
    sure = results.picture(job, "confidence")
    shown = {
        panels.status: look.finished(verdict.status, _figures(job), told, _cameras(job)),
        panels.measure_verdict: look.banner(verdict.status),
        panels.files_verdict: look.banner(verdict.status),
        panels.slider: (results.picture(job, "photograph"), results.picture(job, "depth")),
        panels.depth_legend: results.legend_of_depth(results.depth_of(job)),
        panels.picture: marked,
        panels.readings: words,
        panels.files: [str(path) for path in results.files_of(job)],
        panels.confidence: sure,
        panels.confidence_legend: "" if sure is None else results.legend_of_confidence(),
    }
    if opened == CLOUD_TAB:
        shown[panels.scene], shown[panels.points] = _scene(job)
    return shown


def _scene(job: PairResult) -> tuple[Any, str]:
    """The view of the cloud of confident points from behind the cameras, and a line about it."""
    path, depth_m = job.folder / results.SCENE, results.depth_of(job)
    count = results.write_scene(path, job, LEAST_CONFIDENCE)
    share, away = 100 * count / depth_m.size, VIEW_FROM * float(np.percentile(depth_m, 90))
    view = gr.Model3D(str(path), camera_position=(*VIEW_ANGLES, away))
    return view, f'<div class="legend-caption">{count:,} points, {share:.0f} % of the pixels</div>'


@dataclass
class Session:
    """One open tab: what ends its run, the folders of its uploads, and its last result."""

    stop: threading.Event = field(default_factory=threading.Event)
    uploads: set[Path] = field(default_factory=set)
    result: PairResult | None = None


class Sessions:
    """The open tabs by gradio's name for them; a call over the API may have none."""

    def __init__(self) -> None:
        self._of = defaultdict[str | None, Session](Session)

    def of(self, request: gr.Request) -> Session:
        """The session of a request."""
        return self._of[request.session_hash]

    def leave(self, request: gr.Request) -> None:
        """End a session's run, and delete its result and the uploads that no other one has."""
        session = self._of.pop(request.session_hash, Session())
        session.stop.set()
        _delete(session.uploads.difference(*(other.uploads for other in self._of.values())))
        _forget(session.result)


def _wire_run(
    form: Form, panels: SimpleNamespace, state: gr.State, points: gr.State, tab: gr.State, priors: Priors
) -> Callable[[gr.Request], Any]:
    """Everything from the run to its result; what happens when a visitor leaves."""
    fields, turn = list(form.fields.values()), threading.Lock()  # one job runs at a time
    sessions = Sessions()
    fixed = (panels.tabs, panels.pixel, panels.add, panels.clear)
    shows = [component for component in vars(panels).values() if component not in fixed]

    def come(request: gr.Request) -> str:
        sessions.of(request).stop = threading.Event()
        return look.BUSY

    def stop(request: gr.Request) -> str:
        sessions.of(request).stop.set()
        return look.STOPPED

    def nothing(status: str) -> dict[Any, Any]:
        """No result, and why."""
        empty = {each: "" if isinstance(each, gr.HTML) else None for each in shows}
        return {**empty, panels.readings: look.HOW_TO_MEASURE, panels.status: status, state: None, points: []}

    def estimate(
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
        *values: Any,
    ) -> dict[Any, Any]:
        """Depth in metres of the left photograph, with its files."""
        (*filled, before, opened), session = values, sessions.of(request)
        try:
            wanted, ended = form.options(tuple(filled)), session.stop
            session.uploads |= _uploads(wanted)
            with turn:
                job = session.result = _kept(run_job(wanted, priors, ended, progress), ended)
            return {state: job, points: [], **_everything(panels, job, opened)}
        except Stopped:
            return nothing(look.STOPPED)
        except Exception as error:  # whatever it is, the visitor reads a sentence
            return nothing(look.failed(_sentence(error)))
        finally:
            session.stop = threading.Event()
            _forget(before)

    def take(event: gr.SelectData) -> list[Any]:
        return form.example(int(event.index))

    chosen = form.examples.select(take, outputs=fields, **QUICK)
    for name, begins in (("estimate", form.run.click), ("example", chosen.then)):
        begins(come, outputs=panels.status, js=look.RUN_BEGINS, **QUICK).then(
            estimate,
            [*fields, state, tab],
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
    return sessions.leave


def _wire_panels(panels: SimpleNamespace, state: gr.State, points: gr.State, tab: gr.State) -> None:
    def redraw(job: PairResult | None, pixels: results.Pixels) -> tuple[Any, ...]:
        if job is None:
            return gr.skip(), gr.skip(), gr.skip()
        return pixels, *results.measurement(job, pixels)

    def click(job: PairResult | None, pixels: results.Pixels, event: gr.SelectData) -> tuple[Any, ...]:
        return redraw(job, [*pixels, tuple(event.index)][-len(results.NAMES) :])

    def add(job: PairResult | None, pixels: results.Pixels, typed: str) -> tuple[Any, ...]:
        numbers = [int(word) for word in re.findall(r"\d{1,6}", typed or "")]
        if job is None or len(numbers) != 2:
            return gr.skip(), gr.skip(), "Type two whole numbers: x, y." if job else gr.skip()
        x, y = (round(number * results.scale_of(job)) for number in numbers)
        return redraw(job, [*pixels, (x, y)][-len(results.NAMES) :])

    def turn(job: PairResult | None, pixels: results.Pixels, event: gr.SelectData) -> dict[Any, Any]:
        """What is made when its tab is opened."""
        shown: dict[Any, Any] = {tab: event.value}
        if job is not None and event.value == CLOUD_TAB:
            # A 3D view that gets its file while it is hidden stays empty (gradio 6.31).
            shown[panels.scene], shown[panels.points] = _scene(job)
        elif job is not None and event.value == FILES_TAB:  # with what was measured
            shown[panels.files] = [str(path) for path in results.files_of(job, pixels)]
        return shown

    measured = [points, panels.picture, panels.readings]
    panels.picture.select(click, [state, points], measured, **TAPS)
    gr.on([panels.add.click, panels.pixel.submit], add, [state, points, panels.pixel], measured, **QUICK)
    panels.clear.click(lambda job: redraw(job, []), state, measured, **QUICK)
    shows = [tab, panels.scene, panels.points, panels.files]
    panels.tabs.select(turn, [state, points], shows, **QUICK)


def _image(label: str, **more: Any) -> gr.Image:
    return gr.Image(
        label=label, show_label=False, interactive=False, format="png", buttons=["fullscreen"], **more
    )


def _build_panels() -> SimpleNamespace:
    """Draw the result side of the page, tab by tab, into the open gradio context."""
    panels = SimpleNamespace(status=gr.HTML(look.WAITING, elem_id="status"))
    with gr.Tabs() as panels.tabs:
        with gr.Tab("Depth"):
            panels.slider = gr.ImageSlider(
                label="Drag: photograph | metric depth",
                show_label=False,
                interactive=False,
                format="png",
                max_height=PANEL_HEIGHT,
                buttons=["fullscreen"],
                elem_id="slider",
            )
            panels.depth_legend = gr.HTML(elem_id="depth-legend")
        with gr.Tab("Measure"):
            panels.measure_verdict = gr.HTML()
            with gr.Row():
                with gr.Column(scale=5, min_width=300):
                    panels.picture = _image("Click points", elem_id="measure-picture")
                with gr.Column(scale=3, min_width=260):
                    panels.readings = gr.HTML(look.HOW_TO_MEASURE, elem_id="readings")
                    label = "A point by its pixel: x, y"
                    panels.pixel = gr.Textbox(
                        label=label, placeholder="320, 240", max_lines=1, elem_id="pixel"
                    )
                    with gr.Row():
                        panels.add = gr.Button("Add point", size="sm", elem_id="add-point")
                        panels.clear = gr.Button("Clear points", size="sm")
        with gr.Tab(CLOUD_TAB):
            panels.scene = gr.Model3D(
                label="Drag to turn, scroll to come nearer",
                interactive=False,
                clear_color=NIGHT,
                height=PANEL_HEIGHT,
                elem_id="scene",
            )
            panels.points = gr.HTML(elem_id="points")
        with gr.Tab("How sure"):
            panels.confidence, panels.confidence_legend = _image("Confidence"), gr.HTML()
        with gr.Tab(FILES_TAB):
            panels.files_verdict = gr.HTML()
            label = "All in one, depth, cloud and report"
            panels.files = gr.File(label=label, interactive=False, elem_id="files")
    return panels


def build_page(priors: Priors) -> gr.Blocks:
    """The whole page with what a visitor may choose; launch it with ``theme=THEME, css=look.CSS``."""
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
                panels = _build_panels()
        leave = _wire_run(form, panels, state, points, tab, priors)
        _wire_panels(panels, state, points, tab)

        page.load(None, js=look.WATCH_FORM)
        page.unload(leave)
    return page
