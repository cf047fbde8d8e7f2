"""``geodiff video``: the results of a sequence as one video.

Data flow: folders of ``geodiff depth``, or depth maps -> a video.
Paper: none.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats import check_file
from geodiff_plugin.formats.video import VideoReader, both_halves
from geodiff_plugin.plotting.video import depth_frames, write_depth_video

__all__ = ["run_video"]


def _map(path: Path) -> np.ndarray:
    file = check_file(
        path / "depth.npy" if os.path.isdir(path) else path, "FRAME", "a folder of geodiff depth or a .npy"
    )
    try:
        depth_m = np.load(file, allow_pickle=False)
    except (ValueError, EOFError) as error:
        bad_value("FRAME", "a depth map that numpy.save wrote", f"{file} ({error})")
    known = isinstance(depth_m, np.ndarray) and depth_m.ndim == 2 and depth_m.dtype.kind == "f"
    if not (known and depth_m.size):
        bad_value("FRAME", "a depth map (H, W) of floats in metres", f"{file}")
    return depth_m


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
        return Image.open(check_file(folder / "undistorted.png", f"the undistorted left image of {folder}"))
    if frame is not None:
        with VideoReader(left, f"the left video of {folder}") as video:
            image = video.read(frame)
        view = both_halves(image)[0] if arguments["right"] is None else image
        return Image.fromarray(np.rint(view * 255).astype(np.uint8))
    return ImageOps.exif_transpose(Image.open(check_file(left, f"the left image of {folder}")))


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
    depths_m = [_map(path) for path in frames]
    pictures = depth_frames(
        depths_m, [_photograph(path) for path in frames] if photographs else None, near, far
    )
    write_depth_video(out, pictures, fps)
    print(f"{len(pictures)} frames, {len(pictures) / fps:.1f} s -> {out}")
