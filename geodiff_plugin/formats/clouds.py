"""Point clouds and textured meshes from depth (Eq. 9, unprojection), as PLY and binary glTF."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from PIL import Image

from geodiff_plugin._camera_checks import check_intrinsics
from geodiff_plugin._checks import bad_value
from geodiff_plugin._strips import row_strips
from geodiff_plugin.formats.files import PathLike
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV

if TYPE_CHECKING:
    from trimesh import Trimesh

#: Depth change from one pixel to the next, as a share of the nearer depth: at a focal length of 500 px of a
#: surface seen at 87 degrees from its normal.
RELATIVE_STEP = 0.04
#: A corner of a flat surface has three neighbours on it, a one-pixel ramp along an edge has two.
FEWEST_NEIGHBOURS = 3
#: Upper bound on the points of a mesh; a larger one is thinned.
MESH_POINTS = 300_000
#: Upper bound on the points of a cloud as GLB, likewise.
GLB_POINTS = 2_000_000
PYRAMID_SHARE = 0.08  # of the cloud's median depth
CAMERA_COLOURS = ((255, 255, 255), (255, 170, 0), (0, 200, 255), (160, 255, 120))
EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])


def _usable(depth_m: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
    use = np.isfinite(depth_m) & (depth_m > 0)
    return use if valid is None else use & np.asarray(valid, dtype=bool)


def flying_points(depth_m: np.ndarray) -> np.ndarray:
    """Points that hang in the air between a near and a far surface, ``(H, W)`` boolean.

    A pixel of ``depth_m``, ``(H, W)`` metres, flies when fewer than three of its eight neighbours have its
    depth within 4 % of the nearer: things one pixel wide and surfaces at a grazing angle go too. Unknown
    depth (not finite, or not above 0) never flies.
    """
    depth_m = np.asarray(depth_m, dtype=np.float32)
    use = _usable(depth_m, None)
    height, width = depth_m.shape
    # NaN compares false with everything, so what is unknown or outside the image supports nobody.
    padded = np.pad(np.where(use, depth_m, np.nan), 1, constant_values=np.nan)
    flying = np.empty(depth_m.shape, dtype=bool)
    for rows in row_strips(height, width):
        count, strip = rows.stop - rows.start, padded[rows.start : rows.stop + 2]
        centre = strip[1:-1, 1:-1]
        support = np.zeros(centre.shape, dtype=np.int8)
        for dy, dx in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
            neighbour = strip[dy : dy + count, dx : dx + width]
            support += np.abs(centre - neighbour) <= RELATIVE_STEP * np.minimum(centre, neighbour)
        flying[rows] = use[rows] & (support < FEWEST_NEIGHBOURS)
    return flying


@dataclass(frozen=True)
class Cloud:
    """Points ``(N, 3)`` float64 metres in the left camera's frame, their colours ``(N, 3)`` uint8 RGB."""

    points_m: np.ndarray
    colours: np.ndarray

    def thinned(self, most: int) -> Cloud:
        """At most ``most`` of the points, evenly over their order, which is that of the pixels."""
        if len(self.points_m) <= most:
            return self
        kept = np.linspace(0, len(self.points_m) - 1, most).astype(int)
        return Cloud(self.points_m[kept], self.colours[kept])


def make_cloud(
    depth_m: np.ndarray, image_01: np.ndarray, K: np.ndarray, valid: np.ndarray | None = None
) -> Cloud:
    """The points of a depth map, one a pixel, row by row; none where it is not finite or not above 0.

    ``depth_m`` is ``(H, W)`` metres along z, ``image_01`` ``(H, W, 3)`` in [0, 1] or uint8, ``K`` ``(3, 3)``
    pixels of this grid, ``valid`` ``(H, W)`` boolean. A pixel on the principal point at 2 m is (0, 0, 2).
    Raises ``ValueError`` for shapes that do not fit, or a K that is none.
    """
    return Cloud(*map(np.concatenate, zip(*_cloud_strips(depth_m, image_01, K, valid), strict=True)))


def _cloud_strips(
    depth_m: np.ndarray, image_01: np.ndarray, K: np.ndarray, valid: np.ndarray | None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Points and colours of ``make_cloud``, a strip of rows after the other; coordinates are contiguous."""
    depth_m, image_01 = np.asarray(depth_m), np.asarray(image_01)
    if depth_m.ndim != 2 or image_01.shape != (*depth_m.shape, 3):
        bad_value("image_01", "(H, W, 3) over a depth of (H, W)", f"{image_01.shape} over {depth_m.shape}")
    unproject, u = np.linalg.inv(check_intrinsics(K)), np.arange(depth_m.shape[1])
    for rows in row_strips(*depth_m.shape):
        z, v = depth_m[rows].astype(np.float64), np.arange(rows.start, rows.stop)[:, None]
        used = np.flatnonzero(_usable(z, None if valid is None else valid[rows]))
        points = [((u * of_u + v * of_v + of_both) * z).ravel()[used] for of_u, of_v, of_both in unproject]
        colours = np.take(in_8_bits(image_01[rows]).reshape(-1, 3), used, axis=0)  # quicker than an index
        yield np.stack(points).T, colours


def in_8_bits(image: np.ndarray) -> np.ndarray:
    """Colours in 8 bits, of uint8 or of floats in [0, 1]."""
    if image.dtype == np.uint8:
        return image
    levels = np.empty(image.shape, np.uint8)
    for rows in row_strips(len(image), math.prod(image.shape[1:])):
        levels[rows] = np.rint(np.clip(image[rows], 0.0, 1.0) * 255.0)
    return levels


def make_mesh(
    depth_m: np.ndarray, image_01: np.ndarray, K: np.ndarray, valid: np.ndarray | None = None
) -> Trimesh:
    """The surface through the points of ``make_cloud``, arguments as there, textured with the image.

    It has at most ``MESH_POINTS`` points, and no triangle where depth steps by more than ``RELATIVE_STEP``.
    """
    from trimesh import Trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    depth_m, sides = np.asarray(depth_m, np.float32), depth_m.shape
    stride = max(1, math.ceil(math.sqrt(depth_m.size / MESH_POINTS)))
    rows, columns = (np.arange(0, side, stride) for side in sides)
    z = np.where(_usable(depth_m, valid), depth_m, np.nan)
    cut = np.zeros(sides, np.uint8)  # what lies below and to the right of a pixel, up to the next point
    for axis in (0, 1):
        there = np.pad(z, ((0, 1 - axis), (0, axis)), mode="edge")[1 - axis :, axis:]
        steps = ~(np.abs(there - z) <= RELATIVE_STEP * np.minimum(there, z))  # or unknown
        window = np.ones((stride + axis, stride + 1 - axis), np.uint8)
        cut |= cv2.dilate(steps.astype(np.uint8), window, anchor=(0, 0))
    z, cut = (each[np.ix_(rows, columns)] for each in (z, cut))
    u, v = np.meshgrid(columns, rows)
    points = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(check_intrinsics(K)).T * z[..., None]
    index = np.arange(z.size).reshape(z.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    whole = cut[:-1, :-1] == 0
    faces = np.concatenate([np.stack(part, -1)[whole] for part in ((a, c, b), (b, c, d))])
    uv = np.stack([(u + 0.5) / sides[1], 1.0 - (v + 0.5) / sides[0]], -1)
    texture = Image.fromarray(in_8_bits(np.asarray(image_01)))
    texture.format = "JPEG"  # makes trimesh store it as one
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
) -> int:
    """Write the points of ``make_cloud`` as binary little-endian PLY, whole or not at all; returns how many.

    ``unit`` is ``"m"``, or ``None`` for a depth without one; a comment of the file says which, and the frame.
    """
    count = int(np.count_nonzero(_usable(np.asarray(depth_m), valid)))
    frame, names = "camera frame: x right, y down, z forward", (*"xyz", "red", "green", "blue")
    write_vertices(path, frame, unit, count, names, _cloud_strips(depth_m, image_01, K, valid))
    return count


def write_vertices(
    path: PathLike,
    frame: str,
    unit: str | None,
    count: int,
    names: Sequence[str],
    parts: Iterable[Sequence[np.ndarray]],
) -> None:
    """Write ``count`` vertices as binary little-endian PLY; a comment says their frame and unit.

    Of every part the columns of its arrays together are called ``names``: floats, the last three colours.
    """
    comment = f"comment {frame}, {'metres' if unit else 'no unit'}"
    lines = ["ply", "format binary_little_endian 1.0", comment, f"element vertex {count}"]
    lines += [f"property float {name}" for name in names[:-3]] + [f"property uchar {n}" for n in names[-3:]]
    vertex = np.dtype([(name, "<f4") for name in names[:-3]] + [(name, "u1") for name in names[-3:]])
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
        for part in parts:
            vertices = np.empty(len(part[0]), vertex)
            for name, column in zip(names, (column for array in part for column in array.T), strict=True):
                vertices[name] = column
            file.write(vertices.tobytes())


def camera_pyramid(K: np.ndarray, E: np.ndarray, size: tuple[int, int], length_m: float) -> np.ndarray:
    """``(5, 3)`` centre and corners of a camera's view at ``length_m``, in the left camera's frame."""
    right, bottom = (side - 0.5 for side in size)
    corners = [(-0.5, -0.5), (right, -0.5), (right, bottom), (-0.5, bottom)]
    rays = np.array([(u, v, 1.0) for u, v in corners]) @ np.linalg.inv(K).T * length_m
    return np.vstack([np.zeros(3), rays]) @ E[:3, :3].T + E[:3, 3]


def write_glb(
    path: PathLike,
    shape: Cloud | Trimesh,
    cameras: Sequence[tuple[np.ndarray, np.ndarray, tuple[int, int]]] = (),
) -> None:
    """Write a cloud or a mesh, which may be empty, and its cameras as GLB, whole or not at all.

    ``cameras`` has ``(K, E, (width, height))`` of those to draw, E the pose in the left camera's frame. In
    glTF's axes, in metres, a point 1 m right of, above and before the camera is (1, 1, -1). ``ValueError``
    without a point and a camera.
    """
    import trimesh

    if isinstance(shape, Cloud):
        name, cloud = "cloud", shape.thinned(GLB_POINTS)
        geometry: Any = trimesh.PointCloud(cloud.points_m, colors=cloud.colours)
    else:  # of its parts, because a mesh's own copy forgets that the texture is a JPEG
        name = "mesh"
        geometry = trimesh.Trimesh(shape.vertices, shape.faces, visual=shape.visual, process=False)
    scene, length_m = trimesh.Scene(), 1.0
    if len(geometry.vertices):
        length_m = PYRAMID_SHARE * float(np.median(geometry.vertices[:, 2]))
        scene.add_geometry(geometry, geom_name=name)
    for number, (K, E, size) in enumerate(cameras):
        lines = trimesh.load_path(camera_pyramid(np.asarray(K), np.asarray(E), size, length_m)[EDGES])
        lines.colors = np.tile(CAMERA_COLOURS[number % len(CAMERA_COLOURS)], (len(lines.entities), 1))
        scene.add_geometry(lines, geom_name=f"camera {number}")
    for geometry in scene.geometry.values():
        geometry.apply_transform(OPENGL_FROM_OPENCV)

    def unlit(tree: dict[str, Any]) -> None:
        """Shown without lights: a photograph already has its shading."""
        for material in tree["materials"]:
            material["extensions"] = {"KHR_materials_unlit": {}}
        tree["extensionsUsed"] = ["KHR_materials_unlit"]

    glb = scene.export(file_type="glb", include_normals=True, tree_postprocessor=unlit)
    with atomic_path(path) as temporary:
        temporary.write_bytes(glb)
