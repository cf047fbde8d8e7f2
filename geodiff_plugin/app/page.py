"""The page: its panels and event handlers."""

from __future__ import annotations

import filecmp
import math
import re
import sys
import tempfile
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gradio as gr

from geodiff_plugin._internal.checks import InputError, UnknownFormatError
from geodiff_plugin.app import results, templates
from geodiff_plugin.app.form import IN_ORDER, QUICK, Form, build_examples, build_form
from geodiff_plugin.app.job import EXAMPLES, Priors, Request, run_job, write_job
from geodiff_plugin.app.messages import Message, PageError, error_on_page
from geodiff_plugin.app.results import Measurement
from geodiff_plugin.app.sessions import (
    FORGET_AFTER_S,
    Result,
    ResultStore,
    Run,
    RunQueue,
    Session,
    Sessions,
    Stopped,
)
from geodiff_plugin.app.shown import Shown, clean_report, load, shown_of
from geodiff_plugin.jobs import PairRun

FILES_TAB = "Files"
#: Panels of each tab. The open tab is drawn first.
PANELS_OF_TABS = {
    "3D": ("scene_data", "marks_data", "headline"),
    "Depth": ("scene_data", "marks_data", "depth", "legend"),
    "Measure": ("scene_data", "marks_data", "readings"),
    "Confidence": ("confidence",),
}
#: The result that the page opens with. Regenerate it with ``python -m tests.browser.make_first_result``.
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
    """The components that show a result; all take HTML except the last ones."""

    status: gr.HTML
    scene_data: gr.HTML
    marks_data: gr.HTML
    headline: gr.HTML
    depth_headline: gr.HTML
    depth: gr.HTML
    legend: gr.HTML
    readings: gr.HTML
    confidence: gr.HTML
    files: gr.HTML
    tabs: gr.Tabs
    pick: gr.Button  # pressed by the browser's script on a click on an image
    picked: gr.Textbox  # the pixel of that click
    pixel: gr.Textbox
    add: gr.Button
    undo: tuple[gr.Button, ...]
    clear: tuple[gr.Button, ...]
    paths: gr.File  # targets of the links in ``files``, for API clients

    def of_result(self) -> list[gr.HTML]:
        """Return the components that are computed from a result."""
        return [each for f in fields(self) if isinstance(each := getattr(self, f.name), gr.HTML)]


def read_first_result() -> Result:
    """Load the precomputed result on display when the page opens."""
    return Result(*load(FIRST_RESULT, EXAMPLES[0].left, EXAMPLES[0].label))


def _uploads(paths: list[str | None]) -> set[Path]:
    """Return the folders of a visitor's uploads, without copies of examples.

    gradio names folders by content, so all visitors share the copies of the examples.
    """
    temporary = Path(tempfile.gettempdir()).resolve()
    examples = [path for example in EXAMPLES for path in example.folder.iterdir()]
    given = [Path(path) for path in paths if path and temporary in Path(path).resolve().parents]
    existing = [path for path in given if path.is_file()]
    return {p.parent for p in existing if not any(filecmp.cmp(p, each, shallow=False) for each in examples)}


def _failed(error: Exception, request: Request | None = None) -> str:
    """Return the HTML of an error; print the traceback of an internal error to the terminal."""
    if isinstance(error, InputError):
        options = None if request is None else request.options
        paths = () if options is None else (*options.image_files().values(), *options.calib)
        camera_input = "" if request is None else request.camera_input
        message = error_on_page(error, {path.parent for path in paths}, camera_input)
        link = templates.LINK_TO_FORMATS if isinstance(error, UnknownFormatError) else ""
        return templates.failed(message, link)
    traceback.print_exception(error, file=sys.stderr)
    return templates.failed(
        Message(f"Internal error ({type(error).__name__}).", "Your input is not the cause. Run again.")
    )


def _measured(result: Result) -> dict[str, str]:
    """Return the HTML of the panels that change with every measured point."""
    found = Measurement.of(result)
    return {
        "marks_data": templates.hidden(found.marks()),
        **_headlines(found.headline()),
        "readings": found.html(),
    }


def _headlines(html: str) -> dict[str, str]:
    """Return the line with the last measurement, which is above the 3D view and above the depth map."""
    return {"headline": html, "depth_headline": html}


def _depth(result: Result) -> dict[str, str]:
    """Return the HTML of the depth map and its legend."""
    depth = results.map_image(result.shown, "depth")
    assert depth is not None
    legend = results.legend_of_depth(result.shown.depth_m)
    return {"depth": templates.compared(results.data_url(depth)), "legend": legend}


def _confidence(result: Result) -> dict[str, str]:
    """Return the HTML of the confidence map."""
    confidence = results.map_image(result.shown, "confidence")
    if confidence is None:
        return {"confidence": "This preset estimates no confidence."}
    image = templates.image(results.data_url(confidence), "Confidence map")
    return {"confidence": image + results.legend_of_confidence()}


def _scene(result: Result) -> dict[str, str]:
    """Return the data of the 3D view."""
    return {"scene_data": templates.hidden(results.scene_data(result.shown))}


def _files(result: Result) -> dict[str, str]:
    """Return the HTML of the list of files."""
    if result.shown.folder is None and not result.shown.precomputed:
        return {"files": templates.FILES_COMING}
    return {"files": templates.files(results.files_of(result), results.PURPOSES)}


def drawn(result: Result, tab: str = "") -> Iterator[dict[str, str]]:
    """Yield the HTML of all panels of a result: the banner and the open tab first, then the others."""
    parts = {"scene_data": _scene, "headline": _measured, "depth": _depth, "confidence": _confidence}
    wanted = PANELS_OF_TABS.get(tab, PANELS_OF_TABS["3D"])
    first = [part for name, part in parts.items() if name in wanted or part is _measured]
    now: dict[str, str] = {"status": templates.banner(result.shown)}
    for part in first:
        now |= part(result)
    yield now
    rest: dict[str, str] = {}
    for part in (*(part for part in parts.values() if part not in first), _files):
        rest |= part(result)
    yield rest


def _nothing(status: str) -> dict[str, str]:
    """Return the HTML of the panels without a result; ``status`` states the reason."""
    empty = dict.fromkeys(("scene_data", "marks_data", "depth", "legend", "confidence"), "")
    empty |= _headlines(templates.headline("", "No result yet.")) | {"files": templates.WAITING}
    return empty | {"readings": templates.HOW_TO_MEASURE, "status": status}


@dataclass(frozen=True)
class _Handlers:
    """State shared by the event handlers of all visitors.

    A visitor's pair, result and measurements are one ``Result`` in the visitor's session. Each handler reads
    and changes it there, and returns what the page shows of it.
    """

    form: Form
    panels: Panels
    secret: gr.Textbox  # secret of the result on display, or empty; hidden in the browser
    priors: Priors
    sessions: Sessions
    queue: RunQueue
    progress: gr.HTML  # box of a run, below gradio's progress

    def on_panels(self, html: dict[str, str]) -> dict[Any, Any]:
        """Return a value per component from a value per panel name."""
        return {getattr(self.panels, name): value for name, value in html.items()}

    def of_result(self) -> list[Any]:
        """Return the components that a new result changes, in the order of the API."""
        return [*self.panels.of_result(), self.panels.paths, self.secret]

    def keep(self, session: Session, notice: str) -> dict[Any, Any]:
        """Return a notice above the result that stays on display, or no result if it has expired."""
        result = self.sessions.result(session)
        if result is None:
            return {self.panels.paths: None, **self.on_panels(_nothing(notice))}
        shown = {}
        if session.drawn != session.secret:  # this run began before the result was drawn
            shown = {self.secret: session.secret, **self.on_panels(_all_drawn(result))}
            session.drawn = session.secret
        return shown | {self.panels.status: templates.earlier(notice, result.shown)}

    def compute(self, session: Session, run: Run, request: Request, progress: Any) -> PairRun:
        """Run a job, and make its result the one of the session."""
        job = run_job(request, self.priors, run.stop, progress)
        shown = shown_of(job, request.name, request.scale_rel_std)
        self.sessions.show(session, run, shown, _measurable(shown, request))
        return job

    def write(self, session: Session, secret: str, job: PairRun) -> dict[Any, Any]:
        """Write the files of a result; return the values of their components if it is still on display."""
        folder = clean_report(write_job(job))
        result = self.sessions.store.get(secret) if self.sessions.store.add_files(secret, folder) else None
        if result is None or session.secret != secret:
            return {}
        paths = results.files_of(result)
        return {self.panels.paths: [str(path) for path in paths], **self.on_panels(_files(result))}

    def steps(self, session: Session, run: Run, request: Request, progress: Any) -> Iterator[dict[Any, Any]]:
        """Yield what the page shows of a run: its result as soon as it exists, then the files."""

        def wait(others: int) -> None:
            runs = "1 run is" if others == 1 else f"{others} runs are"
            progress(0.0, f"Queued: {runs} ahead of yours")

        with self.queue.acquire(run, wait):
            job = self.compute(session, run, request, progress)
            secret = session.secret
            result = self.sessions.result(session)
            if result is None:
                return
            for html in drawn(result, session.tab):
                yield {self.secret: secret, **self.on_panels(html), **self.controls("")}
            if session.run is run:  # a later run may have kept the page from drawing them
                session.drawn = secret
            yield self.write(session, secret, job)

    def run(
        self, session: Session, filled: tuple[Any, ...], progress: Any, values: dict[Any, Any]
    ) -> Iterator[dict[Any, Any]]:
        """Yield what the page shows while a run is in progress, and how it ended; first also ``values``.

        A later run of the same visitor ends this one without a message.
        """
        run = session.begin()
        request = None
        yield values | self.keep(session, "") | self.controls(templates.running(self.form.name(filled)))
        try:
            request = self.form.request(filled)
            for shown in self.steps(session, run, request, progress):
                # Files are shown also if a later run has begun, because they are of the result on display.
                if shown and (session.run is run or self.secret not in shown):
                    yield shown
            ended: dict[Any, Any] = {}
        except Stopped:
            ended = self.keep(session, templates.STOPPED)
        except Exception as error:  # the visitor always gets a message
            ended = self.keep(session, _failed(error, request))
        if session.end(run):
            yield ended | self.controls("")
        yield {self.panels.paths: gr.skip()}  # gradio repeats the last update when a run ends

    def controls(self, running: str) -> dict[Any, Any]:
        """Return the box of a run, empty if there is none, and the stop button, which is active in a run."""
        return {self.progress: running, self.form.stop: gr.update(interactive=bool(running))}

    def session_of(self, request: gr.Request, secret: str) -> Session:
        """Return the session of a page that shows the result of this secret.

        If the connection was lost, the session was forgotten, but the page is still open.
        """
        session = self.sessions.of(request.session_hash)
        if not session.secret and session.run is None:
            session.secret = session.drawn = secret
        return session

    def estimate(
        self,
        request: gr.Request,
        secret: str,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
        *values: Any,
    ) -> Iterator[dict[Any, Any]]:
        """Estimate metric depth of the left image and write its files."""
        yield from self.run(self.session_of(request, secret), values, progress, {})

    def estimate_at_once(
        self,
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
        *values: Any,
    ) -> dict[Any, Any]:
        """Estimate metric depth of the left image and write its files, for API clients."""
        shown: dict[Any, Any] = {}
        for update in self.run(self.sessions.of(request.session_hash), values, progress, {}):
            shown |= {component: value for component, value in update.items() if value != gr.skip()}
        outputs = self.of_result()
        return {component: shown[component] for component in outputs if component in shown}

    def run_example(
        self,
        request: gr.Request,
        event: gr.SelectData,
        secret: str,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
    ) -> Iterator[dict[Any, Any]]:
        """Fill in an example and run it."""
        values = self.form.example(int(event.index))
        filled = dict(zip(self.form.fields.values(), values, strict=True))
        yield from self.run(self.session_of(request, secret), tuple(values), progress, filled)

    def stop(self, request: gr.Request) -> None:
        """Stop the visitor's run before its next step."""
        self.sessions.of(request.session_hash).stop()

    def note_uploads(self, request: gr.Request, left: Any, right: Any, files: Any) -> None:
        """Record a visitor's uploads, to delete them when the tab is closed."""
        paths = [left, right, *(files or ())]
        self.sessions.of(request.session_hash).uploads |= _uploads(paths)

    def restore(self, request: gr.Request, secret: str) -> dict[Any, Any]:
        """Return the result that a tab had before a reload, if it has not expired."""
        result = self.sessions.store.get(secret)
        return {self.secret: ""} if result is None else self._restored(request, secret, result)

    def _restored(self, request: gr.Request, secret: str, result: Result) -> dict[Any, Any]:
        """Return the updates that show a result, and make it the one of the visitor's session."""
        self.sessions.store.end_in(secret, FORGET_AFTER_S)
        session = self.sessions.of(request.session_hash)
        session.secret = session.drawn = secret
        shown = {self.secret: secret, self.panels.paths: [str(path) for path in results.files_of(result)]}
        return shown | self.on_panels(_all_drawn(result))

    def measure(self, request: gr.Request, secret: str, change: Any) -> dict[Any, Any]:
        """Change the pixels of the result on display by ``change``, and update what shows them.

        ``secret`` belongs to the result that the visitor saw. Nothing happens if another one replaced it.
        """
        session = self.session_of(request, secret)
        if secret != session.secret:
            return {self.panels.readings: gr.skip()}
        result = self.sessions.result(session)
        if result is None:
            expired = templates.failed(Message(templates.EXPIRED))
            hint = _headlines(templates.headline("", templates.EXPIRED))
            return self.on_panels({"status": expired, "readings": expired, **hint})
        try:
            result.pixels[:] = change(result)
        except PageError as error:
            html = Measurement.of(result).html()
            message = templates.note(error_on_page(error))
            return self.on_panels(
                {"readings": message + html, **_headlines(templates.headline("", str(error)))}
            )
        return self.on_panels(_measured(result))

    def add_point(self, request: gr.Request, secret: str, typed: str) -> dict[Any, Any]:
        """Add one point, given by its typed or clicked pixel."""

        def added(result: Result) -> list[tuple[int, int]]:
            pixel = pixel_of(typed)
            results.check_pixel(result.shown, pixel)
            return [*result.pixels, pixel]

        return self.measure(request, secret, added)

    def undo_point(self, request: gr.Request, secret: str) -> dict[Any, Any]:
        """Remove the last point."""
        return self.measure(request, secret, lambda result: result.pixels[:-1])

    def clear_points(self, request: gr.Request, secret: str) -> dict[Any, Any]:
        """Remove all points."""
        return self.measure(request, secret, lambda _: [])

    def open_tab(self, request: gr.Request, secret: str, event: gr.SelectData) -> Any:
        """Remember the open tab; write the measurements to the files when the Files tab is opened."""
        session = self.sessions.of(request.session_hash)
        session.tab = str(event.value)
        result = self.sessions.result(session)
        if result is None or session.tab != FILES_TAB or secret != session.secret:
            return gr.skip()
        return _files(result)["files"]

    def leave(self, request: gr.Request) -> None:
        """Stop the run of a closed tab, and delete its data."""
        self.sessions.leave(request.session_hash)


def _all_drawn(result: Result) -> dict[str, str]:
    """Return the HTML of all panels by their names."""
    return {name: html for panels in drawn(result) for name, html in panels.items()}


def _measurable(shown: Shown, request: Request) -> list[tuple[int, int]]:
    """Return the ends of the known length if both have a depth, so that the result shows them."""
    try:
        for pixel in request.pixels:
            results.check_pixel(shown, pixel)
    except PageError:
        return []
    return list(request.pixels)


def pixel_of(typed: str | None) -> tuple[int, int]:
    """Return the pixel nearest to typed coordinates, such as "320, 240" or "1.5 2.5".

    Raises:
        PageError: They are not two numbers.
    """
    words = re.split(r"[\s,;]+", (typed or "").strip(" ()[],;"))
    try:
        x, y = (math.floor(float(word) + 0.5) for word in words)
    except (ValueError, OverflowError):
        shown = f", not {typed.strip()[:40]!r}" if typed and typed.strip() else ""
        raise PageError(f"Enter two numbers, x and y, such as 320, 240{shown}.") from None
    return x, y


def _wire_run(desk: _Handlers, examples: gr.Gallery) -> None:
    """Connect the examples and the run button to the estimation."""
    form = desk.form
    fields_of_form = list(form.fields.values())
    outputs = [*desk.of_result(), desk.progress, form.stop]
    by_client = gr.Button(visible=False)  # first, so that the endpoint gets its name
    by_client.click(desk.estimate_at_once, fields_of_form, desk.of_result(), api_name="estimate")
    shows: dict[str, Any] = {
        "concurrency_limit": None,
        "show_progress": "full",
        "show_progress_on": desk.progress,
        "trigger_mode": "multiple",  # the last of several clicks wins
        "js": templates.RUN_BEGINS,
        "api_visibility": "private",
    }
    for event in (
        form.run.click(desk.estimate, [desk.secret, *fields_of_form], outputs, **shows),
        examples.select(desk.run_example, desk.secret, [*fields_of_form, *outputs], **shows),
    ):
        event.then(None, js=templates.RUN_ENDS, queue=False, api_visibility="private")
    # At once, so that a reload while the files are written finds the result.
    desk.secret.change(None, desk.secret, js=templates.KEEP_SECRET, queue=False, api_visibility="private")
    form.stop.click(desk.stop, **QUICK)


def _wire_form(desk: _Handlers, examples: gr.Gallery) -> None:
    """Connect the handlers of uploads and of changed inputs."""
    drops = [desk.form.fields[name] for name in ("left", "right", "calib")]
    images = [field.upload for field in drops[:2]]
    gr.on(images, lambda: gr.Gallery(selected_index=None), None, examples, **QUICK)  # no longer an example
    gr.on([field.upload for field in drops], desk.note_uploads, drops, None, **QUICK)
    changes = [event for field in drops for event in (field.upload, field.clear)]
    # The browser's own events do not report these, and gradio's do not report values set by an example.
    chosen = [field for field in desk.form.fields.values() if isinstance(field, (gr.Dropdown, gr.Slider))]
    gr.on([*changes, *(field.input for field in chosen)], None, js=templates.CHANGED, queue=False)


def _wire_measuring(desk: _Handlers) -> None:
    """Connect the handlers of measured points: clicks in the 3D view or on the image, and typed pixels."""
    panels, secret = desk.panels, desk.secret
    measured = [panels.marks_data, panels.headline, panels.depth_headline, panels.readings, panels.status]
    in_order = IN_ORDER | {"concurrency_id": "points"}
    panels.pick.click(desk.add_point, [secret, panels.picked], measured, js=templates.PICKED, **in_order)
    typed = [panels.add.click, panels.pixel.submit]
    gr.on(typed, desk.add_point, [secret, panels.pixel], measured, **in_order)
    gr.on([button.click for button in panels.undo], desk.undo_point, secret, measured, **in_order)
    gr.on([button.click for button in panels.clear], desk.clear_points, secret, measured, **in_order)
    panels.tabs.select(desk.open_tab, secret, panels.files, **QUICK)


def _point_buttons(drawn: dict[str, Any]) -> None:
    """Draw the buttons that remove points."""
    with gr.Row():
        drawn["undo"] = (*drawn.get("undo", ()), gr.Button("Undo point", size="sm", min_width=90))
        drawn["clear"] = (*drawn.get("clear", ()), gr.Button("Clear points", size="sm", min_width=90))


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
            gr.HTML(templates.VIEWER, elem_id="scene")
            _point_buttons(drawn)
        with gr.Tab("Depth"):
            drawn["depth_headline"] = gr.HTML(html["depth_headline"], elem_id="depth-headline")
            drawn["depth"] = gr.HTML(html["depth"], elem_id="depth")
            drawn["legend"] = gr.HTML(html["legend"], elem_id="depth-legend")
        with gr.Tab("Measure"), gr.Row():
            with gr.Column(scale=5, min_width=280):
                gr.HTML(templates.zoomable("measure"), elem_id="measure-image")
            with gr.Column(scale=3, min_width=240):
                drawn["readings"] = gr.HTML(html["readings"], elem_id="readings")
                drawn["pixel"] = gr.Textbox(
                    label="Add a point by its pixel (x, y)",
                    placeholder="320, 240",
                    max_lines=1,
                    elem_id="pixel",
                )
                drawn["add"] = gr.Button("Add point", size="sm", elem_id="add-point")
                _point_buttons(drawn)
        with gr.Tab("Confidence"):
            drawn["confidence"] = gr.HTML(html["confidence"], elem_id="confidence")
        with gr.Tab(FILES_TAB):
            drawn["files"] = gr.HTML(html["files"], elem_id="files")
            drawn["paths"] = gr.File(file_count="multiple", interactive=False, visible=False)
    return Panels(**drawn)


def build_page(priors: Priors) -> gr.Blocks:
    """Build the page with these priors to choose from; launch it with ``theme=THEME, css=templates.CSS``."""
    first = read_first_result()
    sessions = Sessions(ResultStore(), lambda: Result(first.shown, list(first.pixels)))
    with gr.Blocks(
        title="Metric depth from two images",
        analytics_enabled=False,
        delete_cache=(FORGET_AFTER_S // 10, FORGET_AFTER_S),
        fill_width=True,
    ) as page:
        gr.HTML(templates.HEADER)
        secret = gr.Textbox(visible="hidden")
        with gr.Row(equal_height=False, elem_id="main"):
            with gr.Column(elem_id="examples-panel"):
                examples = build_examples()
            with gr.Column(elem_id="results"):
                progress = gr.HTML(elem_id="progress")
                panels = _build_panels(_all_drawn(first))
            with gr.Column(elem_id="form"):
                form = build_form(priors)
        desk = _Handlers(form, panels, secret, priors, sessions, RunQueue(), progress)
        _wire_run(desk, examples)
        _wire_form(desk, examples)
        _wire_measuring(desk)
        page.load(None, None, form.fields["camera_input"], js=templates.PHONE_CAMERAS, queue=False)
        page.load(desk.restore, secret, desk.of_result(), js=templates.COME_BACK, **QUICK)
        page.unload(desk.leave)
    return page
