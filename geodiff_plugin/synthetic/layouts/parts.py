"""Furniture, vegetation, vehicles and clutter: things made of a few primitives, standing on a spot.

Hop: a place and a size -> primitives in a ``Builder``.
Paper: none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodiff_plugin.synthetic.builder import Builder, Look, rotation
from geodiff_plugin.synthetic.layouts.palettes import colour, object_look, palette, pick, surface_look
from geodiff_plugin.synthetic.scene import Material, Shape

__all__ = ["Spot", "camera_pose"]


def camera_pose(x: float, y: float, z: float, yaw: float, pitch: float, roll: float) -> np.ndarray:
    """``(4, 4)`` world-from-camera; angles in radians, positive pitch looks down."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.float64(yaw), np.float64(pitch), np.float64(roll))
    pose[:3, 3] = x, y, z
    return pose


@dataclass(frozen=True)
class Spot:
    """A place on the ground with a heading; local x to the right, z to the back, heights upwards from the ground.

    Attributes:
        b: where primitives go.
        x: world position; ``z`` likewise.
        z: see ``x``.
        yaw: heading in radians.
        ground: world y of the ground (y down).
    """

    b: Builder
    x: float
    z: float
    yaw: float = 0.0
    ground: float = 0.0

    def at(self, lx: float, lz: float) -> tuple[float, float]:
        """World x and z of a local position."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return self.x + c * lx + s * lz, self.z - s * lx + c * lz

    def moved(self, lx: float, lz: float, turn: float = 0.0, up: float = 0.0) -> Spot:
        """The spot at a local position, turned, its ground raised."""
        x, z = self.at(lx, lz)
        return Spot(self.b, x, z, self.yaw + turn, self.ground - up)

    def box(self, lx, lz, bottom, size, look, turn=0.0, **rest):
        """Box whose bottom is at a height."""
        x, z = self.at(lx, lz)
        self.b.box((x, self.ground - bottom - size[1] / 2, z), size, look, yaw=self.yaw + turn, **rest)

    def wedge(self, lx, lz, bottom, size, look, taper, **rest):
        """Box with a narrower top."""
        x, z = self.at(lx, lz)
        self.b.wedge(x, z, self.ground - bottom, size, look, taper, yaw=self.yaw, **rest)

    def column(self, lx, lz, bottom, radius, height, look, top=1.0):
        """Upright round column."""
        x, z = self.at(lx, lz)
        self.b.column(x, z, self.ground - bottom, radius, height, look, top=top, yaw=self.yaw)

    def ball(self, lx, lz, centre, half, look, **rest):
        """Ellipsoid with its centre at a height."""
        x, z = self.at(lx, lz)
        self.b.ball((x, self.ground - centre, z), half, look, yaw=self.yaw, **rest)

    # Furniture ---------------------------------------------------------------------------------

    def table(self, width: float, depth: float, height: float, look: Look, legs: str = "posts") -> None:
        """Table or desk; its front is at local -z."""
        rng = self.b.rng
        self.box(0, 0, height - 0.035, (width, 0.035, depth), look)
        metal = surface_look(rng, "plain", pick(rng, "grey", "dark", "wood"), gloss=0.2)
        if legs == "posts":
            for sx in (-1, 1):
                for sz in (-1, 1):
                    self.box(sx * (width / 2 - 0.06), sz * (depth / 2 - 0.06), 0, (0.05, height - 0.035, 0.05), metal)
        elif legs == "sides":
            for sx in (-1, 1):
                self.box(sx * (width / 2 - 0.02), 0, 0, (0.03, height - 0.035, depth * 0.9), look)
            if rng.random() < 0.6:
                front = Look("drawers", palette(rng, "wood"), (0.45, height), origin=(0.5, 0.5))
                self.box(pick(rng, -1, 1) * (width / 2 - 0.27), 0, 0.05, (0.42, height - 0.1, depth * 0.85), front)
        else:
            self.column(0, 0, 0.02, 0.05, height - 0.05, metal)
            self.column(0, 0, 0, 0.28, 0.03, metal)

    def monitor(self, lx: float, lz: float, bottom: float) -> None:
        """Screen on a foot, facing local -z."""
        rng = self.b.rng
        w = rng.uniform(0.42, 0.65)
        h = w * 0.6
        dark = surface_look(rng, "plain", pick(rng, "dark", "dark", "grey"), gloss=0.2)
        spot = self.moved(lx, lz, rng.normal(0, 0.2), bottom)
        spot.box(0, 0.02, 0, (0.22, 0.015, 0.18), dark)
        spot.box(0, 0.05, 0, (0.05, 0.25, 0.03), dark)
        on = rng.random() < 0.55
        face = Look(pick(rng, "screen_a", "screen_b"), palette(rng, "white" if on else "dark"), (w, h), gloss=0.4 if on else 0.8,
                    macro=0, emission=0.5 if on else 0.0, origin=(0.5, 0.5)) if on else Look(
            "plain", np.full((3, 3), 0.015), gloss=0.85, material=Material.GLOSSY, macro=0)
        spot.box(0, 0, 0.12, (w, h, 0.025), face)
        spot.box(0, 0.03, 0.13, (w * 0.98, h * 0.96, 0.03), dark)

    def desk_things(self, width: float, depth: float, height: float, count: int) -> None:
        """Monitor, keyboard, papers, cups, lamp and clutter on a desk."""
        rng = self.b.rng
        if rng.random() < 0.75:
            self.monitor(rng.uniform(-0.25, 0.25) * width, depth * 0.18, height)
            if rng.random() < 0.7:
                keys = Look("keyboard", palette(rng, pick(rng, "dark", "grey", "white")), (0.45, 0.16), origin=(0.5, 0.5))
                self.box(rng.uniform(-0.2, 0.2) * width, -depth * 0.25, height, (0.44, 0.025, 0.15), keys, turn=rng.normal(0, 0.15))
            if rng.random() < 0.4:
                self.monitor(pick(rng, -1, 1) * 0.36 * width, depth * 0.12, height)
        if rng.random() < 0.4:
            self.desk_lamp(pick(rng, -1, 1) * 0.4 * width, depth * 0.3, height)
        for _ in range(count):
            lx, lz = rng.uniform(-0.45, 0.45) * width, rng.uniform(-0.45, 0.45) * depth
            self.thing(lx, lz, height, rng.uniform(0.06, 0.28))

    def desk_lamp(self, lx: float, lz: float, bottom: float) -> None:
        """A foot, a thin stem and a conical shade."""
        look = surface_look(self.b.rng, "plain", pick(self.b.rng, "vivid", "grey", "dark"), gloss=0.5)
        self.column(lx, lz, bottom, 0.09, 0.02, look)
        self.column(lx, lz, bottom + 0.02, 0.01, 0.38, look)
        self.column(lx, lz, bottom + 0.36, 0.1, 0.14, look, top=0.45)

    def thing(self, lx: float, lz: float, bottom: float, size: float) -> None:
        """One small thing resting at a height."""
        rng = self.b.rng
        look = object_look(rng, size)
        kind = rng.random()
        turn = rng.uniform(-np.pi, np.pi)
        if kind < 0.32:
            dims = size * rng.uniform(0.35, 1.0, 3)
            self.box(lx, lz, bottom, dims, look, turn=turn)
            if rng.random() < 0.35:
                self.box(lx, lz, bottom + dims[1], dims * rng.uniform(0.5, 0.9), object_look(rng, size), turn=turn + rng.normal(0, 0.3))
        elif kind < 0.46:  # book or paper stack
            up = bottom
            for _ in range(int(rng.integers(1, 5))):
                thick = rng.uniform(0.008, 0.045)
                page = rng.random() < 0.35
                cover = Look(pick(rng, "document", "page"), palette(rng, "white"), (0.22, 0.3), origin=(0.5, 0.5)) if page else object_look(rng, 0.25, 0)
                self.box(lx + rng.normal(0, 0.01), lz + rng.normal(0, 0.01), up, (0.2, 0.003 if page else thick, 0.28), cover, turn=turn + rng.normal(0, 0.12))
                up += 0.003 if page else thick
        elif kind < 0.68:  # cup, can or bottle
            r = size * rng.uniform(0.2, 0.4)
            h = size * rng.uniform(0.6, 1.3)
            self.column(lx, lz, bottom, r, h, look, top=rng.uniform(0.75, 1.0))
            if rng.random() < 0.35:
                self.column(lx, lz, bottom + h, r * 0.75, h * 0.35, look, top=0.4)
                self.column(lx, lz, bottom + h * 1.35, r * 0.3, h * 0.2, look)
        elif kind < 0.82:
            half = size * rng.uniform(0.25, 0.5) * np.array([1, rng.uniform(0.6, 1.3), rng.uniform(0.7, 1.2)])
            self.ball(lx, lz, bottom + half[1], half, look)
        elif kind < 0.88:
            self.column(lx, lz, bottom, size * 0.4, size, look, top=rng.uniform(0, 0.4))
        else:  # tilted, leaning on something unseen
            dims = size * rng.uniform(0.25, 1.0, 3)
            x, z = self.at(lx, lz)
            self.b.box((x, self.ground - bottom - 0.42 * size, z), dims, look, yaw=turn, pitch=rng.uniform(-1.2, 1.2), roll=rng.uniform(-0.6, 0.6))

    def chair(self) -> None:
        """Chair facing local -z."""
        rng = self.b.rng
        seat = surface_look(rng, pick(rng, "fabric", "wood", "plain"), pick(rng, "any", "dark", "wood", "vivid"))
        leg = surface_look(rng, "plain", pick(rng, "grey", "dark", "wood"), gloss=0.3)
        if rng.random() < 0.5:
            self.box(0, 0, 0.42, (0.44, 0.06, 0.44), seat)
            self.box(0, 0.2, 0.48, (0.42, 0.45, 0.05), seat, pitch=-0.12)
            for sx in (-0.19, 0.19):
                for sz in (-0.19, 0.19):
                    self.box(sx, sz, 0, (0.035, 0.42, 0.035), leg)
        else:
            self.ball(0, 0, 0.45, (0.25, 0.06, 0.25), seat)
            self.ball(0, 0.22, 0.78, (0.22, 0.3, 0.05), seat)
            self.column(0, 0, 0.08, 0.03, 0.35, leg)
            for k in range(5):
                self.moved(0, 0, k * 1.2566).box(0, 0.15, 0.03, (0.04, 0.05, 0.3), leg)

    def shelf(self, width: float, height: float, depth: float = 0.3) -> None:
        """Book shelf, open towards local -z, its back at local +z."""
        rng = self.b.rng
        wood = surface_look(rng, pick(rng, "wood", "plain"), pick(rng, "wood", "white", "dark", "grey"))
        self.box(0, depth / 2 - 0.01, 0, (width, height, 0.02), wood)
        for sx in (-1, 1):
            self.box(sx * (width / 2 - 0.01), 0, 0, (0.02, height, depth), wood)
        rows = max(2, int(height / rng.uniform(0.32, 0.45)))
        step = (height - 0.03) / rows
        for k in range(rows + 1):
            self.box(0, 0, k * step, (width - 0.04, 0.022, depth), wood)
            if k == rows:
                break
            if rng.random() < 0.75:
                fill = rng.uniform(0.5, 1.0)
                books = Look(pick(rng, "books_a", "books_b"), palette(rng, pick(rng, "any", "vivid", "dark", "painted")), (0.9, step * 0.9))
                h = step * rng.uniform(0.6, 0.85)
                shift = pick(rng, -1, 1) * (1 - fill) * (width / 2 - 0.03)
                look = Look(books.layer, books.palette, (0.9, h), origin=(rng.random(), 0.5))
                self.box(shift, rng.uniform(-0.04, 0.02), k * step + 0.022, ((width - 0.05) * fill, h, depth * 0.65), look)
            else:
                for _ in range(int(rng.integers(0, 4))):
                    self.thing(rng.uniform(-0.4, 0.4) * width, -0.03, k * step + 0.022, step * 0.55)

    def cabinet(self, width: float, height: float, depth: float) -> None:
        """Closed cabinet or fridge with things on top."""
        rng = self.b.rng
        look = Look(pick(rng, "cabinet", "drawers"), palette(rng, pick(rng, "wood", "white", "grey", "painted")), (width / max(1, round(width / 0.9)), height),
                    gloss=rng.uniform(0, 0.3), origin=(0.5, 0.5))
        self.box(0, 0, 0, (width, height, depth), look)
        if height < 1.5:
            for _ in range(int(rng.integers(0, 4))):
                self.thing(rng.uniform(-0.4, 0.4) * width, rng.uniform(-0.2, 0.2) * depth, height, rng.uniform(0.1, 0.35))

    def sofa(self, width: float) -> None:
        """Sofa facing local -z."""
        rng = self.b.rng
        look = surface_look(rng, pick(rng, "fabric", "plain", "stripes"), pick(rng, "any", "grey", "dark", "painted"))
        self.box(0, 0, 0.08, (width, 0.34, 0.85), look)
        self.box(0, 0.33, 0.3, (width, 0.5, 0.2), look)
        for sx in (-1, 1):
            self.box(sx * (width / 2 - 0.09), 0, 0.1, (0.18, 0.5, 0.85), look)
        for _ in range(int(rng.integers(0, 4))):
            pillow = object_look(rng, 0.4, 0)
            self.ball(rng.uniform(-0.35, 0.35) * width, 0.15, 0.58, (0.22, 0.2, 0.08), pillow, pitch=-0.4)

    def plant(self, height: float) -> None:
        """Pot with leaves."""
        rng = self.b.rng
        r = height * 0.16
        self.column(0, 0, 0, r, height * 0.3, object_look(rng, 0.3, 0), top=1.25)
        leaf = surface_look(rng, "leaves", "leaf", (0.3, 0.5))
        for _ in range(int(rng.integers(4, 9))):
            a = rng.uniform(-np.pi, np.pi)
            self.ball(np.cos(a) * r * 0.9, np.sin(a) * r * 0.9, height * rng.uniform(0.4, 0.95), height * rng.uniform(0.06, 0.2, 3), leaf)

    # Outdoors ----------------------------------------------------------------------------------

    def tree(self, height: float, blobs: int) -> None:
        """Trunk and a crown of ellipsoids, or a conifer."""
        rng = self.b.rng
        bark = surface_look(rng, pick(rng, "soil", "rock"), "soil", (0.3, 0.5))
        leaf = surface_look(rng, pick(rng, "leaves", "hedge"), pick(rng, "leaf", "leaf", "dry"), (0.8, 1.6))
        crown = rng.uniform(0.25, 0.45)
        self.column(0, 0, 0, height * 0.025 + 0.05, height * 0.7, bark, top=0.6)
        if rng.random() < 0.15:
            for k in range(3):
                self.column(0, 0, height * (0.15 + 0.25 * k), height * (0.22 - 0.05 * k), height * 0.38, leaf, top=0.0)
            return
        for k in range(blobs):
            a, d = k * 2.4 + rng.normal(0, 0.4), height * 0.2 * np.sqrt((k + 0.5) / blobs)
            up = height * (crown + (1 - crown) * rng.uniform(0.15, 0.9))
            self.ball(np.cos(a) * d, np.sin(a) * d, up, height * rng.uniform(0.09, 0.2) * np.array([1, rng.uniform(0.7, 1.1), 1]), leaf)

    def car(self) -> None:
        """Car or van along local z."""
        rng = self.b.rng
        family = pick(rng, "grey", "dark", "white", "vivid", "grey")
        paint = Look("plain", palette(rng, family), gloss=rng.uniform(0.4, 0.75), macro=0.05)
        glass = Look("plain", np.full((3, 3), rng.uniform(0.01, 0.05)), gloss=0.9, macro=0, material=Material.GLOSSY)
        black = Look("plain", np.full((3, 3), 0.02), macro=0.1)
        length, width, height = rng.uniform(3.7, 4.8), rng.uniform(1.65, 1.85), rng.uniform(1.4, 1.6)
        if rng.random() < 0.18:
            length, height = rng.uniform(4.6, 6.0), rng.uniform(1.9, 2.6)
            self.wedge(0, 0, 0.3, (width, height - 0.3, length), paint, (0.08, 0.12))
            self.wedge(0, 0, height * 0.58, (width + 0.01, height * 0.28, length * 0.93), glass, (0.05, 0.04))
        else:
            self.wedge(0, 0, 0.24, (width, 0.58, length), paint, (0.06, 0.05))
            self.wedge(0, 0.1 * length * pick(rng, -1, 1), 0.8, (width * 0.93, height - 0.84, length * 0.58), glass, (0.22, 0.35))
            self.wedge(0, 0.1 * length * 0, height - 0.06, (width * 0.74, 0.05, length * 0.4), paint, (0.1, 0.05))
        red = Look("plain", np.array([[0.5, 0.02, 0.02]] * 3), emission=0.4, macro=0)
        plate = Look("document", palette(rng, "white"), (0.5, 0.2))
        for end in (-1, 1):
            for sx in (-1, 1):
                self.box(sx * (width / 2 - 0.2), end * length / 2 * 0.985, 0.58, (0.3, 0.14, 0.06), red if end < 0 else plate)
                x, z = self.at(sx * (width / 2 - 0.1), end * length * 0.31)
                self.b.add(Shape.FRUSTUM, (x, self.ground - 0.31, z), (0.31, 0.11, 0.31), black, yaw=self.yaw, roll=np.pi / 2)
            self.box(0, end * length / 2 * 0.99, 0.36, (0.5, 0.12, 0.04), plate)

    def person(self) -> None:
        """Standing figure."""
        rng = self.b.rng
        h = rng.uniform(1.5, 1.9)
        skin = Look("plain", np.array([colour(0.06, 0.4, rng.uniform(0.4, 0.9))] * 3))
        self.column(-0.09, 0, 0, 0.09, h * 0.48, object_look(rng, 0.5, 0), top=1.1)
        self.column(0.09, 0.08, 0, 0.09, h * 0.48, object_look(rng, 0.5, 0), top=1.1)
        self.ball(0, 0, h * 0.65, (0.23, h * 0.2, 0.15), object_look(rng, 0.5, 0))
        self.ball(0, 0, h * 0.93, (0.09, 0.12, 0.1), skin)

    def pole(self, height: float, arm: float = 0.0, sign: bool = False) -> None:
        """Lamp post, traffic sign or utility pole."""
        rng = self.b.rng
        look = surface_look(rng, "concrete", pick(rng, "grey", "dark", "wood"))
        self.column(0, 0, 0, rng.uniform(0.04, 0.14), height, look, top=0.7)
        if arm:
            self.box(arm / 2, 0, height - 0.1, (abs(arm), 0.07, 0.07), look)
            self.box(arm, 0, height - 0.16, (0.6, 0.1, 0.22), look)
        if sign:
            face = Look(pick(rng, "poster_a", "poster_b", "label_a", "plain"), palette(rng, "vivid"), (0.7, 0.7), origin=(0.5, 0.5))
            if rng.random() < 0.5:
                self.box(0, -0.08, height - 0.7, (0.65, 0.65, 0.02), face)
            else:
                x, z = self.at(0, -0.1)
                self.b.add(Shape.FRUSTUM, (x, self.ground - height + 0.35, z), (0.33, 0.01, 0.33), face, yaw=self.yaw, pitch=np.pi / 2)

    def rock(self, size: float) -> None:
        """Boulder: an ellipsoid or a tilted block, partly in the ground."""
        rng = self.b.rng
        look = surface_look(rng, pick(rng, "rock", "concrete", "fbm"), pick(rng, "stone", "grey"), (0.4, 1.0), macro=0.6)
        x, z = self.at(0, 0)
        half = size * rng.uniform(0.35, 0.6, 3)
        turn = dict(yaw=rng.uniform(-3, 3), pitch=rng.normal(0, 0.3), roll=rng.normal(0, 0.3))
        if rng.random() < 0.6:
            self.b.ball((x, self.ground - half[1] * 0.4, z), half, look, **turn)
        else:
            self.b.add(Shape.TAPER, (x, self.ground - half[1] * 0.5, z), half, look, taper=tuple(rng.uniform(0.1, 0.6, 2)), **turn)
