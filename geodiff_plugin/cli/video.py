"""``geodiff video``: the results of a sequence as one video."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats import check_file, read_image
from geodiff_plugin.formats.files import read_npy
from geodiff_plugin.formats.video import VideoReader, both_halves
from geodiff_plugin.plotting import check_video, depth_frames, write_depth_video

__all__ = ["run_video"]


def _file(path: Path) -> Path:
    return path / "depth.npy" if os.path.isdir(path) else path


def _map(path: Path) -> np.ndarray:
    file = check_file(_file(path), "FRAME", "a folder of geodiff depth or a .npy")
    expected = "a depth map (H, W) of floats in metres"
    depth_m = read_npy(file, "FRAME", expected)
    if depth_m.ndim != 2 or depth_m.dtype.kind != "f" or not depth_m.size:
        bad_value("FRAME", expected, f"{file}")
    return depth_m


class _Maps(Sequence[np.ndarray]):
    """The maps of all frames, read whenever they are asked for: those of a long video exceed the memory."""

    def __init__(self, frames: list[Path]) -> None:
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, number: Any) -> Any:
        return _map(self._frames[number])


def _has_unit(path: Path) -> bool:
    """Whether a map is in metres, as maps are unless the report beside them says that they have no unit."""
    try:
        report = json.loads((_file(path).parent / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):  # no report, or one that says nothing
        return True
    return not isinstance(report, dict) or report.get("unit", "m") is not None


def _unit(frames: list[Path]) -> str | None:
    """``"m"``, or ``None`` where no map has a unit; one range of colours cannot show both kinds."""
    in_metres = [_has_unit(path) for path in frames]
    if any(in_metres) and not all(in_metres):
        with_unit, without = frames[in_metres.index(True)], frames[in_metres.index(False)]
        expected = "all in metres, or all without a unit"
        bad_value("FRAME", expected, f"{with_unit} with and {without} without", "Make a video of each kind.")
    return "m" if all(in_metres) else None


def _picture(image_01: np.ndarray) -> Image.Image:
    return Image.fromarray(np.rint(image_01 * 255).astype(np.uint8))


def _photograph(folder: Path) -> Image.Image:
    """The left image that the depth of a result belongs to, where it lay when the result was made."""
    report = check_file(folder / "report.json", "--photographs", "the report of a folder of geodiff depth")
    try:
        result = json.loads(report.read_text(encoding="utf-8"))
        arguments, frame = result["arguments"], result.get("pair", {}).get("frame")
        undistorted = result["undistorted"]
        left = Path(arguments["left"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        bad_value("--photographs", "the report of a folder of geodiff depth", f"{report}, which is damaged")
    if undistorted:
        return _picture(read_image(folder / "undistorted.png", f"the undistorted left image of {folder}")[0])
    if frame is not None:
        with VideoReader(left, f"the left video of {folder}") as video:
            image = video.read(frame)
        view = both_halves(image)[0] if arguments["right"] is None else image
        return _picture(view)
    return _picture(read_image(left, f"the left image of {folder}")[0])


def run_video(
    frames: list[Path], out: Path, fps: float, near: float | None, far: float | None, photographs: bool
) -> None:
    """Write the video and say what is in it.

    Args:
        frames: folders of ``geodiff depth``, or ``.npy`` maps of one size, in order.
        out: the video.
        fps: frames a second.
        near: depth of the last colour, metres, or ``None``.
        far: depth of the first colour, metres, or ``None``.
        photographs: show the left images beside the depth.
    """
    check_video(out, fps)
    depths_m = _Maps(frames)
    shapes = [depth_m.shape for depth_m in depths_m]
    for path, shape in zip(frames, shapes, strict=True):
        if shape != shapes[0]:
            (height, width), (first_height, first_width) = shape, shapes[0]
            expected = f"all of one shape, {first_width}x{first_height} pixels as {frames[0]}"
            bad_value("FRAME", expected, f"{path} of {width}x{height}", "Make a video of each size.")
    unit = _unit(frames)
    lefts = map(_photograph, frames) if photographs else None
    write_depth_video(out, depth_frames(depths_m, lefts, near, far, unit), fps)
    print(f"{len(frames)} frames, {len(frames) / fps:.1f} s -> {out}")
