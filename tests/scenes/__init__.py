"""Procedural stereo scenes with exact depth: rooms, streets, table tops, corridors, terrain.

Data flow: a seed -> ``Scene`` -> ``RenderedView``, ``SyntheticPair`` or a training batch.
Paper: stands in for the rendered training sets of S5.1; mirrors and glass are the hard cases of S5.2.
"""

from __future__ import annotations

from tests.scenes.effects import CameraEffects
from tests.scenes.layouts import KINDS, sample_scene
from tests.scenes.mono import render_mono
from tests.scenes.pairs import SyntheticPair, render_pair
from tests.scenes.render import render_views
from tests.scenes.scene import Camera, Material, RenderedView, Scene
from tests.scenes.sequences import SyntheticSequence, render_sequence

__all__ = [
    "KINDS",
    "Camera",
    "CameraEffects",
    "Material",
    "RenderedView",
    "Scene",
    "SyntheticPair",
    "SyntheticSequence",
    "render_mono",
    "render_pair",
    "render_sequence",
    "render_views",
    "sample_scene",
]
