"""Still pictures of rooms and rendered scenes: README's tiles, the gallery, prior beside guided depth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from geodiff_plugin import Rig
from geodiff_plugin.evaluation.metrics import align
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.jobs.report import single_map
from geodiff_plugin.plotting import colour_depth, colour_share, depth_range, grid
from tests.lab.surfaces import STAGES, guided_stages, relief
from tests.pictures.moving import measured
from tests.pictures.orbit import look_from, surface_of
from tests.pictures.rooms import Room, RoomResult, call, guidance_of, prior, read_room
from tests.scenes.dataset import find_synthetic, load_synthetic

#: Width of a picture in a row of tiles, and of one in the gallery, pixels.
TILE_PX = 300
GALLERY_PX = 280
#: The rendered scenes of the gallery; the bundled prior has seen none of them.
RENDERED = "synthetic:3@640x480"
#: An error of this share of the depth has the lightest colour.
LARGEST_ERROR = 0.2
QUALITY = 82
#: Stages whose surfaces are shown beside each other.
WALL_STAGES = ("fit", "result")


def save_webp(picture: Image.Image, path: Path) -> None:
    """Write a picture whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        picture.save(temporary, format="WEBP", quality=QUALITY, method=6)


def write_tiles(results: Sequence[tuple[Room, RoomResult]], path: Path) -> None:
    """A column a room: photograph with a measured distance, depth, and the surface seen from the side."""
    rows: list[list[np.ndarray]] = [[], [], []]
    titles: list[list[str]] = [[], [], []]
    for room, result in results:
        photograph, text = measured(result, room)
        near, far = depth_range(result.depth_m)
        surface = surface_of(result.depth_m, result.left, result.K, result.solid)
        aside = look_from(surface, result.K, result.depth_m.shape, yaw=20.0, pitch=8.0, back=0.12)
        for column, (picture, title) in enumerate(
            (
                (photograph, text),
                (colour_depth(result.depth_m), f"{near:.1f} m to {far:.1f} m"),
                (aside, "from the side"),
            )
        ):
            rows[column].append(picture)
            titles[column].append(title)
    save_webp(grid(sum(rows, []), sum(titles, []), columns=len(results), cell_width=TILE_PX), path)


def write_room(room: Room, result: RoomResult, path: Path) -> None:
    """One row of the gallery: photograph, depth and confidence."""
    near, far = depth_range(result.depth_m)
    pictures = [result.left, colour_depth(result.depth_m), colour_share(result.confidence)]
    titles = [f"{room.title}: {result.status}", f"{near:.1f} m to {far:.1f} m", "confidence, light is 1"]
    save_webp(grid(pictures, titles, cell_width=GALLERY_PX), path)


def write_slider(result: RoomResult, folder: Path) -> None:
    """``prior.webp``, scaled and shifted to fit, and ``guided.webp``, in the same colours."""
    near, far = depth_range(result.depth_m)
    fitted = align(result.prior, result.depth_m, np.ones_like(result.solid))
    for name, depth_m in (("prior", fitted), ("guided", result.depth_m)):
        save_webp(Image.fromarray(colour_depth(depth_m, near, far)), folder / f"{name}.webp")


def write_walls(folder: Path, names: Sequence[str], path: Path) -> None:
    """A row a room: photograph, depth, and how even surfaces are before the last stages and after them."""
    heads = ["left image", "depth", *(f"{STAGES[stage]}, lit from the side" for stage in WALL_STAGES)]
    pictures: list[np.ndarray] = []
    for name in names:
        left, right, rig = read_room(folder, name)
        stages = guided_stages(prior(), (left, right), rig)
        lit = (relief(stages.of(stage)) for stage in WALL_STAGES)
        pictures += [left, colour_depth(stages.of("result")), *lit]
    titles = heads + [""] * (len(pictures) - len(heads))
    save_webp(grid(pictures, titles, columns=len(heads), cell_width=GALLERY_PX), path)


def write_rendered(folder: Path) -> None:
    """``rendered-1.webp`` and so on: left image, depth, and how far it is from the truth."""
    for number, ref in enumerate(find_synthetic(Path(RENDERED)), 1):
        sample = load_synthetic(ref)
        rig = Rig(sample.K_left, sample.K_right, sample.E)
        out = call(sample.left, guidance_of(sample.right, rig))
        depth_m = single_map(out.prediction)
        near, far = depth_range(sample.depth_m)
        error = np.where(
            sample.valid, np.abs(depth_m / np.where(sample.valid, sample.depth_m, 1.0) - 1.0), np.nan
        )
        pictures = [sample.left, colour_depth(depth_m, near, far), colour_share(error, LARGEST_ERROR)]
        titles = [
            f"rendered: {out.verdict.status}",
            f"{near:.1f} m to {far:.1f} m",
            f"error, light is {100 * LARGEST_ERROR:.0f} %; mean {100 * np.nanmean(error):.1f} %",
        ]
        save_webp(grid(pictures, titles, cell_width=GALLERY_PX), folder / f"rendered-{number}.webp")
