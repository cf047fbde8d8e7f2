"""Input fields of the page, and pairs to try it with."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import gradio as gr

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.app import look
from geodiff_plugin.app.job import CAMERA_WAYS, LIMITS, CameraFields, Priors, options_of, photograph_size
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, REAL_PAIRS_FOLDER
from geodiff_plugin.formats.reading import CALIBRATION_FORMATS
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.options import PRESETS, help_of

PICTURE_HEIGHT = 130
CALIBRATION_HEIGHT = 104
#: Short, as it stands in a field of half a phone's width.
DROP_HERE = "Drop or choose"
#: Of handlers that only the page itself calls.
QUICK: dict[str, Any] = {"queue": False, "show_progress": "hidden", "api_visibility": "private"}
#: Of taps that come at once every one counts, after the one before.
TAPS = QUICK | {"queue": True, "concurrency_limit": 1, "trigger_mode": "multiple"}
#: Labels of the fields that hold a number or nothing.
NUMBERS = {
    "fx": "fx, px",
    "fy": "fy, px",
    "cx": "cx, px",
    "cy": "cy, px",
    "cx_right": "Right camera's cx, px",
    "baseline": "Distance between the cameras, m",
    "known_length": "Or a known length in the left photograph, m",
    "near": "Nearest depth, m",
    "far": "Farthest depth, m",
}
PAIRS_FOLDER = Path(__file__).resolve().parent / "pairs"


@dataclass(frozen=True)
class Example:
    """A pair to try the page with: its folder, how its images end, and what the page calls it."""

    folder: Path
    ending: str
    label: str

    @property
    def left(self) -> Path:
        """The left image."""
        return self.folder / f"left.{self.ending}"


#: Real pairs first; ``tests.scenes.make_examples`` renders the others anew.
EXAMPLES = (
    Example(REAL_PAIRS_FOLDER / "toy", "png", "Playroom"),
    Example(REAL_PAIRS_FOLDER / "cycles", "png", "Hallway"),
    Example(REAL_PAIRS_FOLDER / "donkey_toy", "png", "Bedroom"),
    Example(DEMO_PAIR_FOLDER, "png", "Desk"),
    Example(PAIRS_FOLDER / "street", "jpg", "Street"),
)


@dataclass(frozen=True)
class Form:
    """The components, ``fields`` by the name of what they fill in, and the values that they begin with."""

    fields: dict[str, Any]
    untouched: dict[str, Any]
    run: gr.Button
    stop: gr.Button

    def options(self, values: tuple[Any, ...]) -> DepthOptions:
        """What was filled in."""
        named = dict(zip(self.fields, values, strict=True))
        for name, label in NUMBERS.items():
            named[name] = _number(named[name], label)
        named["lens"] = {name: named.pop(name) for name in ("fx", "fy", "cx", "cy")}
        named |= {name: int(named[name] or 0) for name in ("steps", "ensemble", "resolution", "seed")}
        named |= {name: named[name] or None for name in ("steps", "resolution")}  # 0: the prior's own
        named["calib"] = tuple(named["calib"] or ())
        cameras = CameraFields(**{field.name: named.pop(field.name) for field in fields(CameraFields)})
        return options_of(cameras=cameras, **named)

    def example(self, number: int) -> list[Any]:
        """A value for every field: the files of an example, and all others as they began."""
        folder, ending = EXAMPLES[number].folder, EXAMPLES[number].ending
        files: dict[str, Any] = {side: str(folder / f"{side}.{ending}") for side in ("left", "right")}
        files["calib"] = [str(folder / "calib.txt")]
        return list((self.untouched | files).values())


def _number(text: str | None, label: str) -> float | None:
    """The number of an optional field, or ``None``; a number field of gradio shows 0 where it is empty."""
    if text is None or not text.strip():
        return None
    try:
        return float(text.replace(",", "."))
    except ValueError:
        bad_value(label, "a number", repr(text), "Leave it empty if you do not know it.")


def _optional(name: str, placeholder: str, **more: Any) -> gr.Textbox:
    return gr.Textbox(
        label=NUMBERS[name], placeholder=placeholder, max_lines=1, min_width=90, elem_id=name, **more
    )


def _path_of(payload: Any) -> str | None:
    """The path of what was dropped, which nothing opens before us."""
    return None if payload is None else payload.path


def photograph_field(label: str, name: str) -> gr.Image:
    """A field for one photograph, whose value is the path of the file that was dropped, unchanged."""
    image = gr.Image(
        label=label,
        type="filepath",
        sources=["upload", "clipboard"],
        height=PICTURE_HEIGHT,
        placeholder=DROP_HERE,
        elem_id=name,
    )
    # gradio's own opens the file, and says what is wrong with it in words of Pillow.
    vars(image)["preprocess"] = _path_of
    return image


def _told(path: str | None, name: str) -> str:
    """What a file that was dropped is, or what is wrong with it, as soon as it is there."""
    if path is None:
        return ""
    try:
        width, height = photograph_size(path, name)
    except InputError as error:
        return f'<div class="note bad" role="alert">{escape(look.for_visitors(str(error)))}</div>'
    shows = "" if Path(path).suffix.lower() not in (".heic", ".heif") else "; browsers cannot show HEIC"
    return f'<div class="note">{width} x {height} pixels{shows}</div>'


def _views() -> dict[str, Any]:
    """The photographs and their cameras."""
    drawn: dict[str, Any] = {}
    with gr.Row():
        for name, label in (("left", "Left photograph"), ("right", "Right photograph")):
            with gr.Column(min_width=130):
                drawn[name] = photograph_field(label, name)
                about = gr.HTML(elem_id=f"{name}-note")
            told = partial(_told, name=f"the {label.lower()}")
            drawn[name].change(told, drawn[name], about, **QUICK)
    ways = [(label, name) for name, label in CAMERA_WAYS.items()]
    drawn["way"] = way = gr.Radio(ways, value="file", label="What you know of the cameras", elem_id="way")
    drawn["calib"] = calibration = gr.File(
        label="Calibration file, or one per camera",
        file_count="multiple",
        height=CALIBRATION_HEIGHT,
        elem_id="calibration",
    )
    readable = gr.HTML(look.formats(entry.summary for entry in CALIBRATION_FORMATS.values()))
    with gr.Column(visible=False) as lens, gr.Row():
        for name, placeholder in (("fx", "focal"), ("fy", "as fx"), ("cx", "middle"), ("cy", "middle")):
            drawn[name] = _optional(name, placeholder)
    note = "cx + doffs; empty means that of the left camera"
    drawn["cx_right"] = cx_right = _optional("cx_right", "assumed as cx", info=note, visible=False)
    drawn["baseline"] = _optional("baseline", "as the calibration file says")

    with gr.Row(visible=False) as length:
        drawn |= _length_fields(drawn["left"])

    def show(chosen: str) -> list[Any]:
        by_file = chosen == "file"
        shown = by_file, by_file, not by_file, chosen == "numbers", chosen == "photographs"
        return [gr.update(visible=seen) for seen in shown]

    way.change(show, way, [calibration, readable, lens, cx_right, length], **QUICK)
    return drawn


def _length_fields(left: gr.Image) -> dict[str, Any]:
    """A known length, and its ends, which are typed or tapped on the left photograph."""
    known_length = _optional("known_length", "such as a door's height")
    ends = gr.Textbox(
        label="Its two ends, px", placeholder="tap them, best in full screen", max_lines=1, elem_id="ends"
    )

    def tap(before: list[int], event: gr.SelectData) -> tuple[list[int], str]:
        """The pixels of both ends; a third tap begins anew."""
        pixels = [*before, *event.index] if len(before) == 2 else list(event.index)
        return pixels, ", ".join(map(str, pixels))

    tapped = gr.State([])  # at the server, where a second tap knows of the first
    left.select(tap, tapped, [tapped, ends], **TAPS)
    left.change(lambda: ([], ""), outputs=[tapped, ends], **QUICK)
    return {"known_length": known_length, "ends": ends}


def _settings(priors: Priors) -> dict[str, Any]:
    drawn: dict[str, Any] = {}
    with gr.Accordion("Settings", open=False):
        with gr.Row():
            drawn["prior"] = gr.Dropdown(list(priors.names), value=priors.names[0], label="Prior")
            drawn["preset"] = gr.Dropdown(
                list(PRESETS), value="default", label="Preset", info=help_of("preset")
            )
        with gr.Row():
            for name, label, least in (("steps", "Steps", 0), ("ensemble", "Ensemble", 1)):
                drawn[name] = gr.Slider(
                    least, LIMITS[name], value=least, step=1, label=label, info=help_of(name)
                )
        with gr.Row():
            drawn["resolution"] = gr.Slider(
                0, 1536, value=0, step=32, label="Resolution, px", info="0: the prior's own"
            )
            drawn["seed"] = gr.Number(0, precision=0, minimum=0, label="Seed", min_width=90)
        with gr.Row():
            drawn |= {name: _optional(name, "unknown") for name in ("near", "far")}
    return drawn


def build_examples() -> gr.Gallery:
    """Draw the examples into the open gradio context."""
    gr.HTML(f'<div class="legend-caption" id="examples-note">{look.EXAMPLES_NOTE}</div>')
    return gr.Gallery(
        [(str(example.left), example.label) for example in EXAMPLES],
        label="Examples: one click runs one",
        show_label=False,
        columns=len(EXAMPLES),
        rows=1,
        allow_preview=False,
        interactive=False,
        buttons=[],
        object_fit="cover",
        elem_id="examples",
    )


def build_form(priors: Priors) -> Form:
    """Draw the fields into the open gradio context."""
    drawn = _views() | _settings(priors)
    untouched = {name: component.value for name, component in drawn.items()}
    with gr.Row(elem_id="actions"):
        run = gr.Button("Estimate depth", variant="primary", scale=3, min_width=120, elem_id="run")
        stop = gr.Button("Stop", scale=1, min_width=70, elem_id="stop")
    return Form(drawn, untouched, run, stop)
