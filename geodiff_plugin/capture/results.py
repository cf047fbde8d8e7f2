"""What a run leaves behind its frames: depth agreed between them, one cloud, a contact sheet, a video."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin.capture.agreement import DepthFrame, agreed
from geodiff_plugin.capture.capture import Capture
from geodiff_plugin.capture.fusion import fuse, write_colmap_maps, write_mesh, write_normal_ply
from geodiff_plugin.capture.neighbours import choose_neighbours
from geodiff_plugin.formats.clouds import write_glb
from geodiff_plugin.formats.depth import write_depth_mm, write_depth_npy
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.plotting import depth_figure, depth_frames, grid, write_depth_video

__all__ = ["ALONE", "write_agreement", "write_results"]

#: Depth and confidence of a frame by its own run, which agreement starts from whenever it is made anew.
ALONE = ("depth_alone.npy", "confidence_alone.npy")
#: Frames that a frame is checked against, frames on the contact sheet, and points of the GLB, at most.
OTHERS, ON_SHEET, GLB_POINTS = 6, 24, 400_000


def write_agreement(capture: Capture, out: Path, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Check every frame against those that see the same, and write what they agree on into its folder.

    Args:
        capture: with its poses.
        out: of the run.
        names: of the finished frames.

    Returns:
        By frame: how many others it was checked against, the share of its pixels that another frame sees and
        confirms, and that another one sees and none confirms.
    """
    solved, number = capture.solve(), {name: i for i, name in enumerate(capture.names)}
    there, shares = {number[name] for name in names}, {}
    load = lru_cache(maxsize=2 * OTHERS)(lambda name: _alone(capture, out, name))
    for name in names:
        others = [load(capture.names[i]) for i in choose_neighbours(solved, number[name], OTHERS, there)]
        frame = agreed(load(name), others)
        assert frame.confirmed is not None and frame.asked is not None
        write_depth_npy(out / name / "depth.npy", frame.depth)
        write_depth_mm(out / name / "depth_mm.png", frame.depth)
        depth_figure(frame.depth, unit=capture.unit).save(out / name / "depth.png")
        _save(out / name / "confidence.npy", frame.confidence)
        _save(out / name / "confirmed.npy", frame.confirmed)
        _save(out / name / "asked.npy", frame.asked)
        shares[name] = {
            "checked_against": len(others),
            "confirmed": round(float((frame.confirmed > 0).mean()), 4),
            "unconfirmed": round(float(((frame.asked > 0) & (frame.confirmed == 0)).mean()), 4),
        }
    return shares


def _save(path: Path, values: np.ndarray) -> None:
    with atomic_path(path) as temporary:
        np.save(temporary, values)


def _alone(capture: Capture, out: Path, name: str) -> DepthFrame:
    return _frame(capture, name, *(np.load(out / name / file) for file in ALONE))


def _frame(capture: Capture, name: str, depth: np.ndarray, confidence: np.ndarray, *of: Any) -> DepthFrame:
    solved, i = capture.solve(), capture.names.index(name)
    return DepthFrame(name, depth, confidence, solved.K[i], solved.E[i], *of)


class _Agreed(Sequence[DepthFrame]):
    """The agreed frames, read whenever they are asked for: those of a long capture exceed the memory."""

    def __init__(self, capture: Capture, out: Path, names: Sequence[str]) -> None:
        self._capture, self._out, self._names = capture, out, list(names)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, number: Any) -> Any:
        name = self._names[number]
        files = ("depth", "confidence", "confirmed", "asked")
        return _frame(self._capture, name, *(np.load(self._out / name / f"{file}.npy") for file in files))


class _Depths(Sequence[np.ndarray]):
    def __init__(self, out: Path, names: Sequence[str]) -> None:
        self._paths = [out / name / "depth.npy" for name in names]

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, number: Any) -> Any:
        return np.load(self._paths[number])


def write_results(capture: Capture, out: Path, names: Sequence[str], export: Sequence[str]) -> dict[str, Any]:
    """Write ``cloud.ply``, ``cloud.glb``, ``sheet.jpg``, ``depth.webp``, and what ``export`` asks for.

    Args:
        capture: with its poses.
        out: of the run, where ``write_agreement`` has been.
        names: of the finished frames.
        export: ``"colmap"`` (a dense workspace), ``"mesh"`` (TSDF, extra ``mesh``).

    Returns:
        Counts for the report.
    """
    frames = _Agreed(capture, out, names)
    cloud, normals = fuse(frames, capture.image)
    write_normal_ply(out / "cloud.ply", cloud, normals, capture.unit)
    cameras = [(f.K, f.E, f.depth.shape[::-1]) for f in frames]
    write_glb(out / "cloud.glb", cloud.thinned(GLB_POINTS), cameras)
    if "mesh" in export:
        write_mesh(out / "mesh.ply", frames, capture.image)
    if "colmap" in export:
        files = {name: f"{name}.png" for name in names}
        write_colmap_maps(out / "colmap", frames, files, cloud, capture.image)
    _sheet(capture, out, names)
    _video(capture, out, names)
    return {"cloud_points": len(cloud.points_m)}


def _picture(image: np.ndarray) -> Image.Image:
    return Image.fromarray(np.rint(image * 255).astype(np.uint8))


def _sheet(capture: Capture, out: Path, names: Sequence[str]) -> None:
    shown = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, ON_SHEET).astype(int))]
    depths, cells, titles = _Depths(out, shown), [], []
    for name, figure in zip(shown, _figures(depths, capture.unit), strict=True):
        cells += [_picture(capture.image(name)), figure]
        titles += [name, "depth"]
    with atomic_path(out / "sheet.jpg") as temporary:
        grid(cells, titles, columns=min(4, len(cells)), cell_width=360).save(temporary, quality=88)


def _figures(depths: _Depths, unit: str | None) -> Iterator[Image.Image]:
    if len({depth.shape for depth in depths}) == 1:
        yield from depth_frames(depths, unit=unit)
    else:
        yield from (depth_figure(depth, unit=unit) for depth in depths)


def _video(capture: Capture, out: Path, names: Sequence[str]) -> None:
    depths = _Depths(out, names)
    if len(names) < 3 or len({depth.shape for depth in depths}) > 1:
        return
    lefts: Callable[[str], Image.Image] = lambda name: _picture(capture.image(name))  # noqa: E731
    write_depth_video(out / "depth.webp", depth_frames(depths, map(lefts, names), unit=capture.unit), 5.0)
