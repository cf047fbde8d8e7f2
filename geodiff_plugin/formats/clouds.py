"""Converts depth to point clouds and textured meshes (Eq. 9, unprojection), as PLY and binary glTF."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from PIL import Image

from geodiff_plugin._internal.camera_checks import check_intrinsics
from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin._internal.reprojection import STEEPEST_STEP
from geodiff_plugin._internal.strips import row_strips
from geodiff_plugin.cameras import Camera, PosedCamera, rays_of_pixels
from geodiff_plugin.formats.files import PathLike
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV

if TYPE_CHECKING:
    from trimesh import Trimesh

#: Minimum number of neighbours at the same depth: the corner of a flat surface has three, a one-pixel ramp
#: two.
MIN_NEIGHBOURS = 3
#: Maximum number of points of a mesh; larger ones are subsampled.
MESH_POINTS = 300_000
#: Maximum number of points of a GLB cloud; larger ones are subsampled.
GLB_POINTS = 2_000_000
#: Columns of vertices that are bytes; all others are floats.
COLOURS = ("red", "green", "blue")
PYRAMID_FRACTION = 0.08  # relative to the median depth of the cloud
CAMERA_COLOURS = ((255, 255, 255), (255, 170, 0), (0, 200, 255), (160, 255, 120))
EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])


def _usable(depth_m: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
    use = np.isfinite(depth_m) & (depth_m > 0)
    return use if valid is None else use & np.asarray(valid, dtype=bool)


def flying_points(depth_m: np.ndarray) -> np.ndarray:
    """Return the ``(H, W)`` mask of flying pixels between a near and a far surface.

    A pixel of ``depth_m``, ``(H, W)`` metres, is flying if fewer than three of its eight neighbours have its
    depth within 4 % of the nearer one. This includes objects one pixel wide and surfaces at grazing angles.
    Unknown depth (not finite, or not positive) is never flying.
    """
    depth_m = np.asarray(depth_m, dtype=np.float32)
    use = _usable(depth_m, None)
    height, width = depth_m.shape
    # NaN compares false, so unknown pixels and pixels outside the image support no neighbour.
    padded = np.pad(np.where(use, depth_m, np.nan), 1, constant_values=np.nan)
    flying = np.empty(depth_m.shape, dtype=bool)
    for rows in row_strips(height, width):
        count = rows.stop - rows.start
        strip = padded[rows.start : rows.stop + 2]
        centre = strip[1:-1, 1:-1]
        support = np.zeros(centre.shape, dtype=np.int8)
        for dy, dx in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
            neighbour = strip[dy : dy + count, dx : dx + width]
            support += np.abs(centre - neighbour) <= STEEPEST_STEP * np.minimum(centre, neighbour)
        flying[rows] = use[rows] & (support < MIN_NEIGHBOURS)
    return flying


@dataclass(frozen=True)
class Cloud:
    """Points ``(N, 3)`` float64 metres in the left camera's frame, and their colours ``(N, 3)`` uint8 RGB."""

    points_m: np.ndarray
    colours: np.ndarray

    def thinned(self, max_points: int) -> Cloud:
        """Return at most ``max_points`` points, evenly subsampled in pixel order."""
        if len(self.points_m) <= max_points:
            return self
        kept = np.linspace(0, len(self.points_m) - 1, max_points).astype(int)
        return Cloud(self.points_m[kept], self.colours[kept])


def make_cloud(
    depth_m: np.ndarray, image_01: np.ndarray, K: np.ndarray, valid: np.ndarray | None = None
) -> Cloud:
    """Convert a depth map to points, one per pixel, row by row; skip depth that is not finite and positive.

    ``depth_m`` is ``(H, W)`` metres along z, ``image_01`` ``(H, W, 3)`` in [0, 1] or uint8, ``K`` ``(3, 3)``
    pixels of this grid, ``valid`` ``(H, W)`` boolean. A pixel at the principal point at 2 m is (0, 0, 2).
    Raises ``ValueError`` for inconsistent shapes or an invalid K.
    """
    return Cloud(*map(np.concatenate, zip(*_cloud_strips(depth_m, image_01, K, valid), strict=True)))


def _cloud_strips(
    depth_m: np.ndarray, image_01: np.ndarray, K: np.ndarray, valid: np.ndarray | None, *further: np.ndarray
) -> Iterator[tuple[np.ndarray, ...]]:
    """Yield points and colours of ``make_cloud`` in strips of rows, with contiguous coordinates.

    Also yields the values ``(N, 1)`` of each ``further`` map ``(H, W)`` at the points.
    """
    depth_m, image_01 = np.asarray(depth_m), np.asarray(image_01)
    if depth_m.ndim != 2 or image_01.shape != (*depth_m.shape, 3):
        bad_value("image_01", "(H, W, 3) over a depth of (H, W)", f"{image_01.shape} over {depth_m.shape}")
    K = check_intrinsics(K)
    u = np.arange(depth_m.shape[1])
    for rows in row_strips(*depth_m.shape):
        z = depth_m[rows].astype(np.float64)
        v = np.arange(rows.start, rows.stop)[:, None]
        used = np.flatnonzero(_usable(z, None if valid is None else valid[rows]))
        points = [(each * z).ravel()[used] for each in (*rays_of_pixels(K, u, v), 1.0)]
        colours = np.take(in_8_bits(image_01[rows]).reshape(-1, 3), used, axis=0)  # faster than indexing
        yield np.stack(points).T, colours, *(each[rows].reshape(-1, 1)[used] for each in further)


def in_8_bits(image: np.ndarray) -> np.ndarray:
    """Convert uint8 or floats in [0, 1] to 8-bit colours."""
    if image.dtype == np.uint8:
        return image
    levels = np.empty(image.shape, np.uint8)
    for rows in row_strips(len(image), math.prod(image.shape[1:])):
        levels[rows] = np.rint(np.clip(image[rows], 0.0, 1.0) * 255.0)
    return levels


def make_mesh(
    depth_m: np.ndarray, image_01: np.ndarray, K: np.ndarray, valid: np.ndarray | None = None
) -> Trimesh:
    """Return the surface through the points of ``make_cloud`` (same arguments), textured with the image.

    It has at most ``MESH_POINTS`` points, and no triangles where depth steps exceed ``STEEPEST_STEP``.
    """
    from trimesh import Trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    depth_m, sides = np.asarray(depth_m, np.float32), depth_m.shape
    stride = max(1, math.ceil(math.sqrt(depth_m.size / MESH_POINTS)))
    rows, columns = (np.arange(0, side, stride) for side in sides)
    z = np.where(_usable(depth_m, valid), depth_m, np.nan)
    cut = np.zeros(sides, np.uint8)  # marks pixels to the right and below, up to the next point
    for axis in (0, 1):
        neighbour = np.pad(z, ((0, 1 - axis), (0, axis)), mode="edge")[1 - axis :, axis:]
        steps = ~(np.abs(neighbour - z) <= STEEPEST_STEP * np.minimum(neighbour, z))  # includes unknown depth
        window = np.ones((stride + axis, stride + 1 - axis), np.uint8)
        cut |= cv2.dilate(steps.astype(np.uint8), window, anchor=(0, 0))
    z, cut = (each[np.ix_(rows, columns)] for each in (z, cut))
    u, v = np.meshgrid(columns, rows)
    points = Camera(check_intrinsics(K)).rays(np.stack([u, v], -1)) * z[..., None]
    index = np.arange(z.size).reshape(z.shape)
    a = index[:-1, :-1]
    b = index[:-1, 1:]
    c = index[1:, :-1]
    d = index[1:, 1:]
    whole = cut[:-1, :-1] == 0
    faces = np.concatenate([np.stack(part, -1)[whole] for part in ((a, c, b), (b, c, d))])
    uv = np.stack([(u + 0.5) / sides[1], 1.0 - (v + 0.5) / sides[0]], -1)
    texture = Image.fromarray(in_8_bits(np.asarray(image_01)))
    texture.format = "JPEG"  # so that trimesh stores a JPEG
    material = PBRMaterial(baseColorTexture=texture, metallicFactor=0.0, doubleSided=True)
    visual = TextureVisuals(uv=uv.reshape(-1, 2), material=material)
    mesh = Trimesh(points.reshape(-1, 3), faces, visual=visual, process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def write_ply(
    path: PathLike,
    depth_m: np.ndarray,
    image_01: np.ndarray,
    K: np.ndarray,
    valid: np.ndarray | None = None,
    unit: str | None = "m",
    sigma_m: np.ndarray | None = None,
) -> int:
    """Write the points of ``make_cloud`` as binary little-endian PLY; return their number.

    ``unit`` is ``"m"``, or ``None`` for depth without a unit; a comment in the file states it, and the frame.
    ``sigma_m``, the standard deviation of the depth ``(H, W)``, becomes the property ``sigma`` of the points.
    """
    count = int(np.count_nonzero(_usable(np.asarray(depth_m), valid)))
    frame = "camera frame: x right, y down, z forward"
    further = {} if sigma_m is None else {"sigma": sigma_m}
    parts = _cloud_strips(depth_m, image_01, K, valid, *further.values())
    write_vertices(path, frame, unit, count, (*"xyz", *COLOURS, *further), parts)
    return count


def write_vertices(
    path: PathLike,
    frame: str,
    unit: str | None,
    count: int,
    names: Sequence[str],
    parts: Iterable[Sequence[np.ndarray]],
) -> None:
    """Write ``count`` vertices as binary little-endian PLY; a comment states frame and unit.

    ``names`` are the columns of the concatenated arrays of every part: ``COLOURS`` are bytes, others floats.
    """
    comment = f"comment {frame}, {'metres' if unit else 'no unit'}"
    lines = ["ply", "format binary_little_endian 1.0", comment, f"element vertex {count}"]
    lines += [f"property {'uchar' if name in COLOURS else 'float'} {name}" for name in names]
    vertex_type = np.dtype([(name, "u1" if name in COLOURS else "<f4") for name in names])
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
        for part in parts:
            columns = [column for array in part for column in array.T]
            vertices = np.empty(len(part[0]), vertex_type)
            for name, column in zip(names, columns, strict=True):
                vertices[name] = column
            file.write(vertices.tobytes())


def camera_pyramid(camera: PosedCamera, length_m: float) -> np.ndarray:
    """Return ``(5, 3)`` centre and corners of a camera's view at ``length_m``, in the left camera's frame."""
    right, bottom = (side - 0.5 for side in camera.size)
    corners = np.array([(-0.5, -0.5), (right, -0.5), (right, bottom), (-0.5, bottom)])
    return camera.to_world(np.vstack([np.zeros(3), camera.rays(corners) * length_m]))


def write_glb(
    path: PathLike,
    shape: Cloud | Trimesh,
    cameras: Sequence[tuple[np.ndarray, np.ndarray, tuple[int, int]]] = (),
) -> None:
    """Write a cloud or mesh, possibly empty, and its cameras as GLB.

    ``cameras`` has ``(K, E, (width, height))`` of the cameras to draw, E the pose in the left camera's frame.
    In glTF's axes, in metres, a point 1 m right of, above and in front of the camera is (1, 1, -1). Raises
    ``ValueError`` without points and cameras.
    """
    import trimesh

    if isinstance(shape, Cloud):
        name = "cloud"
        cloud = shape.thinned(GLB_POINTS)
        geometry: Any = trimesh.PointCloud(cloud.points_m, colors=cloud.colours)
    else:  # a mesh's own copy loses the JPEG format of the texture
        name = "mesh"
        geometry = trimesh.Trimesh(shape.vertices, shape.faces, visual=shape.visual, process=False)
    scene = trimesh.Scene()
    length_m = 1.0
    if len(geometry.vertices):
        length_m = PYRAMID_FRACTION * float(np.median(geometry.vertices[:, 2]))
        scene.add_geometry(geometry, geom_name=name)
    for number, (K, E, size) in enumerate(cameras):
        camera = PosedCamera(np.asarray(K), size, E=np.asarray(E))
        lines = trimesh.load_path(camera_pyramid(camera, length_m)[EDGES])
        lines.colors = np.tile(CAMERA_COLOURS[number % len(CAMERA_COLOURS)], (len(lines.entities), 1))
        scene.add_geometry(lines, geom_name=f"camera {number}")
    for geometry in scene.geometry.values():
        geometry.apply_transform(OPENGL_FROM_OPENCV)

    def unlit(tree: dict[str, Any]) -> None:
        """Disable lighting: an image already contains its shading."""
        for material in tree["materials"]:
            material["extensions"] = {"KHR_materials_unlit": {}}
        tree["extensionsUsed"] = ["KHR_materials_unlit"]

    glb = scene.export(file_type="glb", include_normals=True, tree_postprocessor=unlit)
    with atomic_path(path) as temporary:
        temporary.write_bytes(glb)
