"""The animation of the README: a stereo pair, its depth, an orbit around the surface, a measured distance."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from geodiff_plugin.app.results import point_name
from geodiff_plugin.plotting import colour_depth, depth_range, write_depth_video
from geodiff_plugin.result.readings import Reading, distance_m, metres, read_pixel
from tests.images.orbit import BACKGROUND, look_from, surface_of
from tests.images.rooms import Room, RoomResult

FPS = 12.0
#: Seconds of each scene, ten in all.
PAIR_S = 2.0
WIPE_S = 1.5
DEPTH_S = 0.7
ORBIT_S = 3.6
MEASURE_S = 2.2
#: Frequency of switching between left and right image.
WIGGLES_HZ = 3.0
#: Amplitude of the camera's orbit to either side, and downwards, degrees.
SWING_DEG = 24.0
DOWN_DEG = 9.0
#: Maximum backwards motion, as a fraction of the distance to the centre of the scene.
BACK = 0.12
#: Width of the animation, and height of the caption below it, pixels.
WIDTH_PX = 480
CAPTION_PX = 36
#: Colours of measured points and of the boxes behind their names.
MARK, BOX = "#c2410c", "#141414"


def _captioned(image: np.ndarray, text: str) -> Image.Image:
    """Return the image above a caption."""
    height = round(WIDTH_PX * image.shape[0] / image.shape[1])
    sheet = Image.new("RGB", (WIDTH_PX, height + CAPTION_PX), BACKGROUND)
    sheet.paste(Image.fromarray(image).resize((WIDTH_PX, height), Image.Resampling.LANCZOS))
    font = ImageFont.load_default(size=17)
    ImageDraw.Draw(sheet).text((WIDTH_PX / 2, height + CAPTION_PX / 2), text, "white", font, anchor="mm")
    return sheet


def _frames(seconds: float) -> range:
    return range(round(seconds * FPS))


def _pair(result: RoomResult) -> Iterator[Image.Image]:
    text = f"stereo pair, baseline {1000 * result.baseline_m:.0f} mm"
    for k in _frames(PAIR_S):
        yield _captioned(result.right if int(k / FPS * 2 * WIGGLES_HZ) % 2 else result.left, text)


def _wipe(result: RoomResult) -> Iterator[Image.Image]:
    """Reveal the depth from the left."""
    coloured, width = colour_depth(result.depth_m), result.left.shape[1]
    near, far = depth_range(result.depth_m)
    text = f"metric depth, {near:.1f} m to {far:.1f} m, without training"
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
    """Orbit around the surface, starting and ending at the left view."""
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
        yield _captioned(view, "textured surface")


def _marked(image: np.ndarray, pixels: Sequence[tuple[int, int]], readings: Sequence[Reading]) -> np.ndarray:
    """Draw these pixels and the distance of every two of them into a copy of an image ``(h, w, 3)`` uint8."""
    sheet = Image.fromarray(image)
    draw = ImageDraw.Draw(sheet)
    unit = max(sheet.size) / 100
    radius, font = max(3.0, 0.8 * unit), ImageFont.load_default(size=max(11.0, 2.8 * unit))

    def label(x: float, y: float, text: str) -> None:
        left, top, right, bottom = draw.textbbox((x, y), text, font=font, anchor="mm")
        draw.rounded_rectangle((left - 3, top - 2, right + 3, bottom + 2), radius=3, fill=BOX)
        draw.text((x, y), text, font=font, fill="white", anchor="mm")

    segments = list(zip(pixels[::2], pixels[1::2], readings[::2], readings[1::2], strict=False))
    for a, b, *_ in segments:
        draw.line([a, b], fill="black", width=max(3, round(0.7 * unit)))
        draw.line([a, b], fill="white", width=max(1, round(0.3 * unit)))
    for number, (x, y) in enumerate(pixels):
        box = (x - radius, y - radius, x + radius, y + radius)
        draw.ellipse(box, fill=MARK, outline="white", width=max(1, round(0.25 * unit)))
        label(x, y - 2.6 * radius, point_name(number))
    for a, b, first, second in segments:
        middle = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 2.2 * radius
        label(*middle, metres(distance_m(first, second)[0]))
    return np.asarray(sheet)


def readings_of(result: RoomResult, room: Room) -> list[Reading]:
    """Return the readings of the maps at both clicks of a room."""
    maps = result.confidence, result.sigma_m
    return [read_pixel(result.depth_m, result.K, pixel, *maps) for pixel in room.clicks]


def measured(result: RoomResult, room: Room) -> tuple[np.ndarray, str]:
    """Return the image with both clicks, and ``table: 0.54 ± 0.02 m``."""
    readings = readings_of(result, room)
    return _marked(
        result.left, list(room.clicks), readings
    ), f"{room.thing}: {metres(*distance_m(*readings))}"


def _measure(result: RoomResult, room: Room) -> Iterator[Image.Image]:
    readings = readings_of(result, room)
    image, text = measured(result, room)
    count = len(_frames(MEASURE_S))
    for k in range(count):
        if k < count // 5:
            yield _captioned(_marked(result.left, list(room.clicks[:1]), readings[:1]), "click two points")
        else:
            yield _captioned(image, text)


def write_moving(result: RoomResult, room: Room, path: Path) -> None:
    """Write the animation of a room, ``.webp`` or ``.gif``."""
    scenes = (_pair(result), _wipe(result), _orbit(result), _measure(result, room))
    write_depth_video(path, (frame for scene in scenes for frame in scene), FPS)
