"""The fields of the page: what they are called, hold and show, and the options that they become."""

import asyncio
import gc
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from PIL import Image

from geodiff_plugin._checks import InputError
from geodiff_plugin.app.job import CAMERA_WAYS, LIMITS, Priors
from geodiff_plugin.options import PRESETS, help_of

gr = pytest.importorskip("gradio", reason="gradio is in the extra app")
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # gradio 6.31 leaves files and sockets open
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def drawn():
    """The form in a page of its own, with the page."""
    from geodiff_plugin.app.form import build_examples, build_form

    with gr.Blocks() as page:
        gallery = build_examples()
        form = build_form(Priors(("tiny", "other"), torch.device("cpu")))
    yield SimpleNamespace(page=page, form=form, gallery=gallery)
    asyncio.set_event_loop(None)
    gc.collect()


def handlers(drawn, component, event: str) -> list:
    """The page's functions for an event of a component."""
    return [f for f in drawn.page.fns.values() if (component._id, event) in f.targets]


@pytest.fixture
def pair(tmp_path):
    for name in ("left.png", "right.png"):
        Image.new("RGB", (64, 48)).save(tmp_path / name)
    (tmp_path / "calib.txt").touch()
    return {name: str(tmp_path / f"{name}.png") for name in ("left", "right")} | {
        "calib": [str(tmp_path / "calib.txt")]
    }


NUMBERS = {
    "fx": "61,5",
    "fy": "62",
    "cx": "30.5",
    "cy": " 21 ",
    "cx_right": "33",
    "baseline": "0,125",
    "near": "0.5",
    "far": "9",
}


def test_untouched_fields_are_the_defaults_of_the_command(drawn, pair):
    from geodiff_plugin.jobs.options import DepthOptions

    options = drawn.form.options(tuple((drawn.form.untouched | pair).values()))
    usual = DepthOptions(left=Path(pair["left"]), right=Path(pair["right"]), prior="tiny")
    own = {"calib": (Path(pair["calib"][0]),), "export": ("glb", "mesh")}
    assert vars(options) == vars(usual) | own


def test_every_field_becomes_its_own_option(drawn, pair):
    settings = {
        "prior": "other",
        "preset": "fast",
        "steps": 7,
        "ensemble": 3,
        "resolution": 416,
        "seed": 11.0,
    }
    filled = drawn.form.untouched | pair | NUMBERS | settings
    options = drawn.form.options(tuple((filled | {"way": "numbers"}).values()))
    assert (options.fx, options.fy, options.cx, options.cy) == (61.5, 62, 30.5, 21)
    assert (options.cx_right, options.baseline, options.near, options.far) == (33, 0.125, 0.5, 9)
    got = {name: getattr(options, name) for name in settings}
    assert got == settings and isinstance(options.seed, int) and options.calib == ()
    assert (str(options.left), str(options.right)) == (pair["left"], pair["right"])
    length = {"way": "photographs", "known_length": "2,5", "ends": "1, 2, 3, 4", "baseline": ""}
    options = drawn.form.options(tuple((filled | length).values()))
    assert options.known_length == "1,2,3,4,2.5" and options.estimate_pose and options.baseline is None
    none = filled | {"way": "file", "calib": None, "steps": None, "seed": None}
    with pytest.raises(InputError, match="The calibration file is missing"):
        drawn.form.options(tuple(none.values()))
    for name, label in (
        ("far", "Farthest depth, m"),
        ("known_length", "Or a known length"),
        ("cx_right", "Right camera's cx, px"),
    ):
        with pytest.raises(InputError, match=f"{label}.* must be a number; got 'x'. Leave it empty"):
            drawn.form.options(tuple((filled | {name: "x"}).values()))


@pytest.mark.parametrize("number", range(5))
def test_an_example_fills_in_its_files_and_nothing_else(number, drawn):
    from geodiff_plugin.app.form import EXAMPLES

    example = EXAMPLES[number]
    values = dict(zip(drawn.form.fields, drawn.form.example(number), strict=True))
    changed = {name: value for name, value in values.items() if value != drawn.form.untouched[name]}
    folder = example.folder
    assert changed == {
        "left": str(example.left),
        "right": str(folder / f"right.{example.ending}"),
        "calib": [str(folder / "calib.txt")],
    }
    assert all(Path(path).is_file() for path in (changed["left"], changed["right"], *changed["calib"]))
    captions = (
        [image.caption for image in drawn.gallery.value.root]
        if hasattr(drawn.gallery.value, "root")
        else None
    )
    labels = captions or [entry["caption"] for entry in drawn.gallery.value]
    assert labels[number] == example.label and len(labels) == len(EXAMPLES)


def test_fields_are_named_limited_and_begin_as_they_should(drawn):
    fields = drawn.form.fields
    labels = {name: field.label for name, field in fields.items()}
    assert labels["left"] == "Left photograph" and labels["right"] == "Right photograph"
    assert labels["known_length"] == "Or a known length in the left photograph, m"
    assert all(label for label in labels.values()) and len(set(labels.values())) == len(labels)
    assert fields["way"].choices == [(label, name) for name, label in CAMERA_WAYS.items()]
    assert (
        fields["prior"].choices == [("tiny", "tiny"), ("other", "other")] and fields["prior"].value == "tiny"
    )
    assert (
        fields["preset"].choices == [(name, name) for name in PRESETS] and fields["preset"].value == "default"
    )
    for name, least in (("steps", 0), ("ensemble", 1)):
        slider = fields[name]
        assert (slider.minimum, slider.maximum, slider.value, slider.step) == (least, LIMITS[name], least, 1)
    for name in ("steps", "ensemble", "preset"):
        assert fields[name].info == help_of(name)
    resolution = fields["resolution"]
    assert (resolution.minimum, resolution.value, resolution.step) == (
        0,
        0,
        32,
    ) and resolution.maximum % 32 == 0
    assert (fields["seed"].value, fields["seed"].minimum, fields["seed"].precision) == (0, 0, 0)
    assert fields["calib"].file_count == "multiple" and fields["left"].type == "filepath"
    assert fields["left"].sources == ["upload", "clipboard"]
    one_line = ("fx", "fy", "cx", "cy", "cx_right", "baseline", "known_length", "ends", "near", "far")
    assert all(fields[name].max_lines == 1 and fields[name].elem_id == name for name in one_line)
    assert all(fields[name].placeholder for name in one_line)
    ids = {name: fields[name].elem_id for name in ("left", "right", "way", "calib")}
    assert ids == {"left": "left", "right": "right", "way": "way", "calib": "calibration"}
    assert (drawn.form.run.elem_id, drawn.form.stop.elem_id) == ("run", "stop")
    assert (drawn.form.run.value, drawn.form.stop.value) == ("Estimate depth", "Stop")
    assert drawn.form.run.variant == "primary" and drawn.gallery.elem_id == "examples"
    gallery = drawn.gallery
    assert (
        not gallery.interactive
        and not gallery.allow_preview
        and gallery.columns == 5
        and gallery.buttons == []
    )


def shown_fields(drawn) -> dict[str, bool]:
    """Which fields a visitor sees at first, those in hidden groups left out."""

    def seen(block) -> bool:
        return block is None or (
            getattr(block, "visible", True) is True and seen(getattr(block, "parent", None))
        )

    return {name: seen(field) for name, field in drawn.form.fields.items()}


def test_at_first_the_fields_of_a_calibration_file_are_seen(drawn):
    seen = shown_fields(drawn)
    hidden = {name for name, is_seen in seen.items() if not is_seen}
    assert hidden == {"fx", "fy", "cx", "cy", "cx_right", "known_length", "ends"}


@pytest.mark.parametrize(
    ("way", "seen"),
    [
        ("file", {"calib", "formats"}),
        ("numbers", {"lens", "cx_right"}),
        ("photographs", {"lens", "length"}),
    ],
)
def test_a_way_shows_the_fields_that_it_needs(way, seen, drawn):
    fields = drawn.form.fields
    (handler,) = handlers(drawn, fields["way"], "change")
    named = {fields["calib"]._id: "calib", fields["cx_right"]._id: "cx_right"}
    named |= {
        fields["fx"].parent.parent.parent._id: "lens",
        fields["known_length"].parent.parent._id: "length",
    }
    outputs = [named.get(output._id, "formats") for output in handler.outputs]
    assert (
        len(set(outputs)) == 5
        and not handler.queue
        and [i._id for i in handler.inputs] == [fields["way"]._id]
    )
    updates = dict(zip(outputs, handler.fn(way), strict=True))
    assert {name for name, update in updates.items() if update["visible"]} == seen


def test_a_dropped_file_is_told_by_its_size_or_by_what_is_wrong(drawn, pair, tmp_path, monkeypatch):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (64, 48)).save(tmp_path / "turned.jpg", exif=exif)
    for side in ("left", "right"):
        (handler,) = [f for f in handlers(drawn, drawn.form.fields[side], "change") if f.inputs]
        assert [output.elem_id for output in handler.outputs] == [f"{side}-note"]
        assert handler.fn(None) == ""
        assert handler.fn(pair["left"]) == '<div class="note">64 x 48 pixels</div>'
        assert handler.fn(str(tmp_path / "turned.jpg")) == '<div class="note">48 x 64 pixels</div>'
        said = handler.fn(__file__)
        assert said.startswith(
            f'<div class="note bad" role="alert">the {side} photograph must be an image file'
        )
        assert str(Path(__file__).parent) not in said
    monkeypatch.setattr("geodiff_plugin.app.form.photograph_size", lambda path, name: (64, 40))
    for name, more in (
        ("a.HEIC", "; browsers cannot show HEIC"),
        ("a.heif", "; browsers cannot show HEIC"),
        ("a.png", ""),
    ):
        assert handler.fn(name) == f'<div class="note">64 x 40 pixels{more}</div>'


def test_taps_are_the_ends_of_the_known_length_and_a_third_begins_again(drawn):
    fields = drawn.form.fields
    (tap,) = handlers(drawn, fields["left"], "select")
    (forget,) = [f for f in handlers(drawn, fields["left"], "change") if not f.inputs]
    state = tap.inputs[0]
    assert (
        [output._id for output in tap.outputs]
        == [state._id, fields["ends"]._id]
        == [o._id for o in forget.outputs]
    )
    assert tap.queue and tap.trigger_mode == "multiple" and tap.concurrency_limit == 1
    first = tap.fn(state.value, SimpleNamespace(index=[3, 4]))
    assert first == ([3, 4], "3, 4")
    second = tap.fn(first[0], SimpleNamespace(index=(50, 60)))
    assert second == ([3, 4, 50, 60], "3, 4, 50, 60")
    assert tap.fn(second[0], SimpleNamespace(index=(7, 8))) == ([7, 8], "7, 8")
    assert forget.fn() == ([], "")
    assert all(
        not f.queue and f.show_progress == "hidden"
        for f in (forget, *handlers(drawn, fields["way"], "change"))
    )
