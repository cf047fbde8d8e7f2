"""What a run leaves behind its frames: agreed depth, one cloud, a mesh, a sheet, a workspace of COLMAP."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageOps

from geodiff_plugin import plotting
from geodiff_plugin._checks import InputFileError, warn
from geodiff_plugin.capture.agreement import agreed, scene_poses, steadied
from geodiff_plugin.capture.frames import Capture, choose_neighbours
from geodiff_plugin.capture.splats import SplatFrame, write_splats
from geodiff_plugin.formats.clouds import Cloud, flying_points, write_glb, write_vertices
from geodiff_plugin.formats.colmap import write_colmap
from geodiff_plugin.formats.depth import write_depth_mm, write_depth_npy
from geodiff_plugin.formats.files import save_png
from geodiff_plugin.formats.out import REPORT, atomic_path, files_of_report, write_text
from geodiff_plugin.formats.transforms import TransformsFile
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.multiview import Observations
from geodiff_plugin.types import DepthFrame

#: Depth and confidence of a frame by its own run, which agreement starts from whenever it is made anew.
ALONE = ("depth_alone", "confidence_alone")
#: Files of a frame after agreement; ``asked`` holds the ``observers`` of ``DepthFrame``.
AGREED = ("depth", "confidence", "confirmed", "asked")
#: Pictures of the depth that agreement makes anew.
FIGURES = ("depth_mm.png", "depth.png")
#: Frames that a frame is checked against.
OTHERS = 6
#: Frames on the contact sheet.
ON_SHEET = 24
#: Points of the GLB at most, few enough for a viewer in a browser.
GLB_POINTS = 400_000
#: Pixels of the video, whose frames are a photograph and its depth side by side.
VIDEO_SIZE = (1280, 480)
#: Frames a second, slow enough to look at each.
VIDEO_FPS = 5.0
#: Points closer than this share of the median depth are one.
CELL_SHARE = 0.004
#: Points of lower confidence are left out of the cloud.
LEAST_CONFIDENCE = 0.5
#: Points of one frame at most; more would not show in a cloud of many frames.
MOST_POINTS = 200_000
#: A voxel of the mesh, as a share of the median depth.
MESH_SHARE = 0.004
#: Voxels along a block's side, Open3D's usual number.
BLOCK = 16
#: Blocks to begin with; Open3D makes room for more.
BLOCKS = 10_000
#: Frames after which their points are merged, so that a long capture fits the memory.
MERGED_AFTER = 20
#: Columns of the cloud.
VERTEX = (*"xyz", "nx", "ny", "nz", "red", "green", "blue")


def _frame(capture: Capture, out: Path, maps: Sequence[str], name: str) -> DepthFrame:
    """A frame of a run, read on demand: all frames of a long capture exceed the memory."""
    depth, confidence, *more = (np.load(out / name / f"{file}.npy") for file in maps)
    solved, i = capture.solve(), capture.names.index(name)
    return DepthFrame(name, depth, confidence, solved.K[i], solved.E[i], *more)


def write_agreement(capture: Capture, out: Path, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Check finished frames against those that see the same, and write the result; pixel shares by frame."""
    solved, number = capture.solve(), {name: i for i, name in enumerate(capture.names)}
    there, shares = {number[name] for name in names}, {}
    load = lru_cache(maxsize=2 * OTHERS)(partial(_frame, capture, out, ALONE))
    for name in names:
        others = [load(capture.names[i]) for i in choose_neighbours(solved, number[name], OTHERS, there)]
        frame = agreed(load(name), others)
        assert frame.confirmed is not None and frame.observers is not None
        _write_agreed(out / name, frame, capture.unit)
        shares[name] = {
            "checked_against": len(others),
            "confirmed": round(float((frame.confirmed > 0).mean()), 4),
            "unconfirmed": round(float(((frame.observers > 0) & (frame.confirmed == 0)).mean()), 4),
        }
    return shares


def _write_agreed(folder: Path, frame: DepthFrame, unit: str | None) -> None:
    write_depth_npy(folder / "depth.npy", frame.depth)
    write_depth_mm(folder / "depth_mm.png", frame.depth * (frame.confidence > 0))
    save_png(plotting.depth_figure(frame.depth, unit=unit), folder / "depth.png")
    for file, values in zip(AGREED[1:], (frame.confidence, frame.confirmed, frame.observers), strict=True):
        assert values is not None  # of agreement
        with atomic_path(folder / f"{file}.npy") as temporary:
            np.save(temporary, values)


class FinishedFrame(NamedTuple):
    """A frame of a video whose own run is finished."""

    folder: Path
    K: np.ndarray  # (3, 3) pixels of its maps
    unit: str | None  # of its depth


def write_steady(frames: Sequence[FinishedFrame], picture: Callable[[int], np.ndarray]) -> list[int]:
    """Write what the finished frames of a video agree on with their neighbours; the scene of each.

    ``picture(i)`` is ``(H, W, 3)`` in [0, 1]. Depth by a frame's own run stays as ``ALONE``, so the same call
    again changes nothing.
    """
    scenes = scene_poses((_alone(frame), picture(i)) for i, frame in enumerate(frames))
    averaged = steadied(scenes, lambda i: _alone(frames[i]))
    for frame, depth in zip(frames, averaged, strict=True):
        _write_agreed(frame.folder, depth, frame.unit)
    return [number for number, poses in enumerate(scenes) for _ in poses]


def save_alone(folder: Path, depth: np.ndarray, confidence: np.ndarray | None) -> None:
    """Save depth and confidence of a frame's own run as ``ALONE``; without a confidence 0.5 everywhere."""
    confidence = np.full_like(depth, 0.5) if confidence is None else confidence
    for file, values in zip(ALONE, (depth, confidence), strict=True):
        with atomic_path(folder / f"{file}.npy") as temporary:
            np.save(temporary, values.astype(np.float32))


def read_agreed(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Depth and confidence ``(H, W)`` of a frame after agreement."""
    depth, confidence = (np.load(folder / f"{file}.npy") for file in AGREED[:2])
    return depth, confidence


def clear_frame(folder: Path) -> None:
    """Remove what a run wrote of a frame; files of others stay, and then the folder."""
    names = [*(f"{file}.npy" for file in (*ALONE, *AGREED)), *FIGURES, *files_of_report(folder), REPORT]
    for path in (folder / name for name in names):
        path.unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def _alone(frame: FinishedFrame) -> DepthFrame:
    """Depth and confidence by the frame's own run, saved as ``ALONE`` on first use."""
    folder = frame.folder
    if not (folder / f"{ALONE[1]}.npy").is_file():
        path = folder / "confidence.npy"
        save_alone(folder, np.load(folder / "depth.npy"), np.load(path) if path.is_file() else None)
    depth, confidence = (np.load(folder / f"{alone}.npy") for alone in ALONE)
    return DepthFrame(folder.name, depth, confidence, frame.K, np.eye(4))


def write_results(
    capture: Capture,
    out: Path,
    names: Sequence[str],
    export: Sequence[str],
    doubted: Sequence[str],
    original: TransformsFile | None,
) -> dict[str, Any]:
    """Write, after ``write_agreement``, clouds, a sheet that marks ``doubted`` frames, ``export``; counts.

    ``original`` is the transforms.json that the capture was read from.
    """
    unsure = set(doubted) if len(doubted) < len(names) else set()  # of these only what another frame confirms

    def load(name: str) -> DepthFrame:
        frame = _frame(capture, out, AGREED, name)
        return replace(frame, observers=np.ones_like(frame.observers)) if name in unsure else frame

    cloud, normals = fuse(names, load, capture.image)
    parts, count = (cloud.points_m, normals, cloud.colours), len(cloud.points_m)
    write_vertices(out / "cloud.ply", "world frame", capture.unit, count, VERTEX, [parts])
    cameras = [(f.K, f.E, f.depth.shape[::-1]) for f in map(load, names)]
    write_glb(out / "cloud.glb", cloud.thinned(GLB_POINTS), cameras)
    if "mesh" in export:
        write_mesh(out / "mesh.ply", names, load, capture.image)
    if "colmap" in export:
        solved = capture.solve()
        seen = [solved.seen[capture.names.index(name)] for name in names]
        write_workspace(out / "colmap", map(load, names), capture.image, solved.points, seen)
    if "nerfstudio" in export:
        write_splats(out / "nerfstudio", capture, names, lambda name: _sure(load(name)), cloud, original)
    _sheet(capture, out, names, doubted)
    _video(capture, out, names)
    return {"cloud_points": count}


def _sure(frame: DepthFrame) -> SplatFrame:
    return SplatFrame(frame, kept(frame))


def _sheet(capture: Capture, out: Path, names: Sequence[str], doubted: Sequence[str]) -> None:
    """A picture of evenly chosen frames and their depth, in the colours of one range where they are alike."""
    shown = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, ON_SHEET).astype(int))]
    depths, unit = [np.load(out / name / "depth.npy") for name in shown], capture.unit
    alike, figure = len({depth.shape for depth in depths}) == 1, partial(plotting.depth_figure, unit=unit)
    figures = plotting.depth_frames(depths, unit=unit) if alike else map(figure, depths)
    cells: list[Any] = []
    for name, drawn in zip(shown, figures, strict=True):
        cells += [capture.image(name), drawn]
    titles = [t for name in shown for t in (name, "depth, not trusted" if name in doubted else "depth")]
    with atomic_path(out / "sheet.jpg") as temporary:
        plotting.grid(cells, titles, columns=min(4, len(cells)), cell_width=360).save(temporary, quality=88)


def _video(capture: Capture, out: Path, names: Sequence[str]) -> None:
    """Every frame beside its depth, all in the colours of one range; frames of other sizes are padded."""
    maps = [np.load(out / name / "depth.npy", mmap_mode="r") for name in names]
    near, far = plotting.depth_range(np.concatenate([depth[::8, ::8].reshape(-1) for depth in maps])[None])

    def frames() -> Iterator[Image.Image]:
        for name, depth in zip(names, maps, strict=True):
            photo, drawn = plotting.as_picture(capture.image(name)), plotting.colour_depth(depth, near, far)
            yield ImageOps.pad(Image.fromarray(np.hstack([np.asarray(photo), drawn])), VIDEO_SIZE)

    try:
        plotting.write_depth_video(out / "video.mp4", frames(), VIDEO_FPS)
    except InputFileError as error:  # an OpenCV without codecs; everything else is there
        warn(Message("capture.no-video", str(error)))


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
    if frame.confirmed is not None and frame.observers is not None:
        good &= (frame.confirmed > 0) | (frame.observers == 0)
    return good


def fuse(
    names: Sequence[str], load: Callable[[str], DepthFrame], image: Callable[[str], np.ndarray]
) -> tuple[Cloud, np.ndarray]:
    """The cloud of all frames in the world's frame, one point a cell, and its ``(N, 3)`` normals.

    ``load`` gives the agreed frame of a name, ``image`` its ``(H, W, 3)`` in [0, 1].
    """
    cell = CELL_SHARE * float(np.median([np.median(load(name).depth) for name in names]))
    every_point, parts = np.zeros((0, 9)), list[np.ndarray]()
    for number, name in enumerate(names, 1):
        frame = load(name)
        mask = kept(frame)
        normals = normals_of(frame.depth, frame.K)[mask] @ frame.E[:3, :3].T
        rows = np.hstack([frame.world(mask), normals, image(name)[mask] * 255])
        parts.append(_thinned(rows[:: max(1, len(rows) // MOST_POINTS)], cell))
        if number % MERGED_AFTER == 0 or number == len(names):
            every_point, parts = _thinned(np.concatenate([every_point, *parts]), cell), []
    normals = every_point[:, 3:6]
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Cloud(every_point[:, :3], np.rint(every_point[:, 6:]).astype(np.uint8)), normals


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


def write_workspace(
    folder: Path,
    frames: Iterable[DepthFrame],
    image: Callable[[str], np.ndarray],
    points: np.ndarray,
    seen: Sequence[Observations],
) -> None:
    """Write a dense workspace of COLMAP: images, sparse model, depth (where it is kept) and normal maps.

    ``points (M, 3)`` are those of the solve, ``seen`` by frame: by what they share COLMAP chooses pairs.
    """
    for name in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps", "stereo/consistency_graphs"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    views, maps, colours = [], folder / "stereo", np.zeros(points.shape, np.uint8)
    for frame, (px, rows) in zip(frames, seen, strict=True):
        picture = plotting.as_picture(image(frame.name))
        save_png(picture, folder / "images" / f"{frame.name}.png")
        u, v = np.rint(px).astype(int).T.clip(0, np.array(picture.size)[:, None] - 1)
        colours[rows] = np.asarray(picture)[v, u]
        depth, file = np.where(kept(frame), frame.depth, 0)[..., None], f"{frame.name}.png.geometric.bin"
        write_map(maps / "depth_maps" / file, depth)
        write_map(maps / "normal_maps" / file, normals_of(frame.depth, frame.K))
        views.append((f"{frame.name}.png", frame.K, frame.E, picture.size))
    rows, counts = np.unique(np.concatenate([each for _, each in seen]), return_counts=True)
    rows = rows[counts > 1]
    place = np.full(len(points), -1)
    place[rows] = np.arange(len(rows))
    tracks = [(px[place[each] >= 0], place[each][place[each] >= 0]) for px, each in seen]
    write_colmap(folder / "sparse", views, Cloud(points[rows], colours[rows]), tracks)
    write_text(maps / "fusion.cfg", "".join(f"{file}\n" for file, *_ in views))
    write_text(maps / "patch-match.cfg", "".join(f"{file}\n__auto__, 20\n" for file, *_ in views))


def write_map(path: Path, values: np.ndarray) -> None:
    """Write ``(H, W, C)`` floats as COLMAP does: a head ``W&H&C&``, then one channel after the other."""
    height, width, channels = values.shape
    data = np.ascontiguousarray(values.transpose(2, 0, 1), dtype="<f4").tobytes()
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + data)


def write_mesh(
    path: Path, names: Sequence[str], load: Callable[[str], DepthFrame], image: Callable[[str], np.ndarray]
) -> None:
    """Write a mesh of all frames by TSDF (extra ``mesh``)."""
    import open3d

    core, tensors = open3d.core, open3d.t.geometry
    voxel = MESH_SHARE * float(np.median([np.median(load(name).depth) for name in names]))
    kinds = ("tsdf", "weight", "color"), (core.float32,) * 3, ((1,), (1,), (3,))
    volume = tensors.VoxelBlockGrid(*kinds, voxel, BLOCK, BLOCKS)
    for frame in map(load, names):
        depth = np.where(kept(frame), frame.depth, 0).astype(np.float32)
        colour = np.ascontiguousarray(image(frame.name), np.float32)
        maps = [tensors.Image(core.Tensor(values)) for values in (depth[..., None], colour)]
        K, T = core.Tensor(frame.K.astype(np.float64)), core.Tensor(np.linalg.inv(frame.E))
        reach = 1.0, float(depth.max()) * 1.01 + voxel
        blocks = volume.compute_unique_block_coordinates(maps[0], K, T, *reach)
        volume.integrate(blocks, *maps, K, K, T, *reach)
    mesh = volume.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
    mesh.compute_vertex_normals()
    with atomic_path(path) as temporary:
        open3d.io.write_triangle_mesh(str(temporary), mesh)
