"""Still images of rooms and rendered scenes: tiles, gallery, comparison of prior and guided depth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from geodiff_plugin.evaluation.metrics import align
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.jobs.report import single_map
from geodiff_plugin.plotting import colour_depth, colour_fraction, depth_range, grid
from tests.images.moving import measured
from tests.images.orbit import look_from, surface_of
from tests.images.rooms import Room, RoomResult, call, guidance_of, prior, read_room
from tests.lab.surfaces import STAGES, guided_stages, relief
from tests.scenes.dataset import find_synthetic, load_synthetic
from tests.views import made_rig

#: Width of an image in the tiles, and in the gallery, pixels.
TILE_PX = 300
GALLERY_PX = 280
#: Rendered scenes of the gallery; the bundled prior was not trained on them.
RENDERED = "synthetic:3@640x480"
#: Relative error with the lightest colour.
LARGEST_ERROR = 0.2
QUALITY = 82
#: Stages whose surfaces are shown side by side.
WALL_STAGES = ("fit", "result")


def save_webp(image: Image.Image, path: Path) -> None:
    """Write an image atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        image.save(temporary, format="WEBP", quality=QUALITY, method=6)


def write_tiles(results: Sequence[tuple[Room, RoomResult]], path: Path) -> None:
    """Write one column per room: image with a measured distance, depth, surface seen from the side."""
    rows: list[list[np.ndarray]] = [[], [], []]
    titles: list[list[str]] = [[], [], []]
    for room, result in results:
        image, text = measured(result, room)
        near, far = depth_range(result.depth_m)
        surface = surface_of(result.depth_m, result.left, result.K, result.solid)
        aside = look_from(surface, result.K, result.depth_m.shape, yaw=20.0, pitch=8.0, back=0.12)
        for column, (drawn, title) in enumerate(
            (
                (image, text),
                (colour_depth(result.depth_m), f"{near:.1f} m to {far:.1f} m"),
                (aside, "from the side"),
            )
        ):
            rows[column].append(drawn)
            titles[column].append(title)
    save_webp(grid(sum(rows, []), sum(titles, []), columns=len(results), cell_width=TILE_PX), path)


def write_room(room: Room, result: RoomResult, path: Path) -> None:
    """Write one row of the gallery: image, depth and confidence."""
    near, far = depth_range(result.depth_m)
    images = [result.left, colour_depth(result.depth_m), colour_fraction(result.confidence)]
    titles = [f"{room.title}: {result.status}", f"{near:.1f} m to {far:.1f} m", "confidence, light is 1"]
    save_webp(grid(images, titles, cell_width=GALLERY_PX), path)


def write_slider(result: RoomResult, folder: Path) -> None:
    """Write ``prior.webp``, after the best-fit scale and shift, and ``guided.webp`` in the same colours."""
    near, far = depth_range(result.depth_m)
    fitted = align(result.prior, result.depth_m, np.ones_like(result.solid))
    for name, depth_m in (("prior", fitted), ("guided", result.depth_m)):
        save_webp(Image.fromarray(colour_depth(depth_m, near, far)), folder / f"{name}.webp")


def write_walls(folder: Path, names: Sequence[str], path: Path) -> None:
    """Write one row per room: image, depth, and surfaces before and after the last stages."""
    heads = ["left image", "depth", *(f"{STAGES[stage]}, lit from the side" for stage in WALL_STAGES)]
    images: list[np.ndarray] = []
    for name in names:
        left, right, rig = read_room(folder, name)
        stages = guided_stages(prior(), (left, right), rig)
        lit = (relief(stages.of(stage)) for stage in WALL_STAGES)
        images += [left, colour_depth(stages.of("result")), *lit]
    titles = heads + [""] * (len(images) - len(heads))
    save_webp(grid(images, titles, columns=len(heads), cell_width=GALLERY_PX), path)


def write_rendered(folder: Path) -> None:
    """Write ``rendered-1.webp`` and so on: left image, depth, and error."""
    for number, ref in enumerate(find_synthetic(Path(RENDERED)), 1):
        sample = load_synthetic(ref)
        rig = made_rig(sample.K_left, sample.K_right, sample.E)
        out = call(sample.left, guidance_of(sample.right, rig))
        depth_m = single_map(out.prediction)
        near, far = depth_range(sample.depth_m)
        error = np.where(
            sample.valid, np.abs(depth_m / np.where(sample.valid, sample.depth_m, 1.0) - 1.0), np.nan
        )
        images = [sample.left, colour_depth(depth_m, near, far), colour_fraction(error, LARGEST_ERROR)]
        titles = [
            f"rendered: {out.verdict.status}",
            f"{near:.1f} m to {far:.1f} m",
            f"error, light is {100 * LARGEST_ERROR:.0f} %; mean {100 * np.nanmean(error):.1f} %",
        ]
        save_webp(grid(images, titles, cell_width=GALLERY_PX), folder / f"rendered-{number}.webp")
