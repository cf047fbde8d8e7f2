"""Collects primitives, lights and a camera while a layout draws them, then packs them into a ``Scene``.

Data flow: calls like ``box(centre, size, ...)`` -> tensors of a ``Scene``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch

from tests.scenes.patterns import LAYERS, TILE_M
from tests.scenes.scene import Material, Scene, Shape

__all__ = ["Builder", "Look", "rotation"]


def rotation(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """``R_world_from_local = R_y(yaw) R_x(pitch) R_z(roll)``; positive pitch tips z down."""
    yaw, pitch, roll = np.broadcast_arrays(yaw, pitch, roll)
    cy, sy, cp, sp, cr, sr = (
        np.cos(yaw),
        np.sin(yaw),
        np.cos(pitch),
        np.sin(pitch),
        np.cos(roll),
        np.sin(roll),
    )
    one, zero = np.ones_like(cy), np.zeros_like(cy)

    def matrix(*rows):
        return np.stack([np.stack(r, -1) for r in rows], -2)

    r_y = matrix((cy, zero, sy), (zero, one, zero), (-sy, zero, cy))
    r_x = matrix((one, zero, zero), (zero, cp, sp), (zero, -sp, cp))
    r_z = matrix((cr, -sr, zero), (sr, cr, zero), (zero, zero, one))
    return r_y @ r_x @ r_z


@dataclass(frozen=True)
class Look:
    """Texture and material of a primitive.

    Attributes:
        layer: name of a texture layer.
        palette: ``(3, 3)`` linear colours A, B, accent.
        tile: metres of a tile along u and v; None for the layer's own size.
        material: class of the surface.
        gloss: strength of highlights and reflections in [0, 1].
        macro: large-scale variation in [0, 1].
        emission: radiance in units of the albedo.
        origin: the texture's offset in tiles; None for a random one.
        row: the same as flat numbers.
    """

    layer: str
    palette: np.ndarray
    tile: tuple[float, float] | None = None
    material: Material = Material.DIFFUSE
    gloss: float = 0.0
    macro: float = 0.25
    emission: float = 0.0
    origin: tuple[float, float] | None = None
    row: tuple[float, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # One look serves many primitives, so its share of a primitive's row is made once.
        row = (
            int(self.material),
            LAYERS[self.layer],
            *(self.tile or (TILE_M[self.layer],) * 2),
            *(self.origin or (math.nan, math.nan)),
            *np.asarray(self.palette, dtype=float).ravel().tolist(),
            self.gloss,
            self.macro,
            self.emission,
        )
        object.__setattr__(self, "row", row)


@dataclass
class Builder:
    """Mutable collector used only inside ``sample_scene``."""

    rng: np.random.Generator
    rows: list = field(default_factory=list)
    lights: list = field(default_factory=list)

    def add(
        self,
        shape: Shape,
        centre,
        half,
        look: Look,
        yaw=0.0,
        pitch=0.0,
        roll=0.0,
        taper=(1.0, 0.0),
        fixed=False,
    ):
        """Append a primitive; ``fixed`` ones stay even if the camera is near."""
        self.rows.append((int(shape), *centre, *half, yaw, pitch, roll, *taper, *look.row, float(fixed)))

    def box(self, centre, size, look, **turn):
        """Box by full size (x, y, z)."""
        self.add(Shape.BOX, centre, (size[0] / 2, size[1] / 2, size[2] / 2), look, **turn)

    def standing(self, x, z, ground, size, look, **turn):
        """Box whose bottom is at height ``ground`` (y down)."""
        self.box((x, ground - size[1] / 2, z), size, look, **turn)

    def ball(self, centre, half, look, **turn):
        """Ellipsoid by half axes."""
        self.add(Shape.SPHERE, centre, np.broadcast_to(half, 3), look, **turn)

    def quad(self, centre, half_u, half_v, look, **turn):
        """Flat rectangle in its local x-z plane."""
        self.add(Shape.QUAD, centre, (half_u, 1.0, half_v), look, **turn)

    def light(self, position, colour, directional=False):
        """Point light at a position, or a directional one from a direction."""
        self.lights.append((*position, *np.asarray(colour, float), float(directional)))

    def finish(self, camera: np.ndarray, clearance: float, **rest) -> Scene:
        """Pack everything, leaving out what stands nearer to the camera than the clearance."""
        a = np.array(self.rows, dtype=np.float64)
        a[:, 16:18] = np.where(np.isnan(a[:, 16:18]), self.rng.random((len(a), 2)), a[:, 16:18])
        shape, centre, half = a[:, 0].astype(int), a[:, 1:4], a[:, 4:7]
        r = rotation(a[:, 7], a[:, 8], a[:, 9])  # world from local
        eye = camera[:3, 3]
        flat = np.where((shape == Shape.QUAD)[:, None], [1.0, 0.0, 1.0], 1.0)
        p = np.einsum("nji,nj->ni", r, eye - centre)
        gap = np.linalg.norm(np.maximum(np.abs(p) - half * flat, 0), axis=1)
        keep = (gap > clearance) | (a[:, 30] > 0)
        a, shape, centre, half, r, flat = a[keep], shape[keep], centre[keep], half[keep], r[keep], flat[keep]
        linear = np.swapaxes(r, 1, 2) / half[:, :, None]
        matrix = np.concatenate([linear, -np.einsum("nij,nj->ni", linear, centre)[..., None]], -1)
        ball = shape == Shape.SPHERE
        radius = np.where(ball, half.max(1), np.linalg.norm(half * flat, axis=1)) * 1.0001
        f = lambda x: torch.from_numpy(np.ascontiguousarray(x)).float()  # noqa: E731
        i = lambda x: torch.from_numpy(np.ascontiguousarray(x)).long()  # noqa: E731
        lights = np.array(self.lights or [(0, -1, 0, 0, 0, 0, 1)], dtype=np.float64)
        return Scene(
            shape=i(shape),
            world_to_local=f(matrix),
            half=f(half),
            taper=f(a[:, 10:12]),
            centre=f(centre),
            radius=f(radius),
            material=i(a[:, 12]),
            layer=i(a[:, 13]),
            tile_m=f(a[:, 14:16]),
            tile_offset=f(a[:, 16:18]),
            palette=f(a[:, 18:27].reshape(-1, 3, 3)),
            gloss=f(a[:, 27]),
            macro=f(a[:, 28]),
            emission=f(a[:, 29]),
            fixed=torch.from_numpy(a[:, 30] > 0),
            light_position=f(lights[:, :3]),
            light_colour=f(lights[:, 3:6]),
            light_directional=torch.from_numpy(lights[:, 6] > 0),
            T_world_from_camera=f(camera),
            clearance_m=clearance,
            **rest,
        )
