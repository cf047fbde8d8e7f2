"""A place for objects: local coordinates with a heading, heights upwards from the ground.

Data flow: local positions and sizes -> primitives in a ``Builder``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tests.scenes.builder import Builder, rotation
from tests.scenes.scene import Shape

__all__ = ["Spot", "camera_pose"]


def camera_pose(x: float, y: float, z: float, yaw: float, pitch: float, roll: float) -> np.ndarray:
    """``(4, 4)`` world-from-camera; radians, positive yaw looks right, positive pitch looks down."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.float64(yaw), np.float64(pitch), np.float64(roll))
    pose[:3, 3] = x, y, z
    return pose


@dataclass(frozen=True)
class Spot:
    """A place on the ground with a heading; local x to the right, z to the back, heights upwards.

    Attributes:
        b: where primitives go.
        x: world position in metres; ``z`` likewise.
        z: see ``x``.
        yaw: heading in radians.
        ground: world y of the ground (y points down).
    """

    b: Builder
    x: float
    z: float
    yaw: float = 0.0
    ground: float = 0.0

    @property
    def rng(self) -> np.random.Generator:
        """The layout's source of randomness."""
        return self.b.rng

    def at(self, lx: float, lz: float) -> tuple[float, float]:
        """World x and z of a local position."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return self.x + c * lx + s * lz, self.z - s * lx + c * lz

    def moved(self, lx: float, lz: float, turn: float = 0.0, up: float = 0.0) -> Spot:
        """The spot at a local position, turned, its ground raised."""
        x, z = self.at(lx, lz)
        return Spot(self.b, x, z, self.yaw + turn, self.ground - up)

    def box(self, lx, lz, bottom, size, look, turn=0.0, **rest):
        """Box by full size, its bottom at a height."""
        x, z = self.at(lx, lz)
        self.b.box((x, self.ground - bottom - size[1] / 2, z), size, look, yaw=self.yaw + turn, **rest)

    def wedge(self, lx, lz, bottom, size, look, taper, **rest):
        """Box with a narrower top, its bottom at a height."""
        x, z = self.at(lx, lz)
        centre = (x, self.ground - bottom - size[1] / 2, z)
        self.b.add(
            Shape.TAPER,
            centre,
            (size[0] / 2, size[1] / 2, size[2] / 2),
            look,
            yaw=self.yaw,
            taper=taper,
            **rest,
        )

    def column(self, lx, lz, bottom, radius, height, look, top=1.0):
        """Upright round column; ``top`` is the upper radius in parts of the lower."""
        x, z = self.at(lx, lz)
        centre = (x, self.ground - bottom - height / 2, z)
        self.b.add(Shape.FRUSTUM, centre, (radius, height / 2, radius), look, yaw=self.yaw, taper=(top, 0.0))

    def rod(self, lx, lz, height, radius, length, look, pitch=np.pi / 2, roll=0.0, turn=0.0):
        """Thin round rod in any direction, its middle at a height; by default along local z."""
        x, z = self.at(lx, lz)
        half = (radius, length / 2, radius)
        self.b.add(
            Shape.FRUSTUM,
            (x, self.ground - height, z),
            half,
            look,
            yaw=self.yaw + turn,
            pitch=pitch,
            roll=roll,
        )

    def ball(self, lx, lz, centre, half, look, **rest):
        """Ellipsoid by half axes, its centre at a height."""
        x, z = self.at(lx, lz)
        self.b.ball((x, self.ground - centre, z), half, look, yaw=self.yaw, **rest)
