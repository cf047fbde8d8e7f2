"""The fields of the page: what they are called, hold and show, and the requests that they become."""

import asyncio
import gc
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from PIL import Image

from geodiff_plugin.app.job import CAMERA_INPUTS, LIMITS, Priors
from geodiff_plugin.app.messages import PageError
from geodiff_plugin.options import PRESETS, RunOptions
from geodiff_plugin.settings import settings_of

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


IMAGES = ("Left image", "Right image")


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


def options_of(drawn, values: dict):
    return drawn.form.request(tuple(values.values())).options


def test_untouched_fields_are_the_defaults_of_the_command(drawn, pair):
    from geodiff_plugin.jobs.options import DepthOptions

    options = options_of(drawn, drawn.form.initial | pair)
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
    filled = drawn.form.initial | pair | NUMBERS | settings
    options = options_of(drawn, filled | {"camera_input": "numbers"})
    assert (options.fx, options.fy, options.cx, options.cy) == (61.5, 62, 30.5, 21)
    assert (options.cx_right, options.baseline, options.near, options.far) == (33, 0.125, 0.5, 9)
    got = {name: getattr(options, name) for name in settings}
    assert got == settings and isinstance(options.seed, int) and options.calib == ()
    assert (str(options.left), str(options.right)) == (pair["left"], pair["right"])
    known = {"scale_input": "known", "known_length": "250 cm", "ends": "1, 2, 3, 4"}
    options = options_of(drawn, filled | {"camera_input": "images"} | known)
    assert options.known_length == "1,2,3,4,2.5" and options.estimate_pose and options.baseline is None
    none = filled | {"camera_input": "file", "calib": None, "steps": None, "seed": None}
    with pytest.raises(PageError, match="The calibration file is missing"):
        options_of(drawn, none)
    for name, message in (
        ("far", "Farthest depth, m: enter a number such as 0.12 or 12 cm, not 'x'. Clear the field"),
        ("known_length", "Known length, m: enter a number such as 0.12 or 12 cm, not 'x'."),
        ("baseline", "not 'x'. If you know it only roughly, choose \"Estimate from the images\""),
        ("cx_right", "Right camera's cx, px: enter a number such as 812.5, not 'x'."),
    ):
        shown = {"known_length": {"camera_input": "images", "scale_input": "known"}}
        source = shown.get(name, {"camera_input": "numbers"})
        with pytest.raises(PageError, match=message):
            options_of(drawn, filled | source | {name: "x"})


def test_what_was_typed_in_a_field_that_is_no_longer_shown_is_ignored(drawn, pair):
    filled = drawn.form.initial | pair | NUMBERS
    hidden = dict.fromkeys(("known_length", "baseline_error", "fov", "cx_right", "fx"), "some")
    options = options_of(drawn, filled | hidden | {"camera_input": "file"})
    assert options.baseline == 0.125 and options.fx is options.fov is options.cx_right is None


def test_an_image_that_is_no_longer_on_the_server_is_named(drawn, pair):
    Path(pair["right"]).unlink()
    with pytest.raises(PageError, match="The right image is no longer on the server. Drop it again."):
        options_of(drawn, drawn.form.initial | pair)


@pytest.mark.parametrize(
    ("text", "metres"),
    [("0.12", 0.12), ("12 cm", 0.12), ("120mm", 0.12), (" 1,5 m ", 1.5), ("2", 2.0), ("1e-1", 0.1)],
)
def test_lengths_have_any_metric_unit(text, metres):
    from geodiff_plugin.app.form import _number

    assert _number(text, "baseline") == pytest.approx(metres)


@pytest.mark.parametrize("text", ["12 px", "x", "1.2.3", "12 inch", "nan", "1 2", "--1", "12 cm"])
def test_what_is_no_number_of_pixels_is_explained(text):
    from geodiff_plugin.app.form import _number

    with pytest.raises(PageError, match="fx, px: enter a number such as 812.5, not"):
        _number(text, "fx")
    assert _number("  ", "fx") is None


@pytest.mark.parametrize("number", range(5))
def test_an_example_fills_in_its_files_and_nothing_else(number, drawn):
    from geodiff_plugin.app.job import EXAMPLES

    example = EXAMPLES[number]
    values = dict(zip(drawn.form.fields, drawn.form.example(number), strict=True))
    changed = {name: value for name, value in values.items() if value != drawn.form.initial[name]}
    folder = example.folder
    assert changed == {
        "left": str(example.left),
        "right": str(folder / f"right.{example.ending}"),
        "calib": [str(folder / "calib.txt")],
    }
    assert values["camera_input"] == "file"
    assert all(Path(path).is_file() for path in (changed["left"], changed["right"], *changed["calib"]))
    captions = (
        [image.caption for image in drawn.gallery.value.root]
        if hasattr(drawn.gallery.value, "root")
        else None
    )
    labels = captions or [entry["caption"] for entry in drawn.gallery.value]
    assert labels[number] == example.label and len(labels) == len(EXAMPLES)
    assert drawn.form.request(tuple(values.values())).name == example.label


def test_what_appears_later_is_hidden_and_settings_are_closed_at_first(drawn):
    from geodiff_plugin.app.form import DROP_HERE

    blocks = [block for block in drawn.page.blocks.values() if isinstance(block, (gr.HTML, gr.Accordion))]
    (poselib,) = [b for b in blocks if isinstance(b, gr.HTML) and "PoseLib" in str(b.value)]
    assert not poselib.visible
    assert [b.open for b in blocks if isinstance(b, gr.Accordion) and b.label == "Settings"] == [False]
    drops = [b for b in drawn.page.blocks.values() if isinstance(b, gr.Image) and b.label in IMAGES]
    assert [b.placeholder for b in drops] == [DROP_HERE] * 2


def test_fields_are_named_limited_and_begin_as_they_should(drawn):
    fields = drawn.form.fields
    labels = {name: field.label for name, field in fields.items()}
    assert labels["left"] == "Left image" and labels["right"] == "Right image"
    assert all(label for label in labels.values()) and len(set(labels.values())) == len(labels)
    assert fields["camera_input"].choices == [(label, name) for name, label in CAMERA_INPUTS.items()]
    assert next(iter(CAMERA_INPUTS)) == "images" and fields["camera_input"].value == "file"
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
        assert fields[name].info == settings_of(RunOptions)[name].help
    resolution = fields["resolution"]
    assert (resolution.minimum, resolution.value, resolution.step) == (
        0,
        0,
        32,
    ) and resolution.maximum % 32 == 0
    assert (fields["seed"].value, fields["seed"].minimum, fields["seed"].precision) == (0, 0, 0)
    assert fields["calib"].file_count == "multiple" and fields["left"].type == "filepath"
    assert fields["left"].sources == ["upload", "clipboard"]
    one_line = "fx fy cx cy cx_right fov baseline baseline_error known_length ends near far".split()
    assert all(fields[name].max_lines == 1 and fields[name].elem_id == name for name in one_line)
    assert all(fields[name].placeholder for name in one_line)
    ids = {name: fields[name].elem_id for name in ("left", "right", "camera_input", "calib")}
    assert ids == {"left": "left", "right": "right", "camera_input": "camera-input", "calib": "calibration"}
    assert (drawn.form.run.elem_id, drawn.form.stop.elem_id) == ("run", "stop")
    assert (drawn.form.run.value, drawn.form.stop.value) == ("Estimate depth", "Stop")
    assert drawn.form.stop.interactive is False, "nothing is running"
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
    of_images = {"camera", "fov", "scale_input", "baseline_error", "guess", "known_length", "ends"}
    assert hidden == {"fx", "fy", "cx", "cy", "cx_right", *of_images}
    assert drawn.form.fields["baseline"].placeholder == "from the file"


@pytest.mark.parametrize(
    ("given", "seen"),
    [
        (("file", "exif", "measured"), {"calib", "formats", "baseline"}),
        (("numbers", "fov", "known"), {"lens", "cx_right", "baseline"}),
        (("images", "exif", "measured"), {"camera", "scale", "baseline", "error"}),
        (("images", "fov", "guess"), {"camera", "fov", "scale", "guess"}),
        (("images", "fx", "known"), {"camera", "lens", "scale", "length"}),
    ],
)
def test_a_source_shows_the_fields_that_it_needs_with_fitting_placeholders(given, seen, monkeypatch):
    from geodiff_plugin.app.form import _updates

    groups = "calib formats poselib camera fov lens cx_right scale baseline error guess length".split()
    updates = dict(zip(groups, _updates(groups, *given), strict=True))
    assert {name for name, update in updates.items() if update["visible"]} == seen
    placeholders = {"file": "from the file", "numbers": "required", "images": "such as 12 cm"}
    assert updates["baseline"]["placeholder"] == placeholders[given[0]]
    monkeypatch.setattr("geodiff_plugin.app.form.can_estimate", lambda: False)
    updates = dict(zip(groups, _updates(groups, *given), strict=True))
    assert updates["poselib"]["visible"] == (given[0] == "images"), "a missing package is reported at once"


def test_the_browser_shows_the_fields_of_a_source_without_a_request(drawn):
    from geodiff_plugin.app.form import _updates

    fields = [drawn.form.fields[name] for name in ("camera_input", "camera", "scale_input")]
    handler = handlers(drawn, fields[2], "change")[0]
    assert not handler.fn and [i._id for i in handler.inputs] == [field._id for field in fields]
    assert {(field._id, "change") for field in fields} == set(handler.targets)
    assert handlers(drawn, fields[0], "change")[0] is handler, "before others, whose answers it would await"
    updates, _ = json.JSONDecoder().raw_decode(handler.js, handler.js.index('{"images,'))
    assert len(updates) == 3 * 3 * 3
    one = _updates(["fov", "baseline"], "images", "fov", "guess")
    shown = dict(zip((output._id for output in handler.outputs), updates["images,fov,guess"], strict=True))
    assert [shown[drawn.form.fields[name]._id] for name in ("fov", "baseline")] == one


def test_a_dropped_file_is_described_by_its_size_or_its_error(drawn, pair, tmp_path, monkeypatch):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (64, 48)).save(tmp_path / "turned.jpg", exif=exif)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28  # focal length in 35 mm film
    Image.new("RGB", (64, 48)).save(tmp_path / "focal.jpg", exif=exif)
    for side in ("left", "right"):
        of_field = handlers(drawn, drawn.form.fields[side], "change")
        (handler,) = [f for f in of_field if [each.elem_id for each in f.outputs] == [f"{side}-note"]]
        assert handler.targets == [(drawn.form.fields[side]._id, "change")], "answers could change places"
        size = '<div class="note">64 x 48 pixels</div>'
        assert handler.fn(None) == "" and handler.fn(str(tmp_path / "focal.jpg")) == size
        turned = handler.fn(str(tmp_path / "turned.jpg"))
        assert turned.startswith('<div class="note">48 x 64 pixels</div>')
        message = handler.fn(__file__)
        assert message.startswith(
            '<div class="note error" role="alert">An image file cannot be read. Save it'
        )
        assert str(Path(__file__).parent) not in message
        missing = handler.fn(pair["left"])
        assert missing.startswith(f'{size}<div class="needs-camera">')
        assert "Choose your camera or field of view under Focal length" in missing
    monkeypatch.setattr("geodiff_plugin.app.form.image_size", lambda path, name: (64, 40))
    for name, more in (
        ("a.HEIC", "; browsers cannot display HEIC"),
        ("a.heif", "; browsers cannot display HEIC"),
        ("a.png", ""),
    ):
        assert handler.fn(name).startswith(f'<div class="note">64 x 40 pixels{more}</div>')


def test_the_left_image_is_shown_for_taps_on_the_ends_of_a_known_length(drawn, pair):
    fields = drawn.form.fields
    of_field = handlers(drawn, fields["left"], "change")
    (handler,) = [f for f in of_field if [each.elem_id for each in f.outputs] == ["known-image"]]
    assert handler.targets == [(fields["left"]._id, "change")], "answers of two fields could change places"
    assert handler.trigger_mode == "multiple" and handler.concurrency_limit == 1
    html = handler.fn(pair["left"])
    assert 'data-picked="ends" data-width="64" data-height="48"' in html and "data:image/jpeg" in html
    assert handler.fn(None) == handler.fn(__file__) == ""
    (clear,) = [f for f in of_field if f.js]
    assert not clear.fn and [output._id for output in clear.outputs] == [
        handler.outputs[0]._id,
        fields["ends"]._id,
    ]
    assert of_field.index(clear) < of_field.index(handler), "at once, and not after the new image"


def test_a_run_is_named_by_its_files_before_they_are_checked(drawn, pair):
    values = tuple((drawn.form.initial | pair).values())
    assert drawn.form.name(values) == "left.png and right.png"
    one_expired = drawn.form.initial | pair | {"right": f"{pair['right']}.expired"}
    assert drawn.form.name(tuple(one_expired.values())) == "left.png and right.png.expired"
    assert drawn.form.name(tuple(drawn.form.initial.values())) == "without images"
