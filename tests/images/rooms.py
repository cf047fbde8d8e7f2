"""Ordinary rooms seen by an OAK-D, and what a guided call makes of them."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, Rig, enable_geometry_guidance, load_prior, read_calibration
from geodiff_plugin.formats.clouds import flying_points
from geodiff_plugin.jobs.report import single_map

#: One calibration for all pairs of its folder, as the author of these images wrote it.
CALIBRATION = "stereodemo_calibration.json"
Clicks = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class Room:
    """A pair ``NAME_left.png``, ``NAME_right.png``, and between which pixels of it something is measured."""

    name: str
    title: str
    thing: str
    clicks: Clicks


ROOMS = (
    Room("cycles", "a hallway", "scooter", ((232, 192), (232, 318))),
    Room("toy", "a play mat", "toy bench", ((286, 288), (414, 288))),
    Room("desk", "a desk", "drawers", ((250, 346), (329, 336))),
    Room("corridor", "a landing", "door", ((228, 260), (318, 260))),
    Room("living_room", "a living room", "table", ((270, 330), (420, 330))),
    Room("donkey_toy", "a rocking toy", "runner", ((140, 310), (395, 340))),
)


@dataclass(frozen=True)
class RoomResult:
    """A pair without the bands that rectification left, and the output of the default with the bundled prior.

    ``left``, ``right`` are ``(H, W, 3)`` uint8; ``depth_m`` and ``confidence`` ``(H, W)``; ``prior`` is the
    relative map ``(H, W)`` of the plain call; ``K`` ``(3, 3)`` is in their pixels.
    """

    left: np.ndarray
    right: np.ndarray
    prior: np.ndarray
    depth_m: np.ndarray
    confidence: np.ndarray
    K: np.ndarray
    baseline_m: float
    status: str
    sigma_m: np.ndarray | None = None  # standard deviation of the depth

    @property
    def solid(self) -> np.ndarray:
        """``(H, W)``: pixels whose depth is on a surface and not between two."""
        return ~flying_points(self.depth_m)


def room_named(name: str) -> Room:
    """``KeyError`` for a name that ``ROOMS`` does not have."""
    return {room.name: room for room in ROOMS}[name]


@lru_cache
def prior() -> Any:
    """The bundled prior, with guidance."""
    return enable_geometry_guidance(load_prior("bundled"))


def call(left: np.ndarray, guidance: GeometryGuidance | None) -> Any:
    """The output for an image ``(H, W, 3)`` uint8, by the bundled prior with seed 0."""
    generator = torch.Generator().manual_seed(0)
    return prior()(Image.fromarray(left), guidance=guidance, generator=generator)


def guidance_of(right: np.ndarray, rig: Rig) -> GeometryGuidance:
    """The guidance of a right image ``(H, W, 3)`` uint8 and a rig in pixels of both images."""
    return GeometryGuidance(Image.fromarray(right), (rig.K_left, rig.K_right), rig.E)


def read_room(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray, Rig]:
    """Both images and their rig, cut to the rectangle that the cameras filled."""
    reported, rig = json.loads((folder / CALIBRATION).read_text()), read_calibration(folder / CALIBRATION)
    x0, y0, x1, y1 = reported["left_image_rect_normalized"]
    columns = slice(round(x0 * reported["width"]), round(x1 * reported["width"]))
    rows = slice(round(y0 * reported["height"]), round(y1 * reported["height"]))
    left, right = (
        np.asarray(Image.open(folder / f"{name}_{side}.png").convert("RGB"))[rows, columns]
        for side in ("left", "right")
    )
    box = columns.start, rows.start, columns.stop, rows.stop
    return left, right, replace(rig, left=rig.left.cropped(box), right=rig.right.cropped(box))


def solve(folder: Path, room: Room) -> RoomResult:
    """A plain and a guided call on a pair of ``folder``, seed 0."""
    left, right, rig = read_room(folder, room.name)
    out, plain = call(left, guidance_of(right, rig)), call(left, None)
    return RoomResult(
        left=left,
        right=right,
        prior=single_map(plain.prediction),
        depth_m=single_map(out.prediction),
        confidence=single_map(out.confidence),
        K=rig.K_left,
        baseline_m=float(np.linalg.norm(rig.E[:3, 3])),
        status=out.verdict.status,
        sigma_m=single_map(out.sigma),
    )
