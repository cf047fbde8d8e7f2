"""Components of the page's result side, tab by tab."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gradio as gr

from geodiff_plugin.app import look

__all__ = ["CLOUD_TAB", "Panels", "build_panels"]

CLOUD_TAB = "Point cloud"
BESIDE = {"photograph": "Photograph", "prior": "What the prior says alone"}
UNDER = {"photograph": "Photograph", "depth": "Depth"}
FIRST_CONFIDENCE = 0.5
SLIDER_HEIGHT, SCENE_HEIGHT = 560, 560
NIGHT = (0.09, 0.1, 0.12, 1.0)


@dataclass(frozen=True)
class Panels:
    """What shows a result, and what a visitor moves to see more of it."""

    status: gr.HTML
    tabs: gr.Tabs
    beside: gr.Radio
    slider: gr.ImageSlider
    depth_legend: gr.HTML
    under: gr.Radio
    picture: gr.Image
    readings: gr.HTML
    clear: gr.Button
    least_confidence: gr.Slider
    scene: gr.Model3D
    points: gr.HTML
    confidence: gr.Image
    confidence_legend: gr.HTML
    error: gr.Image
    error_legend: gr.HTML
    files: gr.File


def _image(label: str, **more: Any) -> gr.Image:
    return gr.Image(label=label, interactive=False, format="png", buttons=["fullscreen"], **more)


def _choice(choices: dict[str, str], label: str, **more: Any) -> gr.Radio:
    return gr.Radio(
        [(shown, name) for name, shown in choices.items()], value=next(iter(choices)), label=label, **more
    )


def _depth() -> dict[str, Any]:
    beside = _choice(BESIDE, "Left of the slider", elem_id="beside")
    slider = gr.ImageSlider(
        label="Drag: photograph or prior | metric depth",
        interactive=False,
        format="png",
        max_height=SLIDER_HEIGHT,
        buttons=["fullscreen"],
        elem_id="slider",
    )
    return {"beside": beside, "slider": slider, "depth_legend": gr.HTML(elem_id="depth-legend")}


def _measure() -> dict[str, Any]:
    under = _choice(UNDER, "Measure on")
    with gr.Row():
        with gr.Column(scale=5, min_width=360):
            picture = _image("Click two points", elem_id="measure-picture")
        with gr.Column(scale=3, min_width=260):
            readings = gr.HTML(look.HOW_TO_MEASURE, elem_id="readings")
            clear = gr.Button("Clear points", size="sm")
    return {"under": under, "picture": picture, "readings": readings, "clear": clear}


def _cloud() -> dict[str, Any]:
    least = gr.Slider(
        0, 1, value=FIRST_CONFIDENCE, step=0.05, label="Least confidence of a point", elem_id="least"
    )
    scene = gr.Model3D(
        label="Drag to turn, scroll to come nearer",
        interactive=False,
        clear_color=NIGHT,
        height=SCENE_HEIGHT,
        elem_id="scene",
    )
    return {"least_confidence": least, "scene": scene, "points": gr.HTML(elem_id="points")}


def _doubt() -> dict[str, Any]:
    found: dict[str, Any] = {}
    with gr.Row():
        for name, label in (("confidence", "Confidence"), ("error", "Photometric error")):
            with gr.Column():
                found |= {name: _image(label), f"{name}_legend": gr.HTML()}
    return found


def build_panels() -> Panels:
    """Draw the right side of the page into the open gradio context."""
    found: dict[str, Any] = {"status": gr.HTML(look.WAITING, elem_id="status")}
    with gr.Tabs() as found["tabs"]:
        with gr.Tab("Depth"):
            found |= _depth()
        with gr.Tab("Measure"):
            found |= _measure()
        with gr.Tab(CLOUD_TAB):
            found |= _cloud()
        with gr.Tab("How sure"):
            found |= _doubt()
        with gr.Tab("Downloads"):
            found["files"] = gr.File(label="Depth, cloud and report", interactive=False, elem_id="files")
    return Panels(**found)
