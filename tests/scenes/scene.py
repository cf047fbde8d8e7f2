"""Frozen records of the renderer: a scene's primitives, lights and sky, its cameras, and what is rendered.

Data flow: a layout's draws -> ``Scene`` -> rays -> ``RenderedView``.
Paper: none; stands in for the rendered training data of Marigold (S5.1) and for the hard cases of S5.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import torch

__all__ = ["Camera", "Material", "RenderedView", "Scene", "Shape"]


class Shape(IntEnum):
    """Canonical convex shapes; every primitive is one of them under an affine map.

    Local coordinates run over [-1, 1] on each axis, y down as in the world: ``BOX`` the cube, ``SPHERE`` the
    unit ball, ``FRUSTUM`` a round column along y of radius 1 at the bottom and ``taper[0]`` at the top (1 a
    cylinder, 0 a cone), ``TAPER`` a cube whose top is narrower by ``taper`` along x and z (1 a gable or a
    pyramid), ``QUAD`` the flat square y = 0.
    """

    BOX = 0
    SPHERE = 1
    FRUSTUM = 2
    TAPER = 3
    QUAD = 4


class Material(IntEnum):
    """Class of a pixel's surface, as written in ``RenderedView.material``."""

    DIFFUSE = 0
    GLOSSY = 1
    MIRROR = 2
    GLASS = 3
    SKY = 4


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the world.

    Attributes:
        K: ``(3, 3)`` float, pixels of the image to render; integer coordinate = pixel centre.
        T_world_from_camera: ``(4, 4)`` float, metres; camera x right, y down, z forward.
    """

    K: torch.Tensor
    T_world_from_camera: torch.Tensor


@dataclass(frozen=True)
class Scene:
    """A world of convex primitives, drawn on the CPU; y points down, lengths in metres, colours linear.

    Attributes:
        shape: ``(N,)`` int64, a ``Shape``.
        world_to_local: ``(N, 3, 4)`` affine map from world to the shape's local coordinates.
        half: ``(N, 3)`` half extents along the local axes.
        taper: ``(N, 2)`` see ``Shape``.
        centre: ``(N, 3)`` centre of the bounding sphere, its radius in ``radius`` ``(N,)``.
        radius: ``(N,)``.
        material: ``(N,)`` int64, a ``Material``.
        layer: ``(N,)`` int64, index into ``textures.LAYERS`` (or an image after them).
        tile_m: ``(N, 2)`` metres that one texture tile covers along u and v.
        tile_offset: ``(N, 2)`` in tiles.
        palette: ``(N, 3, 3)`` colours A, B and accent C.
        gloss: ``(N,)`` in [0, 1], strength of highlights and reflections.
        macro: ``(N,)`` in [0, 1], large-scale variation over the surface.
        emission: ``(N,)`` radiance in units of the albedo.
        fixed: ``(N,)`` bool, ground, walls and hills: they stay even where a camera is near.
        light_position: ``(L, 3)`` position, or the direction towards a directional light.
        light_directional: ``(L,)`` bool.
        light_colour: ``(L, 3)``.
        ambient_up: ``(3,)`` light that arrives from above; ``ambient_down`` ``(3,)`` from below.
        ambient_down: ``(3,)``.
        ao_length_m: how far ambient light can be blocked.
        sky: ``(3, 3)`` colours at zenith, horizon and in the clouds.
        sky_clouds: amount of cloud in [0, 1].
        fog_density: 1/m; ``fog_colour`` ``(3,)``.
        fog_colour: ``(3,)``.
        T_world_from_camera: ``(4, 4)`` pose of the layout's own camera.
        fov_deg: field of view along the longer image side that suits the scene.
        baseline_m: a plausible stereo baseline.
        clearance_m: nothing but the floor is nearer to the camera than this.
        kind: one of ``KINDS``.
        seed: what it was drawn from.
    """

    shape: torch.Tensor
    world_to_local: torch.Tensor
    half: torch.Tensor
    taper: torch.Tensor
    centre: torch.Tensor
    radius: torch.Tensor
    material: torch.Tensor
    layer: torch.Tensor
    tile_m: torch.Tensor
    tile_offset: torch.Tensor
    palette: torch.Tensor
    gloss: torch.Tensor
    macro: torch.Tensor
    emission: torch.Tensor
    fixed: torch.Tensor
    light_position: torch.Tensor
    light_directional: torch.Tensor
    light_colour: torch.Tensor
    ambient_up: torch.Tensor
    ambient_down: torch.Tensor
    ao_length_m: float
    sky: torch.Tensor
    sky_clouds: float
    fog_density: float
    fog_colour: torch.Tensor
    T_world_from_camera: torch.Tensor
    fov_deg: float
    baseline_m: float
    clearance_m: float
    kind: str
    seed: int


@dataclass(frozen=True)
class RenderedView:
    """One image and all that is known about its pixels.

    Attributes:
        image_01: ``(3, H, W)`` float32 in [0, 1], sRGB.
        depth_m: ``(1, H, W)`` float32, planar z in metres; ``inf`` for the sky.
        valid: ``(1, H, W)`` bool, depth is finite.
        material: ``(1, H, W)`` int64, a ``Material``. Mirror and glass pixels carry the surface's own depth.
    """

    image_01: torch.Tensor
    depth_m: torch.Tensor
    valid: torch.Tensor
    material: torch.Tensor
