"""Files of ``geodiff depth``: maps, cloud, GLB and COLMAP; and viewers (rerun, viser)."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.inputs import Inputs
from geodiff_plugin.cli.options import DepthOptions, undistorted_name
from geodiff_plugin.cli.report import single_map, used_poses
from geodiff_plugin.cli.terminal import say
from geodiff_plugin.formats import (
    Cloud,
    flying_points,
    make_cloud,
    write_colmap,
    write_depth_mm,
    write_depth_npy,
    write_glb,
    write_ply,
)
from geodiff_plugin.formats.colmap import check_colmap_names
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.plotting import depth_figure, overview, share_figure
from geodiff_plugin.types import MetricDepthOutput


def write_maps(
    folder: Path, output: MetricDepthOutput, left: np.ndarray, min_confidence: float = 0.0
) -> dict[str, Any]:
    """Write every file but exports and the report.

    Args:
        folder: an existing one.
        output: of the guided call, at the left image's resolution.
        left: ``(H, W, 3)`` image in [0, 1], colours of the cloud.
        min_confidence: pixels below it are no points of the cloud, [0, 1].

    Returns:
        Counts for the report.
    """
    depth_m, K = single_map(output.prediction).astype(np.float32), np.asarray(output.K)[0]
    write_depth_npy(folder / "depth.npy", depth_m)
    zeros = write_depth_mm(folder / "depth_mm.png", depth_m)
    depth_figure(depth_m, unit=output.unit).save(folder / "depth.png")
    maps = {name: np.asarray(extra)[0] for name, extra in output.extras.items()}
    if output.visible is not None:
        visible = single_map(output.visible).astype(bool)
        Image.fromarray(visible.astype(np.uint8) * 255).save(folder / "visible.png")
        maps["photometric_error"] = single_map(output.photometric_error)
    if output.uncertainty is not None:
        maps["uncertainty"] = single_map(output.uncertainty)
    flying, doubtful = flying_points(depth_m), np.zeros(depth_m.shape, dtype=bool)
    if output.confidence is not None:
        maps["confidence"] = single_map(output.confidence)
        share_figure(maps["confidence"], "confidence", 1.0).save(folder / "confidence.png")
        doubtful = maps["confidence"] < min_confidence
    for name, values in maps.items():
        np.save(folder / f"{name}.npy", values.astype(np.float32))
    error = np.where(visible, maps["photometric_error"], np.nan) if output.visible is not None else None
    overview(left, depth_m, maps.get("confidence"), error, output.unit).save(folder / "overview.png")
    points = write_ply(folder / "cloud.ply", depth_m, left, K, valid=~(flying | doubtful), unit=output.unit)
    return {
        "depth_mm_zero_pixels": zeros,
        "cloud_points": points,
        "flying_points": int(flying.sum()),
        "doubtful_points": int(doubtful.sum()),
    }


def write_undistorted(folder: Path, image_01: np.ndarray, number: int = 1) -> None:
    """Write a view without its lens distortion; the depth belongs to the first, which is the left one."""
    image = Image.fromarray(np.rint(image_01.clip(0, 1) * 255).astype(np.uint8))
    image.save(folder / undistorted_name(number))


Cameras = tuple[tuple[np.ndarray, np.ndarray, tuple[int, int]], ...]


def cameras_of(output: MetricDepthOutput, guidance: GeometryGuidance) -> Cameras:
    """``(K, E, (width, height))`` of every view of one image, left one first; poses as the call used them."""
    depth_m, K = single_map(output.prediction), np.asarray(output.K)[0].astype(np.float64)
    further = zip(guidance.rigs, used_poses(output, guidance), guidance.rights, strict=True)
    rights = ((rig.K_right, E, (image.shape[-1], image.shape[-2])) for rig, E, image in further)
    return ((K, np.eye(4), (depth_m.shape[1], depth_m.shape[0])), *rights)


@dataclass(frozen=True, eq=False)
class Scene:
    """What can be exported and shown.

    Attributes:
        cloud: points of at least the least confidence, without those that hang between two surfaces.
        cameras: of ``cameras_of``.
        names: of their images, which a pinhole camera took: the photographs, or without lens distortion
            those of ``write_undistorted``.
        left: ``(H, W, 3)`` in [0, 1].
        further: likewise, the other views without lens distortion; empty where the names are photographs.
    """

    cloud: Cloud
    cameras: Cameras
    names: tuple[str, ...]
    left: np.ndarray
    further: tuple[np.ndarray, ...] = ()


def make_scene(output: MetricDepthOutput, inputs: Inputs, options: DepthOptions) -> Scene:
    """The cloud of a guided call with the cameras of all its views.

    Args:
        output: at the left image's resolution.
        inputs: the views and cameras.
        options: names of the images, and the least confidence of a point.
    """
    depth_m, cameras = single_map(output.prediction), cameras_of(output, inputs.guidance)
    keep = ~flying_points(depth_m)
    if output.confidence is not None:
        keep &= single_map(output.confidence) >= options.min_confidence
    cloud = make_cloud(depth_m, inputs.left, cameras[0][0], keep)
    if not inputs.undistorted:
        return Scene(cloud, cameras, _image_names(options.photographs().values()), inputs.left)
    further = tuple(image.permute(1, 2, 0).numpy() for image in inputs.guidance.rights)
    written = tuple(undistorted_name(number) for number in range(1, 2 + len(further)))
    return Scene(cloud, cameras, written, inputs.left, further)


def _image_names(paths: Collection[Path]) -> tuple[str, ...]:
    """Names of the images, with their folders below a common one where two of them are alike."""
    names = tuple(path.name for path in paths)
    if len(set(names)) == len(names):
        return names
    absolute = [path.absolute() for path in paths]
    root = os.path.commonpath([path.parent for path in absolute])
    return tuple(path.relative_to(root).as_posix() for path in absolute)


def check_image_names(options: DepthOptions, inputs: Inputs) -> None:
    """Refuse photographs whose names an export cannot hold, before the work that would be lost.

    Raises:
        InputError: naming the photograph.
    """
    if "colmap" in options.export and not inputs.undistorted:
        check_colmap_names(_image_names(options.photographs().values()))


def write_exports(folder: Path, kinds: Collection[str], scene: Scene) -> None:
    """Write what ``--export`` asks for, into a folder with the maps."""
    if "glb" in kinds:
        write_glb(folder / "cloud.glb", scene.cloud, scene.cameras)
    if "colmap" in kinds:
        for number, image_01 in enumerate(scene.further, 2):  # the left one is there without any export
            write_undistorted(folder, image_01, number)
        views = [(name, *camera) for name, camera in zip(scene.names, scene.cameras, strict=True)]
        write_colmap(folder, views, scene.cloud)


def _in_rerun(scene: Scene) -> None:
    import rerun

    rerun.init("geodiff", spawn=True)
    rerun.log("world", rerun.ViewCoordinates.RDF, static=True)
    rerun.log("world/cloud", rerun.Points3D(scene.cloud.points_m, colors=scene.cloud.colours))
    for number, (K, E, (width, height)) in enumerate(scene.cameras):
        entity = f"world/camera {number}"
        rerun.log(entity, rerun.Transform3D(translation=E[:3, 3], mat3x3=E[:3, :3]))
        rerun.log(entity, rerun.Pinhole(image_from_camera=K, width=width, height=height))
    rerun.log("world/camera 0", rerun.Image(np.rint(scene.left * 255).astype(np.uint8)))


def _in_viser(scene: Scene) -> None:
    import viser

    server = viser.ViserServer()
    server.scene.set_up_direction("-y")
    points_m, left = scene.cloud.points_m.astype(np.float32), np.rint(scene.left * 255).astype(np.uint8)
    size = float(np.median(points_m[:, 2])) / 400 if len(points_m) else 0.01
    server.scene.add_point_cloud("/cloud", points_m, scene.cloud.colours, point_size=size)
    for number, (K, E, (width, height)) in enumerate(scene.cameras):
        x, y, z, w = Rotation.from_matrix(E[:3, :3]).as_quat()
        view = {"fov": 2 * float(np.arctan(height / (2 * K[1, 1]))), "aspect": width / height}
        pose = {"wxyz": (w, x, y, z), "position": E[:3, 3], "image": left if number == 0 else None}
        server.scene.add_camera_frustum(f"/camera {number}", scale=20 * size, **view, **pose)
    say(f"viser serves the cloud at http://localhost:{server.get_port()}; Ctrl-C ends it.")
    server.sleep_forever()


#: What ``--show`` opens, by the name of the module: its package, and how. "auto" is the first that is there.
VIEWERS: dict[str, tuple[str, Callable[[Scene], None]]] = {
    "rerun": ("rerun-sdk", _in_rerun),
    "viser": ("viser", _in_viser),
}


def pick_viewer(wanted: str | None) -> str | None:
    """The viewer to open, ``"auto"`` resolved, or ``None``; asked before anything is computed.

    Raises:
        InputError: naming what to install.
    """
    if wanted is None:
        return None
    names = tuple(VIEWERS) if wanted == "auto" else (wanted,)
    for name in names:
        if importlib.util.find_spec(name) is not None:
            return name
    packages = " or ".join(VIEWERS[name][0] for name in names)
    bad_value("--show", "a viewer that is installed", repr(wanted), f"pip install {packages}")


def show_scene(viewer: str, scene: Scene) -> None:
    """Open a viewer of ``VIEWERS``; viser serves until Ctrl-C."""
    VIEWERS[viewer][1](scene)
