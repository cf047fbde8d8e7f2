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

    def __init__(self, frames: Sequence[Path]) -> None:
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, number: Any) -> Any:
        return _map(self._frames[number])


def _report(folder: Path) -> dict[str, Any]:
    """The report of a result; empty where there is none, or none that can be read."""
    try:
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}


def _unit(frames: Sequence[Path]) -> str | None:
    """``"m"``, or ``None`` where no map has a unit; one range of colours cannot show both kinds."""
    in_metres = [_report(_file(path).parent).get("unit", "m") is not None for path in frames]
    if any(in_metres) and not all(in_metres):
        with_unit, without = frames[in_metres.index(True)], frames[in_metres.index(False)]
        expected = "all in metres, or all without a unit"
        bad_value("FRAME", expected, f"{with_unit} with and {without} without", "Make a video of each kind.")
    return "m" if all(in_metres) else None


def _photograph(folder: Path) -> Image.Image:
    """The left image that the depth of a result belongs to, where it lay when the result was made."""
    expected = "the report of a folder of geodiff depth"
    path, report = check_file(folder / "report.json", "--photographs", expected), _report(folder)
    try:
        left, right = Path(report["arguments"]["left"]), report["arguments"]["right"]
        frame, undistorted = report.get("pair", {}).get("frame"), report["undistorted"]
    except (KeyError, TypeError, AttributeError):
        bad_value("--photographs", expected, f"{path}, which is damaged")
    if frame is None or undistorted:
        image, _ = read_image(
            folder / "undistorted.png" if undistorted else left, f"the left image of {folder}"
        )
    else:
        with VideoReader(left, f"the left video of {folder}") as video:
            image = video.read(frame)
        image = both_halves(image)[0] if right is None else image
    return Image.fromarray(np.rint(image * 255).astype(np.uint8))


def run_video(
    frames: Sequence[Path], out: Path, fps: float, near: float | None, far: float | None, photographs: bool
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
