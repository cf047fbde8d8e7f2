"""Input fields of the page."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import gradio as gr

from geodiff_plugin._checks import bad_value
from geodiff_plugin.app.cameras import CAMERA_WAYS, CameraFields
from geodiff_plugin.app.examples import EXAMPLES
from geodiff_plugin.app.job import MOST_MEMBERS, MOST_STEPS, PRESETS, Request
from geodiff_plugin.app.priors import Priors
from geodiff_plugin.options import help_of

__all__ = ["Form", "build_form", "photograph_field"]

PICTURE_HEIGHT = 190
#: Labels of the fields that hold a number or nothing.
NUMBERS = {
    "fx": "fx, px",
    "fy": "fy, px",
    "cx": "cx, px",
    "cy": "cy, px",
    "cx_right": "Right camera's cx, px",
    "baseline_m": "Distance of the cameras, m",
    "near": "Nearest depth, m",
    "far": "Farthest depth, m",
}
CAMERA_NAMES = tuple(field.name for field in fields(CameraFields))


@dataclass(frozen=True)
class Form:
    """The components, and how their values become a request.

    Attributes:
        fields: by the name of what they fill in, of ``Request`` or ``CameraFields``.
        run: starts a job.
        stop: ends it.
    """

    fields: dict[str, Any]
    run: gr.Button
    stop: gr.Button

    def request(self, values: tuple[Any, ...]) -> Request:
        """What was filled in; empty fields are ``None``."""
        named = dict(zip(self.fields, values, strict=True))
        for name, label in NUMBERS.items():
            named[name] = _number(named[name], label)
        cameras = CameraFields(**{name: named.pop(name) or None for name in CAMERA_NAMES})
        for name in ("steps", "members", "resolution", "seed"):
            named[name] = int(named[name] or 0)
        return Request(**named, cameras=cameras)


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


def photograph_field(label: str, name: str) -> gr.Image:
    """A field for one photograph, whose value is the path of the file that was dropped, unchanged."""
    return gr.Image(
        label=label,
        type="filepath",
        image_mode=None,  # the file as it is: gradio's own conversion clips 16 bits and drops EXIF
        sources=["upload", "clipboard"],
        height=PICTURE_HEIGHT,
        elem_id=name,
    )


def _photographs() -> dict[str, Any]:
    found: dict[str, Any] = {}
    with gr.Row():
        for name, label in (("left", "Left photograph"), ("right", "Right photograph")):
            found[name] = photograph_field(label, name)
    with gr.Accordion("A third photograph", open=False):
        found["third"] = photograph_field("Third photograph, of the left camera", "third")
        found["third_pose"] = gr.Textbox(
            label="Its pose in the left camera's frame, metres",
            info="4x4, row by row: a camera 0.1 m higher has -0.1 as the fourth number of the second row.",
            placeholder="1 0 0 0    0 1 0 -0.1    0 0 1 0    0 0 0 1",
            lines=2,
        )
    return found


def _cameras() -> dict[str, Any]:
    ways = [(way.label, name) for name, way in CAMERA_WAYS.items()]
    way = gr.Radio(ways, value=ways[0][1], label="Where the cameras are", elem_id="way")
    found: dict[str, Any] = {"way": way}
    with gr.Column(visible=True) as files:
        found["calibration"] = gr.File(label="Calibration file", height=140, elem_id="calibration")
        with gr.Accordion("One file per camera (MVSNet, ROS, COLMAP)", open=False):
            found["second_calibration"] = gr.File(label="Second file", height=140)
    with gr.Row(visible=False) as lens:
        for name, placeholder in (("fx", "focal"), ("fy", "as fx"), ("cx", "middle"), ("cy", "middle")):
            found[name] = _optional(name, placeholder)
        found["cx_right"] = _optional("cx_right", "assumed as cx")
    found["baseline_m"] = _optional("baseline_m", "as the calibration file says")

    def show(chosen: str) -> tuple[Any, Any]:
        fields = CAMERA_WAYS[chosen].fields
        return gr.update(visible="calibration" in fields), gr.update(visible="fx" in fields)

    way.change(show, way, [files, lens], queue=False, api_visibility="private")
    return found


def _settings(priors: Priors) -> dict[str, Any]:
    with gr.Accordion("Settings", open=False):
        with gr.Row():
            prior = gr.Dropdown(list(priors.names), value=priors.names[0], label="Prior")
            preset = gr.Dropdown(list(PRESETS), value="default", label="Preset", info=help_of("preset"))
        with gr.Row():
            steps = gr.Slider(0, MOST_STEPS, value=0, step=1, label="Steps", info=help_of("steps"))
            members = gr.Slider(1, MOST_MEMBERS, value=1, step=1, label="Ensemble", info=help_of("ensemble"))
        with gr.Row():
            resolution = gr.Slider(
                0, 1536, value=0, step=32, label="Resolution, px", info="0: the prior's own"
            )
            seed = gr.Number(0, precision=0, minimum=0, label="Seed", min_width=90)
        with gr.Row():
            near, far = _optional("near", "unknown"), _optional("far", "unknown")
        show_prior = gr.Checkbox(True, label="Also show what the prior says alone (one more plain call)")
    return {
        "prior": prior,
        "preset": preset,
        "steps": steps,
        "members": members,
        "resolution": resolution,
        "seed": seed,
        "near": near,
        "far": far,
        "show_prior": show_prior,
    }


def build_form(priors: Priors) -> Form:
    """Draw the fields into the open gradio context."""
    found = _photographs() | _cameras() | _settings(priors)
    with gr.Row():
        run = gr.Button("Estimate depth", variant="primary", scale=3, elem_id="run")
        stop = gr.Button("Stop", scale=1, elem_id="stop")
    gr.Examples(
        [list(example.paths) for example in EXAMPLES],
        inputs=[found["left"], found["right"], found["calibration"]],
        example_labels=[example.label for example in EXAMPLES],
        label="Examples, rendered by this project",
    )
    return Form(found, run, stop)
