"""Exports of ``geodiff depth``: GLB and COLMAP files, and viewers (rerun, viser).

Data flow: ``MetricDepthOutput``, ``Inputs`` -> files in ``--out``, or a window.
Paper: none.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.cli.arguments import DepthArguments, undistorted_name
from geodiff_plugin.cli.inputs import Inputs
from geodiff_plugin.cli.messages import say
from geodiff_plugin.cli.outputs import write_undistorted
from geodiff_plugin.cli.report import single_map, used_poses
from geodiff_plugin.formats import Cloud, flying_points, make_cloud, write_colmap, write_glb
from geodiff_plugin.formats.colmap import check_colmap_names
from geodiff_plugin.types import MetricDepthOutput

__all__ = [
    "EXPORTS",
    "VIEWERS",
    "Scene",
    "check_exports",
    "check_image_names",
    "make_scene",
    "show_scene",
    "write_exports",
]


@dataclass(frozen=True, eq=False)
class Scene:
    """What can be exported and shown.

    Attributes:
        cloud: the sure points, without those that hang between two surfaces.
        cameras: ``(K, E, (width, height))``, the left one first; poses as the call used them.
        names: of their images, which a pinhole camera took: the photographs, or without lens distortion
            those of ``write_undistorted``.
        left: ``(H, W, 3)`` in [0, 1].
        further: likewise, the other views without lens distortion; empty where the names are photographs.
    """

    cloud: Cloud
    cameras: tuple[tuple[np.ndarray, np.ndarray, tuple[int, int]], ...]
    names: tuple[str, ...]
    left: np.ndarray
    further: tuple[np.ndarray, ...] = ()


def check_image_names(arguments: DepthArguments, inputs: Inputs) -> None:
    """Refuse photographs whose names an export cannot hold, before the work that would be lost.

    Raises:
        ValueError: naming the photograph.
    """
    if "colmap" in arguments.export and not inputs.undistorted:
        check_colmap_names(_image_names(arguments.photographs()))


def make_scene(
    output: MetricDepthOutput, inputs: Inputs, names: tuple[Path, ...], min_confidence: float
) -> Scene:
    """The cloud of a guided call with the cameras of all its views.

    Args:
        output: at the left image's resolution.
        inputs: the views and cameras.
        names: paths of the images, the left one first.
        min_confidence: pixels below it are no points.
    """
    depth_m, K = single_map(output.prediction), np.asarray(output.K)[0].astype(np.float64)
    keep = ~flying_points(depth_m)
    if output.confidence is not None:
        keep &= single_map(output.confidence) >= min_confidence
    cameras = [(K, np.eye(4), (depth_m.shape[1], depth_m.shape[0]))]
    Es = used_poses(output, inputs.guidance)
    for rig, E, image in zip(inputs.guidance.rigs, Es, inputs.guidance.rights, strict=True):
        cameras.append((rig.K_right, E, (image.shape[-1], image.shape[-2])))
    cloud = make_cloud(depth_m, inputs.left, K, keep)
    if not inputs.undistorted:
        return Scene(cloud, tuple(cameras), _image_names(names), inputs.left)
    further = tuple(image.permute(1, 2, 0).numpy() for image in inputs.guidance.rights)
    written = tuple(undistorted_name(number) for number in range(1, 2 + len(further)))
    return Scene(cloud, tuple(cameras), written, inputs.left, further)


def _image_names(paths: tuple[Path, ...]) -> tuple[str, ...]:
    """Names of the images, with their folders below a common one where two of them are alike."""
    names = tuple(path.name for path in paths)
    if len(set(names)) == len(names):
        return names
    absolute = [path.absolute() for path in paths]
    root = os.path.commonpath([path.parent for path in absolute])
    return tuple(path.relative_to(root).as_posix() for path in absolute)


def _glb(folder: Path, scene: Scene) -> None:
    write_glb(folder / "cloud.glb", scene.cloud, scene.cameras)


def _colmap(folder: Path, scene: Scene) -> None:
    for number, image_01 in enumerate(scene.further, 2):  # the left one is there without any export
        write_undistorted(folder, image_01, number)
    views = [(name, *camera) for name, camera in zip(scene.names, scene.cameras, strict=True)]
    write_colmap(folder, views, scene.cloud)


#: What ``--export`` writes, by name.
EXPORTS: dict[str, Callable[[Path, Scene], None]] = {"glb": _glb, "colmap": _colmap}


def write_exports(folder: Path, kinds: tuple[str, ...], scene: Scene) -> None:
    """Write every kind of ``EXPORTS`` that was asked for."""
    for kind in kinds:
        EXPORTS[kind](folder, scene)


def _in_rerun(scene: Scene) -> None:
    import rerun

    rerun.init("geodiff", spawn=True)
    rerun.log("world", rerun.ViewCoordinates.RDF, static=True)
    rerun.log("world/cloud", rerun.Points3D(scene.cloud.points_m, colors=scene.cloud.colours))
    for number, (K, E, (width, height)) in enumerate(scene.cameras):
        entity = f"world/camera {number}"
        rerun.log(entity, rerun.Transform3D(translation=E[:3, 3], mat3x3=E[:3, :3]))
        rerun.log(entity, rerun.Pinhole(image_from_camera=K, width=width, height=height))
        if number == 0:
            rerun.log(entity, rerun.Image(np.rint(scene.left * 255).astype(np.uint8)))


def _in_viser(scene: Scene) -> None:
    import viser

    server = viser.ViserServer()
    server.scene.set_up_direction("-y")
    size = float(np.median(scene.cloud.points_m[:, 2])) / 400 if len(scene.cloud.points_m) else 0.01
    points = scene.cloud.points_m.astype(np.float32)
    server.scene.add_point_cloud("/cloud", points, scene.cloud.colours, point_size=size)
    for number, (K, E, (width, height)) in enumerate(scene.cameras):
        x, y, z, w = Rotation.from_matrix(E[:3, :3]).as_quat()
        server.scene.add_camera_frustum(
            f"/camera {number}",
            fov=2 * float(np.arctan(height / (2 * K[1, 1]))),
            aspect=width / height,
            scale=20 * size,
            wxyz=(w, x, y, z),
            position=E[:3, 3],
            image=np.rint(scene.left * 255).astype(np.uint8) if number == 0 else None,
        )
    say(f"viser serves the cloud at http://localhost:{server.get_port()}; Ctrl-C ends it.")
    server.sleep_forever()


#: What ``--show`` opens, by the name of the module: its package, and how. "auto" is the first that is there.
VIEWERS: dict[str, tuple[str, Callable[[Scene], None]]] = {
    "rerun": ("rerun-sdk", _in_rerun),
    "viser": ("viser", _in_viser),
}


def check_exports(kinds: tuple[str, ...], viewer: str | None) -> str | None:
    """Refuse unknown exports, and a viewer that is not installed, before anything is computed.

    Returns:
        The viewer to open, ``"auto"`` resolved, or ``None``.

    Raises:
        ValueError: naming the option and what to install.
    """
    for kind in kinds:
        check_choice(kind, "--export", EXPORTS)
    if viewer is None:
        return None
    check_choice(viewer, "--show", ("auto", *VIEWERS))
    wanted = tuple(VIEWERS) if viewer == "auto" else (viewer,)
    for name in wanted:
        if importlib.util.find_spec(name) is not None:
            return name
    packages = " or ".join(VIEWERS[name][0] for name in wanted)
    bad_value("--show", "a viewer that is installed", repr(viewer), f"pip install {packages}")


def show_scene(viewer: str, scene: Scene) -> None:
    """Open a viewer of ``VIEWERS``; viser serves until Ctrl-C."""
    VIEWERS[viewer][1](scene)
