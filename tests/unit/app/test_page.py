"""The page without a browser: its functions are called as clicks call them, with a made-up run."""

import asyncio
import gc
import itertools
import json
import re
import shutil
import threading
from dataclasses import replace
from types import SimpleNamespace
from zipfile import ZipFile

import numpy as np
import pytest
import torch
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from PIL import Image

from geodiff_plugin import enable_geometry_guidance
from geodiff_plugin._internal.checks import InputError, UnknownFormatError, bad_value
from geodiff_plugin.app import results, sessions, templates
from geodiff_plugin.app.job import EXAMPLES, CameraFields, Priors, Request, request_of, run_job, write_job
from geodiff_plugin.app.messages import ERRORS_ON_PAGE, Message, PageError
from geodiff_plugin.app.results import Measurement
from geodiff_plugin.app.sessions import Result, Stopped
from geodiff_plugin.app.shown import clean_report, load, save, shown_of, visible_in_viewer
from geodiff_plugin.formats import read_calibration, read_image
from geodiff_plugin.jobs import DepthOptions
from tests.images.rooms import room_named
from tests.unit.app.made_result import made_result

gr = pytest.importorskip("gradio", reason="gradio is in the extra app")
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # gradio 6.31 leaves files and sockets open
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


class Page:
    """A built page, its functions by their names, and its components by what they are for."""

    def __init__(self):
        from geodiff_plugin.app import page

        self.module = page
        self.blocks = page.build_page(Priors(("tiny", "other"), torch.device("cpu")))
        self.fns = list(self.blocks.fns.values())
        self.desk = self.of("estimate")[0].fn.__self__

    def of(self, name: str) -> list:
        """The functions that call a method of the desk, in the order of the page."""
        return [f for f in self.fns if getattr(f.fn, "__name__", "") == name]

    def targets(self, f) -> set:
        return {(block, event) for block, event in f.targets if event not in ("then", "unload")}


@pytest.fixture(scope="module")
def page():
    yield Page()
    asyncio.set_event_loop(None)
    gc.collect()


@pytest.fixture
def desk(page, tmp_path, monkeypatch):
    """The desk of the page with no visitors, whose temporary files are in a folder of the test."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(sessions, "gc", SimpleNamespace(collect=lambda: None))  # takes long
    page.desk.sessions._of.clear()
    page.desk.sessions.store._results.clear()
    yield page.desk
    for secret in list(page.desk.sessions.store._results):
        page.desk.sessions.store.drop(secret)


def asks(name: str = "tab") -> SimpleNamespace:
    return SimpleNamespace(session_hash=name)


def named(desk, values: dict) -> dict:
    """Values of components by what they are for, without those that do not change."""
    names = {
        component: name for name, component in vars(desk.panels).items() if name not in ("undo", "clear")
    }
    names |= {desk.secret: "secret", desk.progress: "progress", desk.form.stop: "stop"}
    names |= {component: f"field {name}" for name, component in desk.form.fields.items()}
    return {names[component]: value for component, value in values.items() if value != gr.skip()}


class Screen:
    """What a tab shows: every update is applied to it, as the browser does."""

    def __init__(self, desk, visitor="tab"):
        self.desk, self.visitor = desk, visitor
        self.shows = {"secret": ""}

    def apply(self, update: dict) -> dict:
        changes = named(self.desk, update)
        self.shows |= changes
        return changes

    def click(self, x: int, y: int) -> dict:
        return self.apply(self.desk.add_point(asks(self.visitor), self.shows["secret"], f"{x}, {y}"))


@pytest.fixture
def jobs(page, desk, monkeypatch, tmp_path):
    """Replaces jobs: ``jobs.outcome`` is the next result, or an error; ``jobs.during`` is called in it."""
    numbers = itertools.count()
    made = SimpleNamespace(outcome=None, during=lambda: None, reported=[])

    def job(request, priors, stop, progress):
        assert priors is desk.priors
        progress(0.5, "half")
        made.during()
        if isinstance(made.outcome, Exception):
            raise made.outcome
        if stop.is_set():
            raise Stopped
        return made.outcome

    def request(_, filled):
        if filled and isinstance(filled[0], Exception):
            raise filled[0]
        return Request(DepthOptions(left=tmp_path / "left.png", right=tmp_path / "right.png"), "a pair")

    def write(shown):
        folder = tmp_path / f"out{next(numbers)}"
        folder.mkdir()
        (folder / "depth.npy").write_bytes(b"x")
        return folder

    monkeypatch.setattr(page.module, "run_job", job)
    monkeypatch.setattr(page.module, "shown_of", lambda done, name, scale: done)
    monkeypatch.setattr(page.module, "write_job", write)
    monkeypatch.setattr(page.module, "clean_report", lambda folder: folder)
    monkeypatch.setattr(type(desk.form), "request", request)
    monkeypatch.setattr(type(desk.form), "name", lambda *_: "what runs")
    return made


def run(desk, jobs, outcome, screen: Screen, during=lambda: None, filled=(1, 2)) -> list[dict]:
    """A click on the button whose job gives this result, or raises this error; returns all updates."""
    jobs.outcome, jobs.during = outcome, during
    secret = screen.shows["secret"]
    steps = desk.estimate(asks(screen.visitor), secret, lambda *now: jobs.reported.append(now), *filled)
    return [screen.apply(update) for update in steps]


def is_drawn(values: dict, result: Result, paths=None) -> bool:
    """Whether every panel shows this result."""
    shown, found = result.shown, Measurement.of(result)
    url = {name: results.data_url(results.map_image(shown, name)) for name in ("depth", "confidence")}
    assert values["status"] == templates.banner(shown)
    assert values["scene_data"] == templates.hidden(results.scene_data(shown))
    assert values["depth"] == templates.compared(url["depth"])
    assert values["legend"] == results.legend_of_depth(shown.depth_m)
    assert f'src="{url["confidence"]}"' in values["confidence"]
    assert values["confidence"].endswith(results.legend_of_confidence())
    if paths is not None:
        assert values["files"] == templates.files(paths, results.PURPOSES)
    assert values["marks_data"] == templates.hidden(found.marks())
    assert values["headline"] == values["depth_headline"] == found.headline()
    assert values["readings"] == found.html()
    return True


def test_the_page_opens_with_a_finished_result(page, desk):
    first = page.module.read_first_result()
    others = ("tabs", "undo", "clear")
    values = {name: each.value for name, each in vars(desk.panels).items() if name not in others}
    assert is_drawn(values, first, []) and len(first.pixels) == 2
    assert first.shown.name == "Playroom" and first.shown.precomputed
    assert "Playroom, precomputed" in values["status"]
    assert first.shown.image.shape[:2] == first.shown.depth_m.shape
    found = Measurement.of(first)
    (segment,) = found.segments
    assert 0.1 < segment.length_m < 1 and 0 < segment.spread_m < segment.length_m / 3
    assert segment.text in found.headline() and "use your own pair" in found.headline()
    assert visible_in_viewer(first.shown).mean() > 0.5


def test_the_first_measurement_is_the_one_of_the_animation_in_the_readme(page):
    assert page.module.read_first_result().pixels == list(room_named("toy").clicks)


def test_components_have_the_ids_that_styles_and_scripts_use(page, desk):
    places = {block.elem_id for block in page.blocks.blocks.values() if getattr(block, "elem_id", None)}
    used = set(re.findall(r"#([a-z-]+)[ .,:{)]", templates.CSS))
    used |= set(re.findall(r"getElementById\('([^']*)'\)", templates.RUN_BEGINS + templates.RUN_ENDS))
    colours = {name for name in used if re.fullmatch(r"[0-9a-f]{3}|[0-9a-f]{6}", name)}
    assert used - colours - places <= {"examples-note"}
    hidden = {name: getattr(desk.panels, name).visible for name in ("pick", "picked", "paths")}
    assert hidden == {"pick": "hidden", "picked": "hidden", "paths": False}
    assert desk.secret.visible == "hidden" and not desk.panels.paths.interactive
    assert page.blocks.delete_cache == (60, 600) and page.blocks.title == "Metric depth from two images"
    assert not page.blocks.analytics_enabled and page.blocks.fill_width


def luminance(colour: str) -> float:
    """Relative luminance by WCAG 2."""
    levels = [int({"white": "#ffffff"}.get(colour, colour)[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in levels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize(
    ("text", "background"),
    [
        ("button_primary_text_color", "button_primary_background_fill"),
        ("button_primary_text_color", "button_primary_background_fill_dark"),
        ("button_primary_text_color", "button_primary_background_fill_hover"),
        ("body_text_color_subdued", "background_fill_primary"),
        ("body_text_color_subdued_dark", "background_fill_primary_dark"),
        ("block_info_text_color", "block_background_fill"),
        ("block_info_text_color_dark", "block_background_fill_dark"),
        ("input_placeholder_color", "input_background_fill"),
        ("input_placeholder_color_dark", "input_background_fill_dark"),
        ("link_text_color_dark", "block_background_fill_dark"),
        ("block_label_text_color", "block_label_background_fill"),
    ],
)
def test_texts_stand_out_from_what_is_behind_them(text, background, page):
    """By WCAG's ratio of contrast: 4.5 for texts, 7 for small labels, a little less for a placeholder."""

    def colour(name: str) -> str:
        value = getattr(page.module.THEME, name)
        return colour(value[1:]) if value.startswith("*") else value

    bright, dark = sorted((luminance(colour(name)) for name in (text, background)), reverse=True)
    least = 4.0 if "placeholder" in text else 7.0 if "label" in text else 4.5
    assert (bright + 0.05) / (dark + 0.05) > least


def test_fonts_and_colours_of_the_page_are_those_of_the_system_and_of_its_style_sheet(page):
    theme = page.module.THEME
    assert theme._font == ["system-ui", "sans-serif"] and theme._font_mono == ["ui-monospace", "monospace"]
    assert theme.primary_700 in templates.CSS and theme.neutral_600 == theme.body_text_color_subdued
    assert theme.button_primary_background_fill == theme.button_primary_background_fill_dark


def test_clicks_call_what_they_should_with_their_fields(page, desk):
    form, panels, secret = desk.form, desk.panels, desk.secret
    fields, outputs = list(form.fields.values()), desk.of_result()
    assert [type(output).__name__ for output in outputs] == ["HTML"] * 10 + ["File", "Textbox"]

    def check(f, events, inputs, to, **more):
        if events is not None:
            assert page.targets(f) == {(component._id, event) for component, event in events}
        assert f.inputs == inputs and f.outputs == to
        for name, value in more.items():
            assert getattr(f, name) == value, name

    quick = {"queue": False, "show_progress": "hidden", "api_visibility": "private"}
    shows = {"concurrency_limit": None, "show_progress": "full", "queue": True, "trigger_mode": "multiple"}
    shows |= {"show_progress_on": [desk.progress], "js": templates.RUN_BEGINS, "api_visibility": "private"}
    (by_button,), (by_example,) = page.of("estimate"), page.of("run_example")
    on_screen = [*outputs, desk.progress, form.stop]
    check(by_button, [(form.run, "click")], [secret, *fields], on_screen, **shows)
    check(by_example, None, [secret], [*fields, *on_screen], **shows)
    (by_client,) = page.of("estimate_at_once")
    check(by_client, None, fields, outputs, api_name="estimate")
    ends = [f for f in page.fns if f.js == templates.RUN_ENDS]
    assert len(ends) == 2 and not any(f.queue for f in ends)
    (keep,) = [f for f in page.fns if f.js == templates.KEEP_SECRET]
    check(keep, [(secret, "change")], [secret], [], queue=False)
    check(page.of("stop")[0], [(form.stop, "click")], [], [], **quick)
    drops = [form.fields[name] for name in ("left", "right", "calib")]
    check(page.of("note_uploads")[0], [(field, "upload") for field in drops], drops, [], **quick)
    (changed,) = [f for f in page.fns if f.js == templates.CHANGED]
    events = [(field, event) for field in drops for event in ("upload", "clear")]
    chosen = ("camera", "guess", "prior", "preset", "steps", "ensemble", "resolution")
    events += [(form.fields[name], "input") for name in chosen]
    check(changed, events, [], [], queue=False)
    measured = [panels.marks_data, panels.headline, panels.depth_headline, panels.readings, panels.status]
    in_order = quick | {"queue": True, "trigger_mode": "multiple", "concurrency_limit": 1}
    in_order |= {"concurrency_id": "points"}
    picked, typed = page.of("add_point")
    check(
        picked, [(panels.pick, "click")], [secret, panels.picked], measured, js=templates.PICKED, **in_order
    )
    check(
        typed, [(panels.add, "click"), (panels.pixel, "submit")], [secret, panels.pixel], measured, **in_order
    )
    for name, buttons in (("undo_point", panels.undo), ("clear_points", panels.clear)):
        assert len(buttons) == 2, "in the 3D view and next to the readings"
        check(page.of(name)[0], [(button, "click") for button in buttons], [secret], measured, **in_order)
    check(page.of("open_tab")[0], [(panels.tabs, "select")], [secret], [panels.files], **quick)
    (back,) = page.of("restore")
    assert back.outputs == outputs and back.js == templates.COME_BACK
    (phone,) = [f for f in page.fns if f.js == templates.PHONE_CAMERAS]
    assert phone.outputs == [form.fields["camera_input"]] and not phone.fn, "the browser does not ask"
    assert len(page.of("leave")) == 1


def test_a_run_shows_its_result_before_its_files_and_keeps_it_for_its_tab(desk, jobs, tmp_path):
    screen, made = Screen(desk), made_result()
    begun, first, rest, files, *_ = run(desk, jobs, made, screen)
    assert begun["progress"] == templates.running("what runs") and begun["stop"]["interactive"]
    assert "Below: the previous result, for Playroom" in begun["status"]
    assert {"status", "scene_data", "headline", "secret"} <= set(first) and "depth" not in first
    assert first["progress"] == "" and not first["stop"]["interactive"]
    assert {"depth", "confidence"} <= set(rest) and rest["files"] == templates.FILES_COMING
    assert "depth.npy" in files["files"]
    result = desk.sessions.result(desk.sessions.of("tab"))
    assert result.shown.depth_m is made.depth_m and result.pixels == []
    assert is_drawn(screen.shows, result, results.files_of(result))
    assert screen.shows["paths"] == [str(path) for path in results.files_of(result)]
    assert desk.sessions.store.get(screen.shows["secret"]) is result and jobs.reported == [(0.5, "half")]
    before = result.shown.folder
    run(desk, jobs, made_result(name="second", confidence=None), screen)
    assert not before.exists(), "a tab has one result"
    assert screen.shows["confidence"] == "This preset estimates no confidence."


@pytest.mark.parametrize(
    ("tab", "panel"),
    [("Depth", "depth"), ("Confidence", "confidence"), ("Measure", "scene_data"), ("x", "scene_data")],
)
def test_the_open_tab_is_drawn_first(page, tab, panel):
    first, rest = page.module.drawn(Result(made_result()), tab)
    assert panel in first and panel not in rest and "status" in first and "headline" in first
    everything = first | rest
    assert {"depth", "legend", "confidence", "scene_data", "marks_data", "readings", "files"} <= set(
        everything
    )


def coded(code: str) -> InputError:
    with pytest.raises(InputError) as raised:
        bad_value("K", "x", "y", code=code)
    return raised.value


INTERNAL_ERROR = templates.failed(
    Message("Internal error (ZeroDivisionError).", "Your input is not the cause. Run again.")
)


@pytest.mark.parametrize(
    ("filled", "outcome", "notice"),
    [
        ((1, 2), coded("estimate.rotation"), ERRORS_ON_PAGE["estimate.rotation"][0]),
        ((1, 2), UnknownFormatError("x"), templates.LINK_TO_FORMATS),
        ((1, 2), Stopped(), templates.STOPPED),
        ((1, 2), ZeroDivisionError("1/0"), INTERNAL_ERROR),
        ((PageError("Enter fx as well."),), None, "Enter fx as well."),
    ],
)
def test_a_run_that_fails_or_is_stopped_keeps_the_earlier_result_named(
    filled, outcome, notice, desk, jobs, capsys
):
    screen = Screen(desk)
    run(desk, jobs, made_result(name="the first pair"), screen)
    screen.click(5, 7)
    kept = dict(screen.shows)
    run(desk, jobs, outcome, screen, filled=filled)
    status = screen.shows["status"]
    assert notice in status and "Below: the previous result, for the first pair" in status
    assert {**screen.shows, "status": ""} == {
        **kept,
        "status": "",
        "progress": "",
        "stop": screen.shows["stop"],
    }
    assert not screen.shows["stop"]["interactive"]
    reported = capsys.readouterr()
    assert ("Traceback" in reported.err) == isinstance(outcome, ZeroDivisionError) and reported.out == ""
    screen.click(9, 7)
    assert [*Measurement.of(desk.sessions.result(desk.sessions.of("tab"))).readings][1].pixel == (9, 7)


def test_a_stop_in_the_last_stage_discards_the_new_result(desk, jobs):
    screen = Screen(desk)
    run(desk, jobs, made_result(name="kept"), screen)
    run(desk, jobs, made_result(name="stopped"), screen, during=lambda: desk.stop(asks()))
    assert "previous result, for kept" in screen.shows["status"] and "stopped" not in screen.shows["status"]
    run(desk, jobs, made_result(name="next"), screen)
    assert "next" in screen.shows["status"] and "earlier" not in screen.shows["status"]


def test_an_expired_result_is_gone_everywhere(desk, jobs):
    screen = Screen(desk)
    run(desk, jobs, made_result(), screen)
    desk.sessions.store.drop(screen.shows["secret"])
    changes = screen.click(5, 7)
    assert all(templates.EXPIRED in changes[name] for name in ("readings", "headline", "depth_headline"))
    assert changes["status"].startswith('<div class="box box-error" role="alert"><b>No new result.</b> This')
    run(desk, jobs, coded("memory"), screen)
    empty = ("scene_data", "marks_data", "depth", "legend", "confidence")
    assert all(screen.shows[name] == "" for name in empty) and screen.shows["files"] == templates.WAITING
    assert ERRORS_ON_PAGE["memory"][0] in screen.shows["status"] and screen.shows["paths"] is None
    assert templates.EXPIRED in screen.click(5, 7)["readings"], "and not the points of the first result"


def test_a_later_click_ends_the_earlier_run_without_a_message(desk, jobs):
    """The second run begins while the first one computes, as with two quick clicks."""
    screen, second = Screen(desk), []

    def click_again():
        jobs.during = lambda: None
        jobs.outcome = made_result(name="first")
        second.append(desk.estimate(asks(), "", lambda *_: None, 1, 2))
        screen.apply(next(second[0]))

    updates = run(desk, jobs, made_result(name="first"), screen, during=click_again)
    assert [set(update) for update in updates[1:]] == [set()], "the first run shows nothing any more"
    assert screen.shows["progress"] == templates.running("what runs")
    jobs.outcome = made_result(name="second")
    for update in second[0]:
        screen.apply(update)
    assert "second" in screen.shows["status"] and screen.shows["progress"] == ""
    assert is_drawn(screen.shows, desk.sessions.result(desk.sessions.of("tab")))


def test_a_run_that_begins_before_the_earlier_result_is_drawn_draws_it(page, desk, jobs, monkeypatch):
    """The earlier result already belongs to the tab, so the later run keeps it on display."""
    screen, second, draw = Screen(desk), [], page.module.drawn

    def click_again(*given):
        if not second:
            second.append(desk.estimate(asks(), screen.shows["secret"], lambda *_: None, 1, 2))
            screen.apply(next(second[0]))
        return draw(*given)

    monkeypatch.setattr(page.module, "drawn", click_again)
    run(desk, jobs, made_result(name="first"), screen)
    result = desk.sessions.result(desk.sessions.of("tab"))
    assert "previous result, for first" in screen.shows["status"]
    assert screen.shows["progress"] == templates.running("what runs") and "depth.npy" in screen.shows["files"]
    assert is_drawn(screen.shows | {"status": templates.banner(result.shown)}, result)
    assert screen.shows["secret"] == desk.sessions.of("tab").secret


def test_a_run_after_a_lost_connection_keeps_what_the_page_shows(desk, jobs):
    screen = Screen(desk)
    run(desk, jobs, made_result(name="mine"), screen)
    desk.sessions._of.pop("tab")
    begun, *_ = run(desk, jobs, coded("memory"), screen)
    assert "previous result, for mine" in begun["status"]
    assert "previous result, for mine" in screen.shows["status"]


def test_a_waiting_visitor_sees_how_many_runs_are_ahead(desk, jobs, monkeypatch):
    reported = []
    monkeypatch.setattr(sessions.time, "sleep", lambda _: None)
    others = [sessions.Run(), sessions.Run()]
    desk.queue._waiting[:] = others
    desk.queue._lock.acquire()

    def notify(*now):
        reported.append(now)
        if others:
            desk.queue._waiting.remove(others.pop())
        else:
            desk.stop(asks())

    screen = Screen(desk)
    try:
        for update in desk.estimate(asks(), "", notify, 1, 2):
            screen.apply(update)
    finally:
        desk.queue._lock.release()
        desk.queue._waiting.clear()
    assert templates.STOPPED in screen.shows["status"]
    assert reported[0] == (0.0, "Queued: 2 runs are ahead of yours")
    assert reported[-1] == (0.0, "Queued: 1 run is ahead of yours")


def test_an_api_client_gets_the_result_with_its_files_at_once(desk, jobs):
    jobs.outcome = made_result()
    values = named(desk, desk.estimate_at_once(asks(), lambda *_: None, 1, 2))
    assert set(values) == {name for name in named(desk, dict.fromkeys(desk.of_result(), 1))}
    assert is_drawn(values, desk.sessions.result(desk.sessions.of("tab"))) and "depth.npy" in values["files"]


def test_a_reloaded_tab_gets_its_result_again_with_its_points(desk, jobs, monkeypatch):
    screen = Screen(desk)
    run(desk, jobs, made_result(), screen)
    screen.click(5, 7)
    seconds, secret = [], screen.shows["secret"]
    monkeypatch.setattr(desk.sessions.store, "end_in", lambda *given: seconds.append(given))
    values = named(desk, desk.restore(asks("again"), secret))
    assert values["secret"] == secret == desk.sessions.of("again").secret and seconds == [(secret, 600)]
    result = desk.sessions.store.get(secret)
    assert result.pixels == [(5, 7)] and is_drawn(values, result, results.files_of(result))
    assert named(desk, desk.restore(asks("b"), "gone")) == {"secret": ""}
    assert desk.sessions.of("b").secret == ""


def test_points_belong_to_the_result_that_was_clicked(desk, jobs):
    screen = Screen(desk)
    first = desk.sessions.result(desk.sessions.of("tab"))
    screen.click(50, 60)
    assert first.pixels[-1] == (50, 60) and len(first.pixels) == 3
    assert len(desk.sessions.result(desk.sessions.of("other")).pixels) == 2, "another visitor's are untouched"
    run(desk, jobs, made_result(), screen)
    update = desk.add_point(asks(), "", "7, 9")
    assert named(desk, update) == {}, "a late click on the earlier result"
    result = desk.sessions.result(desk.sessions.of("tab"))
    assert result.pixels == [] and len(first.pixels) == 3
    for n in range(30):
        screen.click(n, 2)
    assert result.pixels == [(n, 2) for n in range(30)], "more than there are letters"
    assert "<b>AD</b>" in screen.shows["readings"]
    screen.apply(desk.undo_point(asks(), screen.shows["secret"]))
    assert result.pixels[-1] == (28, 2) and len(result.pixels) == 29
    screen.apply(desk.clear_points(asks(), screen.shows["secret"]))
    screen.apply(desk.undo_point(asks(), screen.shows["secret"]))
    assert result.pixels == [] and screen.shows["readings"] == templates.HOW_TO_MEASURE


def test_a_session_that_was_lost_finds_its_result_again(desk, jobs):
    screen = Screen(desk)
    run(desk, jobs, made_result(), screen)
    desk.sessions._of.clear()  # the connection was interrupted
    screen.click(5, 7)
    assert desk.sessions.store.get(screen.shows["secret"]).pixels == [(5, 7)]


@pytest.mark.parametrize(
    ("typed", "pixel"),
    [
        ("320, 240", (320, 240)),
        ("1.5, 2.5", (2, 3)),
        ("(7;9)", (7, 9)),
        ("1.4 2.6", (1, 3)),
        ("-5, 3", (-5, 3)),
    ],
)
def test_typed_points_are_numbers(typed, pixel, page):
    assert page.module.pixel_of(typed) == pixel


@pytest.mark.parametrize("typed", ["", None, "7", "seven, nine", "-5", "1, 2, 3", "1e999, 2", "nan, 1"])
def test_what_are_not_two_numbers_is_explained(typed, page):
    with pytest.raises(PageError, match="Enter two numbers, x and y, such as 320, 240"):
        page.module.pixel_of(typed)


def test_a_point_that_cannot_be_measured_leaves_the_others(desk, jobs):
    screen, made = Screen(desk), made_result()
    made.depth_m[9, 7] = 0
    run(desk, jobs, made, screen)
    screen.click(5, 7)
    kept = screen.shows["marks_data"]
    for typed, message in (
        ("7, 9", "has no depth"),
        ("-5, 3", "x goes from 0 to 43"),
        ("-5", "Enter two numbers"),
    ):
        screen.apply(desk.add_point(asks(), screen.shows["secret"], typed))
        assert message in screen.shows["readings"] and "<b>A</b>" in screen.shows["readings"]
        assert message in screen.shows["headline"] and screen.shows["marks_data"] == kept


def test_the_ends_of_a_known_length_are_measured_in_the_result(page):
    shown = made_result()
    request = SimpleNamespace(pixels=[(3, 4), (20, 9)])
    assert page.module._measurable(shown, request) == [(3, 4), (20, 9)]
    shown.depth_m[9, 20] = 0
    assert page.module._measurable(shown, request) == []


def test_measurements_are_written_when_the_files_are_opened(desk, jobs):
    screen = Screen(desk)
    run(desk, jobs, made_result(), screen)
    screen.click(3, 4)
    secret = screen.shows["secret"]
    html = desk.open_tab(asks(), secret, SimpleNamespace(value="Files"))
    assert "measurements.csv" in html and desk.sessions.of("tab").tab == "Files"
    skipped = gr.skip()
    assert desk.open_tab(asks(), secret, SimpleNamespace(value="Depth")) == skipped
    assert desk.sessions.of("tab").tab == "Depth"
    assert desk.open_tab(asks(), "gone", SimpleNamespace(value="Files")) == skipped
    assert desk.open_tab(asks("new"), "", SimpleNamespace(value="Files")) == templates.NO_FILES


def test_uploads_are_those_of_the_visitor_and_no_example(page, desk, tmp_path):
    def upload(name, content=b"mine"):
        path = tmp_path / name / "file.png"
        path.parent.mkdir(parents=True)
        path.write_bytes(content)
        return str(path)

    mine, other, calib = (upload(name) for name in ("mine", "other", "calib"))
    copy = tmp_path / "example" / "left.png"
    copy.parent.mkdir()
    shutil.copyfile(EXAMPLES[0].left, copy)
    desk.note_uploads(asks(), mine, None, None)
    desk.note_uploads(asks(), str(copy), other, [calib, str(EXAMPLES[0].left)])
    folders = {tmp_path / name for name in ("mine", "other", "calib")}
    assert desk.sessions.of("tab").uploads == folders
    desk.note_uploads(asks("b"), str(tmp_path / "gone" / "x.png"), __file__, [])
    assert desk.sessions.of("b").uploads == set()
    desk.leave(asks())
    assert not any(folder.exists() for folder in folders) and copy.exists()
    assert "tab" not in desk.sessions._of


def test_a_message_has_no_folder_of_the_server(page, tmp_path):
    options = DepthOptions(left=tmp_path / "left.png", right=tmp_path / "right.png")
    html = page.module._failed(InputError(f"LEFT is bad; got {tmp_path}/left.png."), Request(options, "x"))
    assert "got left.png." in html and str(tmp_path) not in html


class Visit(RuleBasedStateMachine):
    """A visitor who clicks, stops and measures in any order, while runs begin, end and fail.

    The pair in the banner, the result in every panel and the measurements always belong together.
    """

    desk = jobs = None

    def __init__(self):
        super().__init__()
        self.desk.sessions._of.clear()
        self.screen, self.running, self.count = Screen(self.desk), [], 0
        first = self.desk.sessions.result(self.desk.sessions.of("tab"))
        for html in drawn_of(self.desk, first):
            self.screen.shows |= html
        self.last_wanted = self.expected = first.shown.name

    def result(self) -> Result:
        return self.desk.sessions.result(self.desk.sessions.of("tab"))

    @rule(fails=st.booleans(), missing=st.booleans())
    def click_run(self, fails, missing):
        self.count += 1
        name = f"pair {self.count}"
        filled = (PageError("A field is missing."),) if missing else (name, fails)
        steps = self.desk.estimate(asks(), self.screen.shows["secret"], lambda *_: None, *filled)
        self.screen.apply(next(steps))
        self.running.append((steps, name, fails))

    @rule()
    def let_the_oldest_run_end(self):
        if self.running:
            steps, name, fails = self.running.pop(0)
            self.jobs.outcome = coded("memory") if fails else made_result(name=name)
            for update in steps:
                self.screen.apply(update)

    @rule()
    def click_run_while_a_result_is_drawn(self):
        if self.running:
            steps, name, fails = self.running[0]
            self.jobs.outcome = coded("memory") if fails else made_result(name=name)
            self.screen.apply(next(steps, {}))
            self.click_run(False, False)

    @rule()
    def stop(self):
        self.desk.stop(asks())

    @rule(x=st.integers(-2, 45), y=st.integers(-2, 31))
    def measure(self, x, y):
        self.screen.click(x, y)

    @rule()
    def undo(self):
        self.screen.apply(self.desk.undo_point(asks(), self.screen.shows["secret"]))

    @rule(tab=st.sampled_from(("3D", "Depth", "Files")))
    def open_tab(self, tab):
        html = self.desk.open_tab(asks(), self.screen.shows["secret"], SimpleNamespace(value=tab))
        self.screen.apply({self.desk.panels.files: html})

    @rule()
    def reload(self):
        if not self.running:
            secret, self.screen = self.screen.shows["secret"], Screen(self.desk)
            first = self.desk.sessions.of("new").first
            for html in drawn_of(self.desk, first):
                self.screen.shows |= html
            self.desk.sessions._of.pop("tab")
            self.screen.apply(self.desk.restore(asks(), secret))

    @invariant()
    def everything_belongs_together(self):
        result, shows = self.result(), self.screen.shows
        found = Measurement.of(result)
        assert f'<span class="pair-name">{result.shown.name}' in shows["status"]
        assert shows["marks_data"] == templates.hidden(found.marks())
        assert found.html() in shows["readings"] and shows["scene_data"] == self.scene(result)
        assert shows["secret"] == self.desk.sessions.of("tab").secret
        idle = self.desk.sessions.of("tab").run is None
        assert ("Below: the previous result, for" in shows["status"]) or idle
        assert (shows.get("progress", "") == "") == idle
        if "stop" in shows:
            assert shows["stop"]["interactive"] == (not idle)

    def scene(self, result):
        """The data of the 3D view, which takes long to make, once per result."""
        if getattr(result, "scene", None) is None:
            result.scene = templates.hidden(results.scene_data(result.shown))
        return result.scene


def drawn_of(desk, result):
    from geodiff_plugin.app.page import drawn

    return drawn(result)


@pytest.mark.parametrize("seed", [0])
def test_any_order_of_clicks_stops_and_failures_leaves_pair_result_and_points_together(
    seed, desk, jobs, page
):
    small = made_result(name="Playroom", precomputed=True)
    desk.sessions._first = lambda: Result(small, [(1, 2), (3, 4)])
    Visit.desk, Visit.jobs = desk, jobs
    try:
        run_state_machine_as_test(
            Visit, settings=hypothesis_settings(max_examples=40, stateful_step_count=25, deadline=None)
        )
    finally:
        first = page.module.read_first_result()
        desk.sessions._first = lambda: Result(first.shown, list(first.pixels))


@pytest.fixture(scope="module")
def images(textured_plane, tmp_path_factory):
    """Paths of the left and the right one, in folders of their own as the page keeps them."""
    paths = [str(tmp_path_factory.mktemp(side) / f"{side}.png") for side in ("left", "right")]
    for path, image in zip(paths, (textured_plane.left, textured_plane.right), strict=True):
        Image.fromarray(image).save(path)
    return paths


@pytest.mark.filterwarnings("ignore:.*has no unit")
def test_a_calibration_without_a_unit_needs_the_distance(images, priors, tmp_path):
    frames = [
        {"file_path": f"{side}.png", "transform_matrix": (np.eye(4) + x * np.eye(4, k=3)).tolist()}
        for side, x in (("left", 0), ("right", 0.5))
    ]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"fl_x": 60.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "frames": frames}))
    request = request_of(*images, CameraFields("file", (str(path),)), prior="tiny")
    with pytest.raises(PageError, match="calibration has no unit. Enter the distance between the cameras"):
        run_of_app(request, priors)


@pytest.fixture(scope="module")
def priors(make_pipeline):
    offered = Priors(("tiny",), torch.device("cpu"))
    offered._loaded["tiny"] = enable_geometry_guidance(make_pipeline())
    return offered


def asked(images, **more) -> Request:
    cameras = CameraFields("numbers", lens={"fx": 60.0}, baseline=0.12)
    return request_of(*images, cameras, **({"prior": "tiny", "steps": 1} | more))


def run_of_app(request, priors):
    return run_job(request, priors, threading.Event(), lambda *_: None)


@pytest.fixture(scope="module")
def result_of_app(priors, images, tmp_path_factory):
    request, reported = asked(images, ensemble=2), []
    job = run_job(request, priors, threading.Event(), lambda *now: reported.append(now))
    assert reported == sorted(reported) and 0 <= reported[0][0] <= reported[-1][0] <= 1
    assert any("Guided step" in name for _, name in reported)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tempfile.tempdir", str(tmp_path_factory.mktemp("results")))
        folder = clean_report(write_job(job))
    return replace(shown_of(job, request.name), folder=folder)


def test_a_job_and_its_files(result_of_app):
    assert result_of_app.depth_m.shape == result_of_app.sigma_m.shape == (48, 64)
    paths = results.files_of(Result(result_of_app))
    names, folder = [path.name for path in paths], paths[0].parent
    assert names[:3] == ["result.zip", "depth_mm.png", "depth.png"] and "confidence.npy" in names
    assert set(names) <= set(results.PURPOSES), "every file has a purpose"
    assert sorted(ZipFile(paths[0]).namelist()) == sorted(n for n in names[1:] if not n.endswith(".npy"))
    np.testing.assert_array_equal(np.load(folder / "depth.npy"), result_of_app.depth_m)
    report = json.loads((folder / "report.json").read_text())
    assert report["inputs"]["E"][0][3] == pytest.approx(0.12) and report["arguments"]["left"] == "left.png"
    assert report["arguments"]["ensemble"] == 2 and any(
        "cx is assumed" in finding["text"] for finding in report["findings"]
    )
    assert report["verdict"]["status"] == result_of_app.trust.status
    assert not {"signs", "indicators"} & set(report["verdict"])
    pixels = [(5, 5), (50, 40), (20, 20)]
    with ZipFile(results.files_of(Result(result_of_app, pixels))[0]) as archive:
        header, *rows = archive.read("measurements.csv").decode().splitlines()
    assert header.startswith("name,x_px") and rows[0].startswith("A,5,5,")
    assert [row.split(",")[0] for row in rows] == ["A", "B", "C", "A to B"]
    results.files_of(Result(result_of_app))


def test_a_stored_result_reads_back_as_it_was(result_of_app, images, tmp_path):
    save(tmp_path / "first.npz", result_of_app, [(5, 5), (50, 40)])
    again, pixels = load(tmp_path / "first.npz", images[0], "an example")
    assert pixels == [(5, 5), (50, 40)] and again.trust == result_of_app.trust
    assert [m.code for m in again.messages] == [m.code for m in result_of_app.messages]
    np.testing.assert_allclose(again.depth_m, result_of_app.depth_m, atol=5e-4)
    np.testing.assert_array_equal(again.image, result_of_app.image)
    np.testing.assert_allclose(again.views[1].E, result_of_app.views[1].E)


def test_a_stop_ends_a_job_between_steps(priors, images):
    stop = threading.Event()
    with pytest.raises(Stopped):
        run_job(asked(images, steps=3), priors, stop, lambda _, name: "Guided" in name and stop.set())
    assert "step" not in vars(priors.get("tiny").scheduler)  # nothing of the call is left behind


def test_examples_are_whole_and_belong_to_no_visitor(page, monkeypatch):
    form = page.desk.form
    for number, example in enumerate(EXAMPLES):
        folder = example.folder
        options = form.request(tuple(form.example(number))).options
        assert options.baseline is None and not options.estimate_pose
        monkeypatch.setattr("tempfile.tempdir", str(folder.parent))  # gradio's copies lie there
        given = [*options.image_files().values(), *options.calib]
        assert not page.module._uploads([str(path) for path in given]), "no visitor takes an example along"
        rig = read_calibration(options.calib)
        for path in options.image_files().values():
            image, notes = read_image(path, "image")
            assert image.shape[1::-1] == rig.size_left and notes == [] and path.parent == folder


def test_the_page_hands_on_images_as_they_are(tmp_path):
    from gradio.data_classes import ImageData

    from geodiff_plugin.app.form import image_field

    values = np.linspace(0, 65535, 48 * 64).reshape(48, 64).astype(np.uint16)
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 65
    deep, grey = tmp_path / "deep.png", tmp_path / "grey.jpg"
    Image.fromarray(values).save(deep)
    Image.fromarray((values >> 8).astype(np.uint8)).save(grey, exif=exif)
    field = image_field("Left image", "left")
    given = [field.preprocess(ImageData(path=str(path), orig_name=path.name)) for path in (deep, grey)]
    np.testing.assert_allclose(read_image(given[0])[0][..., 0], values / 65535, atol=1e-6)
    with Image.open(given[1]) as image:
        assert image.getexif().get_ifd(0x8769)[0xA405] == 65
    assert read_image(given[1])[0].shape == (64, 48, 3), "turned upright"


def test_an_unknown_calibration_is_one_short_sentence_with_a_link(page, tmp_path):
    from geodiff_plugin.formats import CALIBRATION_FORMATS

    (tmp_path / "notes.txt").write_text("no calibration")
    with pytest.raises(ValueError) as rejected:
        read_calibration(tmp_path / "notes.txt")
    message = page.module._failed(rejected.value)
    assert len(re.sub("<[^>]*>", "", message)) < 120
    target = re.search('href="#([^"]*)"', message)[1]
    listed = templates.formats(entry.summary for entry in CALIBRATION_FORMATS.values())
    assert f'id="{target}"' in listed and "OAK-D JSON" in listed
