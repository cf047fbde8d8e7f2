"""The moving picture of README: two photographs, the depth, a turn around it, and a measured distance."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from geodiff_plugin.app.results import Reading, distance_m, marked, metres, read_pixel
from geodiff_plugin.plotting import colour_depth, depth_range, write_depth_video
from tests.pictures.orbit import BACKGROUND, look_from, surface_of
from tests.pictures.rooms import Room, RoomResult

FPS = 12.0
#: Seconds of each scene, ten in all.
PHOTOGRAPHS_S = 2.0
WIPE_S = 1.5
DEPTH_S = 0.7
ORBIT_S = 3.6
MEASURE_S = 2.2
#: Left and right take turns so many times a second.
WIGGLES_HZ = 3.0
#: The camera swings so many degrees to either side, and looks down by so many.
SWING_DEG = 24.0
DOWN_DEG = 9.0
#: It steps back by this share of the distance to the middle of the scene.
BACK = 0.12
#: Width of the moving picture, and height of the line of text below it, pixels.
WIDTH_PX = 480
CAPTION_PX = 36


def _captioned(picture: np.ndarray, text: str) -> Image.Image:
    """The picture above a line of text on the colour of the background."""
    height = round(WIDTH_PX * picture.shape[0] / picture.shape[1])
    sheet = Image.new("RGB", (WIDTH_PX, height + CAPTION_PX), BACKGROUND)
    sheet.paste(Image.fromarray(picture).resize((WIDTH_PX, height), Image.Resampling.LANCZOS))
    font = ImageFont.load_default(size=17)
    ImageDraw.Draw(sheet).text((WIDTH_PX / 2, height + CAPTION_PX / 2), text, "white", font, anchor="mm")
    return sheet


def _frames(seconds: float) -> range:
    return range(round(seconds * FPS))


def _photographs(result: RoomResult) -> Iterator[Image.Image]:
    text = f"two photographs, {1000 * result.baseline_m:.0f} mm apart"
    for k in _frames(PHOTOGRAPHS_S):
        yield _captioned(result.right if int(k / FPS * 2 * WIGGLES_HZ) % 2 else result.left, text)


def _wipe(result: RoomResult) -> Iterator[Image.Image]:
    """The depth comes in from the left."""
    coloured, width = colour_depth(result.depth_m), result.left.shape[1]
    near, far = depth_range(result.depth_m)
    text = f"depth in metres, {near:.1f} m to {far:.1f} m, without any training"
    count = len(_frames(WIPE_S))
    for k in range(count):
        column = round(width * (1 - math.cos(math.pi * (k + 1) / count)) / 2)
        frame = result.left.copy()
        frame[:, :column] = coloured[:, :column]
        frame[:, max(0, column - 2) : column] = 255
        yield _captioned(frame, text)
    for _ in _frames(DEPTH_S):
        yield _captioned(coloured, text)


def _orbit(result: RoomResult) -> Iterator[Image.Image]:
    """From the photograph's own view to either side and back."""
    surface = surface_of(result.depth_m, result.left, result.K, result.solid)
    count = len(_frames(ORBIT_S))
    for k in range(count):
        phase = 2 * math.pi * k / count
        lifted = (1 - math.cos(phase)) / 2
        view = look_from(
            surface,
            result.K,
            result.depth_m.shape,
            yaw=SWING_DEG * math.sin(phase),
            pitch=DOWN_DEG * lifted,
            back=BACK * lifted,
        )
        yield _captioned(view, "as a surface")


def readings_of(result: RoomResult, room: Room) -> list[Reading]:
    """What the maps say at both clicks of a room."""
    return [read_pixel(result.depth_m, result.K, pixel, result.confidence) for pixel in room.clicks]


def measured(result: RoomResult, room: Room) -> tuple[np.ndarray, str]:
    """The photograph with both clicks, and ``table: 0.54 ± 0.02 m``."""
    readings = readings_of(result, room)
    return marked(result.left, list(room.clicks), readings), f"{room.thing}: {metres(*distance_m(*readings))}"


def _measure(result: RoomResult, room: Room) -> Iterator[Image.Image]:
    readings = readings_of(result, room)
    picture, text = measured(result, room)
    count = len(_frames(MEASURE_S))
    for k in range(count):
        if k < count // 5:
            yield _captioned(marked(result.left, list(room.clicks[:1]), readings[:1]), "click two points")
        else:
            yield _captioned(picture, text)


def write_moving(result: RoomResult, room: Room, path: Path) -> None:
    """Write the moving picture of a room, ``.webp`` or ``.gif``."""
    scenes = (_photographs(result), _wipe(result), _orbit(result), _measure(result, room))
    write_depth_video(path, (frame for scene in scenes for frame in scene), FPS)
