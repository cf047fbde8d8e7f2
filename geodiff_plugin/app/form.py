"""Input fields of the page, and example pairs."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import gradio as gr

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.app import results, templates
from geodiff_plugin.app.job import (
    CAMERA_INPUTS,
    EXAMPLES,
    FOCAL_INPUTS,
    GUESSES,
    LIMITS,
    NO_POSELIB,
    SCALE_INPUTS,
    CameraFields,
    Priors,
    Request,
    can_estimate,
    image_size,
    pair_name,
    request_of,
    states_focal_length,
)
from geodiff_plugin.app.lenses import LENSES
from geodiff_plugin.app.messages import Message, PageError, error_on_page
from geodiff_plugin.formats import CALIBRATION_FORMATS, in_8_bits, read_image
from geodiff_plugin.options import RunOptions
from geodiff_plugin.settings import settings_of

IMAGE_HEIGHT = 130
CALIBRATION_HEIGHT = 104
#: Short, because the field is half as wide as a phone.
DROP_HERE = "Drop or choose"
#: Options of handlers that only the page calls.
QUICK: dict[str, Any] = {"queue": False, "show_progress": "hidden", "api_visibility": "private"}
#: Options of handlers that each of several quick events reaches, in order unless the machine is busy. In
#: gradio's other modes, an event is dropped, or an earlier one is handled last.
IN_ORDER = QUICK | {"queue": True, "concurrency_limit": 1, "trigger_mode": "multiple"}
#: Labels of the optional number fields.
NUMBERS = {
    "fx": "fx, px",
    "fy": "fy, px",
    "cx": "cx, px",
    "cy": "cy, px",
    "cx_right": "Right camera's cx, px",
    "fov": "Horizontal field of view, degrees",
    "baseline": "Distance between the cameras, m",
    "baseline_error": "Accurate to ±, m",
    "known_length": "Known length, m",
    "near": "Nearest depth, m",
    "far": "Farthest depth, m",
}
#: Fields that appear and disappear as a part of a group of another name.
GROUPS = {
    **dict.fromkeys(("fx", "fy", "cx", "cy"), "lens"),
    "baseline_error": "error",
    "known_length": "length",
}
#: Fields that accept a unit, such as "12 cm".
LENGTHS = ("baseline", "baseline_error", "known_length", "near", "far")
_METRES = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
#: Placeholder of the distance between the cameras, by source of the cameras.
BASELINE_PLACEHOLDERS = {"file": "from the file", "numbers": "required", "images": "such as 12 cm"}


@dataclass(frozen=True)
class Form:
    """Components of the form, ``fields`` by option name, and their initial values."""

    fields: dict[str, Any]
    initial: dict[str, Any]
    run: gr.Button
    stop: gr.Button

    def request(self, values: tuple[Any, ...]) -> Request:
        """Return what a visitor asks for with these values of the fields.

        Raises:
            InputError: A field is missing or wrong.
        """
        named = dict(zip(self.fields, values, strict=True))
        for side in ("left", "right"):
            if named[side] and not Path(named[side]).is_file():
                raise PageError(f"The {side} image is no longer on the server. Drop it again.")
        shown = _shown(*(named[name] for name in ("camera_input", "camera", "scale_input")))
        for name in NUMBERS:  # text in a field that is no longer shown is ignored
            named[name] = _number(named[name], name) if shown.get(GROUPS.get(name, name), True) else None
        named["lens"] = {name: named.pop(name) for name in ("fx", "fy", "cx", "cy")}
        named |= {name: int(named[name] or 0) for name in ("steps", "ensemble", "resolution", "seed")}
        named |= {name: named[name] or None for name in ("steps", "resolution")}  # 0: the prior's default
        named["calib"] = tuple(named["calib"] or ())
        cameras = CameraFields(**{field.name: named.pop(field.name) for field in fields(CameraFields)})
        return request_of(cameras=cameras, **named)

    def name(self, values: tuple[Any, ...]) -> str:
        """Return a name for these values of the fields, before they are checked."""
        named = dict(zip(self.fields, values, strict=True))
        paths = [Path(named[side]) for side in ("left", "right") if named[side]]
        if len(paths) == 2 and all(path.is_file() for path in paths):
            return pair_name(*paths)
        return " and ".join(path.name for path in paths) or "without images"

    def example(self, number: int) -> list[Any]:
        """Return a value per field: the files of an example, and the initial values of all others."""
        example = EXAMPLES[number]
        files: dict[str, Any] = {side: str(getattr(example, side)) for side in ("left", "right")}
        files |= {"calib": [str(example.folder / "calib.txt")], "camera_input": "file"}
        return list((self.initial | files).values())


def _number(text: str | None, name: str) -> float | None:
    """Return the number of an optional text field, or ``None``; gradio's number field shows 0 if empty."""
    if text is None or not text.strip():
        return None
    match = re.fullmatch(r"([-+]?[\d.]+(?:e[-+]?\d+)?)\s*(mm|cm|m)?", text.strip().replace(",", ".").lower())
    try:
        value = float(match[1]) if match else math.nan
    except ValueError:
        value = math.nan
    unit = (match[2] or "") if match else ""
    if not math.isfinite(value) or (unit and name not in LENGTHS):
        example = "such as 0.12 or 12 cm" if name in LENGTHS else "such as 812.5"
        otherwise = "Clear the field if you do not know it."
        if name == "baseline":
            otherwise = (
                'If you know it only roughly, choose "Estimate from the images" and "Only a rough distance".'
            )
        raise PageError(f"{NUMBERS[name]}: enter a number {example}, not {text.strip()[:40]!r}. {otherwise}")
    return value * _METRES[unit]


def _optional(name: str, placeholder: str, **more: Any) -> gr.Textbox:
    return gr.Textbox(
        label=NUMBERS[name], placeholder=placeholder, max_lines=1, min_width=90, elem_id=name, **more
    )


def _path_of(payload: Any) -> str | None:
    """Return the path of the dropped file, without opening it."""
    return None if payload is None else payload.path


def image_field(label: str, name: str) -> gr.Image:
    """Build a field for one image; its value is the path of the unchanged file."""
    image = gr.Image(
        label=label,
        type="filepath",
        sources=["upload", "clipboard"],
        height=IMAGE_HEIGHT,
        placeholder=DROP_HERE,
        elem_id=name,
    )
    # gradio's own preprocessing opens the file and reports Pillow's errors.
    vars(image)["preprocess"] = _path_of
    return image


def _file_note(path: str | None, name: str) -> str:
    """Return HTML with the size of a dropped image and what is missing in it, or its error.

    It does not depend on other fields: the answers to two quick changes may arrive in either order.
    """
    if path is None:
        return ""
    try:
        width, height = image_size(path, name)
    except InputError as error:
        return templates.note(error_on_page(error, [Path(path).parent]))
    is_heic = Path(path).suffix.lower() in (".heic", ".heif")
    hidden = "; browsers cannot display HEIC" if is_heic else ""
    notes = [f'<div class="note">{width} x {height} pixels{hidden}</div>']
    if not states_focal_length(path):
        missing = Message(
            "The file does not state its focal length.",
            "Choose your camera or field of view under Focal length.",
        )
        notes.append(templates.needs_camera(missing))
    return "".join(notes)


def _known_image(left: str | None) -> str:
    """Return the left image, on which the ends of a known length are tapped; empty without an image.

    Like the note of a file, it does not depend on other fields.
    """
    if left is None:
        return ""
    try:
        image_size(left, "the left image")
        photo = in_8_bits(read_image(left)[0])
    except InputError:
        return ""  # reported below its field
    shown = results.shrunk(photo)
    size = photo.shape[1], photo.shape[0]
    return templates.zoomable("ends", results.data_url(shown), "Left image: tap both ends", size)


def _views() -> dict[str, Any]:
    """Build the fields of the images and cameras."""
    drawn: dict[str, Any] = {}
    with gr.Row():
        notes = {}
        for name, label in (("left", "Left image"), ("right", "Right image")):
            with gr.Column(min_width=130):
                drawn[name] = image_field(label, name)
                notes[name] = gr.HTML(elem_id=f"{name}-note")
    drawn["camera_input"] = gr.Radio(
        [(label, name) for name, label in CAMERA_INPUTS.items()],
        value="file",
        label="Cameras",
        elem_id="camera-input",
    )
    groups = _camera_fields(drawn)
    sources = [drawn[name] for name in ("camera_input", "camera", "scale_input")]
    show = _show_groups(list(groups))
    gr.on([field.change for field in sources], None, sources, list(groups.values()), js=show, queue=False)
    for name, label in (("left", "the left image"), ("right", "the right image")):
        drawn[name].change(partial(_file_note, name=label), drawn[name], notes[name], **IN_ORDER)
    return drawn


def _camera_fields(drawn: dict[str, Any]) -> dict[str, Any]:
    """Build the fields of all sources of the cameras; return the groups that appear and disappear."""
    groups: dict[str, Any] = {}
    drawn["calib"] = groups["calib"] = gr.File(
        label="Calibration file, or one per camera",
        file_count="multiple",
        height=CALIBRATION_HEIGHT,
        elem_id="calibration",
    )
    groups["formats"] = gr.HTML(templates.formats(entry.summary for entry in CALIBRATION_FORMATS.values()))
    groups["poselib"] = gr.HTML(templates.note(Message(NO_POSELIB)), visible=False)
    with gr.Row(visible=False) as groups["camera"]:
        drawn["camera"] = gr.Dropdown(
            [*((label, name) for name, label in FOCAL_INPUTS.items()), *((name, name) for name in LENSES)],
            value="exif",
            label="Focal length",
            elem_id="camera",
        )
        drawn["fov"] = groups["fov"] = _optional("fov", "such as 70", visible=False)
    with gr.Column(visible=False) as groups["lens"], gr.Row():
        for name, placeholder in (("fx", "required"), ("fy", "fx"), ("cx", "centre"), ("cy", "centre")):
            drawn[name] = _optional(name, placeholder)
    note = "cx + doffs (default: the left camera's cx)"
    drawn["cx_right"] = groups["cx_right"] = _optional("cx_right", "same as cx", info=note, visible=False)
    drawn["scale_input"] = groups["scale"] = gr.Radio(
        [(label, name) for name, label in SCALE_INPUTS.items()],
        value="measured",
        label="Scale",
        elem_id="scale-input",
        visible=False,
    )
    with gr.Row():
        drawn["baseline"] = groups["baseline"] = _optional("baseline", BASELINE_PLACEHOLDERS["file"])
        drawn["baseline_error"] = groups["error"] = _optional("baseline_error", "unknown", visible=False)
    drawn["guess"] = groups["guess"] = gr.Dropdown(
        list(GUESSES),
        value=next(iter(GUESSES)),
        label="Distance between the positions",
        visible=False,
        elem_id="guess",
    )
    with gr.Column(visible=False) as groups["length"]:
        _length_fields(drawn)
    return groups


def _show_groups(groups: list[str]) -> str:
    """Return a script that shows what a source of the cameras, focal length and scale needs.

    The browser looks them up: the form changes at once, and no answer to an earlier change can arrive last.
    """
    sources = product(CAMERA_INPUTS, FOCAL_INPUTS, SCALE_INPUTS)
    updates = {",".join(source): _updates(groups, *source) for source in sources}
    return templates.show_groups(updates, list(FOCAL_INPUTS))


def _updates(groups: list[str], camera_input: str, camera: str, scale_input: str) -> list[Any]:
    """Return the updates of groups of fields, with the placeholder of the distance."""
    shown = _shown(camera_input, camera, scale_input)
    more = {"baseline": {"placeholder": BASELINE_PLACEHOLDERS[camera_input]}}
    return [gr.update(visible=shown[name], **more.get(name, {})) for name in groups]


def _shown(camera_input: str, camera: str, scale_input: str) -> dict[str, bool]:
    """Return which groups of fields appear, for these sources of the cameras, focal length and scale."""
    by_images = camera_input == "images"
    return {
        "calib": camera_input == "file",
        "formats": camera_input == "file",
        "poselib": by_images and not can_estimate(),
        "camera": by_images,
        "fov": by_images and camera == "fov",
        "lens": camera_input == "numbers" or (by_images and camera == "fx"),
        "cx_right": camera_input == "numbers",
        "scale": by_images,
        "baseline": not by_images or scale_input == "measured",
        "error": by_images and scale_input == "measured",
        "guess": by_images and scale_input == "guess",
        "length": by_images and scale_input == "known",
    }


def _length_fields(drawn: dict[str, Any]) -> None:
    """Build the fields of a known length and its ends, which are typed or tapped on the left image."""
    drawn["known_length"] = _optional("known_length", "such as 2 m, the height of a door")
    image = gr.HTML(elem_id="known-image")
    drawn["ends"] = gr.Textbox(
        label="Its two ends, px", placeholder="tap them above", max_lines=1, elem_id="ends"
    )
    # Cleared at once, because both belong to the previous image.
    drawn["left"].change(None, None, [image, drawn["ends"]], js="() => ['', '']", queue=False)
    drawn["left"].change(_known_image, drawn["left"], image, **IN_ORDER)


def _settings(priors: Priors) -> dict[str, Any]:
    drawn: dict[str, Any] = {}
    options = settings_of(RunOptions)
    with gr.Accordion("Settings", open=False, elem_id="settings"):
        with gr.Row():
            drawn["prior"] = gr.Dropdown(list(priors.names), value=priors.names[0], label="Prior")
            drawn["preset"] = gr.Dropdown(
                list(options["preset"].choices),
                value=options["preset"].default,
                label="Preset",
                info=options["preset"].help,
            )
        with gr.Row():
            for name, label, low in (("steps", "Steps", 0), ("ensemble", "Ensemble", 1)):
                drawn[name] = gr.Slider(
                    low, LIMITS[name], value=low, step=1, label=label, info=options[name].help
                )
        with gr.Row():
            drawn["resolution"] = gr.Slider(
                0, 1536, value=0, step=32, label="Resolution, px", info="0: the prior's default"
            )
            drawn["seed"] = gr.Number(0, precision=0, minimum=0, label="Seed", min_width=90)
        with gr.Row():
            drawn |= {name: _optional(name, "unknown") for name in ("near", "far")}
    return drawn


def build_examples() -> gr.Gallery:
    """Build the gallery of examples in the open gradio context."""
    gr.HTML(f'<div class="legend-caption" id="examples-note">{templates.EXAMPLES_NOTE}</div>')
    gallery = gr.Gallery(
        [(str(example.left), example.label) for example in EXAMPLES],
        label="Examples: click one to run it",
        show_label=False,
        columns=len(EXAMPLES),
        rows=1,
        allow_preview=False,
        interactive=False,
        buttons=[],
        object_fit="cover",
        elem_id="examples",
    )
    gr.HTML(templates.LINK_TO_FORM)
    return gallery


def build_form(priors: Priors) -> Form:
    """Build the form in the open gradio context."""
    drawn = _views() | _settings(priors)
    initial = {name: component.value for name, component in drawn.items()}
    with gr.Row(elem_id="actions"):
        run = gr.Button("Estimate depth", variant="primary", scale=3, min_width=120, elem_id="run")
        stop = gr.Button("Stop", scale=1, min_width=70, interactive=False, elem_id="stop")
    return Form(drawn, initial, run, stop)
