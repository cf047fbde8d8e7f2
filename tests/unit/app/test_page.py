"""The page without a browser: its functions are called as clicks call them, with a made-up run."""

import asyncio
import gc
import re
import shutil
from types import SimpleNamespace

import pytest
import torch

from geodiff_plugin._checks import InputError, UnknownFormatError
from geodiff_plugin.app import keeping, look, results
from geodiff_plugin.app.job import Priors
from geodiff_plugin.app.keeping import Stopped
from geodiff_plugin.app.shown import kept_in_view
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
    monkeypatch.setattr(keeping, "gc", SimpleNamespace(collect=lambda: None))  # takes long
    page.desk.sessions._of.clear()
    page.desk.sessions.keeper._shown.clear()
    yield page.desk
    for secret in list(page.desk.sessions.keeper._shown):
        page.desk.sessions.keeper.drop(secret)


def asks(name: str = "tab") -> SimpleNamespace:
    return SimpleNamespace(session_hash=name)


def named(desk, values: dict) -> dict:
    """Values of components by what they are for."""
    names = {component: name for name, component in vars(desk.panels).items()}
    names |= {component: name for name, component in vars(desk.memory).items()}
    return {names[component]: value for component, value in values.items()}


@pytest.fixture
def run(page, desk, monkeypatch, tmp_path):
    """``run(shown)``: a click on the button whose job gives this result, or raises this error."""

    def call(outcome, visitor="tab", during=lambda: None, told=None):
        def job(wanted, priors, stop, progress):
            assert (wanted, priors) == ("wanted", desk.priors) and not stop.is_set()
            progress(0.5, "half")
            during()
            if isinstance(outcome, Exception):
                raise outcome
            return outcome

        monkeypatch.setattr(page.module, "run_job", job)
        monkeypatch.setattr(page.module, "shown_of", lambda done: done)
        monkeypatch.setattr(
            type(desk.form), "options", lambda _, filled: "wanted" if filled == (1, 2) else None
        )
        progress = (lambda *_: None) if told is None else (lambda *now: told.append(now))
        return named(desk, desk.estimate(asks(visitor), progress, 1, 2))

    return call


def result(tmp_path, name="out"):
    folder = tmp_path / name
    folder.mkdir()
    (folder / "depth.npy").write_bytes(b"x")
    return made_result(folder=folder)


def is_drawn(values: dict, shown, pixels=(), paths=()) -> bool:
    """Whether every panel shows this result."""
    url = {
        name: results.data_url(results.picture(shown, name)) for name in ("photograph", "depth", "confidence")
    }
    measured = results.measurement(shown, list(pixels))
    assert values["status"] == look.banner(shown)
    assert values["scene_data"] == look.hidden(results.scene_data(shown))
    assert values["depth"] == look.compared(url["photograph"], url["depth"])
    assert values["legend"] == results.legend_of_depth(shown.depth_m)
    assert f'src="{url["confidence"]}"' in values["confidence"]
    assert values["confidence"].endswith(results.legend_of_confidence())
    assert values["files"] == look.files(paths)
    assert values["marks_data"] == look.hidden(results.marks_data(measured.readings))
    assert values["headline"] == measured.headline and values["readings"] == measured.words
    assert f'src="{results.data_url(measured.picture)}"' in values["picture"]
    return True


def test_the_page_opens_with_a_finished_result(page, desk):
    first = desk.first
    values = {name: component.value for name, component in vars(desk.panels).items() if name != "tabs"}
    assert is_drawn(values, first.shown, first.pixels) and desk.memory.pixels.value == first.pixels
    assert first.shown.title == "example Playroom, computed beforehand" and len(first.pixels) == 2
    assert kept_in_view(first.shown).mean() > 0.5
    ids = {name: component.elem_id for name, component in vars(desk.panels).items()}
    wanted = {
        "status": "status",
        "scene_data": "scene-data",
        "marks_data": "marks-data",
        "pick": "pick",
        "picked": "picked",
    }
    wanted |= {
        "headline": "headline",
        "depth": "depth",
        "legend": "depth-legend",
        "picture": "measure-picture",
    }
    wanted |= {
        "readings": "readings",
        "pixel": "pixel",
        "add": "add-point",
        "confidence": "confidence",
        "files": "files",
    }
    assert {name: ids[name] for name in wanted} == wanted
    places = {block.elem_id for block in page.blocks.blocks.values() if getattr(block, "elem_id", None)}
    assert {"main", "examples-part", "results", "form", "scene", "actions"} <= places
    used = set(re.findall(r"#([a-z-]+)[ .,:{]", look.CSS)) | set(
        re.findall(r"getElementById\('([^']*)'\)", look.RUN_BEGINS)
    )
    assert {name for name in used if not re.fullmatch(r"[0-9a-f]{3}|[0-9a-f]{6}", name)} - places - {
        "examples-note"
    } == set()
    hidden = {name: getattr(desk.panels, name).visible for name in ("pick", "picked", "paths")}
    assert (
        hidden == {"pick": "hidden", "picked": "hidden", "paths": False}
        and desk.memory.secret.visible == "hidden"
    )
    assert not desk.panels.paths.interactive and desk.panels.paths.file_count == "multiple"
    assert (desk.panels.add.value, desk.panels.clear.value) == ("Add point", "Clear points")
    assert desk.panels.pixel.label == "A point by its pixel: x, y" and desk.panels.pixel.max_lines == 1
    assert (
        page.blocks.delete_cache == (60, 600) and page.blocks.title == "Depth in metres from two photographs"
    )
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
    assert theme.primary_700 in look.CSS and theme.neutral_600 == theme.body_text_color_subdued
    assert theme.button_primary_background_fill == theme.button_primary_background_fill_dark


def test_clicks_call_what_they_should_with_their_fields(page, desk):
    form, panels, memory = desk.form, desk.panels, desk.memory
    fields, outputs = list(form.fields.values()), desk.of_result()
    assert [type(output).__name__ for output in outputs] == ["HTML"] * 10 + ["File", "Textbox", "State"]
    assert len(set(outputs)) == 13

    def check(f, events, inputs, to, **more):
        if events is not None:
            assert page.targets(f) == {(component._id, event) for component, event in events}
        assert f.inputs == inputs and f.outputs == to
        for name, value in more.items():
            assert getattr(f, name) == value, name

    quick = {"queue": False, "show_progress": "hidden", "api_visibility": "private"}
    by_button, by_example = page.of("estimate")
    for f, name in ((by_button, "estimate"), (by_example, "false")):
        check(
            f, None, fields, outputs, concurrency_limit=None, show_progress="full", queue=True, api_name=name
        )
        assert f.show_progress_on == [panels.status]
    come, come_by_example = page.of("come")
    check(come, [(form.run, "click")], [], [panels.status], js=look.RUN_BEGINS, **quick)
    check(come_by_example, [], [], [panels.status], js=look.RUN_BEGINS, **quick)
    ends = [f for f in page.fns if f.js == look.RUN_ENDS]
    assert len(ends) == 2 and all(f.inputs == [memory.secret] and not f.queue for f in ends)
    (take,) = page.of("take")
    assert take.outputs == fields and take.fn(SimpleNamespace(index=2)) == form.example(2)
    check(take, None, [], fields, **quick)
    check(page.of("stop")[0], [(form.stop, "click")], [], [panels.status], **quick)
    drops = [form.fields[name] for name in ("left", "right", "calib")]
    check(page.of("note_uploads")[0], [(field, "upload") for field in drops], drops, [], **quick)
    (changed,) = [f for f in page.fns if f.js == look.CHANGED]
    check(changed, [(field, event) for field in drops for event in ("upload", "clear")], [], [], queue=False)
    measured = [memory.pixels, panels.marks_data, panels.headline, panels.picture, panels.readings]
    picked, typed = page.of("add_point")
    known = [memory.secret, memory.pixels]
    check(picked, [(panels.pick, "click")], [*known, panels.picked], measured, js=look.PICKED)
    assert picked.queue and picked.trigger_mode == "multiple" and picked.concurrency_limit == 1
    check(typed, [(panels.add, "click"), (panels.pixel, "submit")], [*known, panels.pixel], measured, **quick)
    check(page.of("clear_points")[0], [(panels.clear, "click")], [memory.secret], measured, **quick)
    check(page.of("open_files")[0], [(panels.tabs, "select")], known, [panels.files], **quick)
    (back,) = page.of("come_back")
    check(back, [(page.blocks, "load")], [memory.secret], outputs, js=look.COME_BACK, **quick)
    assert len(page.of("leave")) == 1


def test_a_run_shows_its_result_and_keeps_it_for_its_tab(run, desk, tmp_path):
    told = []
    assert desk.come(asks()) == look.BUSY
    shown = result(tmp_path)
    values = run(shown, told=told)
    secret = values["secret"]
    assert desk.sessions.keeper.get(secret) is shown and desk.sessions.of("tab").secret == secret
    assert values["paths"] == [str(tmp_path / "out" / name) for name in ("everything.zip", "depth.npy")]
    assert is_drawn(values, shown, (), results.files_of(shown)) and values["pixels"] == []
    assert told == [(0.5, "half")]
    session = desk.sessions.of("tab")
    before = session.stop
    second = run(result(tmp_path, "second"))
    assert desk.sessions.keeper.get(secret) is None and not (tmp_path / "out").exists(), (
        "a tab has one result"
    )
    assert session.secret == second["secret"] != secret and session.stop is not before
    bare = run(made_result(confidence=None, folder=None))
    assert bare["confidence"] == "This preset gives no confidence." and bare["files"] == look.NO_FILES


def test_a_run_that_fails_or_is_stopped_says_so_and_shows_nothing(run, desk, tmp_path, capsys):
    for outcome, status in (
        (
            InputError("K is bad; give --fx."),
            look.failed("the camera's focal length and centre is bad; give fx."),
        ),
        (UnknownFormatError("x"), look.failed(look.UNKNOWN_CALIBRATION, look.LINK_TO_FORMATS)),
        (Stopped(), look.STOPPED),
        (ZeroDivisionError("1/0"), look.failed("This is a defect, not your input: ZeroDivisionError.")),
    ):
        values = run(outcome)
        assert values["status"] == status
        assert values["secret"] == "" and values["paths"] is None and values["pixels"] == []
        empty = ("scene_data", "marks_data", "depth", "legend", "picture", "confidence")
        assert all(values[name] == "" for name in empty)
        assert values["headline"] == look.headline("", "No result yet.") and values["files"] == look.WAITING
        assert values["readings"] == look.HOW_TO_MEASURE
        said = capsys.readouterr()
        assert ("Traceback" in said.err and "1/0" in said.err) == isinstance(outcome, ZeroDivisionError)
        assert said.out == ""
    assert not desk.sessions.keeper._shown and not desk.sessions.of("tab").runs
    shown = result(tmp_path)
    values = run(shown, during=lambda: desk.stop(asks()))
    assert values["status"] == look.STOPPED and not shown.folder.exists(), "its files go"
    assert not desk.sessions.of("tab").stop.is_set(), "the next run begins"
    assert desk.stop(asks("b")) == look.STOPPED and desk.sessions.of("b").stop.is_set()


def test_who_waits_is_told_how_many_are_before(run, desk, monkeypatch):
    told = []
    monkeypatch.setattr(keeping.time, "sleep", lambda _: None)
    others = [keeping.Session(), keeping.Session()]
    desk.turns._waiting[:] = others
    desk.turns._turn.acquire()

    def tell(*now):
        told.append(now)
        if others:
            desk.turns._waiting.remove(others.pop())
        else:
            desk.sessions.of("tab").stop.set()

    try:
        values = named(desk, desk.estimate(asks(), tell, *desk.form.example(0)))
    finally:
        desk.turns._turn.release()
        desk.turns._waiting.clear()
    assert values["status"] == look.STOPPED
    assert told[0] == (0.0, "Waiting: 2 runs are before yours") and told[-1] == (
        0.0,
        "Waiting: 1 run is before yours",
    )


def test_a_reloaded_tab_gets_its_result_again_and_longer(run, desk, tmp_path, monkeypatch):
    shown = result(tmp_path)
    secret = run(shown)["secret"]
    seconds = []
    monkeypatch.setattr(desk.sessions.keeper, "end_in", lambda *given: seconds.append(given))
    values = named(desk, desk.come_back(asks("again"), secret))
    assert values["secret"] == secret == desk.sessions.of("again").secret and seconds == [(secret, 600)]
    assert is_drawn(values, shown, (), results.files_of(shown))
    assert (
        named(desk, desk.come_back(asks("b"), "gone")) == {"secret": ""}
        and desk.sessions.of("b").secret == ""
    )
    assert (
        desk.shown_by("") is desk.first.shown
        and desk.shown_by(secret) is shown
        and desk.shown_by("gone") is None
    )


def test_points_are_added_one_by_one_and_the_last_26_stay(run, desk, tmp_path):
    shown = result(tmp_path)
    secret = run(shown)["secret"]
    values = named(desk, desk.add_point(secret, [(3, 4)], "x 7, y 9 and 11"))
    assert values["pixels"] == [(3, 4), (7, 9)]
    found = results.measurement(shown, [(3, 4), (7, 9)])
    assert values["readings"] == found.words and values["headline"] == found.headline
    assert set(values) == {"pixels", "marks_data", "headline", "picture", "readings"}
    many = [(n, 2) for n in range(26)]
    assert named(desk, desk.add_point(secret, many, "30 5"))["pixels"] == [*many[1:], (30, 5)]
    assert named(desk, desk.add_point(secret, [], "7 9"))["pixels"] == [(7, 9)]
    for typed in ("", None, "7", "seven, nine"):
        assert named(desk, desk.add_point(secret, [], typed)) == {"readings": "Type two whole numbers: x, y."}
    shown.depth_m[9, 7] = 0
    said = named(desk, desk.add_point(secret, [], "7 9"))
    assert list(said) == ["readings"] and "pixel must be one with a depth" in said["readings"]
    assert named(desk, desk.clear_points(secret))["pixels"] == []
    gone = {"readings": look.failed("This result is no longer here. Estimate again.")}
    assert named(desk, desk.measure("gone", [(3, 4)])) == gone
    assert (
        named(desk, desk.measure("", [(3, 4)]))["readings"]
        == results.measurement(desk.first.shown, [(3, 4)]).words
    )


def test_files_are_listed_when_their_tab_is_opened(run, desk, tmp_path):
    shown = result(tmp_path)
    secret = run(shown)["secret"]
    html = desk.open_files(secret, [(3, 4)], SimpleNamespace(value="Files"))
    assert html == look.files(results.files_of(shown, [(3, 4)])) and "measurements.csv" in html
    skipped = gr.skip()
    assert desk.open_files(secret, [(3, 4)], SimpleNamespace(value="Depth")) == skipped
    assert desk.open_files("gone", [(3, 4)], SimpleNamespace(value="Files")) == skipped
    assert (
        "measurements.csv" in html
        and desk.open_files("", [], SimpleNamespace(value="Files")) == look.NO_FILES
    )


def test_uploads_are_those_of_the_visitor_and_no_example(page, desk, tmp_path):
    from geodiff_plugin.app.form import EXAMPLES

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


def test_what_went_wrong_is_in_words_of_a_visitor(page, capsys):
    assert page.module._failed(InputError("LEFT is bad")) == look.failed("the left photograph is bad")
    assert capsys.readouterr().err == ""
