"""The page: its panels, and what happens on every click."""

from __future__ import annotations

import filecmp
import re
import sys
import tempfile
import threading
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gradio as gr

from geodiff_plugin._checks import InputError, UnknownFormatError
from geodiff_plugin.app import look, results
from geodiff_plugin.app.form import EXAMPLES, QUICK, TAPS, Form, build_examples, build_form
from geodiff_plugin.app.job import Priors, run_job
from geodiff_plugin.app.keeping import FORGET_AFTER_S, Keeper, Session, Sessions, Stopped, Turns, forget
from geodiff_plugin.app.shown import Pixels, Shown, load, shown_of

FILES_TAB = "Files"
#: The result that the page opens with; ``python -m tests.browser.make_first_result`` makes it anew.
FIRST_RESULT = Path(__file__).with_name("first.npz")
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


@dataclass(frozen=True)
class Panels:
    """The components that show a result; each takes HTML, but the last ones."""

    status: gr.HTML
    scene_data: gr.HTML
    marks_data: gr.HTML
    headline: gr.HTML
    depth: gr.HTML
    legend: gr.HTML
    picture: gr.HTML
    readings: gr.HTML
    confidence: gr.HTML
    files: gr.HTML
    tabs: gr.Tabs
    pick: gr.Button  # that the browser's script presses for a click on a picture
    picked: gr.Textbox  # the pixel of that click
    pixel: gr.Textbox
    add: gr.Button
    clear: gr.Button
    paths: gr.File  # what ``files`` links to, for programs that ask over the API

    def of_result(self) -> list[gr.HTML]:
        """Those whose value is made of a result."""
        return [each for f in fields(self) if isinstance(each := getattr(self, f.name), gr.HTML)]


@dataclass(frozen=True)
class Memory:
    """What is known of one open tab between its clicks."""

    secret: gr.Textbox  # of the result that is shown, or empty; hidden in the browser
    pixels: gr.State  # that were chosen in it


@dataclass(frozen=True)
class First:
    """The result that was made beforehand, and the pixels that were measured in it."""

    shown: Shown
    pixels: Pixels


def read_first_result() -> First:
    """The result that the page opens with."""
    example = EXAMPLES[0]
    return First(*load(FIRST_RESULT, example.left, f"example {example.label}, computed beforehand"))


def _uploads(paths: list[str | None]) -> set[Path]:
    """The folders of a visitor's uploads; gradio names them by content, so examples are everybody's."""
    temporary = Path(tempfile.gettempdir()).resolve()
    examples = [path for example in EXAMPLES for path in example.folder.iterdir()]
    given = [Path(path) for path in paths if path and temporary in Path(path).resolve().parents]
    there = [path for path in given if path.is_file()]
    return {p.parent for p in there if not any(filecmp.cmp(p, each, shallow=False) for each in examples)}


def _failed(error: Exception) -> str:
    """HTML of a sentence for the visitor; a defect's traceback goes to the terminal."""
    if isinstance(error, UnknownFormatError):
        return look.failed(look.UNKNOWN_CALIBRATION, look.LINK_TO_FORMATS)
    if isinstance(error, InputError):
        return look.failed(look.for_visitors(str(error)))
    traceback.print_exception(error, file=sys.stderr)
    return look.failed(f"This is a defect, not your input: {type(error).__name__}.")


def _measured(shown: Shown, pixels: Pixels) -> dict[str, str]:
    """HTML of the panels that change with every point."""
    found = results.measurement(shown, pixels)
    return {
        "marks_data": look.hidden(results.marks_data(found.readings)),
        "headline": found.headline,
        "picture": look.picture(results.data_url(found.picture), "Photograph with the measured points"),
        "readings": found.words,
    }


def _drawn(shown: Shown, pixels: Pixels, paths: Sequence[Path] = ()) -> dict[str, str]:
    """HTML of every panel for a result, with its files."""
    photograph, depth = (results.picture(shown, name) for name in ("photograph", "depth"))
    assert photograph is not None and depth is not None
    sure = results.picture(shown, "confidence")
    confidence = "This preset gives no confidence."
    if sure is not None:
        confidence = look.picture(results.data_url(sure), "Map of confidence")
        confidence += results.legend_of_confidence()
    return {
        "status": look.banner(shown),
        "scene_data": look.hidden(results.scene_data(shown)),
        "depth": look.compared(results.data_url(photograph), results.data_url(depth)),
        "legend": results.legend_of_depth(shown.depth_m),
        "confidence": confidence,
        "files": look.files(paths),
        **_measured(shown, pixels),
    }


def _nothing(status: str) -> dict[str, str]:
    """HTML of the panels without a result, and why there is none."""
    empty = dict.fromkeys(("scene_data", "marks_data", "depth", "legend", "picture", "confidence"), "")
    empty |= {"headline": look.headline("", "No result yet."), "files": look.WAITING}
    return empty | {"readings": look.HOW_TO_MEASURE, "status": status}


@dataclass(frozen=True)
class _Desk:
    """What runs and measurements need beside their fields; one for all visitors."""

    first: First
    form: Form
    panels: Panels
    memory: Memory
    priors: Priors
    sessions: Sessions
    turns: Turns

    def on_panels(self, html: dict[str, str]) -> dict[Any, Any]:
        """Values of components by the names of panels."""
        return {getattr(self.panels, name): value for name, value in html.items()}

    def of_result(self) -> list[Any]:
        """What a new result changes, in the order in which programs get it."""
        return [*self.panels.of_result(), self.panels.paths, self.memory.secret, self.memory.pixels]

    def show(self, secret: str, shown: Shown) -> dict[Any, Any]:
        """Everything on a new result."""
        paths = results.files_of(shown)
        html = self.on_panels(_drawn(shown, [], paths))
        return {
            self.panels.paths: [str(path) for path in paths],
            self.memory.secret: secret,
            self.memory.pixels: [],
            **html,
        }

    def show_nothing(self, status: str) -> dict[Any, Any]:
        """Nothing, and why."""
        html = self.on_panels(_nothing(status))
        return {self.panels.paths: None, self.memory.secret: "", self.memory.pixels: [], **html}

    def run(self, session: Session, filled: tuple[Any, ...], progress: Any) -> Shown:
        """The result of the fields as a visitor filled them in."""
        wanted, stop = self.form.options(filled), session.stop

        def wait(others: int) -> None:
            runs = "1 run is" if others == 1 else f"{others} runs are"
            progress(0.0, f"Waiting: {runs} before yours")

        with self.turns.turn(session, wait):
            shown = shown_of(run_job(wanted, self.priors, stop, progress))
        if stop.is_set():  # the visitor stopped it, or left, during its last stage
            forget(shown)
            raise Stopped
        return shown

    def estimate(
        self,
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
        *values: Any,
    ) -> dict[Any, Any]:
        """Depth in metres of the left photograph, with its files."""
        session, keeper = self.sessions.of(request.session_hash), self.sessions.keeper
        try:
            shown = self.run(session, values, progress)
            keeper.drop(session.secret)
            session.secret = keeper.add(shown)
            return self.show(session.secret, shown)
        except Stopped:
            return self.show_nothing(look.STOPPED)
        except Exception as error:  # whatever it is, the visitor reads a sentence
            return self.show_nothing(_failed(error))
        finally:
            session.stop = threading.Event()

    def come(self, request: gr.Request) -> str:
        """What is said at once when a run was asked for."""
        self.sessions.of(request.session_hash)
        return look.BUSY

    def stop(self, request: gr.Request) -> str:
        """End the visitor's run before its next step."""
        self.sessions.of(request.session_hash).stop.set()
        return look.STOPPED

    def note_uploads(self, request: gr.Request, left: Any, right: Any, files: Any) -> None:
        """Remember a visitor's uploads, to delete them when the visitor leaves."""
        paths = [left, right, *(files or ())]
        self.sessions.of(request.session_hash).uploads |= _uploads(paths)

    def come_back(self, request: gr.Request, secret: str) -> dict[Any, Any]:
        """The result that a tab had before it was reloaded, if it is still there."""
        shown = self.sessions.keeper.get(secret)
        if shown is None:
            return {self.memory.secret: ""}
        self.sessions.keeper.end_in(secret, FORGET_AFTER_S)
        self.sessions.of(request.session_hash).secret = secret
        return self.show(secret, shown)

    def shown_by(self, secret: str) -> Shown | None:
        """The result of a tab, at first the one that was made beforehand; ``None`` when its time is over."""
        return self.sessions.keeper.get(secret) if secret else self.first.shown

    def measure(self, secret: str, pixels: Pixels) -> dict[Any, Any]:
        """What the maps say at these pixels, on every panel that says it."""
        shown = self.shown_by(secret)
        if shown is None:
            return {self.panels.readings: look.failed("This result is no longer here. Estimate again.")}
        return {self.memory.pixels: pixels, **self.on_panels(_measured(shown, pixels))}

    def add_point(self, secret: str, pixels: Pixels, typed: str) -> dict[Any, Any]:
        """One more point, by its pixel as it was typed or clicked."""
        numbers = [int(word) for word in re.findall(r"\d{1,13}", typed or "")]
        if len(numbers) < 2:
            return {self.panels.readings: "Type two whole numbers: x, y."}
        try:
            return self.measure(secret, [*pixels, (numbers[0], numbers[1])][-len(results.NAMES) :])
        except InputError as error:
            return {self.panels.readings: _failed(error)}

    def clear_points(self, secret: str) -> dict[Any, Any]:
        """No points."""
        return self.measure(secret, [])

    def open_files(self, secret: str, pixels: Pixels, event: gr.SelectData) -> Any:
        """Files with what was measured, as soon as their tab is opened."""
        shown = self.shown_by(secret)
        if shown is None or event.value != FILES_TAB:
            return gr.skip()
        return look.files(results.files_of(shown, pixels))

    def leave(self, request: gr.Request) -> None:
        """End what a closed tab had."""
        self.sessions.leave(request.session_hash)


def _wire_run(desk: _Desk, examples: gr.Gallery) -> None:
    """What happens from a click on an example or on the button to the result."""
    form, panels, memory = desk.form, desk.panels, desk.memory
    fields_of_form = list(form.fields.values())

    def take(event: gr.SelectData) -> list[Any]:
        return form.example(int(event.index))

    chosen = examples.select(take, outputs=fields_of_form, **QUICK)
    for name, begins in (("estimate", form.run.click), ("example", chosen.then)):
        begins(desk.come, outputs=panels.status, js=look.RUN_BEGINS, **QUICK).then(
            desk.estimate,
            fields_of_form,
            desk.of_result(),
            concurrency_limit=None,
            show_progress="full",
            show_progress_on=panels.status,
            api_name=name if name == "estimate" else False,
        ).then(None, memory.secret, js=look.RUN_ENDS, queue=False)
    form.stop.click(desk.stop, outputs=panels.status, **QUICK)


def _wire_form(desk: _Desk) -> None:
    """What happens when files come, change or go."""
    drops = [desk.form.fields[name] for name in ("left", "right", "calib")]
    gr.on([field.upload for field in drops], desk.note_uploads, drops, None, **QUICK)
    changes = [event for field in drops for event in (field.upload, field.clear)]
    gr.on(changes, None, js=look.CHANGED, queue=False)


def _wire_measuring(desk: _Desk) -> None:
    """What happens when points are chosen, in the 3D view, on the photograph or by their numbers."""
    panels, memory = desk.panels, desk.memory
    measured = [memory.pixels, panels.marks_data, panels.headline, panels.picture, panels.readings]
    picked = [memory.secret, memory.pixels, panels.picked]
    panels.pick.click(desk.add_point, picked, measured, js=look.PICKED, **TAPS)
    typed = [panels.add.click, panels.pixel.submit]
    gr.on(typed, desk.add_point, [memory.secret, memory.pixels, panels.pixel], measured, **QUICK)
    panels.clear.click(desk.clear_points, memory.secret, measured, **QUICK)
    panels.tabs.select(desk.open_files, [memory.secret, memory.pixels], panels.files, **QUICK)


def _build_panels(html: dict[str, str]) -> Panels:
    """Draw the result side of the page, tab by tab, into the open gradio context."""
    drawn: dict[str, Any] = {"status": gr.HTML(html["status"], elem_id="status")}
    for name, place in (("scene_data", "scene-data"), ("marks_data", "marks-data")):
        drawn[name] = gr.HTML(html[name], elem_id=place)
    drawn["pick"] = gr.Button(visible="hidden", elem_id="pick")
    drawn["picked"] = gr.Textbox(visible="hidden", elem_id="picked")
    with gr.Tabs() as drawn["tabs"]:
        with gr.Tab("3D"):
            drawn["headline"] = gr.HTML(html["headline"], elem_id="headline")
            gr.HTML(look.VIEWER, elem_id="scene")
        with gr.Tab("Depth"):
            drawn["depth"] = gr.HTML(html["depth"], elem_id="depth")
            drawn["legend"] = gr.HTML(html["legend"], elem_id="depth-legend")
        with gr.Tab("Measure"), gr.Row():
            with gr.Column(scale=5, min_width=280):
                drawn["picture"] = gr.HTML(html["picture"], elem_id="measure-picture")
            with gr.Column(scale=3, min_width=240):
                drawn["readings"] = gr.HTML(html["readings"], elem_id="readings")
                drawn["pixel"] = gr.Textbox(
                    label="A point by its pixel: x, y", placeholder="320, 240", max_lines=1, elem_id="pixel"
                )
                with gr.Row():
                    drawn["add"] = gr.Button("Add point", size="sm", elem_id="add-point")
                    drawn["clear"] = gr.Button("Clear points", size="sm")
        with gr.Tab("Confidence"):
            drawn["confidence"] = gr.HTML(html["confidence"], elem_id="confidence")
        with gr.Tab(FILES_TAB):
            drawn["files"] = gr.HTML(html["files"], elem_id="files")
            drawn["paths"] = gr.File(file_count="multiple", interactive=False, visible=False)
    return Panels(**drawn)


def build_page(priors: Priors) -> gr.Blocks:
    """The whole page with what a visitor may choose; launch it with ``theme=THEME, css=look.CSS``."""
    first, sessions = read_first_result(), Sessions(Keeper())
    with gr.Blocks(
        title="Depth in metres from two photographs",
        analytics_enabled=False,
        delete_cache=(FORGET_AFTER_S // 10, FORGET_AFTER_S),
        fill_width=True,
    ) as page:
        gr.HTML(look.HEADER)
        memory = Memory(gr.Textbox(visible="hidden"), gr.State(first.pixels))
        with gr.Row(equal_height=False, elem_id="main"):
            with gr.Column(elem_id="examples-part"):
                examples = build_examples()
            with gr.Column(elem_id="results"):
                panels = _build_panels(_drawn(first.shown, first.pixels))
            with gr.Column(elem_id="form"):
                form = build_form(priors)
        desk = _Desk(first, form, panels, memory, priors, sessions, Turns())
        _wire_run(desk, examples)
        _wire_form(desk)
        _wire_measuring(desk)
        page.load(desk.come_back, memory.secret, desk.of_result(), js=look.COME_BACK, **QUICK)
        page.unload(desk.leave)
    return page
