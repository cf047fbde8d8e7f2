"""One cloud of all frames with normals and colours, a mesh, and the maps in COLMAP's format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from geodiff_plugin._checks import bad_value
from geodiff_plugin.capture.agreement import DepthFrame
from geodiff_plugin.formats.clouds import Cloud, flying_points
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.formats.sfm import write_colmap
from geodiff_plugin.pose.capture import Observations

#: Points closer than this share of the median depth are one; points of lower confidence are left out.
CELL_SHARE, LEAST_CONFIDENCE = 0.004, 0.5
#: Points of one frame at most; more would not show in a cloud of many frames.
MOST_POINTS = 200_000
#: Frames after which their points are merged, so that a long capture fits the memory.
MERGED_AFTER = 20
#: A voxel of the mesh as a share of the median depth; voxels along a block's side; blocks to begin with.
MESH_SHARE, BLOCK, BLOCKS = 0.004, 16, 10_000
VERTEX = np.dtype(
    [(n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")] + [(n, "u1") for n in ("red", "green", "blue")]
)


def normals_of(depth: np.ndarray, K: np.ndarray) -> np.ndarray:
    """``(H, W, 3)`` unit normals of a depth map in its camera's frame, towards the camera."""
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    points = rays * depth[..., None]
    along = [np.gradient(points, axis=axis) for axis in (0, 1)]
    normals = np.cross(along[0], along[1])
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    away = (normals * rays).sum(-1, keepdims=True) > 0
    return np.where(away, -normals, normals).astype(np.float32)


def kept(frame: DepthFrame) -> np.ndarray:
    """``(H, W)`` pixels that become points: sure or confirmed, never contradicted, not flying."""
    good = (frame.confidence >= LEAST_CONFIDENCE) & ~flying_points(frame.depth)
    if frame.confirmed is not None and frame.asked is not None:
        good &= (frame.confirmed > 0) | (frame.asked == 0)
    return good


def fuse(frames: Sequence[DepthFrame], image: Callable[[str], np.ndarray]) -> tuple[Cloud, np.ndarray]:
    """The cloud of all agreed frames in the world's frame, one point a cell, and its ``(N, 3)`` normals.

    ``image`` gives ``(H, W, 3)`` in [0, 1] by a frame's name.
    """
    cell = CELL_SHARE * float(np.median([np.median(frame.depth) for frame in frames]))
    every_point = np.zeros((0, 9))
    parts: list[np.ndarray] = []
    for number, frame in enumerate(frames, 1):
        parts.append(_points(frame, image(frame.name), cell))
        if number % MERGED_AFTER == 0 or number == len(frames):
            every_point, parts = _thinned(np.concatenate([every_point, *parts]), cell), []
    normals = every_point[:, 3:6]
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Cloud(every_point[:, :3], np.rint(every_point[:, 6:]).astype(np.uint8)), normals


def _points(frame: DepthFrame, image: np.ndarray, cell: float) -> np.ndarray:
    """``(N, 9)`` places, normals and colours of one frame, in the world's frame."""
    mask = kept(frame)
    every = max(1, int(mask.sum()) // MOST_POINTS)
    normals = normals_of(frame.depth, frame.K)[mask] @ frame.E[:3, :3].T
    return _thinned(np.hstack([frame.world(mask), normals, image[mask] * 255])[::every], cell)


def _thinned(rows: np.ndarray, cell: float) -> np.ndarray:
    """The mean of the rows of every cell of a grid over their first three columns."""
    if not len(rows):
        return rows
    cells = np.floor(rows[:, :3] / cell).astype(np.int64)
    cells -= cells.min(0)
    keys = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(0) + 1))
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    sums = [np.bincount(inverse, rows[:, column], len(counts)) for column in range(rows.shape[1])]
    return np.stack(sums, -1) / counts[:, None]


def write_normal_ply(path: Path, cloud: Cloud, normals: np.ndarray, unit: str | None) -> None:
    """Write a cloud with normals as binary PLY."""
    vertices, columns = np.empty(len(cloud.points_m), VERTEX), (cloud.points_m, normals, cloud.colours)
    for name, values in zip(VERTEX.names or (), np.concatenate(columns, axis=1).T, strict=True):
        vertices[name] = values
    kinds = {"<f4": "float", "|u1": "uchar"}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment world frame, {'metres' if unit else 'no unit'}",
        f"element vertex {len(vertices)}",
        *(f"property {kinds[VERTEX[name].str]} {name}" for name in VERTEX.names or ()),
        "end_header\n",
    ]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(lines).encode() + vertices.tobytes())


def write_mesh(path: Path, frames: Sequence[DepthFrame], image: Callable[[str], np.ndarray]) -> None:
    """Write a mesh of all frames by TSDF (extra ``mesh``); ``InputError`` where Open3D is not installed."""
    try:
        import open3d
    except ImportError:
        bad_value("open3d", "installed for a mesh", "missing", "pip install 'geodiff-plugin[mesh]'")
    core, tensors = open3d.core, open3d.t.geometry
    voxel = MESH_SHARE * float(np.median([np.median(frame.depth) for frame in frames]))
    kinds = ("tsdf", "weight", "color"), (core.float32,) * 3, ((1,), (1,), (3,))
    grid = tensors.VoxelBlockGrid(*kinds, voxel, BLOCK, BLOCKS)
    for frame in frames:
        depth = np.where(kept(frame), frame.depth, 0).astype(np.float32)
        colour = np.ascontiguousarray(image(frame.name), np.float32)
        maps = [tensors.Image(core.Tensor(values)) for values in (depth[..., None], colour)]
        K, T = core.Tensor(frame.K.astype(np.float64)), core.Tensor(np.linalg.inv(frame.E))
        reach = 1.0, float(depth.max()) * 1.01 + voxel
        blocks = grid.compute_unique_block_coordinates(maps[0], K, T, *reach)
        grid.integrate(blocks, *maps, K, K, T, *reach)
    mesh = grid.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
    mesh.compute_vertex_normals()
    with atomic_path(path) as temporary:
        open3d.io.write_triangle_mesh(str(temporary), mesh)


def write_colmap_maps(
    folder: Path,
    frames: Sequence[DepthFrame],
    image: Callable[[str], np.ndarray],
    points: np.ndarray,
    seen: Sequence[Observations],
) -> None:
    """Write a dense workspace of COLMAP: images, sparse model, depth (where frames are kept) and normal maps.

    ``points (M, 3)`` are those of the poses' solve, ``seen`` where each of the agreed frames sees them: by
    what frames share COLMAP chooses pairs.

    Convention:
        ``colmap stereo_fusion --workspace_path FOLDER --input_type geometric --output_path fused.ply``
    """
    for name in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps", "stereo/consistency_graphs"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    views, maps, colours = [], folder / "stereo", np.zeros(points.shape, np.uint8)
    for frame, observed in zip(frames, seen, strict=True):
        file, depth = f"{frame.name}.png", np.where(kept(frame), frame.depth, 0).astype(np.float32)
        picture = np.rint(image(frame.name) * 255).astype(np.uint8)
        Image.fromarray(picture).save(folder / "images" / file)
        u, v = np.rint(observed.px).astype(int).T.clip(0, np.array(depth.shape[::-1])[:, None] - 1)
        colours[observed.point] = picture[v, u]
        write_map(maps / "depth_maps" / f"{file}.geometric.bin", depth[..., None])
        write_map(maps / "normal_maps" / f"{file}.geometric.bin", normals_of(frame.depth, frame.K))
        views.append((file, frame.K, frame.E, depth.shape[::-1]))
    rows, counts = np.unique(np.concatenate([observed.point for observed in seen]), return_counts=True)
    rows = rows[counts > 1]
    place = np.full(len(points), -1)
    place[rows] = np.arange(len(rows))
    shared = [place[observed.point] >= 0 for observed in seen]
    tracks = [(o.px[both], place[o.point[both]]) for o, both in zip(seen, shared, strict=True)]
    write_colmap(folder / "sparse", views, Cloud(points[rows], colours[rows]), tracks)
    (maps / "fusion.cfg").write_text("".join(f"{file}\n" for file, *_ in views), encoding="utf-8")
    pairs = "".join(f"{file}\n__auto__, 20\n" for file, *_ in views)
    (maps / "patch-match.cfg").write_text(pairs, encoding="utf-8")


def write_map(path: Path, values: np.ndarray) -> None:
    """Write ``(H, W, C)`` float32 as COLMAP does: a head ``W&H&C&``, then one channel after the other."""
    height, width, channels = values.shape
    data = np.ascontiguousarray(values.transpose(2, 0, 1), dtype="<f4").tobytes()
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + data)
