"""Video of a sequence of depth maps, in one range of colours with a legend.

Data flow: depth maps in metres -> frames, one at a time -> GIF, WebP or MP4.
Paper: none.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from geodiff_plugin._checks import InputError, InputFileError, bad_value, check_number
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.plotting.figures import depth_figure, depth_range

__all__ = ["SUFFIXES", "check_video", "depth_frames", "write_depth_video"]

SUFFIXES = (".mp4", ".webp", ".gif")
#: Of a frame with its photograph, pixels.
MOST_WIDTH = 960
#: The range of colours is taken from so many pixels of all maps.
MOST_FOR_RANGE = 1 << 24


def depth_frames(
    depths_m: Sequence[np.ndarray],
    photographs: Iterable[Image.Image] | None = None,
    near: float | None = None,
    far: float | None = None,
    unit: str | None = "m",
) -> Iterator[Image.Image]:
    """One picture a depth map, all of one size and in the same colours; each is drawn when it is asked for.

    Args:
        depths_m: ``(H, W)`` metres each, of one shape.
        photographs: one a map, shown on its left; each is taken when its picture is drawn.
        near: depth of the last colour, metres; ``None`` takes the 2nd percentile over all maps.
        far: depth of the first colour, metres; ``None`` takes the 98th.
        unit: of all maps, ``"m"``, or ``None`` for depths without one, as the legend then says.

    Raises:
        ValueError: no maps, or maps of several shapes; at the last picture: another number of photographs.
    """
    shapes, samples = set(), []
    for depth_m in depths_m:  # one pass: a map may be read from its file whenever it is asked for
        every = max(1, math.ceil(len(depths_m) * depth_m.size / MOST_FOR_RANGE))
        shapes.add(depth_m.shape)
        samples.append(np.asarray(depth_m).reshape(-1)[::every].copy())
    if len(shapes) != 1:
        bad_value("depths_m", "at least one map, all of one shape", sorted(shapes) or "none")
    near, far = depth_range(np.concatenate(samples)[None], near=near, far=far)
    figures = (depth_figure(depth_m, near=near, far=far, unit=unit) for depth_m in depths_m)
    if photographs is None:
        return figures
    pairs = zip(photographs, figures, strict=True)
    (shape,) = shapes
    return (_beside(photograph, figure, shape) for photograph, figure in pairs)


def _beside(photograph: Image.Image, figure: Image.Image, shape: tuple[int, ...]) -> Image.Image:
    """A photograph as large as the map in a figure, on its left."""
    width = round(shape[1] * figure.height / shape[0])
    joined = Image.new("RGB", (width + figure.width, figure.height))
    joined.paste(photograph.convert("RGB").resize((width, figure.height)), (0, 0))
    joined.paste(figure, (width, 0))
    factor = min(1.0, MOST_WIDTH / joined.width)
    return joined.resize(
        (round(joined.width * factor), round(joined.height * factor)), Image.Resampling.LANCZOS
    )


def _unwritable(path: Path, reason: object) -> InputFileError:
    return InputFileError(f"the video must be a file that can be written; got {path} ({reason}).")


def _write_mp4(
    path: Path, target: Path, size: tuple[int, int], frames: Iterable[Image.Image], fps: float
) -> None:
    # H.264 and its like want even sides.
    width, height = (side // 2 * 2 for side in size)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (width, height))
    if not writer.isOpened():
        raise _unwritable(target, "OpenCV cannot open it")
    try:
        for frame in frames:
            writer.write(np.ascontiguousarray(np.asarray(frame.convert("RGB"))[:height, :width, ::-1]))
    finally:  # an open file can be neither renamed nor removed on Windows
        writer.release()


def check_video(path: str | os.PathLike[str], fps: float) -> None:
    """Refuse a video that could not be written, before its frames are drawn.

    Args:
        path: the video to appear.
        fps: frames a second, in [0.1, 120].

    Raises:
        ValueError: another ending than those of ``SUFFIXES``, a folder, no folder to write into, or ``fps``.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        bad_value("the video", f"a file that ends in {', '.join(SUFFIXES)}", path.name)
    if os.path.isdir(path):
        bad_value("the video", "a file", f"the folder {path}", "Name a file inside of it.")
    if not os.path.isdir(path.parent):
        bad_value("the video", "in an existing folder", path, f"Make the folder {path.parent} first.")
    check_number(fps, "fps", 0.1, 120)


def write_depth_video(path: str | os.PathLike[str], frames: Iterable[Image.Image], fps: float = 10.0) -> None:
    """Write frames as a video, of the kind that the file's name ends in; whole or not at all.

    An MP4 is written frame by frame; all frames of the others are in memory, as Pillow wants them.

    Args:
        path: ends in .mp4 (OpenCV writes it), .webp or .gif.
        frames: of one size.
        fps: frames a second, in [0.1, 120].

    Raises:
        ValueError: as ``check_video``; no frames.
        OSError: the file cannot be written.
    """
    path = Path(path)
    check_video(path, fps)
    rest = iter(frames)
    first = next(rest, None)
    if first is None:
        bad_value("frames", "at least one picture", "none")
    kind = path.suffix.lower()
    try:
        with atomic_path(path) as temporary:
            if kind == ".mp4":
                _write_mp4(temporary, path, first.size, itertools.chain([first], rest), fps)
                return
            more: dict[str, Any] = {"quality": 85} if kind == ".webp" else {}
            more |= {"duration": round(1000 / fps), "loop": 0}
            with open(temporary, "wb") as file:  # Pillow leaves its own open file behind after a Ctrl-C
                first.save(file, kind[1:], save_all=True, append_images=rest, **more)
    except InputError:  # of a photograph, or of the file, which it names
        raise
    except OSError as error:
        raise _unwritable(path, error.strerror or error) from error
