"""The result side of the page, tab by tab."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gradio as gr

from geodiff_plugin.app import look

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
CLOUD_TAB = "Point cloud"
BESIDE = {"photograph": "Photograph", "prior": "What the prior says alone"}
UNDER = {"photograph": "Photograph", "depth": "Depth"}
FIRST_CONFIDENCE = 0.5
PANEL_HEIGHT = 560
NIGHT = (0.09, 0.1, 0.12, 1.0)


@dataclass(frozen=True)
class Panels:
    """What shows a result, and what a visitor moves to see more of it."""

    status: gr.HTML
    tabs: gr.Tabs
    beside: gr.Radio
    slider: gr.ImageSlider
    depth_legend: gr.HTML
    measure_verdict: gr.HTML
    under: gr.Radio
    picture: gr.Image
    readings: gr.HTML
    pixel: gr.Textbox
    add: gr.Button
    clear: gr.Button
    table: gr.DownloadButton
    least_confidence: gr.Slider
    scene: gr.Model3D
    points: gr.HTML
    confidence: gr.Image
    confidence_legend: gr.HTML
    photometric_error: gr.Image
    photometric_error_legend: gr.HTML
    files_verdict: gr.HTML
    files: gr.File


def _image(label: str, **more: Any) -> gr.Image:
    return gr.Image(
        label=label, show_label=False, interactive=False, format="png", buttons=["fullscreen"], **more
    )


def _choice(choices: dict[str, str], label: str, **more: Any) -> gr.Radio:
    return gr.Radio(
        [(shown, name) for name, shown in choices.items()], value=next(iter(choices)), label=label, **more
    )


def _measure() -> dict[str, Any]:
    drawn: dict[str, Any] = {"measure_verdict": gr.HTML(), "under": _choice(UNDER, "Measure on")}
    with gr.Row():
        with gr.Column(scale=5, min_width=300):
            drawn["picture"] = _image("Click points", elem_id="measure-picture")
        with gr.Column(scale=3, min_width=260):
            drawn["readings"] = gr.HTML(look.HOW_TO_MEASURE, elem_id="readings")
            drawn["pixel"] = gr.Textbox(
                label="A point by its pixel: x, y", placeholder="320, 240", max_lines=1, elem_id="pixel"
            )
            with gr.Row():
                drawn["add"] = gr.Button("Add point", size="sm", elem_id="add-point")
                drawn["clear"] = gr.Button("Clear points", size="sm")
                drawn["table"] = gr.DownloadButton("CSV", size="sm", elem_id="measurements")
    return drawn


def build_panels() -> Panels:
    """Draw the result side of the page into the open gradio context."""
    drawn: dict[str, Any] = {"status": gr.HTML(look.WAITING, elem_id="status")}
    with gr.Tabs() as drawn["tabs"]:
        with gr.Tab("Depth"):
            drawn["beside"] = _choice(BESIDE, "Left of the slider", elem_id="beside")
            drawn["slider"] = gr.ImageSlider(
                label="Drag: photograph or prior | metric depth",
                show_label=False,
                interactive=False,
                format="png",
                max_height=PANEL_HEIGHT,
                buttons=["fullscreen"],
                elem_id="slider",
            )
            drawn["depth_legend"] = gr.HTML(elem_id="depth-legend")
        with gr.Tab("Measure"):
            drawn |= _measure()
        with gr.Tab(CLOUD_TAB):
            drawn["least_confidence"] = gr.Slider(
                0, 1, value=FIRST_CONFIDENCE, step=0.05, label="Least confidence of a point", elem_id="least"
            )
            drawn["scene"] = gr.Model3D(
                label="Drag to turn, scroll to come nearer",
                interactive=False,
                clear_color=NIGHT,
                height=PANEL_HEIGHT,
                elem_id="scene",
            )
            drawn["points"] = gr.HTML(elem_id="points")
        with gr.Tab("How sure"), gr.Row():
            for name, label in (("confidence", "Confidence"), ("photometric_error", "Photometric error")):
                with gr.Column():
                    drawn |= {name: _image(label), f"{name}_legend": gr.HTML()}
        with gr.Tab("Downloads"):
            drawn["files_verdict"] = gr.HTML()
            drawn["files"] = gr.File(
                label="All in one, depth, cloud and report", interactive=False, elem_id="files"
            )
    return Panels(**drawn)
