"""What a run leaves behind its frames: depth agreed between them, one cloud, a contact sheet."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin.capture.agreement import DepthFrame, agreed
from geodiff_plugin.capture.capture import Capture, choose_neighbours
from geodiff_plugin.capture.fusion import fuse, write_colmap_maps, write_mesh, write_normal_ply
from geodiff_plugin.formats.clouds import write_glb
from geodiff_plugin.formats.depth import write_depth_mm, write_depth_npy
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.plotting import depth_figure, depth_frames, grid

#: Depth and confidence of a frame by its own run, which agreement starts from whenever it is made anew.
ALONE = ("depth_alone", "confidence_alone")
AGREED = ("depth", "confidence", "confirmed", "asked")
#: Frames that a frame is checked against, frames on the contact sheet, points of the GLB.
OTHERS, ON_SHEET, GLB_POINTS = 6, 24, 400_000


class _Frames(Sequence[DepthFrame]):
    """Frames of a run, read whenever they are asked for: those of a long capture exceed the memory."""

    def __init__(self, capture: Capture, out: Path, names: Sequence[str], maps: Sequence[str]) -> None:
        self._capture, self._out, self._names, self._maps = capture, out, list(names), maps

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, number: Any) -> Any:
        return self.named(self._names[number])

    def named(self, name: str) -> DepthFrame:
        """The frame of a name."""
        depth, confidence, *more = (np.load(self._out / name / f"{file}.npy") for file in self._maps)
        solved, i = self._capture.solve(), self._capture.names.index(name)
        return DepthFrame(name, depth, confidence, solved.K[i], solved.E[i], *more)


def write_agreement(capture: Capture, out: Path, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Check finished frames against those that see the same, and write what they agree on into their folders.

    By frame: how many others it was checked against, the share of its pixels that another frame sees and
    confirms, and that another one sees and none confirms.
    """
    solved, number = capture.solve(), {name: i for i, name in enumerate(capture.names)}
    there, shares = {number[name] for name in names}, {}
    load = lru_cache(maxsize=2 * OTHERS)(_Frames(capture, out, names, ALONE).named)
    for name in names:
        others = [load(capture.names[i]) for i in choose_neighbours(solved, number[name], OTHERS, there)]
        frame, folder = agreed(load(name), others), out / name
        assert frame.confirmed is not None and frame.asked is not None
        write_depth_npy(folder / "depth.npy", frame.depth)
        write_depth_mm(folder / "depth_mm.png", frame.depth)
        depth_figure(frame.depth, unit=capture.unit).save(folder / "depth.png")
        for file in AGREED[1:]:
            with atomic_path(folder / f"{file}.npy") as temporary:
                np.save(temporary, getattr(frame, file))
        shares[name] = {
            "checked_against": len(others),
            "confirmed": round(float((frame.confirmed > 0).mean()), 4),
            "unconfirmed": round(float(((frame.asked > 0) & (frame.confirmed == 0)).mean()), 4),
        }
    return shares


def write_results(capture: Capture, out: Path, names: Sequence[str], export: Sequence[str]) -> dict[str, Any]:
    """Write ``cloud.ply``, ``cloud.glb``, ``sheet.jpg`` and what ``export`` asks for.

    Frames are finished, and ``write_agreement`` has been there. Returns counts for the report.
    """
    frames = _Frames(capture, out, names, AGREED)
    cloud, normals = fuse(frames, capture.image)
    write_normal_ply(out / "cloud.ply", cloud, normals, capture.unit)
    cameras = [(f.K, f.E, f.depth.shape[::-1]) for f in frames]
    write_glb(out / "cloud.glb", cloud.thinned(GLB_POINTS), cameras)
    if "mesh" in export:
        write_mesh(out / "mesh.ply", frames, capture.image)
    if "colmap" in export:
        solved = capture.solve()
        seen = [solved.seen[capture.names.index(name)] for name in names]
        write_colmap_maps(out / "colmap", frames, capture.image, solved.points, seen)
    _sheet(capture, out, names)
    return {"cloud_points": len(cloud.points_m)}


def _sheet(capture: Capture, out: Path, names: Sequence[str]) -> None:
    """A picture of evenly chosen frames and their depth, in the colours of one range where they are alike."""
    shown = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, ON_SHEET).astype(int))]
    depths, unit = [np.load(out / name / "depth.npy") for name in shown], capture.unit
    alike = len({depth.shape for depth in depths}) == 1
    figures = depth_frames(depths, unit=unit) if alike else (depth_figure(d, unit=unit) for d in depths)
    cells: list[Image.Image] = []
    for name, figure in zip(shown, figures, strict=True):
        cells += [Image.fromarray(np.rint(capture.image(name) * 255).astype(np.uint8)), figure]
    titles = [title for name in shown for title in (name, "depth")]
    with atomic_path(out / "sheet.jpg") as temporary:
        grid(cells, titles, columns=min(4, len(cells)), cell_width=360).save(temporary, quality=88)
